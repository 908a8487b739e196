"""Touches that contradict the stated axes of the tool, and agree with others.

With wrong axes, balls at rest seem to move, one after the other; without these balls the remaining touches fit, and
their uncertainty is that of the noise alone. A ball that has really moved is explained by no other axes, unless there
are only three balls.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from errormotion.errors import FitError, MethodError
from errormotion.estimation.checks.exclusions import FALSE_ALARM
from errormotion.estimation.fit import Fit
from errormotion.methods.normal_vector.identification.freedoms import Motion, undetermined
from errormotion.methods.normal_vector.identification.reading import AXES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.estimation.checks.exclusions import Cleaned
    from errormotion.measurement.identification import Solved
    from errormotion.methods.normal_vector.model import Probing

ODDS = 12.0
"""Difference in chi-square from which one explanation is more probable than another: odds of 400 to 1."""


def contradiction(solved: Solved, probing: Probing, smallest_move: float) -> str:
    """Return a note if the touches may contradict the axes that carry the tool; "" if they do not.

    Raises
    ------
    MethodError
        They contradict these axes, and all of them agree with others.
    """
    agreeing = agreeing_axes(solved, probing, smallest_move)
    if not agreeing or solved.cleaned is None:
        return ""
    stated, other = probing.motion.tool_axes or "none", " or ".join(axes or "none" for axes in agreeing)
    if len(solved.cleaned.made) == 1 and probing.usable(solved.fit.problem).all():
        return (
            f"All touches would agree without any exclusion if other axes carried the tool: {other} instead of "
            f"{stated} (tool_axes). Check the machine."
        )
    raise MethodError(
        f"The touches contradict tool_axes = {stated}, the axes that carry the tool: balls seem to move, or touches "
        f"scatter. All of them agree with {other}. State the axes that carry the tool (attribute tool_axes of the "
        "data, which has priority, or the setting).",
        code="probing.tool_axes.contradicted",
    )


def agreeing_axes(solved: Solved, probing: Probing, smallest_move: float) -> list[str]:
    """Return other axes of the tool with which all touches agree, the best first, if they do not with the stated ones.

    Parameters
    ----------
    solved : Solved
        With the stated axes; what was excluded tells whether the touches agree with them.
    probing : Probing
    smallest_move : float
        Of a ball, m.
    """
    if solved.cleaned is None:
        return []
    if solved.given.noise.stated and agrees(solved.cleaned, probing):
        return []
    try:
        own = _Whole(probing)
    except FitError:
        return []
    anchor = solved.fit.constants.centre if probing.data.seen.touched else solved.fit.unknowns.reach
    agreeing: list[tuple[float, str]] = []
    for axes in AXES:
        other = replace(probing, motion=Motion(axes, probing.motion.point))
        if axes == probing.motion.tool_axes or undetermined(anchor, other.motion):
            continue
        try:
            gain, further = _gain(own, _Whole(other))
            if gain <= ODDS + (special.chdtri(further, FALSE_ALARM) if further else 0.0):
                continue
            if agrees(other.cleaned(smallest_move), other):
                agreeing.append((-gain, axes))
        except FitError:
            continue
    return [axes for _, axes in sorted(agreeing)]


def agrees(cleaned: Cleaned, probing: Probing) -> bool:
    """Return whether nothing was excluded, and the touches scatter as stated."""
    return (
        not (cleaned.made or cleaned.undecided)
        and bool(probing.usable(cleaned.fit.problem).all())
        and _scatter_as_stated(cleaned.fit)
    )


class _Whole:
    """The fit of all readings with some axes of the tool."""

    def __init__(self, probing: Probing) -> None:
        self.probing = probing
        self.fit = probing.fitted(probing.problem())
        self.usable = probing.usable(self.fit.problem)

    def chi2(self, cycles: NDArray[np.bool_]) -> float:
        """Return the sum of squares of the readings in some cycles (k,)."""
        some = self.fit if np.array_equal(cycles, self.usable) else self.probing.fitted(self.probing.problem(), cycles)
        return some.chi2


def _gain(own: _Whole, other: _Whole) -> tuple[float, int]:
    """Return the decrease of chi-square by other axes, and the number of their further unknowns.

    Both explain the cycles that determine the motion with either. Without a stated noise its variance is that of all
    touches with the other axes.
    """
    variance = 1.0 if other.fit.problem.noise.stated else other.fit.chi2 / max(other.fit.freedom, 1)
    both = own.usable & other.usable
    further = max(len(other.probing.motion.seen) - len(own.probing.motion.seen), 0) * int(both.sum())
    return (own.chi2(both) - other.chi2(both)) / variance, further


def _scatter_as_stated(solution: Fit) -> bool:
    stated = solution.problem.noise.stated
    return not (stated and solution.freedom > 0 and solution.chi2 > special.chdtri(solution.freedom, FALSE_ALARM))
