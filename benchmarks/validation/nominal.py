"""Nominal coverage: every method, with the data that its model assumes, against the rule of `testing.nominal`."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib import import_module

import numpy as np
import xarray as xr

from errormotion.errors import MethodError
from errormotion.plugins import MethodSubject
from errormotion.testing import nominal
from errormotion.testing.results import covariance, names, truth_at_places, values

TITLE = "Nominal coverage"
SEEDS = nominal.SEEDS
Z95 = 1.959964
METHODS = (
    *("beam_direction", "circular_test", "crossbeam_scan", "linear_positioning", "multilateration"),
    *("normal_vector", "r_test", "spindle_drift", "spindle_error_motion"),
)
SLOW = {("crossbeam_scan", "scan")}
"""Subjects of which 200 seeds suffice."""
FURTHER = {
    "location_error": "location_covariance",
    "squareness": "squareness_covariance",
    "figures": "figure_covariance",
    "parameters": "parameter_covariance",
}
"""Further results with their covariance, by the names of their variables."""
BEFORE = 1000
"""Seeds of other uses are smaller."""


def section(seeds: int, workers: int = 1) -> Iterator[str]:
    """Yield the lines of the section."""
    yield (
        "The data of the conformance kit's simulations, unchanged. Intervals of 95 % of every error at every place, "
        "and of further results with a covariance. The rule: the share of all intervals is "
        f"{nominal.NOMINAL:.0%} within {nominal.PART:.0%} over {nominal.SEEDS} seeds, and no single figure rejects "
        f"{nominal.NOMINAL:.0%} at {nominal.LEVEL:.0%} (exact binomial tests, probabilities by Holm). `worst`: the "
        "figure that contradicts most, its share, and this probability."
    )
    yield from (
        "",
        "| method | figures | seeds | refused | pooled | worst | share | p | rule |",
        "|---|---|---|---|---|---|---|---|---|",
    )
    for method in METHODS:
        for subject in subjects(method):
            its = min(seeds, 200) if (method, subject.name) in SLOW else seeds
            found, refused = verdict(method, subject.name, its, workers)
            name = " ".join(filter(None, (f"`{method}`", subject.name)))
            rule = "met" if found.met else "not met" if found.enough else "few seeds"
            yield (
                f"| {name} | {found.figures} | {found.seeds} | {refused} | {found.pooled:.1%} | {found.worst} "
                f"| {found.share:.1%} | {found.probability:.2g} | {rule} |"
            )


def subjects(method: str) -> tuple[MethodSubject, ...]:
    """Return the subjects of the conformance kit of a method."""
    found: tuple[MethodSubject, ...] = import_module(f"errormotion.methods.{method}.conformance").subjects()
    return found


def verdict(method: str, name: str, seeds: int, workers: int = 1) -> tuple[nominal.Verdict, int]:
    """Return whether a subject meets the rule, and the number of data sets that are refused."""
    one, every = partial(of_seed, method, name), range(BEFORE, BEFORE + seeds)
    if workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            rows = list(pool.map(one, every, chunksize=10))
    else:
        rows = [one(seed) for seed in every]
    labels = list(dict.fromkeys(label for row in rows for label in row))
    held = np.array([[row.get(label, np.nan) for label in labels] for row in rows])
    least = 200 if (method, name) in SLOW else nominal.SEEDS
    return nominal.verdict(held, labels, seeds=least), sum(not row for row in rows)


def of_seed(method: str, name: str, seed: int) -> dict[str, float]:
    """Return by figure whether its interval contains the truth, of one seed; empty if its data are refused."""
    subject = next(each for each in subjects(method) if each.name == name)
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            raw, truth = subject.make(seed)
            return inside(subject.identify(raw), truth)
    except MethodError:
        return {}
    finally:
        logging.disable(before)


def inside(errors: xr.Dataset, truth: xr.Dataset) -> dict[str, float]:
    """Return by figure whether its interval of 95 % contains the truth, 1 or 0; one that is known exactly is none."""
    off = values(errors) - truth_at_places(errors, truth)
    u = np.sqrt(np.einsum("pii->pi", covariance(errors)))
    found = {
        f"{dof} at {place + 1}": _held(off[place, k], u[place, k])
        for place in range(len(off))
        for k, dof in enumerate(names(errors))
    }
    for name, matrix in FURTHER.items():
        if name in errors and name in truth and matrix in errors:
            over = errors[name].dims
            value, true = errors[name].values.ravel(), truth[name].transpose(*over).values.ravel()
            variance = np.diagonal(errors[matrix].values)
            label = [str(each) for each in errors[over[0]].values] if over and over[0] in errors.coords else []
            for k, each in enumerate(label or map(str, range(value.size))):
                found[f"{name} {each}"] = _held(value[k] - true[k], np.sqrt(variance[k]))
    return {name: held for name, held in found.items() if np.isfinite(held)}


def _held(off: float, u: float) -> float:
    """Return whether an interval contains the truth; NaN if there is none, or if it is known exactly."""
    if not (np.isfinite(off) and np.isfinite(u)) or (u == 0 and off == 0):
        return np.nan
    return float(abs(off) <= Z95 * u)
