"""All scans of a campaign registered: what is said of maps that are too coarse."""

import numpy as np
import pytest

from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.conformance import subjects
from errormotion.methods.crossbeam_scan.identification.cutting import Scans
from errormotion.methods.crossbeam_scan.identification.registration import prepare, register
from errormotion.methods.crossbeam_scan.identification.registrations import (
    STRAINS,
    Registrations,
    _of_strains,
    register_all,
)
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
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
    found = register_all(Scans(raw), [0], 0.5e-6, CrossbeamScanSettings())
    assert len(found.doubts) == notes
    assert all("Reduce the pitch of points and lines" in note for note in found.doubts)


def test_error_of_a_registration_by_strains_that_it_does_not_estimate():
    """Pictures that a warm profiler, or a warm artefact, has of one surface are registered as rigid ones."""
    x, y = 25e-6 * (np.arange(480) - 200), 70e-6 * (np.arange(240) - 100)
    X, Y = np.meshgrid(x, y)

    def surface(x, y):
        return 1e-3 * np.sin(600 * x + 100 * y) + 1e-3 * np.cos(500 * y - 80 * x) + 3e-3

    cold, e = prepare(surface(X, Y), x, y), 100e-6
    # A strain enlarges the warm picture to that of the cold scan.
    pictures = {
        "scale_x": surface((1 + e) * X, Y),
        "scale_z": surface(X, Y) / (1 + e),
        "expansion": surface((1 + e) * X, (1 + e) * Y) / (1 + e),
    }
    for k, name in enumerate(STRAINS):
        warm = prepare(pictures[name], x, y)
        found = register(cold, warm, point=np.zeros(3), line_effects=False)
        effect = _of_strains(cold, warm, found)[:, k]
        tight = register(cold, warm, point=np.zeros(3), line_effects=False, extra={name: 1e-9})
        as_estimated = -tight.joint_covariance[:6, 6] / 1e-18
        for part in (slice(0, 3), slice(3, 6)):
            expected = e * effect[part]
            assert found.twist[part] == pytest.approx(expected, abs=0.02 * np.abs(expected).max())
            assert as_estimated[part] == pytest.approx(effect[part], abs=0.02 * np.abs(effect[part]).max())


def test_the_rounding_of_registrations_by_other_software_is_part_of_their_uncertainty():
    raw, _ = next(each for each in subjects() if each.name == "registrations").make(0)
    step = 1e-6
    before = raw["displacement"]
    rounded = raw.assign(displacement=(before.dims, np.round(before.values / step) * step, before.attrs))
    exact, found = Registrations.stated(raw), Registrations.stated(rounded)
    added = (found.covariance - exact.covariance)[1:]
    assert added[..., :3, :3] == pytest.approx(np.broadcast_to(step**2 / 12 * np.eye(3), added[..., :3, :3].shape))
    assert not added[..., 3:, :].any()
    assert (found.covariance[0] == 0).all()
    assert exact.notes == []
    assert "multiples of 1 um" in found.notes[0]
