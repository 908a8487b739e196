"""Zero point of the beam."""

import numpy as np
import pytest

from errormotion.methods.beam_direction.identification.compensation import Planes, uncompensated
from errormotion.methods.beam_direction.identification.origin import locate
from errormotion.methods.beam_direction.identification.propagation import expected_beam, propagate
from errormotion.methods.beam_direction.identification.slopes import expected_covariance

U = np.array([0.34, 0.02, -0.94])
U /= np.linalg.norm(U)
P0 = np.array([0.05, -0.01, 0.2])
NOISE, POINT_U = 0.1e-6, 1e-6
PLACE = np.array([0.1, 0.05, -0.1])
STAGE = PLACE + np.concatenate([np.outer(np.linspace(-5e-3, 5e-3, 12), e) for e in np.eye(3)])


def normal(inclination, rotation):
    a, b = np.radians([inclination, rotation])
    return np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


NORMALS = np.array([normal(20, 0), normal(20, 90), normal(20, 180), normal(35, 45)])
POINTS = np.tile(P0 + PLACE + 4e-3 * U, (4, 1))
C = expected_covariance(STAGE, NOISE)


def planes(rng=None, normals=NORMALS):
    """Return the gradients and offsets of planes through the points; with noise if a generator is passed."""
    g = -normals / (normals @ U)[:, None]
    points = POINTS[: len(g)]
    y = np.column_stack([g, np.sum(g * (P0 - points), axis=1)])
    if rng is not None:
        y = y + rng.multivariate_normal(np.zeros(4), C, len(g))
        # A plane that lies off its point by delta along its normal reads g.P of its true place.
        y[:, 3] -= np.linalg.norm(g, axis=1) * rng.normal(0, POINT_U, len(g))
    names = tuple(f"Plane {i + 1}" for i in range(len(g)))
    return Planes(names, y[:, :3], y[:, 3], np.tile(C, (len(g), 1, 1)))


def located(found, points=POINTS, point_uncertainty=POINT_U):
    settled = uncompensated(found, U)
    return settled, locate(settled.direction, found.offsets, found.covariances, points, point_uncertainty)


def test_exact_planes_determine_the_zero_point():
    _, origin = located(planes())
    np.testing.assert_allclose(origin.origin, P0, atol=1e-12)
    assert origin.chi2 < 1e-9


def test_any_points_on_the_planes_are_accepted():
    aside = POINTS + np.array([np.cross(n, [0.1, 0.7, 0.2]) * 0.02 for n in NORMALS])
    np.testing.assert_allclose(located(planes(), aside)[1].origin, P0, atol=1e-12)


@pytest.mark.parametrize("count", [3, 4])
def test_covariance_is_the_scatter_over_seeds(count):
    rng, miss = np.random.default_rng(count), []
    for _ in range(300):
        settled, origin = located(planes(rng, NORMALS[:count]), POINTS[:count])
        miss.append([*(origin.origin - P0), *(settled.direction.direction - U)])
    covariance = propagate(settled, origin, POINT_U).covariance
    # Rank 5, since the direction keeps its length: 300 seeds of chi-square with five degrees of freedom.
    scale = np.sqrt(np.diag(covariance))
    inverse = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-9, hermitian=True)
    nees = np.einsum("si,ij,sj->s", miss / scale, inverse, miss / scale)
    assert nees.mean() == pytest.approx(5, abs=3.5 * np.sqrt(10 / 300))


def test_expected_covariance_is_that_of_the_estimate():
    settled, origin = located(planes())
    found = propagate(settled, origin, POINT_U).covariance
    stages = [STAGE] * 4
    expected = expected_beam(stages, NORMALS, U, NOISE, origin=P0, points=POINTS, point_uncertainty=POINT_U)
    np.testing.assert_allclose(expected.covariance, found, rtol=1e-6, atol=1e-20)
    assert np.isnan(expected_beam(stages, NORMALS, U, NOISE).covariance[:3]).all()


def test_derivatives():
    found = planes(np.random.default_rng(1))
    _, origin = located(found)
    y = np.column_stack([found.gradients, found.offsets])
    for k in range(4):
        for i, step in enumerate([1e-6, 1e-6, 1e-6, 1e-9]):
            moved = []
            for sign in (1, -1):
                z = y.copy()
                z[k, i] += sign * step
                moved.append(located(Planes(found.names, z[:, :3], z[:, 3], found.covariances))[1].origin)
            scale = np.abs(origin.by_reading[..., i]).max()
            np.testing.assert_allclose(
                (moved[0] - moved[1]) / (2 * step), origin.by_reading[:, k, i], atol=2e-3 * scale
            )
        shifted = [
            located(found, POINTS + sign * 1e-6 * np.outer(np.arange(4) == k, NORMALS[k]))[1].origin for sign in (1, -1)
        ]
        np.testing.assert_allclose((shifted[0] - shifted[1]) / 2e-6, origin.by_point[:, k], atol=1e-3)


def test_a_plane_without_a_known_point_contributes_only_to_the_direction():
    points = POINTS.copy()
    points[3] = np.nan
    _, origin = located(planes(), points)
    np.testing.assert_allclose(origin.origin, P0, atol=1e-12)
    assert np.isnan(origin.misfit).tolist() == [False] * 3 + [True]


def test_two_planes_do_not_determine_the_zero_point():
    points = POINTS.copy()
    points[2:] = np.nan
    assert located(planes(), points)[1] is None


def test_coplanar_normals_do_not_determine_the_zero_point():
    normals = np.array([normal(20, 0), normal(20, 180), normal(5, 0)])
    off = np.array([0.3, 0.3, -0.9])
    off /= np.linalg.norm(off)
    g = -normals / (normals @ off)[:, None]
    found = Planes(("Plane 1", "Plane 2", "Plane 3"), g, np.zeros(3), np.tile(C, (3, 1, 1)))
    settled = uncompensated(found, off)
    assert locate(settled.direction, np.zeros(3), found.covariances, POINTS[:3], POINT_U) is None


def test_a_wrong_point_increases_chi2():
    points = POINTS + 30 * POINT_U * np.outer(np.arange(4) == 1, NORMALS[1])
    assert located(planes(), points)[1].chi2 > 30
