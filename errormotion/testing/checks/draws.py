"""Checks of the random draws of the sources of a method, for the Monte Carlo evaluation."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

import numpy as np
import xarray as xr
from numpy.random import SeedSequence

from errormotion.montecarlo.trials import sample, trial, trial_model_of
from errormotion.plugins import MethodSubject, TrialModel, states
from errormotion.testing.checks.coverage import require_honest, tested_places
from errormotion.testing.kit import require
from errormotion.testing.results import covariance, influence, names, raw_data, values

TRIALS = 40
"""Trials of each source; with five freedoms, a standard uncertainty that is 1.25 times too large is detected."""
SMALL = 1e-3
"""Fraction of a standard uncertainty below which draws and influence need not agree, as effects of second order."""


def why_no_trial_model(subject: MethodSubject) -> str:
    """Return why the checks do not apply: the method has no draws of its sources."""
    return "" if states(subject.plugin, "trial_model") else "the method has no draws of its sources (trial_model)"


def sources_drawn(subject: MethodSubject) -> str:
    """Draws depend only on the seed, do not change data and settings, and include all groups of influences."""
    raw, errors, drawn = _drawn(subject)
    before, settings = drawn.raw.copy(deep=True), drawn.settings.model_dump_json()
    with _quiet():
        first, again, other = (trial(subject.plugin(), drawn, SeedSequence(seed)) for seed in (1, 1, 2))
    require(np.array_equal(values(first), values(again), equal_nan=True), "one seed results in two different trials")
    require(not np.array_equal(values(first), values(other), equal_nan=True), "the trials ignore the seed")
    require(before.identical(drawn.raw), "a trial changed the raw data")
    require(drawn.settings.model_dump_json() == settings, "a trial changed the settings")
    covered = {group for source in drawn.sources.values() for group in source.groups}
    missing = sorted(_groups(errors) - covered)
    require(not missing, f"no source represents the groups {', '.join(missing)} of the influence")
    require(any(source.own for source in drawn.sources.values()), "no source represents the independent noise (own)")
    return f"{', '.join(drawn.sources)}; reduced from {raw.nbytes} to {drawn.raw.nbytes} bytes"


def sources_as_stated(subject: MethodSubject) -> str:
    """Draws of a single source have the covariance of its influence, and draws of all sources the stated covariance."""
    _, errors, drawn = _drawn(subject)
    places, verdicts = tested_places(subject), []
    for what, only in {"all sources": list(drawn.sources), **_parts(drawn)}.items():
        groups = {group for name in only for group in drawn.sources[name].groups}
        stated = covariance(errors) if len(only) == len(drawn.sources) else _of_groups(errors, groups)
        shape = values(errors).shape
        with _quiet():
            found, reasons = sample(subject.plugin(), drawn, SeedSequence(7), range(TRIALS), shape, only)
        require(not reasons, f"{what}: trials were refused: {'; '.join(reasons)}")
        for place in places:
            if not (np.nan_to_num(np.diagonal(stated[place])) > 0).any():
                continue
            off = found[:, place] - values(errors)[place]
            u, total = (np.sqrt(np.nan_to_num(np.diagonal(C[place]))) for C in (stated, covariance(errors)))
            moving = u > SMALL * total
            for name, its, most in zip(
                names(errors), off.T, np.where(moving, np.inf, SMALL * (u + total)), strict=True
            ):
                size = float(np.sqrt(np.mean(np.square(its))))
                require(
                    not size > 2 * most,
                    f"{what}, point {place}: the draws move {name} by {size:.2g}, more than its influence states",
                )
            off[:, ~moving] = np.nan
            repeated = np.repeat(stated[place][None], TRIALS, axis=0)
            verdict = require_honest(off, repeated, names(errors), f"{what}, point {place}", share=len(places))
            verdicts.append(verdict)
    return f"{TRIALS} trials; " + "; ".join(verdicts)


@lru_cache(maxsize=4)
def _drawn(subject: MethodSubject) -> tuple[xr.Dataset, xr.Dataset, TrialModel]:
    """Return raw data, result, and the draws of the sources, for two checks."""
    raw = raw_data(subject)
    errors, _ = subject.outcome(0)
    with _quiet():
        return raw, errors, trial_model_of(subject.plugin(), raw, subject.effective_settings(), errors)


def _groups(errors: xr.Dataset) -> set[str]:
    """Return the groups of sources that have an effect."""
    if "source_group" not in errors.coords:
        return set()
    moving = np.nan_to_num(np.abs(influence(errors))).max(axis=(0, 2)) > 0
    return {str(group) for group in errors["source_group"].values[moving]}


def _parts(drawn: TrialModel) -> dict[str, list[str]]:
    """Return the sources without independent part by their names; sources with a common group together."""
    parts: list[tuple[list[str], set[str]]] = []
    for name, source in drawn.sources.items():
        together = [part for part in parts if part[1] & set(source.groups)]
        names_ = [other for part in together for other in part[0]] + [name]
        merged = (names_, set(source.groups).union(*(part[1] for part in together)))
        parts = [part for part in parts if part not in together] + [merged]
    own = {name for name, source in drawn.sources.items() if source.own or not source.groups}
    return {", ".join(part): part for part, _ in parts if not own & set(part) and len(part) < len(drawn.sources)}


def _of_groups(errors: xr.Dataset, groups: set[str]) -> np.ndarray:
    """Return the covariance (place, n, n) from some groups of sources."""
    chosen = np.isin(errors["source_group"].values, sorted(groups))
    F = influence(errors)[:, chosen]
    return np.asarray(np.einsum("psi,psj->pij", F, F))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the messages of the trials in the log."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
