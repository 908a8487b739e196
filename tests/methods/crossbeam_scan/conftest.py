"""A gantry with a line profiler, and scans of the pocket that it has cut."""

import numpy as np
import pytest

from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts import circular_pocket
from errormotion.twin.profiler import Disturbances, Profiler

RADIUS = 12.496e-3


@pytest.fixture(scope="session")
def gantry():
    """One gantry."""
    return VirtualMachine("gantry", seed=3)


@pytest.fixture(scope="session")
def scan_pocket(gantry):
    """Return x, heights and stage of scans of the pocket at heights of the spindle."""

    def scan(seed, disturbances=None, *, lifts=(0.166, 0.182), lines=80):
        profiler = Profiler(disturbances=Disturbances() if disturbances is None else disturbances)
        along = (np.arange(lines) - (lines - 1) / 2) * 28e-3 / lines
        pocket = circular_pocket(RADIUS)
        height, stage, _ = gantry.crossbeam.pocket_scans(pocket, profiler, along, np.array(lifts), (seed,))
        return profiler.x, height, stage

    return scan
