"""Possible causes, with their effect on the difference of two datasets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from errormotion.arrays import Array
from errormotion.compare.consensus import consensus
from errormotion.compare.diagnosis.shift import Course, smooth
from errormotion.compare.stack import Estimate
from errormotion.kinematics.iso import DOF

MAX_STEPS = 60
"""Largest number of times at which a step is tested."""
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


@dataclass(frozen=True)
class Candidate:
    """A cause with sizes: effects (p, n, d) of one unit of each size, and its name and unit.

    ``choices`` are the sets of sizes that may differ from zero simultaneously: a wrong tool length changes one of the
    three coordinates of a functional point, a holder expands along one axis.
    """

    name: str
    effects: Array
    labels: tuple[tuple[str, str], ...]
    tries: int = 1  # number of trials of a search over time
    kind: str = ""  # kind of the search
    choices: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True)
class Shifted:
    """A shift in time: smoothed errors of the first dataset (sign 1) or of the second one (-1)."""

    course: Course
    sign: float
    time: Array


@dataclass(frozen=True)
class Corrected:
    """A cause without a size: the estimates after its correction."""

    name: str
    a: Estimate
    b: Estimate
    stretch: Array | None = None  # (d,) factors by which the freedoms of one estimate were multiplied


def candidates(
    a: Estimate,
    b: Estimate,
    freedoms: Sequence[str],
    time: Array | None,
    temperatures: Mapping[str, Array],
    turns: Mapping[str, Array],
    courses: Mapping[str, Course],
) -> Iterator[Candidate | Corrected | Shifted]:
    """Yield every cause that can be tested with two estimates."""
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
    choices = _freedom_sets(freedoms)
    yield Candidate("constant difference (reference state)", _columns(np.ones(n), len(k)), units, choices=choices)
    if time is not None and n > 2:
        yield from _shift(a, b, time, courses)
        yield from _steps(n, units, time, choices)
    for name, temperature in temperatures.items():
        change = temperature - temperature[0]
        if np.ptp(change) > 0:
            labels = tuple((label, f"{unit}/K") for label, unit in units)
            yield Candidate(f"expansion with {name}", _columns(change, len(k)), labels, choices=choices)


def _shift(a: Estimate, b: Estimate, time: Array, courses: Mapping[str, Course]) -> Iterator[Shifted]:
    found = {
        sign: courses.get(each.name) or smooth(time, each.value, np.sqrt(np.diagonal(each.own, axis1=1, axis2=2)))
        for each, sign in ((a, 1.0), (b, -1.0))
    }
    known = {sign: course for sign, course in found.items() if course is not None}
    if known:
        sign = max(known, key=lambda sign: known[sign].instants)
        yield Shifted(known[sign], sign, time)


def _geometric(E: Array, k: list[int]) -> Iterator[Candidate]:
    shift, turn = E[:, :3], E[:, 3:]
    yield from _functional_point(turn, k, "functional point")
    for axis, name in enumerate(
        ("roll of the frame (about X)", "pitch of the frame (about Y)", "yaw of the frame (about Z)")
    ):
        rotated = np.concatenate([np.cross(np.eye(3)[axis], part) for part in (shift, turn)], axis=1)
        yield Candidate(name, rotated[None][:, :, k], (("angle", "rad"),))


def _functional_point(turn: Array, k: list[int], name: str) -> Iterator[Candidate]:
    if np.abs(turn).max(initial=0.0) > 0:
        lever = np.zeros((3, len(turn), 6))
        for axis in range(3):
            lever[axis, :, :3] = np.cross(turn, np.eye(3)[axis])
        used = [axis for axis in range(3) if np.abs(lever[axis][:, k]).max() > 0]
        labels = tuple(("XYZ"[axis], "m") for axis in used)
        together = tuple(range(len(used)))
        choices = tuple(dict.fromkeys([*((i,) for i in together), together]))
        yield Candidate(name, lever[used][:, :, k], labels, choices=choices)


def _scales(E: Array, k: list[int], freedoms: Sequence[str]) -> Iterator[Candidate]:
    for name, part in (("displacements", slice(0, 3)), ("rotations", slice(3, 6))):
        scaled = np.zeros_like(E)
        scaled[:, part] = E[:, part]
        if np.abs(scaled[:, k]).max(initial=0.0) > 0:
            yield Candidate(f"scale of the {name}", scaled[None][:, :, k], (("factor - 1", "1"),))
    for freedom in freedoms:
        scaled = np.zeros_like(E)
        scaled[:, DOF.index(freedom)] = E[:, DOF.index(freedom)]
        yield Candidate(f"scale of {freedom}", scaled[None][:, :, k], (("factor - 1", "1"),))


def _fixed(a: Estimate, b: Estimate, freedoms: Sequence[str]) -> Iterator[Corrected]:
    """Yield causes without a size: a sign, exchanged axes, a unit of one dataset."""
    d = len(freedoms)
    for j, name in enumerate(freedoms):
        sign = np.eye(d)
        sign[j, j] = -1.0
        yield Corrected(f"sign of {name}", a, _mapped(b, sign))
    for names in (DOF[:3], DOF[3:]):
        for one, other in combinations(names, 2):
            if one in freedoms and other in freedoms:
                order = list(freedoms)
                i, j = order.index(one), order.index(other)
                swap = np.eye(d)
                swap[[i, j]] = swap[[j, i]]
                yield Corrected(f"{one} and {other} exchanged", a, _mapped(b, swap))
    for names, factors in ((DOF[:3], FACTORS), (DOF[3:], TURNS)):
        inside = np.array([name in names for name in freedoms])
        if not inside.any():
            continue
        for what, factor in factors.items():
            back = np.diag(np.where(inside, 1 / factor, 1.0))
            for wrong in (a, b):
                pair = (_mapped(a, back), b) if wrong is a else (a, _mapped(b, back))
                yield Corrected(f"unit of '{wrong.name}': {what}", *pair, stretch=np.diag(back))


def _mapped(each: Estimate, A: Array) -> Estimate:
    """Return an estimate whose freedoms are transformed by a matrix with one entry per row; NaN remains NaN."""
    value = np.nan_to_num(each.value) @ A.T
    gone = (np.abs(A) @ np.isnan(each.value).T.astype(float)).T > 0
    value[gone] = np.nan
    return replace(
        each, value=value, own=A @ np.nan_to_num(each.own) @ A.T, influence=np.nan_to_num(each.influence) @ A.T
    )


def _steps(
    n: int, units: tuple[tuple[str, str], ...], time: Array, choices: tuple[tuple[int, ...], ...]
) -> Iterator[Candidate]:
    """Yield a step at each time: an object was moved or struck."""
    indices = np.unique(np.linspace(2, max(n - 2, 2), max(min(n - 3, MAX_STEPS), 0)).astype(int)).tolist()
    for i in indices:
        after = np.where(np.arange(n) >= i, 1.0, 0.0)
        name = f"step at {time[i]:.0f} s (something moved)"
        yield Candidate(name, _columns(after, len(units)), units, tries=len(indices), kind="step", choices=choices)


def _columns(profile: Array, d: int) -> Array:
    """Return the effects of one size for each freedom with the same profile, (d, n, d)."""
    found: Array = np.einsum("n,ij->inj", profile, np.eye(d))
    return found


def _six(values: Array, freedoms: Sequence[str]) -> Array:
    found = np.zeros((len(values), 6))
    for column, name in enumerate(freedoms):
        found[:, DOF.index(name)] = np.nan_to_num(values[:, column])
    return found


def _freedom_sets(freedoms: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Return the sets of freedoms that a cause may affect: one, all displacements, all rotations, or all."""
    parts = [tuple(i for i, name in enumerate(freedoms) if name in names) for names in (DOF[:3], DOF[3:], DOF)]
    singles = [(i,) for i in range(len(freedoms))]
    return tuple(dict.fromkeys([*singles, *(part for part in parts if part)]))
