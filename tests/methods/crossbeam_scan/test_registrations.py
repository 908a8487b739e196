"""All scans of a campaign registered: what is said of maps that are too coarse."""

import numpy as np
import pytest

from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.identification.cutting import Scans
from errormotion.methods.crossbeam_scan.identification.registration import prepare
from errormotion.methods.crossbeam_scan.identification.registrations import register_all
from errormotion.methods.crossbeam_scan.settings import Settings
from errormotion.twin.sensors.profiler import Profiler


def test_bending_of_a_block_is_that_of_its_parabola():
    x, y = 25e-6 * np.arange(400), 70e-6 * np.arange(200)
    z = np.broadcast_to(0.5 * 30.0 * (x - x.mean()) ** 2, (200, 400))  # 30 per metre
    block = x[:16]
    assert prepare(z, x, y).bending == pytest.approx(np.std(0.5 * 30.0 * (block - block.mean()) ** 2), rel=0.01)


@pytest.mark.parametrize(("pitch", "notes"), [(25e-6, 0), (50e-6, 1)])
def test_points_too_far_apart_for_the_relief_are_reported(gantry, pitch, notes):
    profiler = Profiler(400, pitch)
    raw = simulation.raw_scans(gantry, [0, 3600], [0.1], seed=1, profiler=profiler, profiles=200, feed=70e-6)
    found = register_all(Scans(raw), [0], 0.5e-6, Settings())
    assert len(found.notes) == notes
    assert all("Reduce the pitch of points and lines" in note for note in found.notes)
