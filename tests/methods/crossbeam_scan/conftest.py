"""A gantry with a line profiler, and scans of the pocket that it has cut."""

import pytest

from errormotion.methods.crossbeam_scan import simulation
from errormotion.twin import VirtualMachine
from errormotion.twin.sensors.profiler import Disturbances, Profiler


@pytest.fixture(scope="session")
def gantry():
    """One gantry."""
    return VirtualMachine("gantry", seed=3)


@pytest.fixture(scope="session")
def scan_pocket(gantry):
    """Return x, heights and stage of scans of the pocket at heights of the spindle."""

    def scan(seed, disturbances=None, *, lifts=(0.166, 0.182), lines=80):
        profiler = Profiler(disturbances=Disturbances() if disturbances is None else disturbances)
        feed = 28e-3 / lines
        raw = simulation.raw_pocket(gantry, seed=seed, lifts=lifts, profiler=profiler, profiles=lines, feed=feed)
        return raw["x"].values, raw["height"].values.astype(float), raw["stage"].values

    return scan
