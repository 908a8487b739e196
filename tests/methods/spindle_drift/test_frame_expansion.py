"""Smoothed temperature of the frame: its covariance against that of the smoothing, written out."""

import numpy as np
import pytest

from errormotion.methods.spindle_drift.identification.frame_expansion import LocalLine, smoothing_sources

LENGTH, NOISE = 60.0, 0.02
rng = np.random.default_rng(0)
TIME = np.sort(rng.uniform(0.0, 1500.0, 300))  # uneven, so that windows differ
KNOWN = rng.uniform(size=TIME.size) > 0.1
KNOWN[:3] = True


def written_out():
    """Return the smoothing as a matrix (instant, instant), each line fitted by itself."""
    S = np.zeros((TIME.size, TIME.size))
    for i in np.flatnonzero(KNOWN):
        near = np.flatnonzero(KNOWN & (np.abs(TIME - TIME[i]) <= LENGTH / 2))
        lines = np.column_stack([np.ones(near.size), TIME[near] - TIME[i]])
        S[i, near] = np.linalg.pinv(lines)[0]
    return S


def test_local_lines_are_linear_in_the_values():
    S, smoothing, values = written_out(), LocalLine(TIME, KNOWN, LENGTH), rng.normal(20.0, 1.0, TIME.size)
    np.testing.assert_allclose(smoothing(values)[KNOWN], (S @ values)[KNOWN], rtol=0, atol=1e-9)
    np.testing.assert_allclose(smoothing.weights(values), S.T @ values, rtol=0, atol=1e-9)
    np.testing.assert_allclose(smoothing.gain[KNOWN], np.sum(S**2, axis=1)[KNOWN], rtol=1e-6)
    assert np.isnan(smoothing(values)[~KNOWN]).all()


@pytest.mark.parametrize("reference", [np.array([0]), np.array([150]), np.array([0, 1, 2])], ids=str)
def test_the_sources_have_the_covariance_of_the_smoothing(reference):
    S = NOISE * written_out()
    relative = S - S[reference].mean(axis=0)
    shared, own = smoothing_sources(LocalLine(TIME, KNOWN, LENGTH), NOISE, TIME, reference)
    away = np.flatnonzero(KNOWN & ~np.isin(np.arange(TIME.size), reference))
    # Of every instant exactly.
    variance = np.sum(np.square(shared), axis=0) + own**2
    np.testing.assert_allclose(variance[away], np.sum(relative**2, axis=1)[away], rtol=1e-6)
    if reference.size == 1:
        assert np.sum(np.square(shared), axis=0)[reference] + own[reference] ** 2 < 1e-12 * NOISE**2
    # Of the difference of means over five lengths: what is stated as independent is missing at their ends only.
    weights = ((TIME > 900) & (TIME < 1200) & KNOWN) / 1.0
    weights = weights / weights.sum() - (near := (TIME > 300) & (TIME < 600) & KNOWN) / near.sum()
    stated = np.sum((shared @ weights) ** 2) + np.sum((own * weights) ** 2)
    assert np.sqrt(stated) == pytest.approx(np.linalg.norm(weights @ relative), rel=0.05)


def test_a_thermometer_without_noise_has_no_sources():
    shared, own = smoothing_sources(LocalLine(TIME, KNOWN, LENGTH), 0.0, TIME, np.array([0]))
    assert not shared
    assert not own.any()


def test_a_gap_in_the_record_is_no_noise():
    """The temperature before and after a gap of an hour differs by a kelvin, that of neighbours by 0.01 K."""
    time = np.concatenate([10.0 * np.arange(40), 4000.0 + 10.0 * np.arange(40)])
    values = np.where(time < 2000.0, 20.0, 21.0) + np.random.default_rng(2).normal(0.0, 0.01, time.size)
    smoothing = LocalLine(time, np.ones(time.size, bool), LENGTH)
    assert smoothing.noise(values, smoothing(values)) == pytest.approx(0.01, rel=0.5)
