"""Diagnosis of a difference: single causes, ranked by their posterior odds.

A cause either adds an effect that is linear in its sizes to the difference d of two datasets (a constant, a step, a
drift, an expansion, a shift in time), or changes what one dataset states at its own functional point (the point itself,
the orientation of its frame, a scale, a sign, exchanged axes, a unit, the point at which a straightness is read). The
sizes are those of the greatest likelihood. With the covariance V of the difference before and V' after the correction
the gain of a cause is ``2 ln L = d' V^-1 d - d'' V'^-1 d'' + ln |V| - ln |V'|``, with the determinant of a scale or a
unit. Causes are ranked by

    score = gain - k ln n - 2 ln(choices) - 2 ln(members) - 2 ln(families):

k sizes of n values (Schwarz 1978), and a prior that is equal for all families, for all causes of a family, and for all
choices within a cause. A cause is named if its score is positive: the data then favour it against chance. A cause that
changes the errors of a dataset changes their noise as well: it is named only if the change is significant.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy import special

from errormotion.arrays import Array
from errormotion.compare.diagnosis.causes import Added, AnyCause, Mapped, Read, Shifted, Side, candidates
from errormotion.compare.diagnosis.shift import SmoothCurves, fitted
from errormotion.compare.point_errors import Stored
from errormotion.compare.stack import Estimate, difference
from errormotion.estimation.low_rank import Whitener, whitener
from errormotion.kinematics.iso import DOF

SCORE_MARGIN = 6.0
"""Difference of scores below which two causes are indistinguishable: a likelihood ratio of 20."""
SIGNIFICANT = 0.05
"""Probability of a larger change of a dataset by its noise alone, above which a cause that changes it is not named."""
REFINEMENTS = 8
"""Largest number of Gauss-Newton steps to the sizes of a cause that changes the covariance as well."""
SELECTIONS = 3
"""Largest number of selections of the sizes that differ from 0."""
SETTLED = 0.05
"""Step in units of its standard uncertainty that ends them."""
WORST_CONDITION = 1e10
"""Condition number of scaled normal equations above which their sizes are not determined."""
SMALL = 1e-6
"""Difference of a parameter for a derivative."""


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
        Twice the log likelihood ratio, minus the penalties for sizes and choices and for the prior.
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


@dataclass(frozen=True)
class _Difference:
    """The difference of two datasets as they are, its whitener, sum of squares, and number of values."""

    a: Side
    b: Side
    d: Estimate
    white: Whitener
    whole: float

    @property
    def count(self) -> int:
        return max(self.white.degrees, 2)


@dataclass(frozen=True)
class _Found:
    """A fitted cause: gain, penalty of its sizes and choices, probability of the residuals.

    ``change`` returns the change of one dataset by the correction, with the covariance that its own noise gives it.
    """

    name: str
    sizes: tuple[Size, ...]
    gain: float
    penalty: float
    p: float
    change: Callable[[], Estimate] | None = None


def diagnose(
    a: Estimate,
    b: Estimate,
    freedoms: Sequence[str],
    stored: Mapping[str, Stored],
    *,
    time: Array | None = None,
    temperatures: Mapping[str, Array] | None = None,
    curves: Mapping[str, SmoothCurves] | None = None,
) -> list[Cause]:
    """Return the causes of the difference of two estimates that are more likely than chance, the most likely one first.

    Parameters
    ----------
    a, b : Estimate
        Estimates on one grid, (n, d).
    freedoms : sequence of str
        Freedoms of the d columns.
    stored : mapping of str to Stored
        The errors of each dataset as a function of the errors that it states.
    time : ndarray, (n,), optional
        Times, s; without them no cause in time is tested.
    temperatures : mapping of str to ndarray (n,), optional
        Recorded temperatures, degC, for an expansion.
    curves : mapping of str to SmoothCurves, optional
        Smoothed errors by dataset, over its whole record, for a shift in time.

    Returns
    -------
    list of Cause
        Empty if no cause has a positive score. The first one may leave a significant difference; see `Cause.p`.
    """
    d = difference(a, b)
    white = whitener(d.own, d.influence)
    if not white.degrees:
        return []
    chosen = tuple(freedoms)
    sides = (Side(a, stored[a.name], 1.0, chosen), Side(b, stored[b.name], -1.0, chosen))
    given = _Difference(*sides, d, white, white.square(d.value))
    tested = list(candidates(*sides, time, temperatures or {}, curves or {}))
    members = Counter(family for family, _ in {(each.family, _kind(each)) for each in tested})
    by_kind: dict[str, Cause] = {}
    for candidate in tested:
        if (found := _fitted(candidate, given)) is None:
            continue
        prior = 2 * np.log(members[candidate.family] * len(members))
        score = float(found.gain - found.penalty - prior)
        kind = _kind(candidate)
        best = by_kind[kind].score if kind in by_kind else 0.0
        if score > best and (found.change is None or _significant(found.change())):
            by_kind[kind] = Cause(found.name, found.sizes, found.gain / 2, score, found.p)  # the best one of a search
    causes = sorted(by_kind.values(), key=lambda each: -each.score)
    return [_with_alike(cause, causes) for cause in causes]


def _kind(candidate: AnyCause) -> str:
    """Return the name that all trials of a search have in common."""
    if isinstance(candidate, Shifted):
        return candidate.family
    return (candidate.kind if isinstance(candidate, Added) else "") or candidate.name


def _fitted(candidate: AnyCause, given: _Difference) -> _Found | None:
    if isinstance(candidate, Mapped):
        return _mapped(candidate, given)
    if isinstance(candidate, Read):
        return _read(candidate)
    if isinstance(candidate, Shifted):
        return _shifted(candidate, given)
    return _added(candidate, given)


def _added(candidate: Added, given: _Difference) -> _Found | None:
    effects = np.where(np.isfinite(given.d.value), np.nan_to_num(candidate.effects), 0.0)
    normal, gradient = given.white.normal(effects, given.d.value)
    best = _best(normal, gradient, candidate.choices, given.count)
    if best is None:
        return None
    used, beta, C, gain = best
    u = np.sqrt(np.diag(C))
    sizes = tuple(
        Size(candidate.labels[i][0], float(value), float(each), candidate.labels[i][1])
        for i, value, each in zip(used, beta, u, strict=True)
    )
    # A search is a maximum of dependent statistics; its penalty is the logarithm of the number of trials.
    penalty = _penalty(len(used), candidate.tries * len(candidate.choices), given.count)
    return _Found(candidate.name, sizes, gain, penalty, _p(given.white.degrees - len(used), given.whole - gain))


def _mapped(candidate: Mapped, given: _Difference) -> _Found | None:
    """Fit a cause by the likelihood of both datasets, since its correction changes the covariance as well.

    With ``a' = A a``, ``b' = B b`` and the covariance V' of their difference, ``-2 ln L = chi'^2 + ln |V'|``, minus
    ``ln |A| + ln |B|``: a factor on one dataset and its inverse on the other one are equivalent.
    """
    every = len(candidate.labels)
    state = _corrected(candidate, given, np.zeros(every))
    if state is None:
        return None
    if not every:
        p = _p(state.white.degrees, state.rest)
        return _Found(candidate.name, (), state.gain, 0.0, p, partial(_change, candidate, state.beta))
    used: list[int] = []
    for _ in range(SELECTIONS):
        # The covariance at the sizes found decides which of them differ from 0.
        normal, gradient = _normal(candidate, state, range(every))
        best = _best(normal, gradient + normal @ state.beta, candidate.choices, given.count)
        if best is None or best[3] <= _penalty(len(best[0]), len(candidate.choices), given.count):
            return None  # an effect without part in the difference, whatever its size
        if best[0] == used:
            break
        used = best[0]
        state = _refined(candidate, given, used)
    normal, _ = _normal(candidate, state, used)
    solved = _sizes(normal, np.zeros(len(used)))
    if solved is None or np.abs(state.beta).max() > candidate.most:
        return None
    u = np.sqrt(np.diag(solved[1]))
    values, u = candidate.size(state.beta[used], u)
    sizes = tuple(
        Size(candidate.labels[i][0], float(value), float(each), candidate.labels[i][1])
        for i, value, each in zip(used, values, u, strict=True)
    )
    penalty = _penalty(len(used), len(candidate.choices), given.count)
    p = _p(state.white.degrees - len(used), state.rest)
    return _Found(candidate.name, sizes, state.gain, penalty, p, partial(_change, candidate, state.beta))


def _refined(candidate: Mapped, given: _Difference, used: Sequence[int]) -> _Corrected:
    """Return the difference at the parameters ``used`` of the greatest likelihood, the others being 0."""
    state = _Corrected(np.zeros(len(candidate.labels)), given.d, given.white, given.whole, 0.0)
    for _ in range(REFINEMENTS):
        solved = _sizes(*_normal(candidate, state, used))
        if solved is None:
            break
        move, C, _ = solved
        step = _improved(candidate, given, state, used, move)
        if step is None:
            break
        state = step
        if (np.abs(move) < SETTLED * np.sqrt(np.diag(C))).all():
            break
    return state


def _change(candidate: Mapped, beta: Array) -> Estimate:
    """Return the change of the dataset by a correction, with the covariance that its own noise gives it."""
    side = candidate.side
    return side.estimate(side.stored.changed(candidate.matrix(beta) - np.eye(6)))


def _significant(change: Estimate) -> bool:
    white = whitener(change.own, change.influence)
    return white.degrees > 0 and _p(white.degrees, white.square(change.value)) < SIGNIFICANT


@dataclass(frozen=True)
class _Corrected:
    """A difference after a correction with parameters ``beta``, and the gain of the likelihood."""

    beta: Array
    d: Estimate
    white: Whitener
    rest: float
    gain: float


def _corrected(candidate: Mapped, given: _Difference, beta: Array) -> _Corrected | None:
    if candidate.labels and not beta.any():
        return _Corrected(beta, given.d, given.white, given.whole, 0.0)
    A = candidate.matrix(beta)
    side = candidate.side
    scale = np.log(np.abs(np.diag(A))) if candidate.stretched else np.zeros(6)
    if not np.isfinite(scale).all() or (candidate.labels and candidate.stretched and (np.diag(A) <= 0).any()):
        return None
    changed = side.corrected(A)
    d = difference(changed, given.b.given) if side is given.a else difference(given.a.given, changed)
    white = whitener(d.own, d.influence)
    rest = white.square(d.value)
    counted = (np.isfinite(given.d.value) & (np.nan_to_num(given.d.variance()) > 0)).sum(axis=0)
    stretch = float(counted @ scale[[DOF.index(name) for name in side.freedoms]])
    gain = given.whole - rest + given.white.log_determinant - white.log_determinant + stretch
    return _Corrected(beta, d, white, rest, gain)


def _normal(candidate: Mapped, state: _Corrected, used: Sequence[int]) -> tuple[Array, Array]:
    """Return the normal equations for a change of the parameters ``used``."""
    effects, known = [], np.isfinite(state.d.value)
    for i in used:
        h = SMALL * np.eye(len(state.beta))[i]
        slope = (candidate.matrix(state.beta + h) - candidate.matrix(state.beta - h)) / (2 * SMALL)
        effect = candidate.side.sign * candidate.side.effect(slope)
        effects.append(np.where(known, effect, 0.0))
    G = np.array(effects).reshape(len(used), *state.d.value.shape)
    normal, gradient = state.white.normal(G, state.d.value)
    return normal, -gradient


def _improved(
    candidate: Mapped, given: _Difference, state: _Corrected, used: Sequence[int], move: Array
) -> _Corrected | None:
    """Return the difference after a step, shortened until the likelihood increases; None if it does not."""
    for shorter in (1.0, 0.5, 0.25, 0.1):
        beta = state.beta.copy()
        beta[list(used)] += shorter * move
        corrected = _corrected(candidate, given, beta)
        if corrected is not None and corrected.gain > state.gain:
            return corrected
    return None


def _read(candidate: Read) -> _Found:
    before, after = difference(*candidate.before), difference(*candidate.after)
    first, second = (whitener(each.own, each.influence) for each in (before, after))
    rest = second.square(after.value)
    gain = first.square(before.value) - rest + first.log_determinant - second.log_determinant
    return _Found(candidate.name, (), gain, 0.0, _p(second.degrees, rest), lambda: candidate.change)


def _shifted(candidate: Shifted, given: _Difference) -> _Found | None:
    shift = fitted(candidate.curves, candidate.sign, candidate.time, given.d.value, given.white)
    if shift is None or shift.gain <= 0:
        return None
    size = Size("shift", shift.value, shift.standard_uncertainty, "s")
    p = _p(given.white.degrees - 1, given.whole - shift.gain)
    return _Found("shift in time", (size,), shift.gain, _penalty(1, 1, given.count), p)


def _best(
    normal: Array, gradient: Array, choices: Sequence[tuple[int, ...]], count: int
) -> tuple[list[int], Array, Array, float] | None:
    """Return the choice of sizes with the largest gain minus penalty, with sizes, covariance and gain."""
    best: tuple[list[int], Array, Array, float] | None = None
    most = -np.inf
    for choice in choices:
        used = list(choice)
        if (solved := _sizes(normal[used][:, used], gradient[used])) is None:
            continue
        beta, C, gain = solved
        if (score := gain - _penalty(len(used), 1, count)) > most:
            most, best = score, (used, beta, C, gain)
    return best


def _sizes(normal: Array, gradient: Array) -> tuple[Array, Array, float] | None:
    """Return sizes, their covariance, and the decrease of the sum of squares; None if they are not determined."""
    diagonal = normal.diagonal()
    if not diagonal.min() > 0:
        return None
    scale = np.sqrt(diagonal)
    power, vectors = np.linalg.eigh(normal / (scale[:, None] * scale))
    if power[-1] > WORST_CONDITION * power[0]:
        return None
    vectors /= scale[:, None]
    C = (vectors / power) @ vectors.T
    beta = C @ gradient
    return beta, C, float(beta @ gradient)


def _penalty(sizes: int, trials: int, count: int) -> float:
    return sizes * math.log(count) + 2 * math.log(trials)


def _p(degrees: int, square: float) -> float:
    return float(special.chdtrc(max(degrees, 1), max(square, 0.0)))


def _with_alike(cause: Cause, causes: Sequence[Cause]) -> Cause:
    names = [other.name for other in causes if other is not cause and abs(other.score - cause.score) <= SCORE_MARGIN]
    return replace(cause, alike=tuple(names))
