"""Target positions with their random part, and the order of the approaches (ISO 230-2:2014, clause 4)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings

LONG = 2.0
"""Travel up to which the standard asks for five targets per metre, m; beyond it, an interval of 250 mm."""
PER_METRE, LONG_INTERVAL, FEWEST = 5.0, 0.25, 11
RANDOM_SHARE = 0.3
"""Largest random part of a position as a share of the interval."""


@dataclass(frozen=True)
class Approach:
    """One approach of a target: over ``before`` (m) to ``place`` (m), where it is read.

    ``before`` is beyond the target on the side from which it is approached; None where the axis comes from there
    already.
    """

    run: int
    approach: int
    target: int
    before: float | None
    place: float


def positions(settings: Settings) -> Array:
    """Return the target positions in increasing order, (target,), m.

    A position is a multiple of the interval plus a random part, so that the targets do not have the period of a pitch
    or a grating. The first and the last target lie within the travel.
    """
    if settings.targets:
        return np.sort(np.array(settings.targets, np.float64))
    low, high = settings.travel
    return spread(low, high, settings.count or needed(high - low), settings)


def spread(low: float, high: float, count: int, settings: Settings) -> Array:
    """Return positions from ``low`` to ``high`` with their random parts, (count,), m."""
    interval = (high - low) / (count - 1)
    largest = min(RANDOM_SHARE * interval if settings.random_part is None else settings.random_part, 0.49 * interval)
    part = np.random.default_rng(settings.seed).uniform(-largest, largest, count)
    part[0], part[-1] = abs(part[0]), -abs(part[-1])
    # 1 um: the resolution of programs, so that commanded and stated positions agree.
    return np.round(low + interval * np.arange(count) + part, 6)


def needed(length: float) -> int:
    """Return the number of targets for a travel, m: as the standard asks, and at least 11."""
    if length <= LONG:
        return max(FEWEST, math.ceil(PER_METRE * length - 1e-9) + 1)
    return max(FEWEST, math.ceil(length / LONG_INTERVAL - 1e-9) + 1)


def sequence(settings: Settings, positions_of: Array | None = None) -> Iterator[Approach]:
    """Yield the approaches in their order, linear or pendulum cycles: of the targets of the settings, or of others."""
    places = [float(place) for place in (positions(settings) if positions_of is None else positions_of)]
    beyond = settings.overrun
    last = len(places) - 1
    if settings.cycle == "linear":
        for run in range(settings.runs):
            for i, place in enumerate(places):
                yield Approach(run, 0, i, place - beyond if i == 0 else None, place)
            for i in range(last, -1, -1):
                yield Approach(run, 1, i, places[i] + beyond if i == last else None, places[i])
        return
    for i, place in enumerate(places):
        for run in range(settings.runs):
            yield Approach(run, 0, i, place - beyond, place)
            yield Approach(run, 1, i, place + beyond, place)


def reach(settings: Settings) -> tuple[float, float]:
    """Return lowest and highest position of the axis, overrun included, m."""
    places = positions(settings)
    return float(places[0]) - settings.overrun, float(places[-1]) + settings.overrun


def seconds(settings: Settings) -> float:
    """Return the duration of the test at its feed, rests included, s; accelerations are neglected."""
    total, place = 0.0, None
    for approach in sequence(settings):
        for stop in (approach.before, approach.place):
            if stop is not None:
                total += abs(stop - place) / settings.feed if place is not None else 0.0
                place = stop
        total += settings.dwell
    return total
