"""Order of the targets of a set-up, and the steps of the machine in a test."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.planning import layout
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.methods.multilateration.settings import Measuring, MultilaterationSettings


def tour(settings: MultilaterationSettings, returns: int) -> tuple[Array, Array, list[int]]:
    """Return axis positions and positions of the reflector, both (m, 3), m, and the order of visits.

    Targets that are visited again (``returns``) are appended.
    """
    position, target = layout.grid(settings.layout)
    order = layout.route(settings.layout)
    again = order[: len(order) // 2 + 1]
    again = [again[int(k)] for k in np.linspace(0, len(again) - 1, min(returns, len(again)))]
    order = [*order, *range(len(target), len(target) + len(again))]
    return np.concatenate([position, position[again]]), np.concatenate([target, target[again]]), order


def stations(settings: MultilaterationSettings, measuring: Measuring) -> list[int]:
    """Return the stations in the order of their set-ups, from 0; MethodError for one that does not exist."""
    count = len(settings.layout.stations)
    sequence = measuring.sequence or tuple(range(1, count + 1))
    if wrong := [k for k in sequence if not 1 <= k <= count]:
        raise MethodError(
            f"measuring.sequence: expected numbers of stations from 1 to {count}; found {wrong}",
            code="network.sequence.form",
        )
    return [k - 1 for k in sequence]


def steps(settings: MultilaterationSettings) -> list[Step]:
    """Return every step of all set-ups, without repetitions: rapid moves, and dwells."""
    position, _, order = tour(settings, settings.measuring.returns)
    result: list[Step] = []
    for _ in stations(settings, settings.measuring):
        for i in (order[0], *order):
            x, y, z = (float(each) for each in position[i])
            result.append(Step("move", (x, y, z), math.nan, math.nan))
            result.append(Step("rest", None, math.nan, settings.measuring.settle))
    return result
