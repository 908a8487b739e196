"""Real readings: every method with readings that are rounded, wrong, drifting or correlated."""

from __future__ import annotations

import logging
import re
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib import import_module

import numpy as np
import xarray as xr

from errormotion.errors import MethodError
from errormotion.plugins import MethodSubject
from errormotion.testing.results import covariance, truth_at_places, values

TITLE = "Real readings"
SEEDS = 60
Z95 = 1.959964
STEP, OUTLIER, TREND, PHI = 10.0, 300.0, 10.0, 0.8
"""Step of the scale, size of an outlier and range of a trend, in standard deviations of the noise; correlation."""
_NUMBER = re.compile(r"[-+]?\d[\d.,]*(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Case:
    """Simulated data of a method: readings with their noise (SI), and the dims along which they drift or correlate.

    ``most`` seeds are examined, where one takes seconds.
    """

    method: str
    subject: str
    readings: str
    noise: float
    over_test: str = ""
    neighbours: str = ""
    most: int = 1000

    @property
    def conditions(self) -> tuple[str, ...]:
        """The changes that apply to it."""
        more = {"trend": self.over_test, "correlated": self.neighbours}
        return ("nominal", "rounded", "outlier", *(name for name, dim in more.items() if dim))


CASES = (
    Case("linear_positioning", "positioning", "deviation", 0.3e-6, "run", "target"),
    Case("linear_positioning", "diagonals", "diagonal_deviation", 0.3e-6, "run", "stop"),
    Case("spindle_drift", "drift", "distance", 3e-9, "", "time"),
    Case("beam_direction", "", "distance", 1e-6),
    Case("multilateration", "", "displacement", 0.5e-6),
    Case("normal_vector", "", "touch", 0.25e-6),
    Case("r_test", "three spheres", "displacement", 0.2e-6, "", "angle"),
    Case("crossbeam_scan", "scan", "height", 0.5e-6, "", "profile", most=20),
    Case("crossbeam_scan", "registrations", "displacement", 0.1e-6),
    Case("spindle_error_motion", "five sensors", "displacement", 5e-9, "", "time"),
    Case("circular_test", "", "length", 0.2e-6, "run", "sample"),
)


@dataclass(frozen=True)
class Outcome:
    """One data set: the share of intervals that hold the truth, the kinds of its notes, and whether they doubt U."""

    held: float
    kinds: frozenset[str]
    doubted: bool


def section(seeds: int, workers: int = 1) -> Iterator[str]:
    """Yield the lines of the section."""
    yield (
        "Intervals of 95 % that hold the truth, where the readings of the conformance kit's simulations are changed: "
        f"rounded to {STEP:g} times their noise; one reading wrong by {OUTLIER:g} times the noise; a trend over the "
        f"test of {TREND:g} times the noise, whose truth is that of its beginning; further noise of twice the size "
        f"with a correlation of {PHI:g} between neighbours. "
        "Noted: data sets with a kind of note that fewer than half of the nominal ones have, or that are refused; of "
        "the nominal ones, false alarms. Doubted: with a note that doubts the uncertainty. The values of one data set "
        f"share sources, so that a share has a standard deviation of up to {np.sqrt(0.05 * 0.95 / seeds):.0%}. Fewer "
        f"seeds: {', '.join(f'`{case.method}` {case.subject} {case.most}' for case in CASES if case.most < seeds)}."
    )
    yield from ("", "| method | condition | held | noted | doubted | refused |", "|---|---|---|---|---|---|")
    if workers == 1:
        for case in CASES:
            yield from rows(case, min(seeds, case.most))
        return
    with ProcessPoolExecutor(workers) as pool:
        for found in [pool.submit(rows, case, min(seeds, case.most)) for case in CASES]:
            yield from found.result()


def rows(case: Case, seeds: int) -> list[str]:
    """Return one row for each condition of a method."""
    usual, lines = set[str](), list[str]()
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    for condition in case.conditions:
        found = outcomes(case, condition, seeds)
        known = [each for each in found if each is not None]
        if condition == "nominal":
            count = Counter(kind for each in known for kind in each.kinds)
            usual = {kind for kind, n in count.items() if 2 * n >= len(known)}
        refused = len(found) - len(known)
        noted = refused + sum(not each.kinds <= usual for each in known)
        doubted = refused + sum(each.doubted for each in known)
        name = " ".join(filter(None, (f"`{case.method}`", case.subject)))
        held = f"{np.mean([each.held for each in known]):.1%}" if known else "-"
        shares = " | ".join(f"{n / seeds:.0%}" for n in (noted, doubted, refused))
        lines.append(f"| {name} | {condition} | {held} | {shares} |")
    logging.disable(logging.NOTSET)
    return lines


def outcomes(case: Case, condition: str, seeds: int) -> list[Outcome | None]:
    """Return what is found with each seed; None where the data are refused."""
    subject = next(
        each
        for each in import_module(f"errormotion.methods.{case.method}.conformance").subjects()
        if each.name == case.subject
    )
    found: list[Outcome | None] = []
    for seed in range(seeds):
        raw, truth = subject.make(seed)
        raw = changed(raw, case, condition, np.random.default_rng([seed, 1]))
        try:
            found.append(outcome(subject, raw, truth))
        except MethodError:
            found.append(None)
    return found


def outcome(subject: MethodSubject, raw: xr.Dataset, truth: xr.Dataset) -> Outcome:
    """Return what is found with one data set."""
    errors = subject.identify(raw)
    for dim in set(errors.em.dims) & set(truth.dims):
        if np.issubdtype(errors[dim].dtype, np.floating):  # a wrong time may be outside of the truth
            low, high = float(truth[dim].min()), float(truth[dim].max())
            errors = errors.isel({dim: np.flatnonzero((errors[dim] >= low) & (errors[dim] <= high))})
    off = values(errors) - truth_at_places(errors, truth)
    u = np.sqrt(np.einsum("pii->pi", covariance(errors)))
    known = np.isfinite(off) & np.isfinite(u) & ((u > 0) | (off != 0))
    return Outcome(
        held=float((np.abs(off) <= Z95 * u)[known].mean()),
        kinds=frozenset(kind(note) for note in errors.em.notes),
        doubted=bool(len(np.atleast_1d(errors.attrs.get("doubts_uncertainty", [])))),
    )


def kind(note: str) -> str:
    """Return a note without its numbers."""
    return _NUMBER.sub("#", note)


def changed(raw: xr.Dataset, case: Case, condition: str, rng: np.random.Generator) -> xr.Dataset:
    """Return raw data with changed readings."""
    before = raw[case.readings]
    y = before.values.astype(float).copy()
    if condition == "rounded":
        q = STEP * case.noise
        y = np.round(y / q) * q
    elif condition == "outlier":
        y.flat[rng.choice(np.flatnonzero(np.isfinite(y)))] += OUTLIER * case.noise
    elif condition == "trend":
        along = np.moveaxis(y, before.dims.index(case.over_test), -1)
        along += TREND * case.noise * np.linspace(0.0, 1.0, along.shape[-1])
    elif condition == "correlated":
        along = np.moveaxis(y, before.dims.index(case.neighbours), 0)
        e = rng.standard_normal(along.shape)
        for k in range(1, len(e)):
            e[k] = PHI * e[k - 1] + np.sqrt(1 - PHI**2) * e[k]
        along += 2 * case.noise * e
    return raw.assign({case.readings: (before.dims, y, before.attrs)})
