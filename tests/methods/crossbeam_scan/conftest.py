"""A gantry with a line profiler, and scans of the pocket that it has cut."""

from contextlib import contextmanager
from dataclasses import replace

import pytest

from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.identification import registrations
from errormotion.twin import VirtualMachine
from errormotion.twin.sensors.profiler import Disturbances, Profiler


@pytest.fixture(scope="session")
def gantry():
    """One gantry."""
    return VirtualMachine("gantry", seed=3)


@pytest.fixture(scope="session")
def scan_pocket(gantry):
    """Return x, heights and stage of scans of the pocket at heights of the spindle."""

    def scan(seed, disturbances=None, *, lifts=(0.166, 0.182), lines=80, points=3200, machine=gantry):
        disturbances = Disturbances() if disturbances is None else disturbances
        profiler = Profiler(points, 40e-3 / points, disturbances=disturbances)
        feed = 28e-3 / lines
        raw = simulation.raw_pocket(machine, seed=seed, lifts=lifts, profiler=profiler, profiles=lines, feed=feed)
        return raw["x"].values, raw["height"].values.astype(float), raw["stage"].values

    return scan


@pytest.fixture(scope="session")
def remembering():
    """Return a context in which no scan is reduced to blocks twice, and no pair of scans is registered twice.

    It is for campaigns of which some scans are altered. All settings of the registration except ``strain`` are equal,
    and it is by height maps: the points themselves are not kept.
    """

    @contextmanager
    def context():
        blocks, pairs = {}, {}
        reduce, register = registrations.prepare, registrations._register

        def prepare(height, x, y, scans):
            key = hash(height.tobytes()), hash(y.tobytes())
            if key not in blocks:
                blocks[key] = replace(reduce(height, x, y, scans), scan=())
            return blocks[key]

        def registered(cold, warm, settings):
            key = id(cold), id(warm), settings.strain == "rigid"
            if key not in pairs:
                pairs[key] = register(cold, warm, settings)
            return pairs[key]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(registrations, "prepare", prepare)
            patch.setattr(registrations, "_register", registered)
            yield

    return context
