"""Diagnosis of a difference: single causes, ranked by likelihood ratio.

The effect of a cause on the difference of two datasets is linear in its size (a functional point, a rotation of the
frame, a scale, a shift in time, a constant, a step, an expansion) or fixed (a sign, exchanged axes, a unit). With the
covariance V of the difference d and the effects G of a cause, its size is the generalised least squares estimate, and
twice the logarithm of the likelihood ratio is ``d' V^-1 G' (G V^-1 G')^-1 G V^-1 d``. Causes are ranked by this value
minus the logarithm of the number of values for each parameter (Schwarz 1978).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import special

from errormotion.arrays import Array
from errormotion.compare.diagnosis.causes import Candidate, Corrected, Shifted, candidates
from errormotion.compare.diagnosis.shift import Course, fitted
from errormotion.compare.low_rank import Whitener, whitener
from errormotion.compare.stack import Estimate, difference

SCORE_MARGIN = 6.0
"""Difference of scores below which two causes are indistinguishable: a likelihood ratio of 20."""


@dataclass(frozen=True)
class Size:
    """One parameter of a cause: SI value, standard uncertainty, unit."""

    name: str
    value: float
    standard_uncertainty: float
    unit: str


@dataclass(frozen=True)
class Cause:
    """A cause, with measures of how well it explains a difference.

    Attributes
    ----------
    name : str
    sizes : tuple of Size
        Empty for a fixed cause.
    log_likelihood_ratio : float
        Relative to the hypothesis that the datasets agree.
    score : float
        Twice the log likelihood ratio, minus the penalty for the parameters.
    p : float
        Probability of larger residuals if this cause is the only one.
    alike : tuple of str
        Causes that are indistinguishable from it with these data.
    """

    name: str
    sizes: tuple[Size, ...]
    log_likelihood_ratio: float
    score: float
    p: float
    alike: tuple[str, ...] = field(default=())


def diagnose(
    a: Estimate,
    b: Estimate,
    freedoms: Sequence[str],
    *,
    time: Array | None = None,
    temperatures: Mapping[str, Array] | None = None,
    turns: Mapping[str, Array] | None = None,
    courses: Mapping[str, Course] | None = None,
) -> list[Cause]:
    """Return the possible causes of the difference of two estimates, the most likely one first.

    Parameters
    ----------
    a, b : Estimate
        Estimates on one grid, (n, d).
    freedoms : sequence of str
        Freedoms of the d columns.
    time : ndarray, (n,), optional
        Times, s; without them no cause in time is tested.
    temperatures : mapping of str to ndarray (n,), optional
        Recorded temperatures, degC, for an expansion.
    turns : mapping of str to ndarray (n, 3), optional
        Rotations by dataset, rad; for its functional point, if rotations are not compared.
    courses : mapping of str to Course, optional
        Smoothed errors by dataset, over its whole record, for a shift in time.

    Returns
    -------
    list of Cause
        Empty without known values. The first cause may be insignificant; see `Cause.p`.
    """
    d = difference(a, b)
    white = whitener(d.own, d.influence)
    if not white.degrees:
        return []
    whole = white.square(d.value)
    count = max(white.degrees, 2)
    by_kind: dict[str, Cause] = {}
    for candidate in candidates(a, b, freedoms, time, temperatures or {}, turns or {}, courses or {}):
        if (found := _judged(candidate, d, white, whole, count)) is None:
            continue
        kind = (candidate.kind if isinstance(candidate, Candidate) else "") or found.name
        if kind not in by_kind or found.score > by_kind[kind].score:
            by_kind[kind] = found  # the best one of a search
    causes = sorted(by_kind.values(), key=lambda each: -each.score)
    return [_with_alike(cause, causes) for cause in causes]


def _judged(
    candidate: Candidate | Corrected | Shifted, d: Estimate, white: Whitener, whole: float, count: int
) -> Cause | None:
    if isinstance(candidate, Corrected):
        return _corrected(candidate, d, white, whole)
    if isinstance(candidate, Shifted):
        shift = fitted(candidate.course, candidate.sign, candidate.time, d.value, white)
        if shift is None or shift.gain <= 0:
            return None
        p = float(special.chdtrc(max(white.degrees - 1, 1), max(whole - shift.gain, 0.0)))
        size = Size("shift", shift.value, shift.standard_uncertainty, "s")
        return Cause("shift in time", (size,), shift.gain / 2, float(shift.gain - np.log(count)), p)
    effects = np.where(np.isfinite(d.value), np.nan_to_num(candidate.effects), 0.0)
    normal, gradient = white.product(effects, effects), white.product(effects, d.value[None])[:, 0]
    choices = candidate.choices or (tuple(range(len(effects))),)
    # A search is a maximum of dependent statistics; its penalty is the logarithm of the number of trials.
    search = 2 * np.log(candidate.tries * len(choices))
    best: tuple[float, float, list[int], Array, Array] | None = None
    for choice in choices:
        used = list(choice)
        if (solved := _sizes(normal[np.ix_(used, used)], gradient[used])) is None:
            continue
        beta, C, gain = solved
        score = gain - len(used) * np.log(count) - search
        if best is None or score > best[0]:
            best = (score, gain, used, beta, C)
    if best is None:
        return None
    score, gain, used, beta, C = best
    sizes = tuple(
        Size(candidate.labels[i][0], float(value), float(u), candidate.labels[i][1])
        for i, value, u in zip(used, beta, np.sqrt(np.diag(C)), strict=True)
    )
    p = float(special.chdtrc(max(white.degrees - len(used), 1), max(whole - gain, 0.0)))
    return Cause(candidate.name, sizes, gain / 2, float(score), p)


def _sizes(normal: Array, gradient: Array) -> tuple[Array, Array, float] | None:
    """Return sizes, their covariance, and the decrease of the sum of squares; None if they are not determined."""
    scale = np.sqrt(np.diag(normal))
    if not (scale > 0).all():
        return None
    unit = normal / np.outer(scale, scale)
    if np.linalg.cond(unit) > 1e10:
        return None
    C = np.linalg.inv(unit) / np.outer(scale, scale)
    beta = C @ gradient
    return beta, C, float(beta @ gradient)


def _corrected(candidate: Corrected, d: Estimate, white: Whitener, whole: float) -> Cause:
    """Evaluate a cause by the likelihood of both datasets, since the correction changes the covariance as well.

    With ``a' = A a``, ``b' = B b`` and the covariance V' of their difference, ``-2 ln L = chi'^2 + ln |V'|``, minus
    ``ln |A| + ln |B|``: a factor on one dataset and its inverse on the other one are equivalent.
    """
    right = difference(candidate.a, candidate.b)
    its = whitener(right.own, right.influence)
    rest = its.square(right.value)
    counted = (np.isfinite(d.value) & (np.nan_to_num(d.variance()) > 0)).sum(axis=0)
    stretched = float(counted @ np.log(candidate.stretch)) if candidate.stretch is not None else 0.0
    gain = whole - rest + white.log_determinant - its.log_determinant + stretched
    p = float(special.chdtrc(its.degrees, rest)) if its.degrees else float("nan")
    return Cause(candidate.name, (), gain / 2, gain, p)


def _with_alike(cause: Cause, causes: Sequence[Cause]) -> Cause:
    names = [other.name for other in causes if other is not cause and abs(other.score - cause.score) <= SCORE_MARGIN]
    return replace(cause, alike=tuple(names))
