"""Scans of a carriage that turns: what the maps show, and what the neighbours add."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from errormotion.kinematics.twists import transform
from errormotion.methods.crossbeam_scan import calibration, chain, strain

T = 7200.0
PLACES = np.linspace(-0.7, 0.7, 8)
#: of a swept free form under the noise of a real profiler: (T, r, g), m and rad; EA and g_z are hard to tell apart
SIGMA = np.array([30e-9, 40e-9, 20e-9, 20e-6, 0.6e-6, 3e-6, 3e-6, 2e-6, 20e-6])


@pytest.fixture
def H(gantry):
    """The true pose of the profiler."""
    return RigidTransform.from_matrix(gantry.crossbeam.pose)


@pytest.fixture
def to_profiler(gantry, H):
    """What takes twists of the carriage to those of the profiler."""
    return np.linalg.inv(chain.carriage_adjoint(H, gantry.crossbeam.lever))


def drift(gantry, to_profiler, places):
    """Return g (n, 3): the true change of T per metre."""
    step = 1e-3
    there, back = (transform(gantry.crossbeam.twist(T, places + d), to_profiler) for d in (step, -step))
    return (there - back)[:, :3] / (2 * step)


def covariance(n, correlation=0.0):
    C = np.diag(SIGMA**2)
    for i, j in ((3, 8), (5, 6)):
        C[i, j] = C[j, i] = correlation * SIGMA[i] * SIGMA[j]
    return np.tile(C, (n, 1, 1))


def displacement_of_map(H, twist, g, Q):
    """Return how a point Q of the map moves, by the geometry of the lines: from the definition."""
    f = chain.feed_direction(H)
    x, s, z = Q

    def seen(point, along):  # the map's coordinates of a point of the profiler's frame
        way = along + point[1] / f[1]
        return np.array([point[0] - point[1] / f[1] * f[0], way, point[2] - point[1] / f[1] * f[2]])

    moved = np.array([x, 0, z]) + twist[:3] + np.cross(twist[3:], [x, 0, z]) + s * g
    return seen(moved, s) - Q


def test_maps_move_as_the_matrix_says():
    H = calibration.pose(0.02, -0.015, 0.03, 0.0, 0.0, 0.0)
    rng = np.random.default_rng(1)
    W = strain.from_maps(H)
    for o in rng.normal(0, 1e-5, (5, 9)):
        TQ, RQ, c = np.split(np.linalg.solve(W, o), 3)
        for Q in rng.uniform(-0.03, 0.03, (5, 3)) * [1, 1, 0.05]:
            there = displacement_of_map(H, o[:6], o[6:], Q)
            stated = TQ + np.cross(RQ, Q) + Q[1] * c
            # what no rotation describes: 0.03 rad of 1e-5 rad over 20 mm in x, of which nothing is left in z
            assert there == pytest.approx(stated, abs=0.04 * 3e-5 * 0.03)
            assert there[2] == pytest.approx(stated[2], abs=0.04 * 3e-5 * 1.5e-3 + 1e-13)


def test_a_square_profiler_changes_nothing_but_the_drift():
    W = strain.from_maps(RigidTransform.identity())
    assert W[:6] == pytest.approx(np.eye(6, 9))
    # a rigid picture: no displacement beside the rotation, so that g is what the rotation does along the feed
    assert (W @ [0, 0, 0, 1, 2, 3, 0, 0, 0])[6:] == pytest.approx([-3, 0, 1])


def test_drift_is_the_slope_of_the_profilers_place(gantry, H, to_profiler):
    lever = gantry.crossbeam.lever
    slope = (gantry.crossbeam.twist(T, PLACES + 1e-3) - gantry.crossbeam.twist(T, PLACES - 1e-3)) / 2e-3
    by_hand = slope[:, :3] + np.cross(slope[:, 3:], lever + H.translation)
    assert drift(gantry, to_profiler, PLACES) == pytest.approx(H.rotation.inv().apply(by_hand), abs=1e-12)


def test_neighbours_tell_roll_from_drift(gantry, to_profiler):
    truth = transform(gantry.crossbeam.twist(T, PLACES), to_profiler)
    o = np.concatenate([truth, drift(gantry, to_profiler, PLACES)], axis=1)
    C = covariance(8, correlation=-0.99)
    rng = np.random.default_rng(2)
    root = np.linalg.cholesky(C[0])
    squares = np.zeros(6)
    for _ in range(200):
        found = strain.combined(o + rng.normal(size=(8, 9)) @ root.T, C, PLACES)
        squares += np.mean((found.twist - truth) ** 2 / np.diagonal(found.covariance, axis1=1, axis2=2), axis=0) / 200
    alone = strain.combined(o, C, PLACES, neighbours=False)
    assert np.sqrt(found.covariance[4, 3, 3]) < 0.3 * np.sqrt(alone.covariance[4, 3, 3])
    # 1600 squares of each freedom, the neighbours' correlated: 1 +- 0.06; the spline's error is counted and not there
    assert squares == pytest.approx(1, abs=0.2)


def test_exact_motions_come_back(gantry, to_profiler):
    truth = transform(gantry.crossbeam.twist(T, PLACES), to_profiler)
    o = np.concatenate([truth, drift(gantry, to_profiler, PLACES)], axis=1)
    found = strain.combined(o, covariance(8), PLACES)
    # the twin bends as cubics do, which the spline follows
    assert found.twist == pytest.approx(truth, abs=1e-11)


def test_what_the_spline_misses_is_counted():
    bent = np.zeros((8, 9))
    bent[:, 2] = 1e-6 * np.sin(2 * np.pi * PLACES / 0.8)  # one wave over four artefacts
    bent[:, 8] = 1e-6 * 2 * np.pi / 0.8 * np.cos(2 * np.pi * PLACES / 0.8)
    found = strain.combined(bent, covariance(8), PLACES)
    missed = np.abs(strain.slopes(PLACES)[0] @ bent[:, 2] - bent[:, 8])
    assert 0.5 * np.sqrt(np.mean(missed**2)) < found.slope_error[2] < 5 * np.sqrt(np.mean(missed**2))


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_any_number_of_artefacts_will_do(n, gantry, to_profiler):
    truth = transform(gantry.crossbeam.twist(T, PLACES[:n]), to_profiler)
    o = np.concatenate([truth, drift(gantry, to_profiler, PLACES[:n])], axis=1)
    found = strain.combined(o, covariance(n), PLACES[:n])
    assert found.twist.shape == (n, 6)
    miss = np.abs(found.twist - truth) / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert miss.max() < 2.0
