"""One figure of one machine over months: values, linear trend, and one step.

The scatter of the values about the model decides on its uncertainty, not their stated U alone, because runs differ by
more than a run can state. Weights are ``1 / U^2``; influences that all runs share shift all values and no trend.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from errormotion.arrays import Array
from errormotion.record.entry import Entry
from errormotion.tolerances.conformity import matches

YEAR = 365.25 * 86400.0
"""Seconds."""
COVERAGE = 0.9545
FALSE_ALARMS = 0.05
"""Probability that a step is reported where there is none, at most."""
LEAST_SIDE = 3
"""Values on either side of a step."""


@dataclass(frozen=True)
class Value:
    """Figure of one run; SI, k = 2, time in s since 1970 (UTC)."""

    run: str
    name: str
    time: float
    value: float
    expanded_uncertainty: float
    unit: str


@dataclass(frozen=True)
class Change:
    """A change with its uncertainty at 95.45 %: of a trend per year; of a step at ``time``, between two runs."""

    size: float
    expanded_uncertainty: float
    time: float = float("nan")
    p: float = float("nan")


def values_of(entries: Iterable[Entry], figure: str) -> list[Value]:
    """Return a figure of runs, the oldest first; ``*`` in its name stands for any characters.

    Of several figures of one run the first is taken; runs without time, value or uncertainty are left out.
    """
    found = []
    for entry in entries:
        each = next((each for each in entry.figures or () if matches(figure, each.name)), None)
        if each is None or entry.time is None:
            continue
        if np.isfinite(each.value) and np.isfinite(each.expanded_uncertainty) and each.expanded_uncertainty > 0:
            time = entry.time.timestamp()
            found.append(Value(entry.folder, each.name, time, each.value, each.expanded_uncertainty, each.unit))
    return sorted(found, key=lambda value: value.time)


def trend(values: list[Value]) -> Change | None:
    """Return the change per year by weighted least squares; None for fewer than three times."""
    t, y, w = _arrays(values)
    if np.unique(t).size < 3:
        return None
    fit = _fit(np.column_stack([np.ones_like(t), t]), y, w)
    return Change(fit[0][1], float(student.ppf(0.5 + COVERAGE / 2, fit[2])) * fit[1][1])


def step(values: list[Value]) -> Change | None:
    """Return the most significant step beside a linear trend; None where none is significant.

    The probability of a value as large as the observed one is multiplied by the number of positions examined
    (Bonferroni), which is on the safe side.
    """
    t, y, w = _arrays(values)
    best: Change | None = None
    splits = [k for k in range(LEAST_SIDE, len(values) - LEAST_SIDE + 1) if t[k] > t[k - 1]]
    for k in splits:
        after = (np.arange(t.size) >= k).astype(float)
        size, u, degrees = _fit(np.column_stack([np.ones_like(t), t, after]), y, w)
        if degrees < 1 or not u[2] > 0:
            continue
        p = min(1.0, len(splits) * 2.0 * float(student.sf(abs(size[2]) / u[2], degrees)))
        if p <= FALSE_ALARMS and (best is None or p < best.p):
            U = float(student.ppf(0.5 + COVERAGE / 2, degrees)) * u[2]
            best = Change(size[2], U, 0.5 * (values[k - 1].time + values[k].time), p)
    return best


def _arrays(values: list[Value]) -> tuple[Array, Array, Array]:
    """Return times in years from the first, values, and weights."""
    t = np.array([each.time for each in values])
    U = np.array([each.expanded_uncertainty for each in values])
    return (t - t[:1]) / YEAR, np.array([each.value for each in values]), 1.0 / U


def _fit(A: Array, y: Array, w: Array) -> tuple[Array, Array, int]:
    """Return parameters of a weighted fit, their standard uncertainties by the scatter, and the degrees of freedom."""
    degrees = int(y.size) - int(A.shape[1])
    if degrees < 1 or np.linalg.matrix_rank(A) < A.shape[1]:
        return np.full(A.shape[1], np.nan), np.full(A.shape[1], np.nan), 0
    x, *_ = np.linalg.lstsq(A * w[:, None], y * w, rcond=None)
    scatter = float(np.sum((w * (y - A @ x)) ** 2)) / degrees
    inverse = np.linalg.inv((A * w[:, None]).T @ (A * w[:, None]))
    return np.asarray(x, dtype=float), np.sqrt(scatter * np.diag(inverse)), degrees
