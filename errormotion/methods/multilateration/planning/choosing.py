"""Candidates for targets, and limits of the number of targets."""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.settings import Choosing, Position


def positions(choosing: Choosing, low: Position, high: Position) -> Array:
    """Return the axis positions of the candidates, (k, 3), m; ``low`` and ``high`` are the layout's corners.

    Raises
    ------
    MethodError
        A box without extent, or beyond the travel.
    """
    a = np.array(choosing.low if choosing.low is not None else low, np.float64)
    b = np.array(choosing.high if choosing.high is not None else high, np.float64)
    if (a > b).any():
        raise MethodError(
            f"candidates: expected low <= high in every coordinate; found {_mm(a)} and {_mm(b)}. Swap them.",
            code="network.candidates.order",
        )
    if (travel := choosing.travel) is not None and ((a < travel.low) | (b > travel.high)).any():
        raise MethodError(
            f"candidates: expected a box within the travel, {_mm(travel.low)} to {_mm(travel.high)}; found {_mm(a)} to "
            f"{_mm(b)}. Reduce it (planning.targets.low, high).",
            code="network.candidates.outside_travel",
        )
    axes = [np.linspace(x, y, k) if k > 1 else np.array([(x + y) / 2])
            for x, y, k in zip(a, b, choosing.candidates, strict=True)]  # fmt: skip
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def refuse_count(wanted: int, candidates: int, stations: int) -> None:
    """Raise MethodError for more targets than candidates, or for fewer than determine the stations."""
    least = -((6 - 4 * stations) // (stations - 3))
    if wanted > candidates:
        raise MethodError(
            f"Expected at most {candidates} targets, the number of candidates visible from three stations; found "
            f"{wanted}. Choose fewer, or increase the number of candidates (planning.targets.candidates).",
            code="network.plan.targets_too_many",
        )
    if wanted < least:
        raise MethodError(
            f"Expected at least {least} targets for {stations} stations with unknown positions and dead paths; found "
            f"{wanted}. Choose more, allow more time, or add a station.",
            code="network.plan.targets_too_few",
        )


def _mm(position: Array | Position) -> str:
    return "({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * float(x) for x in position))
