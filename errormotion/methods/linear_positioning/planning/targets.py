"""Target positions with their random part, and the order of the approaches (ISO 230-2:2014, clause 4)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

LONG_TRAVEL = 2.0
"""Travel up to which the standard requires five targets per metre, m; beyond it, an interval of 250 mm."""
PER_METRE, LONG_INTERVAL, FEWEST = 5.0, 0.25, 11
RANDOM_SHARE = 0.3
"""Largest random part of a position as a share of the interval."""
_STEPS, _DISPLAY = 10, 1e-3
"""Attempts to fit targets into a travel, and steps of its ends, m."""


@dataclass(frozen=True)
class Approach:
    """One approach to a target, in the ``direction`` 0 (forward) or 1 (backward), and the reading at ``position``, m.

    ``before`` (m) is a position on the side from which the target is approached, to which the axis moves first; None if
    the axis is on this side already.
    """

    run: int
    direction: int
    target: int
    before: float | None
    position: float


def positions(settings: LinearPositioningSettings) -> Array:
    """Return the target positions in increasing order, (target,), m.

    A position is a multiple of the interval plus a random part, so that the targets are not periodic like a screw or a
    scale. The first and the last target lie within the travel.
    """
    if settings.targets:
        return np.sort(np.array(settings.targets, np.float64))
    low, high = settings.travel
    return randomised(low, high, settings.count or standard_count(high - low), settings)


def randomised(low: float, high: float, count: int, settings: LinearPositioningSettings) -> Array:
    """Return positions from ``low`` to ``high`` with their random parts, (count,), m."""
    interval = (high - low) / (count - 1)
    largest = min(RANDOM_SHARE * interval if settings.random_part is None else settings.random_part, 0.49 * interval)
    part = np.random.default_rng(settings.seed).uniform(-largest, largest, count)
    part[0], part[-1] = abs(part[0]), -abs(part[-1])
    # rounded to 1 um, the resolution of programs, so that commanded and stated positions agree
    return np.round(low + interval * np.arange(count) + part, 6)


def standard_count(length: float) -> int:
    """Return the number of targets that the standard requires for a travel, m, and at least 11."""
    if length <= LONG_TRAVEL:
        return max(FEWEST, math.ceil(PER_METRE * length - 1e-9) + 1)
    return max(FEWEST, math.ceil(length / LONG_INTERVAL - 1e-9) + 1)


def sequence(settings: LinearPositioningSettings, targets: Array | None = None) -> Iterator[Approach]:
    """Yield the approaches to targets, m, by default those of the settings, in the order of the cycle."""
    P = [float(position) for position in (positions(settings) if targets is None else targets)]
    overrun = settings.overrun
    last = len(P) - 1
    if settings.cycle == "linear":
        for run in range(settings.runs):
            for i, position in enumerate(P):
                yield Approach(run, 0, i, position - overrun if i == 0 else None, position)
            for i in range(last, -1, -1):
                yield Approach(run, 1, i, P[i] + overrun if i == last else None, P[i])
        return
    for i, position in enumerate(P):
        for run in range(settings.runs):
            yield Approach(run, 0, i, position - overrun, position)
            yield Approach(run, 1, i, position + overrun, position)


def reach(settings: LinearPositioningSettings) -> tuple[float, float]:
    """Return the lowest and highest position of the axis, overrun included, m."""
    P = positions(settings)
    return float(P[0]) - settings.overrun, float(P[-1]) + settings.overrun


def within(settings: LinearPositioningSettings, span: tuple[float, float]) -> tuple[float, float] | None:
    """Return the longest travel of the targets with which the axis stays in its span, m; None if there is none."""
    low, high = span
    for _ in range(_STEPS):
        if not low < high:
            return None
        first, last = reach(settings.model_copy(update={"travel": (low, high)}))
        beyond = max(span[0] - first, 0.0), max(last - span[1], 0.0)
        if not any(beyond):
            return low, high
        low = _DISPLAY * math.ceil((low + beyond[0]) / _DISPLAY - 1e-9)
        high = _DISPLAY * math.floor((high - beyond[1]) / _DISPLAY + 1e-9)
    return None


def seconds(settings: LinearPositioningSettings) -> float:
    """Return the duration of the test at its feed, dwells included, s; accelerations are neglected."""
    total, last = 0.0, None
    for approach in sequence(settings):
        for stop in (approach.before, approach.position):
            if stop is not None:
                total += abs(stop - last) / settings.feed if last is not None else 0.0
                last = stop
        total += settings.dwell
    return total
