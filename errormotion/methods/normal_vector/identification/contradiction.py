"""Touches that contradict the stated axes of the tool, and agree with others.

With wrong axes, balls at rest seem to move, one after the other; without these balls the remaining touches fit, and
their uncertainty is that of the noise alone. A ball that has really moved is explained by no other axes, unless there
are only three balls.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from errormotion.errors import MethodError
from errormotion.methods.normal_vector.identification.freedoms import Motion, undetermined
from errormotion.methods.normal_vector.identification.moved import AMBIGUITY, FALSE_ALARM, Cleaned, clean
from errormotion.methods.normal_vector.identification.reading import AXES
from errormotion.methods.normal_vector.identification.rigid import determined, fit

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.identification.rigid import Observations, Rigid


def agreeing_axes(
    seen: Observations, motion: Motion, cleaned: Cleaned, *,
    interpolate: bool, stated: bool, smallest_move: float,
) -> list[str]:  # fmt: skip
    """Return other axes of the tool with which all touches agree, the best first, if they do not with the stated ones.

    Parameters
    ----------
    seen : Observations
        All touches.
    motion : Motion
        With the stated axes.
    cleaned : Cleaned
        With the stated axes.
    interpolate, stated, smallest_move
        See `moved.clean`.
    """
    if agrees(cleaned, len(seen.cycle_time), stated) and stated:
        return []
    found: list[tuple[float, str]] = []
    for axes in AXES:
        other = Motion(axes, motion.point)
        if axes == motion.tool_axes or undetermined(cleaned.fit.anchor, other):
            continue
        try:
            free = clean(seen, other, interpolate=interpolate, stated=stated, robust=True, smallest_move=smallest_move)
        except MethodError:
            continue
        if not agrees(free, len(seen.cycle_time), stated):
            continue
        common = seen.cycles(np.flatnonzero(determined(seen, motion) & determined(seen, other)))
        chi2, other_chi2 = (fit(common, each, interpolate=interpolate).chi2 for each in (motion, other))
        gain = (chi2 - other_chi2) / _variance(free.fit, stated)
        further = max(len(other.seen) - len(motion.seen), 0) * len(common.cycle_time)
        if gain > AMBIGUITY + (special.chdtri(further, FALSE_ALARM) if further else 0.0):
            found.append((-gain, axes))
    return [axes for _, axes in sorted(found)]


def agrees(cleaned: Cleaned, cycles: int, stated: bool) -> bool:
    """Return whether nothing was excluded, and the touches scatter as stated."""
    excluded = bool(cleaned.moves) or bool(cleaned.wrong.any()) or len(cleaned.used) < cycles
    found = cleaned.fit
    return not excluded and not (
        stated and found.freedom > 0 and found.chi2 > special.chdtri(found.freedom, FALSE_ALARM)
    )


def _variance(found: Rigid, stated: bool) -> float:
    return 1.0 if stated else float(found.chi2 / np.maximum(found.freedom, 1))
