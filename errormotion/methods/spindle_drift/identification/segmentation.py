"""Division of the record of a stepped scan into its steps, without the times of the moves.

The machine waits at its start position, moves to one end of the scan, rests at every step, and returns. Near the lowest
point of the sphere a step changes the reading by less than its noise, so that single edges cannot be found there; but
the control repeats the rests with one period. The two large moves, out and back, give start and period to a fraction of
a rest; both are then refined to the smallest variance of the readings within the steps.
Source of the procedure: Geiselhart et al. (euspen 2024), section 2.3; the search is by the authors of this package.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError

if TYPE_CHECKING:
    from numpy.typing import NDArray


_TICK = 0.01
"""Length of the means in which the moves are searched, s."""
_MOVE_RATIO = 20.0
"""Smallest ratio of a large move to the ordinary change: moves of tens of micrometres, noise a hundredth of that."""


LEAD = 10.0
"""Recording time of a scan in addition to its rests and moves, s."""


def scan_seconds(steps: int, dwell: float) -> float:
    """Return the recording time of one scan, s: its rests, a quarter more for the moves, and the lead."""
    return steps * dwell * 1.25 + LEAD


@dataclass(frozen=True)
class Steps:
    """A scan divided into steps.

    Attributes
    ----------
    mean : ndarray (step,)
        Mean reading of each step, m; NaN where less than half of it is valid.
    start, period : float
        Start of the first rest, s since the first sample, and time from rest to rest, s.
    count : ndarray of int64 (step,)
        Valid samples in each mean.
    """

    mean: Array
    start: float
    period: float
    count: NDArray[np.int64]


def segment_steps(distance: Array, rate: float, steps: int, dwell: float, average: float = 0.3) -> Steps:
    """Divide a record into ``steps`` rests and average each over ``average`` seconds from its middle on.

    Parameters
    ----------
    distance : ndarray (sample,)
        Readings, m; NaN where missing.
    rate : float
        Samples per second.
    steps : int
        Number of rests.
    dwell : float
        Commanded rest, s; the actual period may be up to half longer (moves, and delays of the control).
    average : float
        Length of the mean, s; at most half of ``dwell``.

    Raises
    ------
    MethodError
        No large moves out and back, or a period that does not agree with ``dwell``.
    """
    if average > 0.5 * dwell:
        raise MethodError(
            f"Averaging {average:g} s from the middle of a rest of {dwell:g} s: expected at most {dwell / 2:g} s.",
            code="detection.average.too_long",
        )
    tick = max(1, round(rate * _TICK))
    ticks = distance.size // tick
    if ticks < 10:
        raise MethodError(
            f"The record holds {distance.size / rate:.1f} s; expected {steps} steps of {dwell:g} s.",
            code="detection.record.too_short",
        )
    blocks = distance[: ticks * tick].reshape(ticks, tick)
    valid = np.isfinite(blocks)
    number = valid.sum(axis=1)
    level = np.where(number > 0, np.where(valid, blocks, 0.0).sum(axis=1) / np.maximum(number, 1), np.nan)
    seconds = tick / rate
    out, back = _large_moves(level, seconds, steps, dwell)
    period = (back - out) / steps
    if not 0.95 * dwell < period < 1.5 * dwell:
        raise MethodError(
            f"The scan lasts {back - out:.1f} s from its move out to its move back, {period:.3f} s a step for {steps} "
            f"steps; expected about {dwell:g} s. Check the number of steps and the dwell.",
            code="detection.steps.count",
        )
    start, period = _refine(level, seconds, steps, out, period)
    first = np.round((start + (np.arange(steps) + 0.5) * period) * rate).astype(np.int64)
    length = max(1, round(average * rate))
    if first[-1] + length > distance.size:
        raise MethodError(
            "The record ends before the last step. Record until the machine is back at its start position.",
            code="detection.record.too_short",
        )
    rests = distance[first[:, None] + np.arange(length)]
    count = np.isfinite(rests).sum(axis=1)
    total = np.where(np.isfinite(rests), rests, 0.0).sum(axis=1)
    mean = np.where(count >= length / 2, total / np.maximum(count, 1), np.nan)
    return Steps(mean, start, period, count)


def _large_moves(level: Array, seconds: float, steps: int, dwell: float) -> tuple[float, float]:
    """Return the times at which the machine arrives at the first step and leaves the last one."""
    quiet = max(1, round(0.1 / seconds))
    rest = max(2 * quiet, round(0.5 * dwell / seconds))
    known = np.isfinite(level)
    filled = np.interp(np.arange(level.size), np.flatnonzero(known), level[known]) if known.any() else level
    # Change over a tenth of a second, the duration of a move, compared with all other such changes.
    change = np.abs(filled[2 * quiet :] - filled[: -2 * quiet])
    least = round(0.95 * dwell * steps / seconds)
    if change.size <= least:
        raise MethodError(
            f"The record holds {level.size * seconds:.1f} s; a scan of {steps} steps needs more than "
            f"{steps * dwell:g} s.",
            code="detection.record.too_short",
        )
    # The pair of changes, at least a scan apart, with the largest sum.
    before = np.maximum.accumulate(change)
    pair = before[:-least] + change[least:]
    back = int(pair.argmax()) + least
    out = int(change[: back - least + 1].argmax())
    ordinary = np.median(change)
    if not min(change[out], change[back]) > _MOVE_RATIO * ordinary or out + rest >= back:
        raise MethodError(
            "The record shows no large moves out and back: expected the sphere to move to one end of the scan, step "
            "through it and return. Check that the program ran and that the sphere was in the beam.",
            code="detection.no_moves",
        )
    return (out + quiet) * seconds, (back + quiet) * seconds


def _refine(level: Array, seconds: float, steps: int, start: float, period: float) -> tuple[float, float]:
    """Shift and stretch the steps to the smallest variance of the readings inside them."""
    known = np.isfinite(level)
    offset = np.nanmedian(level)
    values = np.where(known, level - offset, 0.0)
    sums = [np.concatenate([[0.0], np.cumsum(part)]) for part in (known.astype(float), values, values**2)]
    k = np.arange(steps)

    def variance(start: Array, period: Array) -> Array:
        first = start[:, None] + (k + 0.15) * period[:, None]
        end = first + 0.7 * period[:, None]
        i = np.clip(np.round(first / seconds).astype(int), 0, level.size)
        j = np.clip(np.round(end / seconds).astype(int), 0, level.size)
        n, s, q = (total[j] - total[i] for total in sums)
        return np.asarray(np.sum(q - s**2 / np.maximum(n, 1), axis=1))

    width, stretch = 0.4 * period, 0.4 * period / steps
    for _ in range(4):
        starts, periods = np.meshgrid(
            start + np.linspace(-width, width, 41), period + np.linspace(-stretch, stretch, 21), indexing="ij"
        )
        noise = variance(starts.ravel(), periods.ravel())
        # Several solutions are equivalent once all edges are in the gaps: take their middle.
        best = noise <= noise.min() * 1.02 + 1e-30
        start, period = float(starts.ravel()[best].mean()), float(periods.ravel()[best].mean())
        width, stretch = width / 4, stretch / 4
    return start, period
