"""What explains a difference: single causes, ranked by likelihood ratio.

Each cause has an effect on the difference of two datasets that is linear in its size (a functional point, a rotation of
the frame, a scale, a shift in time, a constant, a step, an expansion) or fixed (a sign, exchanged axes, a unit). With
the covariance V of the difference d and the effects G of a cause, its size is the generalised least squares estimate,
and twice the logarithm of the likelihood ratio is ``d' V^-1 G' (G V^-1 G')^-1 G V^-1 d``. Causes are ranked by it, less
the logarithm of the number of values for each parameter (Schwarz 1978).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.stats import chi2

from errormotion.arrays import Array
from errormotion.compare.consensus import consensus
from errormotion.compare.low_rank import Whitener, whitener
from errormotion.compare.shift import Course, fitted, smooth
from errormotion.compare.stack import Estimate, difference
from errormotion.kinematics.iso import DOF

CLOSE = 6.0
"""Difference of scores up to which the data cannot tell two causes apart: a likelihood ratio of 20."""
MOST_STEPS = 60
"""Instants at which a step is tried."""
FACTORS = {
    "mm taken as m, or m as mm": 1e3,
    "um taken as mm, or mm as um": 1e-3,
    "inches taken as mm": 25.4,
    "mm taken as inches": 1 / 25.4,
}
TURNS = {
    "arcsec taken as urad": 180 * 3600 / np.pi * 1e-6,
    "urad taken as arcsec": np.pi / 180 / 3600 * 1e6,
    "degrees taken as radians": 180 / np.pi,
    "radians taken as degrees": np.pi / 180,
}
UNEXPLAINED = 1e-3
"""Probability of the rest below which a cause does not explain a difference."""


@dataclass(frozen=True)
class Size:
    """One parameter of a cause: SI value, standard uncertainty, unit."""

    name: str
    value: float
    standard_uncertainty: float
    unit: str


@dataclass(frozen=True)
class Cause:
    """A cause, and how well it explains a difference.

    Attributes
    ----------
    name : str
    sizes : tuple of Size
        Empty for a fixed cause.
    log_likelihood_ratio : float
        Against "the datasets agree".
    score : float
        Twice that, less the penalty for the parameters.
    p : float
        Probability of a larger rest if this cause is the only one.
    alike : tuple of str
        Causes that these data cannot tell from it.
    """

    name: str
    sizes: tuple[Size, ...]
    log_likelihood_ratio: float
    score: float
    p: float
    alike: tuple[str, ...] = field(default=())

    @property
    def explains(self) -> bool:
        """Whether what remains is compatible with the uncertainties."""
        return self.p >= UNEXPLAINED


@dataclass(frozen=True)
class _Candidate:
    """A cause with sizes: effects (p, n, d) of one unit of each, and the name and unit of each.

    ``choices`` are the sets of sizes that may be other than zero together: a tool that is too long has one of the three
    coordinates of a functional point, a holder expands along one axis.
    """

    name: str
    effects: Array
    labels: tuple[tuple[str, str], ...]
    tries: int = 1  # of a search over instants
    kind: str = ""  # what is searched for
    choices: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True)
class _Shift:
    """A shift in time: the course of the first dataset (sign 1) or of the second (-1)."""

    course: Course
    sign: float
    time: Array


@dataclass(frozen=True)
class _Corrected:
    """A cause without a size: the estimates as they would be without it."""

    name: str
    a: Estimate
    b: Estimate
    stretch: Array | None = None  # (d,) factors that were applied to the freedoms of one of them


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
    """Return the causes that could explain the difference of two estimates, the most likely one first.

    Parameters
    ----------
    a, b : Estimate
        On one grid, (n, d).
    freedoms : sequence of str
        Of the d columns.
    time : ndarray, (n,), optional
        s; without it no cause in time is tried.
    temperatures : mapping of str to ndarray (n,), optional
        Recorded temperatures, degC, for an expansion.
    turns : mapping of str to ndarray (n, 3), optional
        Rotations by the name of the dataset, rad: for its functional point, where rotations are not compared.
    courses : mapping of str to Course, optional
        Smooth courses by the name of the dataset, over its whole record, for a shift in time.

    Returns
    -------
    list of Cause
        Empty without known values. The first one may explain nothing: see `Cause.explains`.
    """
    d = difference(a, b)
    white = whitener(d.own, d.influence)
    if not white.degrees:
        return []
    whole = white.square(d.value)
    count = max(white.degrees, 2)
    by_kind: dict[str, Cause] = {}
    for candidate in _candidates(a, b, freedoms, time, temperatures or {}, turns or {}, courses or {}):
        if (found := _judged(candidate, d, white, whole, count)) is None:
            continue
        kind = (candidate.kind if isinstance(candidate, _Candidate) else "") or found.name
        if kind not in by_kind or found.score > by_kind[kind].score:
            by_kind[kind] = found  # of a search the best one
    causes = sorted(by_kind.values(), key=lambda each: -each.score)
    return [_with_alike(cause, causes) for cause in causes]


def _judged(
    candidate: _Candidate | _Corrected | _Shift, d: Estimate, white: Whitener, whole: float, count: int
) -> Cause | None:
    if isinstance(candidate, _Corrected):
        return _corrected(candidate, d, white, whole)
    if isinstance(candidate, _Shift):
        shift = fitted(candidate.course, candidate.sign, candidate.time, d.value, white)
        if shift is None or shift.gain <= 0:
            return None
        p = float(chi2.sf(max(whole - shift.gain, 0.0), max(white.degrees - 1, 1)))
        size = Size("shift", shift.value, shift.standard_uncertainty, "s")
        return Cause("shift in time", (size,), shift.gain / 2, float(shift.gain - np.log(count)), p)
    effects = np.where(np.isfinite(d.value), np.nan_to_num(candidate.effects), 0.0)
    normal, gradient = white.product(effects, effects), white.product(effects, d.value[None])[:, 0]
    choices = candidate.choices or (tuple(range(len(effects))),)
    # A search is a maximum of dependent statistics: it costs the logarithm of the number of its tries.
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
    p = float(chi2.sf(max(whole - gain, 0.0), max(white.degrees - len(used), 1)))
    return Cause(candidate.name, sizes, gain / 2, float(score), p)


def _sizes(normal: Array, gradient: Array) -> tuple[Array, Array, float] | None:
    """Return sizes, their covariance, and the fall of the sum of squares; None where they are not determined."""
    scale = np.sqrt(np.diag(normal))
    if not (scale > 0).all():
        return None
    unit = normal / np.outer(scale, scale)
    if np.linalg.cond(unit) > 1e10:
        return None
    C = np.linalg.inv(unit) / np.outer(scale, scale)
    beta = C @ gradient
    return beta, C, float(beta @ gradient)


def _alone_and_together(freedoms: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Return which freedoms something may act on: one, all displacements, all rotations, or all."""
    parts = [tuple(i for i, name in enumerate(freedoms) if name in names) for names in (DOF[:3], DOF[3:], DOF)]
    singles = [(i,) for i in range(len(freedoms))]
    return tuple(dict.fromkeys([*singles, *(part for part in parts if part)]))


def _corrected(candidate: _Corrected, d: Estimate, white: Whitener, whole: float) -> Cause:
    """Judge a cause by the likelihood of both datasets: the correction changes the covariance as well.

    With ``a' = A a``, ``b' = B b`` and the covariance V' of their difference, ``-2 ln L = chi'^2 + ln |V'|``, less
    ``ln |A| + ln |B|``: a factor that is applied to one dataset or inversely to the other is the same statement.
    """
    right = difference(candidate.a, candidate.b)
    its = whitener(right.own, right.influence)
    rest = its.square(right.value)
    counted = (np.isfinite(d.value) & (np.nan_to_num(d.variance()) > 0)).sum(axis=0)
    stretched = float(counted @ np.log(candidate.stretch)) if candidate.stretch is not None else 0.0
    gain = whole - rest + white.log_determinant - its.log_determinant + stretched
    p = float(chi2.sf(rest, its.degrees)) if its.degrees else float("nan")
    return Cause(candidate.name, (), gain / 2, gain, p)


def _with_alike(cause: Cause, causes: Sequence[Cause]) -> Cause:
    names = [other.name for other in causes if other is not cause and abs(other.score - cause.score) <= CLOSE]
    return replace(cause, alike=tuple(names))


# ------------------------------------------------------------------ the causes


def _candidates(
    a: Estimate,
    b: Estimate,
    freedoms: Sequence[str],
    time: Array | None,
    temperatures: Mapping[str, Array],
    turns: Mapping[str, Array],
    courses: Mapping[str, Course],
) -> Iterator[_Candidate | _Corrected | _Shift]:
    mean = _six(np.nan_to_num(consensus([a, b]).estimate.value), freedoms)
    k = [DOF.index(name) for name in freedoms]
    yield from _geometric(mean, k)
    if not set(DOF[3:]) <= set(freedoms):
        for each in (a, b):
            if each.name in turns:
                yield from _functional_point(turns[each.name], k, f"functional point of '{each.name}'")
    yield from _scales(mean, k, freedoms)
    yield from _fixed(a, b, freedoms)
    n = len(a.value)
    units = tuple((name, "m" if name in DOF[:3] else "rad") for name in freedoms)
    choices = _alone_and_together(freedoms)
    yield _Candidate("constant difference (reference state)", _columns(np.ones(n), len(k)), units, choices=choices)
    if time is not None and n > 2:
        yield from _shift(a, b, time, courses)
        yield from _steps(n, units, time, choices)
    for name, temperature in temperatures.items():
        change = temperature - temperature[0]
        if np.ptp(change) > 0:
            labels = tuple((label, f"{unit}/K") for label, unit in units)
            yield _Candidate(f"expansion with {name}", _columns(change, len(k)), labels, choices=choices)


def _shift(a: Estimate, b: Estimate, time: Array, courses: Mapping[str, Course]) -> Iterator[_Shift]:
    found = {
        sign: courses.get(each.name) or smooth(time, each.value, np.sqrt(np.diagonal(each.own, axis1=1, axis2=2)))
        for each, sign in ((a, 1.0), (b, -1.0))
    }
    known = {sign: course for sign, course in found.items() if course is not None}
    if known:
        sign = max(known, key=lambda sign: known[sign].instants)
        yield _Shift(known[sign], sign, time)


def _geometric(E: Array, k: list[int]) -> Iterator[_Candidate]:
    shift, turn = E[:, :3], E[:, 3:]
    yield from _functional_point(turn, k, "functional point")
    for axis, name in enumerate(
        ("roll of the frame (about X)", "pitch of the frame (about Y)", "yaw of the frame (about Z)")
    ):
        rotated = np.concatenate([np.cross(np.eye(3)[axis], part) for part in (shift, turn)], axis=1)
        yield _Candidate(name, rotated[None][:, :, k], (("angle", "rad"),))


def _functional_point(turn: Array, k: list[int], name: str) -> Iterator[_Candidate]:
    if np.abs(turn).max(initial=0.0) > 0:
        lever = np.zeros((3, len(turn), 6))
        for axis in range(3):
            lever[axis, :, :3] = np.cross(turn, np.eye(3)[axis])
        used = [axis for axis in range(3) if np.abs(lever[axis][:, k]).max() > 0]
        labels = tuple(("XYZ"[axis], "m") for axis in used)
        together = tuple(range(len(used)))
        choices = tuple(dict.fromkeys([*((i,) for i in together), together]))
        yield _Candidate(name, lever[used][:, :, k], labels, choices=choices)


def _scales(E: Array, k: list[int], freedoms: Sequence[str]) -> Iterator[_Candidate]:
    for name, part in (("displacements", slice(0, 3)), ("rotations", slice(3, 6))):
        scaled = np.zeros_like(E)
        scaled[:, part] = E[:, part]
        if np.abs(scaled[:, k]).max(initial=0.0) > 0:
            yield _Candidate(f"scale of the {name}", scaled[None][:, :, k], (("factor - 1", "1"),))
    for freedom in freedoms:
        scaled = np.zeros_like(E)
        scaled[:, DOF.index(freedom)] = E[:, DOF.index(freedom)]
        yield _Candidate(f"scale of {freedom}", scaled[None][:, :, k], (("factor - 1", "1"),))


def _fixed(a: Estimate, b: Estimate, freedoms: Sequence[str]) -> Iterator[_Corrected]:
    """Yield causes without a size: a sign, exchanged axes, a unit of one of the datasets."""
    d = len(freedoms)
    for j, name in enumerate(freedoms):
        sign = np.eye(d)
        sign[j, j] = -1.0
        yield _Corrected(f"sign of {name}", a, _mapped(b, sign))
    for names in (DOF[:3], DOF[3:]):
        for one, other in combinations(names, 2):
            if one in freedoms and other in freedoms:
                order = list(freedoms)
                i, j = order.index(one), order.index(other)
                swap = np.eye(d)
                swap[[i, j]] = swap[[j, i]]
                yield _Corrected(f"{one} and {other} exchanged", a, _mapped(b, swap))
    for names, factors in ((DOF[:3], FACTORS), (DOF[3:], TURNS)):
        inside = np.array([name in names for name in freedoms])
        if not inside.any():
            continue
        for what, factor in factors.items():
            back = np.diag(np.where(inside, 1 / factor, 1.0))
            for wrong in (a, b):
                pair = (_mapped(a, back), b) if wrong is a else (a, _mapped(b, back))
                yield _Corrected(f"unit of '{wrong.name}': {what}", *pair, stretch=np.diag(back))


def _mapped(each: Estimate, A: Array) -> Estimate:
    """Return an estimate with its freedoms under a matrix with one entry in each row; unknown ones stay unknown."""
    value = np.nan_to_num(each.value) @ A.T
    gone = (np.abs(A) @ np.isnan(each.value).T.astype(float)).T > 0
    value[gone] = np.nan
    return replace(
        each, value=value, own=A @ np.nan_to_num(each.own) @ A.T, influence=np.nan_to_num(each.influence) @ A.T
    )


def _steps(
    n: int, units: tuple[tuple[str, str], ...], time: Array, choices: tuple[tuple[int, ...], ...]
) -> Iterator[_Candidate]:
    """Yield a step at each instant: something was moved or struck."""
    instants = np.unique(np.linspace(2, max(n - 2, 2), max(min(n - 3, MOST_STEPS), 0)).astype(int)).tolist()
    for i in instants:
        after = np.where(np.arange(n) >= i, 1.0, 0.0)
        name = f"step at {time[i]:.0f} s (something moved)"
        yield _Candidate(name, _columns(after, len(units)), units, tries=len(instants), kind="step", choices=choices)


def _columns(profile: Array, d: int) -> Array:
    """Return the effects of one size for each freedom with the same course, (d, n, d)."""
    found: Array = np.einsum("n,ij->inj", profile, np.eye(d))
    return found


def _six(values: Array, freedoms: Sequence[str]) -> Array:
    found = np.zeros((len(values), 6))
    for column, name in enumerate(freedoms):
        found[:, DOF.index(name)] = np.nan_to_num(values[:, column])
    return found
