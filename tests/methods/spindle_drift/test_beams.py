"""Beam detection from a stepped sphere."""

import numpy as np
import pytest
from coded import raises

from errormotion.errors import MethodError
from errormotion.kinematics.beams import across
from errormotion.methods.spindle_drift.identification.beams import (
    circles_and_line,
    fisher_bound,
    likelihood_fit,
    sphere_reading,
)

R = 5e-3
U0 = np.array([-1.0, 0, 0])
P0 = np.array([6e-3, 0, 0.01])
SCANS = np.array([[0.0, 1, 0], [0, 0, 1]] * 3)
DEPTHS = np.repeat([0.2e-3, 1e-3, 1.8e-3], 2)
CENTRE = (P0 + (DEPTHS + R)[:, None] * U0)[:, None] + np.linspace(-1e-3, 1e-3, 101)[:, None] * SCANS[:, None]
NOISE = 0.5e-6


def true_beam(rng):
    u = U0 + rng.normal(0, 5e-3, 2) @ across(U0)
    return P0 + rng.normal(0, 1e-4, 3), u / np.linalg.norm(u)


def test_exact_readings_give_the_exact_beam():
    P, u = true_beam(np.random.default_rng(0))
    readings = sphere_reading(P, u, CENTRE, R)[0]
    # With a noise of a picometre, since the uncertainty of readings that do not scatter at all is unknown.
    beam = likelihood_fit(readings + np.random.default_rng(1).normal(0, 1e-12, readings.shape), CENTRE, R, P0, U0)
    np.testing.assert_allclose(beam.origin, P, rtol=0, atol=5e-12)
    np.testing.assert_allclose(beam.direction, u, rtol=0, atol=5e-9)
    with raises("readings.noise.unknown"):
        likelihood_fit(readings, CENTRE, R, P0, U0)


def test_jacobian_is_that_of_finite_differences():
    P, u = true_beam(np.random.default_rng(1))
    _, jacobian = sphere_reading(P, u, CENTRE, R)
    h = 1e-7
    for k, e in enumerate(np.eye(3) * h):
        numeric = (sphere_reading(P + e, u, CENTRE, R)[0] - sphere_reading(P - e, u, CENTRE, R)[0]) / (2 * h)
        np.testing.assert_allclose(jacobian[..., k], numeric, atol=1e-7)
    for k, e in enumerate(across(u) * h):
        turned = [(u + s * e) / np.linalg.norm(u + s * e) for s in (1, -1)]
        numeric = (sphere_reading(P, turned[0], CENTRE, R)[0] - sphere_reading(P, turned[1], CENTRE, R)[0]) / (2 * h)
        np.testing.assert_allclose(jacobian[..., 3 + k], numeric, atol=1e-7)


@pytest.mark.slow
def test_spread_meets_the_bound_and_the_stated_covariance():
    rng = np.random.default_rng(2)
    seeds = 150
    bound_ratio, stated_ratio, paper_ratio = [], [], []
    for _ in range(seeds):
        P, u = true_beam(rng)
        readings = sphere_reading(P, u, CENTRE, R)[0] + rng.normal(0, NOISE, CENTRE.shape[:2])
        beam = likelihood_fit(readings, CENTRE, R, P0, U0)
        error = np.concatenate([beam.origin - P, beam.direction - u])
        bound = np.sqrt(np.diag(fisher_bound(P, u, CENTRE, R, NOISE)))
        bound_ratio.append(error / bound)
        stated_ratio.append(error / np.sqrt(np.diag(beam.covariance)))
        paper = circles_and_line(readings, CENTRE, SCANS, R, U0)
        paper_ratio.append(np.concatenate([paper[0] - P, paper[1] - u]) / bound)
    # The spread of a standard deviation from 150 draws is 1 / sqrt(300) = 6 %; three of it.
    spread = np.sqrt(np.mean(np.square(bound_ratio), axis=0))
    assert (spread < 1.0 + 3 * 0.058).all()
    assert (spread > 1.0 - 3 * 0.058).all()
    inside = np.mean(np.abs(stated_ratio) < 1.96, axis=0)
    assert (np.abs(inside - 0.95) < 3 * np.sqrt(0.05 * 0.95 / seeds)).all()
    # The construction throws readings away; along the beam it keeps only the lowest points.
    assert np.sqrt(np.mean(np.square(paper_ratio), axis=0))[0] > 1.2


def misses(seeds, phi=0.0, radius_u=0.0, scale_u=0.0):
    """Return errors over stated uncertainties (seed, 6) of beams with errors of the radius, of positions, and noise."""
    found = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        P, u = true_beam(rng)
        scale = 1 + scale_u * rng.normal(size=3)
        middle = CENTRE.mean(axis=(0, 1))
        true = middle + (CENTRE - middle) * scale
        readings = sphere_reading(P, u, true, R + radius_u * rng.normal())[0]
        e = rng.normal(size=readings.shape)
        for step in range(1, e.shape[1]):
            e[:, step] = phi * e[:, step - 1] + np.sqrt(1 - phi**2) * e[:, step]
        beam = likelihood_fit(
            readings + NOISE * e, CENTRE, R, P0, U0, radius_uncertainty=radius_u, scale_uncertainty=scale_u
        )
        off = np.concatenate([beam.origin - P, beam.direction - u])
        found.append(off / np.sqrt(np.diag(beam.covariance)))
    return np.array(found)


@pytest.mark.slow
def test_errors_that_are_correlated_from_step_to_step_are_covered():
    """Where positions of neighbouring steps are wrong alike; with white noise 72 % of the intervals were."""
    inside = np.abs(misses(100, phi=0.5)) < 1.96
    # Of 600 values, five of six independent: the standard deviation of the share is 1 %.
    assert inside.mean() > 0.92


@pytest.mark.slow
def test_uncertain_radius_and_scales_are_covered_where_they_are_stated():
    # Of 360 values, of which each beam's are correlated by its one radius: 3 % or less as the deviation of the share.
    assert (np.abs(misses(60, radius_u=2e-6, scale_u=3e-4)) < 1.96).mean() > 0.88


def test_a_larger_radius_moves_the_beam_back_by_its_difference():
    """Along the beam the readings see the near side of the sphere."""
    P, u = true_beam(np.random.default_rng(1))
    rng = np.random.default_rng(2)
    readings = sphere_reading(P, u, CENTRE, R)[0] + rng.normal(0, NOISE, CENTRE.shape[:2])
    beam = likelihood_fit(readings, CENTRE, R, P0, U0, radius_uncertainty=1e-6)
    larger = likelihood_fit(readings, CENTRE, R + 1e-6, P0, U0)
    plain = likelihood_fit(readings, CENTRE, R, P0, U0)
    moved = np.concatenate([larger.origin - plain.origin, larger.direction - plain.direction])
    np.testing.assert_allclose(beam.influence["radius of the sphere"], moved, atol=6e-8)
    np.testing.assert_allclose(moved[:3] @ u, -1e-6, rtol=0.2)
    np.testing.assert_allclose(
        beam.covariance, plain.covariance + np.outer(moved, moved), atol=1e-3 * np.abs(beam.covariance).max()
    )


def test_circles_and_line_find_the_beam_of_exact_readings():
    P, u = true_beam(np.random.default_rng(4))
    origin, direction = circles_and_line(sphere_reading(P, u, CENTRE, R)[0], CENTRE, SCANS, R, U0)
    # The profile of a beam that is not perpendicular to its scan is not quite a circle.
    np.testing.assert_allclose(origin, P, atol=1e-6)
    np.testing.assert_allclose(direction, u, atol=1e-5)


def test_uncertain_constants_that_are_not_stated_are_not_covered():
    """So that the coverage above is that of their sources."""
    found = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        P, u = true_beam(rng)
        readings = sphere_reading(P, u, CENTRE, R + 2e-6 * rng.normal())[0] + rng.normal(0, NOISE, CENTRE.shape[:2])
        beam = likelihood_fit(readings, CENTRE, R, P0, U0)
        found.append((beam.origin - P) @ u / np.sqrt(u @ beam.covariance[:3, :3] @ u))
    assert np.mean(np.abs(found) < 1.96) < 0.7


def test_outliers_are_reported_and_excluded():
    rng = np.random.default_rng(3)
    P, u = true_beam(rng)
    readings = sphere_reading(P, u, CENTRE, R)[0] + rng.normal(0, NOISE, CENTRE.shape[:2])
    readings[2, 40] += 50e-6
    readings[5, 7] -= 20e-6
    beam = likelihood_fit(readings, CENTRE, R, P0, U0)
    assert beam.left_out.tolist() == [[2, 40], [5, 7]]
    assert np.abs(beam.origin - P).max() < 5 * 0.5e-6


def test_missed_steps_are_unknown_and_affect_no_others():
    rng = np.random.default_rng(4)
    P, u = true_beam(rng)
    readings = sphere_reading(P, u, CENTRE, R)[0] + rng.normal(0, NOISE, CENTRE.shape[:2])
    readings[0, :30] = np.nan
    beam = likelihood_fit(readings, CENTRE, R, P0, U0)
    assert np.isnan(beam.residual[0, :30]).all()
    assert np.abs(beam.origin - P).max() < 5 * 0.7e-6


def test_a_beam_far_from_nominal_is_found():
    rng = np.random.default_rng(5)
    P, u = P0 + np.array([3e-4, 4e-4, -4e-4]), U0 + np.array([0, 0.04, -0.03])
    u = u / np.linalg.norm(u)
    readings = sphere_reading(P, u, CENTRE, R)[0] + rng.normal(0, NOISE, CENTRE.shape[:2])
    beam = likelihood_fit(readings, CENTRE, R, P0, U0)
    assert np.abs(beam.origin - P).max() < 5 * 0.5e-6


@pytest.mark.parametrize(
    ("readings", "code"),
    [(np.full(CENTRE.shape[:2], np.nan), "readings.too_few"), (np.full(CENTRE.shape[:2], 0.5), "beam.not_converged")],
    ids=["nothing", "nonsense"],
)
def test_unusable_readings_are_refused(readings, code):
    with raises(code):
        likelihood_fit(readings, CENTRE, R, P0, U0, "X1")


def test_scans_along_one_line_through_one_point_do_not_determine_the_beam():
    rng = np.random.default_rng(6)
    one = np.broadcast_to(CENTRE[2, 50], (1, 40, 3)).copy()
    readings = sphere_reading(P0, U0, one, R)[0] + rng.normal(0, NOISE, (1, 40))
    with pytest.raises(MethodError, match="do not determine the beam"):
        likelihood_fit(readings, one, R, P0, U0)
