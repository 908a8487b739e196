"""The direction of a beam from gradients on planes."""

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize

from errormotion.errors import MethodError
from errormotion.kinematics.beams import across, turned
from errormotion.methods.beam_direction.identification.direction import bound, solve
from errormotion.methods.beam_direction.identification.slopes import fit_plane_readings, gradient_covariance

U = np.array([0.34, 0.02, -0.94])
U /= np.linalg.norm(U)
NOMINAL = np.array([np.sin(np.radians(20)), 0, -np.cos(np.radians(20))])
NOISE = 0.1e-6
STAGE = np.concatenate([np.outer(np.linspace(-5e-3, 5e-3, 12), e) for e in np.eye(3)])
S = gradient_covariance(STAGE, NOISE)


def normal(inclination, rotation):
    a, b = np.radians([inclination, rotation])
    return np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


PAIR = np.array([normal(20, 0), normal(20, 90)])
THREE = np.array([normal(20, 0), normal(20, 90), normal(20, 180)])
FIVE = np.array([normal(20, 0), normal(20, 90), normal(20, 180), normal(35, 45), normal(5, 270)])


SETS = {2: PAIR, 3: THREE, 5: FIVE}


def gradients_of(normals, u=U):
    return -normals / (normals @ u)[:, None]


def noisy(normals, seed, scale=1.0):
    g = gradients_of(normals)
    return g + scale * np.random.default_rng(seed).multivariate_normal(np.zeros(3), S, len(g))


def all_of(normals):
    return np.tile(S, (len(normals), 1, 1))


@pytest.mark.parametrize("normals", [PAIR, THREE, FIVE])
def test_exact_gradients_determine_the_direction(normals):
    found = solve(gradients_of(normals), all_of(normals), NOMINAL)
    np.testing.assert_allclose(found.direction, U, atol=1e-12)
    np.testing.assert_allclose(found.gradients_fitted @ U, -1, atol=1e-12)
    assert found.chi2 < 1e-9


@given(st.lists(st.tuples(st.floats(5, 60), st.floats(0, 360)), min_size=2, max_size=5), st.floats(0, 30))
def test_any_planes_that_determine_the_beam_are_accepted(planes, lean):
    u = -normal(lean, 200.0)
    normals = np.array([normal(*plane) for plane in planes])
    assume((normals @ u < -0.2).all())
    spread, vectors = np.linalg.eigh(normals.T @ normals)
    # Not parallel; and the beam not in the plane of all normals, where the two roots would merge.
    assume(spread[1] > 0.01)
    assume(spread[0] > 0.01 or abs(vectors[:, 0] @ u) > 0.1)
    found = solve(gradients_of(normals, u), all_of(normals), u)
    np.testing.assert_allclose(found.direction, u, atol=1e-8)


def test_no_other_gradients_are_more_likely():
    """The solution agrees with a general optimiser of the full problem: direction and all true gradients."""
    g, W = noisy(FIVE, 1), np.linalg.inv(S)
    found = solve(g, all_of(FIVE), NOMINAL)

    def gradients_at(p):
        u = turned(found.direction, p[:2] * 1e-5)
        free = found.gradients_fitted + p[2:].reshape(-1, 3) * 1e-5
        return free - np.outer((free @ u + 1), u)  # any gradient, then shifted so that it meets its condition

    def deviance(p):
        off = g - gradients_at(p)
        return np.einsum("ki,ij,kj->", off, W, off)

    best = minimize(deviance, np.zeros(2 + 15), method="BFGS", options={"gtol": 1e-6})
    assert deviance(np.zeros(17)) == pytest.approx(found.chi2, rel=1e-9)
    assert best.fun == pytest.approx(found.chi2, rel=1e-6)


@cache
def repeated(number):
    """Return the directions by 400 noisy measurements of the set of planes with this number."""
    normals = SETS[number]
    return [solve(noisy(normals, seed), all_of(normals), NOMINAL) for seed in range(400)]


@pytest.mark.parametrize("number", SETS)
def test_scatter_agrees_with_the_bound_and_the_stated_covariance(number):
    found, normals = repeated(number), SETS[number]
    basis = across(U)
    miss = np.array([f.direction - U for f in found]) @ basis.T
    limit = basis @ bound([STAGE] * len(normals), normals, U, NOISE) @ basis.T
    # 400 seeds: e' C^-1 e is 2 with a standard deviation of sqrt(4 / 400) = 0.1.
    assert np.einsum("si,ij,sj->s", miss, np.linalg.inv(limit), miss).mean() == pytest.approx(2, abs=0.35)
    np.testing.assert_allclose(basis @ found[0].covariance @ basis.T, limit, rtol=0.01)
    assert np.linalg.matrix_rank(found[0].covariance, tol=1e-14) == 2


@pytest.mark.parametrize("k", [3, 5])
def test_closure_is_chi_square(k):
    found = repeated(k)
    assert found[0].freedom == k - 2
    assert np.mean([f.chi2 for f in found]) == pytest.approx(k - 2, abs=3.5 * np.sqrt(2 * (k - 2) / 400))
    z = np.array([f.closure / f.closure_u for f in found])
    np.testing.assert_allclose(np.mean(z**2, axis=0), 1, atol=3.5 * np.sqrt(2 / 400))


def test_derivative_with_respect_to_the_gradients():
    g = noisy(FIVE, 3)
    found = solve(g, all_of(FIVE), NOMINAL)
    for k in range(5):
        for i in range(3):
            step = np.zeros((5, 3))
            step[k, i] = 1e-6
            ahead, behind = (solve(g + sign * step, all_of(FIVE), NOMINAL).direction for sign in (1, -1))
            # Relative to the largest entry: residuals of 1e-5 make the curvature that the derivative leaves out.
            np.testing.assert_allclose((ahead - behind) / 2e-6, found.by_gradient[:, k, i], atol=1e-4)


def test_two_planes_have_two_roots_and_the_nominal_direction_selects_one():
    g = gradients_of(PAIR)
    first = solve(g, all_of(PAIR), NOMINAL)
    np.testing.assert_allclose(g @ first.other_root, -1, atol=1e-12)
    second = solve(g, all_of(PAIR), first.other_root)
    np.testing.assert_allclose(second.direction, first.other_root, atol=1e-12)
    np.testing.assert_allclose(second.other_root, U, atol=1e-12)
    assert (first.closure_u == 0).all()


def test_three_planes_have_one_root():
    assert solve(noisy(THREE, 0), all_of(THREE), NOMINAL).other_root is None


def test_planes_can_exclude_the_root_closer_to_the_nominal_direction():
    mirror = solve(gradients_of(PAIR), all_of(PAIR), NOMINAL).other_root
    between = U + 1.01 * mirror
    np.testing.assert_allclose(solve(gradients_of(THREE), all_of(THREE), between).direction, U, atol=1e-9)


def refused(match, gradients, nominal=NOMINAL, covariances=None):
    with pytest.raises(MethodError, match=match):
        solve(gradients, all_of(gradients) if covariances is None else covariances, nominal)


def test_one_plane_is_refused():
    refused("Expected two or more planes .*; found 1", gradients_of(PAIR[:1]))


@pytest.mark.parametrize("angle", [0.0, 1e-5])
def test_parallel_planes_are_refused_with_the_undetermined_freedom(angle):
    normals = np.array([normal(20, 0), normal(20 + np.degrees(angle), 0), normal(20, 0)])
    refused(
        r"parallel .*between the beam and their common normal \(0.34\d+, 0.0000, 0.9\d+\), but not the rotation of "
        "the beam",
        gradients_of(normals),
    )


def test_a_plane_at_grazing_incidence_is_refused():
    grazed = across(U)[0] - 0.05 * U
    refused("Plane 2: grazing incidence at 2.86 deg", gradients_of(np.array([PAIR[0], grazed, PAIR[1]])))


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_readings_and_stage_in_different_units_are_refused(factor):
    refused("Plane 1: .*have the same unit", gradients_of(PAIR) * factor)


def test_a_direction_of_opposite_sign_is_refused():
    refused("has the opposite sign.*whether the stage carries the sensor or the target", -gradients_of(PAIR))
    refused("has the opposite sign", gradients_of(PAIR), nominal=-NOMINAL)


def test_two_roots_that_the_nominal_direction_does_not_distinguish_are_refused():
    mirror = solve(gradients_of(PAIR), all_of(PAIR), NOMINAL).other_root
    refused("Two directions fit the planes: .* measure a third plane", gradients_of(PAIR), nominal=U + 1.05 * mirror)


@pytest.mark.parametrize("seed", range(6))
def test_roots_that_merge_are_refused(seed):
    # The beam in the plane of the two normals: noise makes two near roots, or none.
    coplanar = np.array([normal(20, 0), normal(10, 180)])
    beam = np.array([0.2, 0, -1.0]) / np.sqrt(1.04)
    g = gradients_of(coplanar, beam)
    g = g + np.random.default_rng(seed).multivariate_normal(np.zeros(3), S, 2)
    refused("Two directions fit|in the plane of the normals of the planes", g, nominal=beam)


def test_bound_refuses_planes_that_do_not_determine_the_direction():
    with pytest.raises(MethodError, match="do not determine the direction of the beam"):
        bound([STAGE, STAGE], np.array([normal(20, 0), normal(20, 0)]), U, NOISE)


def test_stated_uncertainty_is_correct_with_one_less_accurate_plane():
    # The third plane has a fortieth of the stroke; if it counted as the others, the mean would be about 8.
    short = STAGE / 40
    stages = [STAGE, STAGE, short]
    basis = across(U)
    limit = basis @ bound(stages, THREE, U, NOISE) @ basis.T
    rng, miss = np.random.default_rng(7), []
    for _ in range(200):
        fits = [
            fit_plane_readings(stage @ g + rng.normal(0, NOISE, len(stage)), stage, NOISE, robust=False)
            for stage, g in zip(stages, gradients_of(THREE), strict=True)
        ]
        found = solve(np.array([f.gradient for f in fits]), np.array([f.covariance[:3, :3] for f in fits]), NOMINAL)
        miss.append(basis @ (found.direction - U))
    nees = np.einsum("si,ij,sj->s", np.array(miss), np.linalg.inv(limit), np.array(miss))
    assert nees.mean() == pytest.approx(2, abs=3.5 * np.sqrt(4 / 200))
