"""Gradient of the readings on one plane."""

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.methods.beam_direction.identification.slopes import (
    correlation_factor,
    expected_covariance,
    fit_plane_readings,
    gradient_covariance,
)

NOISE, SPECKLE, LENGTH = 0.1e-6, 0.3e-6, 50e-6
G = np.array([0.42, -0.15, 1.2])
OFFSET = 1.3e-3
PLACE = np.array([0.3, -0.2, 0.1])


def strokes(half=5e-3, count=12, axes="xyz"):
    t = np.linspace(-half, half, count)
    return PLACE + np.concatenate([np.outer(t, np.eye(3)["xyz".index(axis)]) for axis in axes])


STAGE = strokes()
EXACT = STAGE @ G + OFFSET


def noisy(seed):
    return EXACT + np.random.default_rng(seed).normal(0, NOISE, EXACT.size)


def draws_of(speckle, number, seed):
    L = correlation_factor(STAGE, NOISE, speckle, LENGTH)
    return EXACT + np.random.default_rng(seed).normal(size=(number, EXACT.size)) @ L.T


def test_exact_readings_determine_gradient_and_offset():
    fit = fit_plane_readings(EXACT, STAGE, NOISE)
    np.testing.assert_allclose(fit.gradient, G, atol=1e-12)
    assert fit.offset == pytest.approx(OFFSET, abs=1e-12)
    assert np.abs(fit.residual).max() < 1e-15


def test_any_path_in_three_directions_is_accepted():
    stage = np.random.default_rng(0).uniform(-5e-3, 5e-3, (10, 3))
    np.testing.assert_allclose(fit_plane_readings(stage @ G, stage, NOISE).gradient, G, atol=1e-12)


@pytest.mark.parametrize("speckle", [0.0, SPECKLE])
def test_covariance_is_the_scatter_over_seeds(speckle):
    # Without a search of outliers, which finds none.
    draws = draws_of(speckle, 800, seed=1)
    fits = [fit_plane_readings(d, STAGE, NOISE, speckle, LENGTH, robust=False) for d in draws]
    miss = np.array([[*(fit.gradient - G), fit.offset - OFFSET] for fit in fits])
    # The mean of e' C^-1 e over 800 seeds is 4 with a standard deviation of sqrt(8 / 800) = 0.1.
    nees = np.einsum("si,ij,sj->s", miss, np.linalg.inv(fits[0].covariance), miss)
    assert nees.mean() == pytest.approx(4, abs=0.35)
    chi2 = [np.nansum(fit.whitened**2) for fit in fits]
    freedom = EXACT.size - 4
    assert np.mean(chi2) == pytest.approx(freedom, abs=3.5 * np.sqrt(2 * freedom / 800))


def test_no_weighting_is_better_than_generalised_least_squares_with_speckle():
    # On places closer than the speckle is long, ordinary least squares scatters more than the bound.
    stage = strokes(half=100e-6, count=30)
    A = np.column_stack([stage - PLACE, np.ones(len(stage))])
    L = correlation_factor(stage, NOISE, SPECKLE, LENGTH)
    ordinary = np.linalg.pinv(A) @ L
    bound = gradient_covariance(stage, NOISE, SPECKLE, LENGTH)
    ratio = np.diag(ordinary @ ordinary.T)[:3] / np.diag(bound)
    assert (ratio > 1.01).all()


def test_expected_covariance_is_that_of_the_fit():
    fit = fit_plane_readings(noisy(0), STAGE, NOISE, SPECKLE, LENGTH)
    np.testing.assert_allclose(expected_covariance(STAGE, NOISE, SPECKLE, LENGTH), fit.covariance, rtol=1e-9)


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_outliers_are_ignored_without_effect(share):
    clean, spoilt = noisy(2), noisy(2)
    wrong = np.random.default_rng(3).choice(EXACT.size, round(share * EXACT.size), replace=False)
    spoilt[wrong] += np.linspace(5e-6, 4e-3, wrong.size)
    fit = fit_plane_readings(spoilt, STAGE, NOISE)
    assert set(np.flatnonzero(fit.left_out)) == set(wrong)
    blank = clean.copy()
    blank[wrong] = np.nan
    np.testing.assert_allclose(fit.gradient, fit_plane_readings(blank, STAGE, NOISE).gradient, atol=1e-12)


@pytest.mark.parametrize("speckle", [0.0, SPECKLE])
def test_clean_readings_are_all_used(speckle):
    draws = draws_of(speckle, 100, seed=2)
    assert sum(fit_plane_readings(d, STAGE, NOISE, speckle, LENGTH).left_out.sum() for d in draws) == 0


def test_without_robust_all_readings_count():
    spoilt = noisy(2)
    spoilt[5] += 1e-3
    assert not fit_plane_readings(spoilt, STAGE, NOISE, robust=False).left_out.any()


def test_missing_readings_are_nan():
    some = noisy(4)
    some[[3, 20]] = np.nan
    fit = fit_plane_readings(some, STAGE, NOISE)
    assert np.isnan(fit.residual)[[3, 20]].all()
    assert not fit.left_out[[3, 20]].any()
    assert np.abs(fit.gradient - G).max() < 5 * np.sqrt(np.diag(fit.covariance)[:3]).max()


@pytest.mark.parametrize(("axes", "missing"), [("xy", r"\(0.00, 0.00, 1.00\)"), ("xz", r"\(0.00, 1.00, 0.00\)")])
def test_a_stage_without_motion_in_one_direction_is_refused(axes, missing):
    stage = strokes(axes=axes)
    with pytest.raises(MethodError, match=rf"Plane 2: .*2 of three independent directions; along {missing}"):
        fit_plane_readings(stage @ G, stage, NOISE, name="Plane 2")


def test_a_stroke_within_the_noise_is_not_counted():
    stage = strokes()
    stage[24:, 2] = PLACE[2] + (stage[24:, 2] - PLACE[2]) * 1e-4
    with pytest.raises(MethodError, match="2 of three independent directions"):
        fit_plane_readings(stage @ G, stage, NOISE)


def test_too_few_readings_are_refused():
    with pytest.raises(MethodError, match="3 of 5 readings are valid; expected at least 4"):
        fit_plane_readings(np.array([1e-3, np.nan, 2e-3, np.nan, 1e-3]), STAGE[:5], NOISE)


def test_readings_that_fit_no_plane_are_refused():
    two = EXACT.copy()
    two[: EXACT.size // 5 * 2] += 1e-3 * np.random.default_rng(5).normal(size=EXACT.size // 5 * 2)
    with pytest.raises(MethodError, match="do not fit a plane"):
        fit_plane_readings(two, STAGE, NOISE)


def test_readings_too_dense_for_their_speckle_are_refused():
    stage = strokes(count=1400)
    with pytest.raises(MethodError, match="Use fewer"):
        fit_plane_readings(stage @ G, stage, NOISE, SPECKLE, LENGTH, robust=False)
