"""Scans of a carriage that turns: what the maps show, and what a guide adds."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from errormotion.kinematics.twists import transform
from errormotion.methods.crossbeam_scan.identification import chain, strain
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration

T = 7200.0
PLACES = np.linspace(-0.7, 0.7, 8)
#: of (T, r) by a registration alone, m and rad: pitch shows by the relief only
SIGMA = np.array([30e-9, 40e-9, 20e-9, 3e-6, 0.1e-6, 0.3e-6])


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


def covariance(n):
    return np.tile(np.diag(SIGMA**2), (n, 1, 1))


def displacement_of_map(H, twist, g, Q):
    """Return how a point Q of the map moves, by the geometry of the lines: from the definition."""
    f = chain.feed_direction(H)
    x, s, z = Q

    def seen(point, along):  # the map's coordinates of a point of the profiler's frame
        way = along + point[1] / f[1]
        return np.array([point[0] - point[1] / f[1] * f[0], way, point[2] - point[1] / f[1] * f[2]])

    moved = np.array([x, 0, z]) + twist[:3] + np.cross(twist[3:], [x, 0, z]) + s * g
    return seen(moved, s) - Q


def test_maps_move_according_to_the_matrix():
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


def test_drift_is_the_slope_of_the_profiler_position(gantry, H, to_profiler):
    lever = gantry.crossbeam.lever
    slope = (gantry.crossbeam.twist(T, PLACES + 1e-3) - gantry.crossbeam.twist(T, PLACES - 1e-3)) / 2e-3
    by_hand = slope[:, :3] + np.cross(slope[:, 3:], lever + H.translation)
    assert drift(gantry, to_profiler, PLACES) == pytest.approx(H.rotation.inv().apply(by_hand), abs=1e-12)


def test_guide_determines_pitch_and_yaw(gantry, H, to_profiler):
    A = np.linalg.inv(to_profiler)
    truth = transform(gantry.crossbeam.twist(T, PLACES), to_profiler)
    rng = np.random.default_rng(2)
    squares = np.zeros(6)
    for _ in range(200):
        found = strain.guided(truth + rng.normal(0, SIGMA, (8, 6)), covariance(8), PLACES, A, 0.1e-6)
        squares += np.mean((found.twist - truth) ** 2 / np.diagonal(found.covariance, axis1=1, axis2=2), axis=0) / 200
    # EZ of the carriage is known to 0.9 m * 0.1 urad, its slope over 0.2 m to some 0.5 urad
    assert np.sqrt(found.covariance[4, 3, 3]) < 0.3 * SIGMA[3]
    assert found.covariance[4, 5, 5] < SIGMA[5] ** 2
    # 1600 squares of each freedom: 1 +- 0.04, those of neighbours correlated; the spline's error is counted, not there
    assert np.all(squares < 1.2)
    assert squares[[0, 1, 2, 4]] == pytest.approx(1, abs=0.2)


def test_carriage_on_its_guide_is_not_changed(gantry, to_profiler):
    truth = transform(gantry.crossbeam.twist(T, PLACES), to_profiler)
    found = strain.guided(truth, covariance(8), PLACES, np.linalg.inv(to_profiler), 1e-7)
    # the twin bends as cubics do, which the spline follows
    assert found.twist == pytest.approx(truth, abs=1e-11)


def test_error_of_the_spline_is_included():
    bent = np.zeros((8, 6))
    bent[:, 2] = 1e-6 * np.sin(2 * np.pi * PLACES / 0.8)  # one wave over four artefacts
    slope = 1e-6 * 2 * np.pi / 0.8 * np.cos(2 * np.pi * PLACES / 0.8)
    found = strain.guided(bent, covariance(8), PLACES, np.eye(6), 1e-9)
    missed = np.sqrt(np.mean((strain.slopes(PLACES)[0] @ bent[:, 2] - slope) ** 2))
    assert 0.5 * missed < found.slope_error[0] < 5 * missed
    assert found.slope_error[1] == 0


def test_noise_and_assumptions_together_are_the_covariance(gantry, to_profiler):
    truth = transform(gantry.crossbeam.twist(T, PLACES), to_profiler)
    C = covariance(8)
    found = strain.guided(truth, C, PLACES, np.linalg.inv(to_profiler), 1e-6)
    noise = np.einsum("ika,kab,jkb->ij", found.gain.reshape(48, 8, 6), C, found.gain.reshape(48, 8, 6))
    whole = noise + found.assumed.T @ found.assumed
    for k in range(8):
        block = slice(6 * k, 6 * k + 6)
        scale = np.outer(SIGMA, SIGMA)
        np.testing.assert_allclose(whole[block, block] / scale, found.covariance[k] / scale, atol=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_any_number_of_artefacts_is_accepted(n, gantry, to_profiler):
    truth = transform(gantry.crossbeam.twist(T, PLACES[:n]), to_profiler)
    found = strain.guided(truth, covariance(n), PLACES[:n], np.linalg.inv(to_profiler), 1e-6)
    miss = np.abs(found.twist - truth) / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert miss.shape == (n, 6)
    assert miss.max() < 2.0
