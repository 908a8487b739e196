"""Checks of the stated uncertainty of a method: against the truth, over many seeds, and between points.

For an error e of d freedoms with the covariance C, e' C^-1 e (NEES, the normalised estimation error squared) has a
chi-square distribution with d degrees of freedom, and its sum over n seeds one with n d. Its mean per degree of freedom
is 1; if the stated covariance is too small by a factor f, it is f. (Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 5.4.)
"""
# ruff: noqa: D401 - the docstring of a check is its requirement

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import xarray as xr
from scipy import stats

from errormotion.plugins import MethodSubject, states
from errormotion.testing.kit import DoesNotApplyError, require
from errormotion.testing.results import covariance, influence, names, place_dims, truth_at_places, values

#: Probability that a method with a correct covariance fails one of the checks below.
FALSE_ALARM = 1e-3
#: Error of a stated covariance, as a factor, that must be detected, and the probability of its detection.
FACTOR, POWER = 1.3, 0.95
#: Largest deviation of a single result from the truth, in standard uncertainties.
GROSS = 5.0
MIN_SEEDS = 60


def recovers_truth(subject: MethodSubject) -> str:
    """All values agree with the truth within five standard uncertainties."""
    worst = 0.0
    for seed in range(3):
        errors, truth = subject.outcome(seed)
        error = values(errors) - truth_at_places(errors, truth)
        u = np.sqrt(np.einsum("pii->pi", covariance(errors)))
        known = np.isfinite(error) & (u > 0)
        require(bool(known.any()), "no freedom is both estimated and known from the truth")
        ratio = np.where(known, np.abs(error) / np.where(known, u, 1.0), 0.0)
        place, freedom = np.unravel_index(np.argmax(ratio), ratio.shape)
        worst = max(worst, ratio.max())
        require(
            ratio.max() <= GROSS,
            f"seed {seed}: {names(errors)[freedom]} at point {place} of {len(ratio)} deviates by "
            f"{error[place, freedom]:.3g}, {ratio.max():.1f} standard uncertainties",
        )
    return f"largest deviation: {worst:.1f} standard uncertainties"


def coverage(subject: MethodSubject) -> str:
    """Over many seeds, 95 % of the 95 % intervals contain the truth; the covariance is not too small or too large."""
    places = tested_places(subject)
    errors, covariances = _samples(subject, places)
    verdicts = [
        require_honest(errors[:, i], covariances[:, i], _labels(subject), f"at point {place}", share=len(places))
        for i, place in enumerate(places)
    ]
    return f"{len(errors)} seeds; " + "; ".join(verdicts)


def differences(subject: MethodSubject) -> str:
    """The difference between two points has the covariance that follows from the shared sources (``influence``)."""
    places = tested_places(subject)
    if len(places) < 2:
        return "only one point"
    errors, covariances = _samples(subject, places)
    shared = []
    for seed in range(len(errors)):
        source = np.nan_to_num(influence(subject.outcome(seed)[0]))
        first, second = source[places[0]], source[places[1]]
        shared.append(first.T @ second + second.T @ first)
    difference = errors[:, 1] - errors[:, 0]
    spread = covariances[:, 1] + covariances[:, 0] - np.array(shared)
    between = f"between points {places[0]} and {places[1]}"
    verdict = require_honest(difference, spread, _labels(subject), between, share=1)
    return f"{len(errors)} seeds; {verdict}"


def no_figures(subject: MethodSubject) -> str:
    """Return why the check of the figures does not apply; empty if it may apply."""
    return "" if states(subject.plugin, "figures") else "the method states no figures"


def figures(subject: MethodSubject) -> str:
    """Over many seeds, the stated intervals (k = 2) of the figures of merit contain those of the true errors."""
    result, truth = subject.outcome(0)
    if _of_errors(subject, result).items() == _true_figures(subject, result, truth).items():
        raise DoesNotApplyError("the result has no figures that follow from its errors alone")
    seeds = subject.seeds or MIN_SEEDS
    held: dict[str, list[bool]] = {}
    for seed in range(seeds):
        result, truth = subject.outcome(seed)
        stated = _of_errors(subject, result)
        for name, (true, _) in _true_figures(subject, result, truth).items():
            value, U = stated.get(name, (math.nan, math.nan))
            if np.isfinite([true, value, U]).all() and true != value:  # equal: computed from other variables
                held.setdefault(name, []).append(abs(value - true) <= U)
    usual = {name: hits for name, hits in held.items() if 2 * len(hits) >= seeds}  # the name may state a place
    require(bool(usual), "no figure of most seeds is known from the truth")
    level = float(2 * stats.norm.cdf(2) - 1)
    for name, hits in usual.items():
        low = float(stats.binom.ppf(FALSE_ALARM / len(usual), len(hits), level))
        require(
            sum(hits) >= low,
            f"the interval of '{name}' contains the true figure for {sum(hits)} of {len(hits)} seeds; expected at "
            f"least {low:.0f}",
        )
    worst = min(float(np.mean(hits)) for hits in usual.values())
    return f"{seeds} seeds; {len(usual)} figures, {100 * worst:.0f} % or more hold"


def _of_errors(subject: MethodSubject, errors: xr.Dataset) -> dict[str, tuple[float, float]]:
    """Return value and U of the figures that the plugin computes from the errors alone, by name."""
    found = subject.plugin.figures(errors)
    return {each.name: (each.value, each.expanded_uncertainty) for each in found if each.influence is None}


def _true_figures(subject: MethodSubject, result: xr.Dataset, truth: xr.Dataset) -> dict[str, tuple[float, float]]:
    """Return the figures of the true errors at the points of a result, as `_of_errors`."""
    return _of_errors(subject, _with_values(result, truth_at_places(result, truth)))


def _with_values(errors: xr.Dataset, true: np.ndarray) -> xr.Dataset:
    """Return a result with other estimates, (place, n), where it has one."""
    dims = place_dims(errors)
    changed = {}
    for k, name in enumerate(names(errors)):
        old = errors[name].transpose(*dims)
        new = np.where(np.isfinite(old.values), true[:, k].reshape(old.shape), np.nan)
        changed[name] = (dims, new, old.attrs)
    return errors.assign(changed)


def tested_places(subject: MethodSubject) -> tuple[int, ...]:
    """Return the points of the checks: of those with an uncertainty, one in the middle and the last."""
    errors, _ = subject.outcome(0)
    u = np.sqrt(np.einsum("pii->pi", covariance(errors)))
    uncertain = np.flatnonzero((u > 0).any(axis=1))
    require(uncertain.size > 0, "no point has an uncertainty greater than zero")
    return tuple(sorted({int(uncertain[uncertain.size // 2]), int(uncertain[-1])}))


@lru_cache(maxsize=4)
def _samples(subject: MethodSubject, places: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (seed, place, n) and stated covariances (seed, place, n, n), for two checks."""
    freedoms = int(np.isfinite(values(subject.outcome(0)[0])[list(places)]).any(axis=0).sum())
    seeds = subject.seeds or max(MIN_SEEDS, math.ceil(degrees_needed(share=len(places)) / freedoms))
    errors, covariances = [], []
    for seed in range(seeds):
        result, truth = subject.outcome(seed)
        errors.append((values(result) - truth_at_places(result, truth))[list(places)])
        covariances.append(covariance(result)[list(places)])
    return np.array(errors), np.array(covariances)


def degrees_needed(share: int) -> int:
    """Return the degrees of freedom needed to detect a covariance that is too large by ``FACTOR``."""
    degrees = 10
    while stats.chi2.ppf(POWER, degrees) / FACTOR > stats.chi2.ppf(FALSE_ALARM / 4 / share, degrees):
        degrees = math.ceil(degrees * 1.05)
    return degrees


def _labels(subject: MethodSubject) -> tuple[str, ...]:
    return names(subject.outcome(0)[0])


def require_honest(errors: np.ndarray, covariances: np.ndarray, labels: tuple[str, ...], where: str, share: int) -> str:
    """Fail unless errors (seed, n) are consistent with covariances (seed, n, n).

    Half of the allowed false alarms goes to the intervals, half to NEES; ``share`` tests divide them again.
    """
    u = np.sqrt(np.einsum("sii->si", covariances))
    seen = np.isfinite(errors).all(axis=0) & (u > 0).all(axis=0)
    require(bool(seen.any()), f"{where}: no freedom is both estimated and known from the truth")
    e, C, u = errors[:, seen], covariances[:, seen][:, :, seen], u[:, seen]
    seeds, freedoms = e.shape
    alarm = FALSE_ALARM / 2 / share

    k = stats.norm.ppf(0.975)
    low, high = (float(stats.binom.ppf(p, seeds, 0.95)) for p in (alarm / freedoms / 2, 1 - alarm / freedoms / 2))
    held = (np.abs(e) <= k * u).sum(axis=0)
    for name, hits in zip(np.array(labels)[seen], held, strict=True):
        require(
            low <= hits <= high,
            f"{where}: 95 % intervals of {name} contain the truth for {hits} of {seeds} seeds, "
            f"expected {low:.0f} to {high:.0f}",
        )

    z, R = e / u, C / (u[:, :, None] * u[:, None, :])
    weight, axes = np.linalg.eigh(R)
    solid = weight > 1e-9  # directions without variance contain no information
    along = np.einsum("sij,si->sj", axes, z)
    nees = float((along[solid] ** 2 / weight[solid]).sum())
    degrees = int(solid.sum())
    floor, ceiling = (float(stats.chi2.ppf(p, degrees)) / degrees for p in (alarm / 2, 1 - alarm / 2))
    require(
        floor <= nees / degrees <= ceiling,
        f"{where}: the stated covariance is {_off(nees / degrees)}: mean NEES per freedom {nees / degrees:.2f}, "
        f"expected {floor:.2f} to {ceiling:.2f} over {seeds} seeds",
    )
    return f"{where} {100 * held.min() / seeds:.0f} % or more contain the truth, NEES {nees / degrees:.2f}"


def _off(ratio: float) -> str:
    return f"too small by a factor of {ratio:.2f}" if ratio > 1 else f"too large by a factor of {1 / ratio:.2f}"
