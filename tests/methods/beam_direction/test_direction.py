"""The direction of a beam from gradients on planes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from beam_bound import bound
from beams_on_planes import COVARIANCE, NOISE, STAGE, errors, gradients_of, normal, planes_of, solved
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize

from errormotion.errors import MethodError
from errormotion.kinematics.beams import across, turned

U = np.array([0.34, 0.02, -0.94])
U /= np.linalg.norm(U)
NOMINAL = np.array([np.sin(np.radians(20)), 0, -np.cos(np.radians(20))])
S = COVARIANCE[:3, :3]
PAIR = np.array([normal(20, 0), normal(20, 90)])
THREE = np.array([normal(20, 0), normal(20, 90), normal(20, 180)])
FIVE = np.array([normal(20, 0), normal(20, 90), normal(20, 180), normal(35, 45), normal(5, 270)])
SETS = {2: PAIR, 3: THREE, 5: FIVE}


def noisy(normals, seed):
    g = gradients_of(normals, U)
    return g + np.random.default_rng(seed).multivariate_normal(np.zeros(3), S, len(g))


def solve(gradients, nominal=NOMINAL, covariances=COVARIANCE):
    return solved(planes_of(gradients, covariances=covariances), nominal)


@pytest.mark.parametrize("normals", [PAIR, THREE, FIVE])
def test_exact_gradients_determine_the_direction(normals):
    found = solve(gradients_of(normals, U))
    np.testing.assert_allclose(found.state.direction, U, atol=1e-12)
    np.testing.assert_allclose(found.state.gradient @ U, -1, atol=1e-12)
    assert found.fit.chi2 < 1e-9


@given(st.lists(st.tuples(st.floats(5, 60), st.floats(0, 360)), min_size=2, max_size=5), st.floats(0, 30))
def test_any_planes_that_determine_the_beam_are_accepted(planes, lean):
    u = -normal(lean, 200.0)
    normals = np.array([normal(*plane) for plane in planes])
    assume((normals @ u < -0.2).all())
    spread, vectors = np.linalg.eigh(normals.T @ normals)
    # Not parallel; and the beam not in the plane of all normals, where the two roots would merge.
    assume(spread[1] > 0.01)
    assume(spread[0] > 0.01 or abs(vectors[:, 0] @ u) > 0.1)
    np.testing.assert_allclose(solve(gradients_of(normals, u), u).state.direction, u, atol=1e-8)


def test_no_other_gradients_are_more_likely():
    """The solution agrees with a general optimiser of the full problem: direction and all true gradients."""
    g, W = noisy(FIVE, 1), np.linalg.inv(S)
    found = solve(g)
    direction, fitted = found.state.direction, found.state.gradient

    def gradients_at(p):
        u = turned(direction, p[:2] * 1e-5)
        free = fitted + p[2:].reshape(-1, 3) * 1e-5
        return free - np.outer((free @ u + 1), u)  # any gradient, then shifted so that it meets its condition

    def deviance(p):
        off = g - gradients_at(p)
        return np.einsum("ki,ij,kj->", off, W, off)

    best = minimize(deviance, np.zeros(2 + 15), method="BFGS", options={"gtol": 1e-6})
    assert deviance(np.zeros(17)) == pytest.approx(found.fit.chi2, rel=1e-9)
    assert best.fun == pytest.approx(found.fit.chi2, rel=1e-6)


@cache
def repeated(number):
    """Return the directions by 400 noisy measurements of the set of planes with this number."""
    return [solve(noisy(SETS[number], seed)) for seed in range(400)]


@pytest.mark.parametrize("number", SETS)
def test_scatter_agrees_with_the_bound_and_the_stated_covariance(number):
    found, normals = repeated(number), SETS[number]
    basis = across(U)
    miss = np.array([f.state.direction - U for f in found]) @ basis.T
    limit = basis @ bound([STAGE] * len(normals), normals, U, NOISE)[3:, 3:] @ basis.T
    # 400 seeds: e' C^-1 e is 2 with a standard deviation of sqrt(4 / 400) = 0.1.
    assert np.einsum("si,ij,sj->s", miss, np.linalg.inv(limit), miss).mean() == pytest.approx(2, abs=0.35)
    stated = errors(replace(found[0].beam, components=np.zeros((1, 0)))).own[0, 3:, 3:]
    np.testing.assert_allclose(basis @ stated @ basis.T, limit, rtol=0.01)
    assert np.linalg.matrix_rank(stated, tol=1e-14) == 2


@pytest.mark.parametrize("k", [3, 5])
def test_closure_is_chi_square(k):
    found = repeated(k)
    assert found[0].fit.freedom == k - 2
    assert np.mean([f.fit.chi2 for f in found]) == pytest.approx(k - 2, abs=3.5 * np.sqrt(2 * (k - 2) / 400))


def test_two_planes_have_two_roots_and_the_nominal_direction_selects_one():
    g = gradients_of(PAIR, U)
    first = solve(g)
    np.testing.assert_allclose(g @ first.other_root, -1, atol=1e-12)
    second = solve(g, first.other_root)
    np.testing.assert_allclose(second.state.direction, first.other_root, atol=1e-12)
    np.testing.assert_allclose(second.other_root, U, atol=1e-12)
    assert first.fit.freedom == 0


def test_three_planes_have_one_root():
    assert solve(noisy(THREE, 0)).other_root is None


def test_planes_can_exclude_the_root_closer_to_the_nominal_direction():
    mirror = solve(gradients_of(PAIR, U)).other_root
    between = U + 1.01 * mirror
    np.testing.assert_allclose(solve(gradients_of(THREE, U), between).state.direction, U, atol=1e-9)


def refused(match, gradients, nominal=NOMINAL, covariances=None):
    with pytest.raises(MethodError, match=match):
        solve(gradients, nominal, COVARIANCE if covariances is None else covariances)


def test_one_plane_is_refused():
    refused("Expected two or more planes .*; found 1", gradients_of(PAIR[:1], U))


@pytest.mark.parametrize("angle", [0.0, 1e-5])
def test_parallel_planes_are_refused_with_the_undetermined_freedom(angle):
    normals = np.array([normal(20, 0), normal(20 + np.degrees(angle), 0), normal(20, 0)])
    refused(
        r"parallel .*between the beam and their common normal \(0.34\d+, 0.0000, 0.9\d+\), but not the rotation of "
        "the beam",
        gradients_of(normals, U),
    )


def test_a_plane_at_grazing_incidence_is_refused():
    grazed = across(U)[0] - 0.05 * U
    refused("Plane 2: grazing incidence at 2.86 deg", gradients_of(np.array([PAIR[0], grazed, PAIR[1]]), U))


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_readings_and_stage_in_different_units_are_refused(factor):
    refused("Plane 1: .*have the same unit", gradients_of(PAIR, U) * factor)


def test_a_direction_of_opposite_sign_is_refused():
    refused("has the opposite sign.*whether the stage carries the sensor or the target", -gradients_of(PAIR, U))
    refused("has the opposite sign", gradients_of(PAIR, U), nominal=-NOMINAL)


def test_two_roots_that_the_nominal_direction_does_not_distinguish_are_refused():
    mirror = solve(gradients_of(PAIR, U)).other_root
    refused("Two directions fit the planes: .* measure a third plane", gradients_of(PAIR, U), nominal=U + 1.05 * mirror)


@pytest.mark.parametrize("seed", range(6))
def test_roots_that_merge_are_refused(seed):
    # The beam in the plane of the two normals: noise makes two near roots, or none.
    coplanar = np.array([normal(20, 0), normal(10, 180)])
    beam = np.array([0.2, 0, -1.0]) / np.sqrt(1.04)
    g = gradients_of(coplanar, beam)
    g = g + np.random.default_rng(seed).multivariate_normal(np.zeros(3), S, 2)
    refused("Two directions fit|in the plane of the normals of the planes", g, nominal=beam)


def test_stated_uncertainty_is_correct_with_one_less_accurate_plane():
    # The third plane has a fortieth of the stroke; if it counted as the others, the mean would be about 8.
    stages, basis = [STAGE, STAGE, STAGE / 40], across(U)
    A = [np.column_stack([stage, np.ones(len(stage))]) for stage in stages]
    C = np.array([NOISE**2 * np.linalg.inv(each.T @ each) for each in A])
    limit = basis @ bound(stages, THREE, U, NOISE)[3:, 3:] @ basis.T
    rng, miss = np.random.default_rng(7), []
    for _ in range(200):
        g = gradients_of(THREE, U) + np.stack([rng.multivariate_normal(np.zeros(3), each[:3, :3]) for each in C])
        miss.append(basis @ (solve(g, covariances=C).state.direction - U))
    nees = np.einsum("si,ij,sj->s", np.array(miss), np.linalg.inv(limit), np.array(miss))
    assert nees.mean() == pytest.approx(2, abs=3.5 * np.sqrt(4 / 200))
