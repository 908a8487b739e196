"""Whether a method's stated uncertainty is true: against the truth, over many seeds, between places.

With the right covariance C of an error e of d freedoms, e' C^-1 e (NEES, the normalised estimation error squared) is
chi-square with d degrees of freedom, and the sum over n seeds is chi-square with n d. Its mean per degree of freedom
is 1; a covariance that is stated too small by a factor f makes it f. (Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 5.4.)
"""
# ruff: noqa: D401 - the docstring of a check is its claim

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy import stats

from errormotion.plugins import MethodSubject
from errormotion.testing.kit import require
from errormotion.testing.results import covariance, influence, names, truth_at_places, values

#: Probability that a method with the right covariance fails one of the checks below.
FALSE_ALARM = 1e-3
#: Error of a stated covariance, as a factor, that has to be seen, and with which probability.
FACTOR, POWER = 1.3, 0.95
#: A single result further from the truth than this many standard uncertainties is wrong, not unlucky.
GROSS = 5.0
FEWEST_SEEDS = 60


def recovers_truth(subject: MethodSubject) -> str:
    """Everywhere the result lies within five standard uncertainties of the truth."""
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
            f"seed {seed}: {names(errors)[freedom]} at place {place} of {len(ratio)} is off by "
            f"{error[place, freedom]:.3g}, {ratio.max():.1f} standard uncertainties",
        )
    return f"at worst {worst:.1f} standard uncertainties off"


def coverage(subject: MethodSubject) -> str:
    """Over seeds, 95 % intervals hold the truth 95 % of the time; the covariance is neither too small nor too large."""
    places = tested_places(subject)
    errors, covariances = _samples(subject, places)
    verdicts = [
        require_honest(errors[:, i], covariances[:, i], _labels(subject), f"at place {place}", share=len(places))
        for i, place in enumerate(places)
    ]
    return f"{len(errors)} seeds; " + "; ".join(verdicts)


def differences(subject: MethodSubject) -> str:
    """The difference between two places has the covariance that follows from the shared sources (``influence``)."""
    places = tested_places(subject)
    if len(places) < 2:
        return "one place only"
    errors, covariances = _samples(subject, places)
    shared = []
    for seed in range(len(errors)):
        source = np.nan_to_num(influence(subject.outcome(seed)[0]))
        first, second = source[places[0]], source[places[1]]
        shared.append(first.T @ second + second.T @ first)
    difference = errors[:, 1] - errors[:, 0]
    spread = covariances[:, 1] + covariances[:, 0] - np.array(shared)
    between = f"between places {places[0]} and {places[1]}"
    verdict = require_honest(difference, spread, _labels(subject), between, share=1)
    return f"{len(errors)} seeds; {verdict}"


def tested_places(subject: MethodSubject) -> tuple[int, ...]:
    """Return the places at which uncertainty is put to the test: one in the middle and the last that have one."""
    errors, _ = subject.outcome(0)
    u = np.sqrt(np.einsum("pii->pi", covariance(errors)))
    uncertain = np.flatnonzero((u > 0).any(axis=1))
    require(uncertain.size > 0, "no place has an uncertainty above zero")
    return tuple(sorted({int(uncertain[uncertain.size // 2]), int(uncertain[-1])}))


@lru_cache(maxsize=4)
def _samples(subject: MethodSubject, places: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (seed, place, n) and stated covariances (seed, place, n, n); two checks share them."""
    freedoms = int(np.isfinite(values(subject.outcome(0)[0])[list(places)]).any(axis=0).sum())
    seeds = subject.seeds or max(FEWEST_SEEDS, math.ceil(degrees_needed(share=len(places)) / freedoms))
    errors, covariances = [], []
    for seed in range(seeds):
        result, truth = subject.outcome(seed)
        errors.append((values(result) - truth_at_places(result, truth))[list(places)])
        covariances.append(covariance(result)[list(places)])
    return np.array(errors), np.array(covariances)


def degrees_needed(share: int) -> int:
    """Return how many degrees of freedom it takes to see a covariance that is stated too large by ``FACTOR``."""
    degrees = 10
    while stats.chi2.ppf(POWER, degrees) / FACTOR > stats.chi2.ppf(FALSE_ALARM / 4 / share, degrees):
        degrees = math.ceil(degrees * 1.05)
    return degrees


def _labels(subject: MethodSubject) -> tuple[str, ...]:
    return names(subject.outcome(0)[0])


def require_honest(errors: np.ndarray, covariances: np.ndarray, labels: tuple[str, ...], where: str, share: int) -> str:
    """Fail unless errors (seed, n) are as large as covariances (seed, n, n) say.

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
            f"{where}: 95 % intervals of {name} hold the truth in {hits} of {seeds} seeds, "
            f"expected {low:.0f} to {high:.0f}",
        )

    z, R = e / u, C / (u[:, :, None] * u[:, None, :])
    weight, axes = np.linalg.eigh(R)
    solid = weight > 1e-9  # directions without any variance hold no information
    along = np.einsum("sij,si->sj", axes, z)
    nees = float((along[solid] ** 2 / weight[solid]).sum())
    degrees = int(solid.sum())
    floor, ceiling = (float(stats.chi2.ppf(p, degrees)) / degrees for p in (alarm / 2, 1 - alarm / 2))
    require(
        floor <= nees / degrees <= ceiling,
        f"{where}: the stated covariance is {_off(nees / degrees)}: mean NEES per freedom {nees / degrees:.2f}, "
        f"expected {floor:.2f} to {ceiling:.2f} over {seeds} seeds",
    )
    return f"{where} {100 * held.min() / seeds:.0f} % or more held, NEES {nees / degrees:.2f}"


def _off(ratio: float) -> str:
    return f"too small by a factor of {ratio:.2f}" if ratio > 1 else f"too large by a factor of {1 / ratio:.2f}"
