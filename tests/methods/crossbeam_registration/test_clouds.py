"""Registration through Open3D, and what it says when that is not there."""

import sys

import needed_open3d
import numpy as np
import pytest
from coded import raises

from errormotion.errors import MethodError
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification.registration import clouds, prepare, register

TWIST = np.array([23e-6, -41e-6, 17e-6, 30e-6, -55e-6, 80e-6])


@pytest.fixture(scope="module")
def small_pair(make_scanner):
    """Return a pair of scans of 10 mm x 14 mm, one of the points missing."""
    scanner = make_scanner(rows=200, columns=800)
    rng = np.random.default_rng(0)
    cold, warm = scanner.scan(rng), scanner.scan(rng, poses.displaced(TWIST))
    cold[0][3, 5] = np.nan
    return prepare(*cold), prepare(*warm)


@pytest.fixture(scope="module")
def _open3d(small_pair):
    # The pair first: numba warns where it starts its threads after Open3D has loaded a TBB of its own.
    needed_open3d.open3d()


@pytest.fixture(scope="module")
def found(small_pair, _open3d):
    """Return what each of the backends finds for the pair."""
    return {name: register(*small_pair, registration=name, point=np.zeros(3)) for name in ("open3d_plane", "paper")}


def test_points_are_those_with_a_value(small_pair):
    cold, _ = small_pair
    z, x, y = cold.scan
    points = clouds.points_of(cold.scan)
    assert points.shape == (z.size - 1, 3)
    np.testing.assert_array_equal(points[0], [x[0], y[0], z[0, 0]])
    trimmed = clouds.points_of(cold.scan, clouds.EDGE)
    assert np.ptp(trimmed[:, 0]) == pytest.approx(np.ptp(x) - 2 * 250e-6)


def test_every_backend_states_what_its_pose_is_worth(small_pair, found):
    best = register(*small_pair, point=np.zeros(3))
    for backend, result in found.items():
        error = result.twist - TWIST
        assert result.backend == backend
        # Its own error, as the height map sees it, is in the covariance: no freedom off by more than 4 sigma.
        assert np.abs(error / result.sigma).max() < 4
        assert (result.sigma >= 0.99 * best.sigma).all()
        # Millions of neighbour distances do not make the pose better: they are as long as the points are apart.
        assert result.rms > 20 * best.rms


def test_the_published_chain_locks_to_the_points_and_its_rms_does_not_tell(found):
    plane, chain = found["open3d_plane"], found["paper"]
    off_plane, off_chain = np.abs(plane.twist - TWIST)[:3].max(), np.abs(chain.twist - TWIST)[:3].max()
    assert off_chain > 10 * off_plane
    assert chain.rms < plane.rms


@pytest.mark.usefixtures("_open3d")
def test_clouds_without_a_common_part_are_refused(small_pair):
    points = clouds.points_of(small_pair[0].scan)[::20]
    with raises("registration.clouds.apart"):
        clouds.plane_icp(points, points + np.array([0.0, 0.0, 0.1]))


@pytest.mark.usefixtures("_open3d")
def test_a_list_of_points_is_no_cloud():
    with pytest.raises(MethodError, match=r"\(n, 3\)"):
        clouds.plane_icp(np.zeros((5, 2)), np.zeros((5, 2)))


def test_a_missing_open3d_is_named_with_its_extra(small_pair, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MethodError, match=r"errormotion\[open3d\]"):
        register(*small_pair, registration="open3d_plane")
