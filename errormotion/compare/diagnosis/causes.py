"""Possible causes of a difference, by family, with their effect on two datasets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from errormotion.arrays import Array, filled
from errormotion.compare.diagnosis.shift import SmoothCurves, smooth
from errormotion.compare.point_errors import PointErrors, Stored
from errormotion.compare.stack import Estimate
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.twists import adjoint

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
FRAMES = ("roll of the frame (about X)", "pitch of the frame (about Y)", "yaw of the frame (about Z)")
LARGEST_TURN = 0.5
"""Largest error of the orientation of a frame, rad; larger ones are signs and exchanged axes."""
SENSOR = {"X": ("EX", "EB", "EC"), "Y": ("EY", "EA", "EC"), "Z": ("EZ", "EA", "EB")}
"""Freedoms that a sensor along each axis affects, by its position relative to the functional point."""


@dataclass(frozen=True)
class Side:
    """One of the two datasets: its estimate, the errors that it states, and its sign in the difference."""

    given: Estimate
    stored: Stored
    sign: float
    freedoms: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the dataset."""
        return self.given.name

    def estimate(self, placed: PointErrors) -> Estimate:
        """Return errors on common ground as an estimate of the compared freedoms."""
        return placed.estimate(self.name, self.freedoms)

    def corrected(self, A: Array) -> Estimate:
        """Return the estimate if the stated errors are multiplied by matrices."""
        return self.estimate(self.stored.changed(A))

    def effect(self, A: Array) -> Array:
        """Return the compared freedoms (n, d) of the stated errors multiplied by matrices; unknown values are 0."""
        return filled(self.stored.values(A)[:, [DOF.index(name) for name in self.freedoms]])

    @cached_property
    def stated(self) -> list[str]:
        """Freedoms that the dataset states and that affect the compared ones."""
        k = [DOF.index(name) for name in self.freedoms]
        acts = np.abs(self.stored.transfer[k]).max(axis=0) > 0
        return [name for name, each in zip(DOF, acts, strict=True) if each and name in self.stored.errors.seen]


@dataclass(frozen=True)
class Added:
    """A cause whose effects (p, n, d) are added to a difference: one unit of each size, with its name and unit.

    ``choices`` are the sets of sizes that may differ from zero simultaneously; ``kind`` is common to the trials of a
    search over time, of which there are ``tries``.
    """

    family: str
    name: str
    effects: Array
    labels: tuple[tuple[str, str], ...]
    choices: tuple[tuple[int, ...], ...]
    tries: int = 1
    kind: str = ""


@dataclass(frozen=True)
class Mapped:
    """A cause that changes the errors that one dataset states, at its own functional point.

    ``matrix`` returns the correction (6, 6) for sizes; without ``labels`` it has none. ``size`` converts the parameters
    of ``matrix`` with their standard uncertainties to sizes. ``stretched`` freedoms are multiplied by the matrix.
    ``most`` is the largest parameter.
    """

    family: str
    name: str
    side: Side
    matrix: Callable[[Array], Array]
    labels: tuple[tuple[str, str], ...] = ()
    choices: tuple[tuple[int, ...], ...] = ((),)
    size: Callable[[Array, Array], tuple[Array, Array]] = lambda value, u: (value, u)
    stretched: bool = False
    most: float = np.inf


@dataclass(frozen=True)
class Read:
    """A straightness that was read at another point; both estimates before and after the correction, and its change."""

    family: str
    name: str
    before: tuple[Estimate, Estimate]
    after: tuple[Estimate, Estimate]
    change: Estimate


@dataclass(frozen=True)
class Shifted:
    """A shift in time: smoothed errors of the first dataset (sign 1) or of the second one (-1)."""

    family: str
    curves: SmoothCurves
    sign: float
    time: Array


AnyCause = Added | Mapped | Read | Shifted


def candidates(
    a: Side, b: Side, time: Array | None, temperatures: Mapping[str, Array], curves: Mapping[str, SmoothCurves]
) -> Iterator[AnyCause]:
    """Yield every cause that can be tested with two datasets."""
    yield from _functional_points(a, b)
    yield from _frames(a, b)
    yield from _scales(a, b)
    yield from _signs(a, b)
    yield from _exchanges(a, b)
    yield from _units(a, b)
    yield from _straightness(a, b)
    n = len(a.given.value)
    yield from _profile(a, b, np.ones(n), "reference state", "constant difference (reference state)")
    if time is not None and n > 2:
        yield from _shift(a, b, time, curves)
        yield from _steps(a, b, time)
        yield from _profile(a, b, time - time[0], "drift of a sensor", "drift of a sensor (linear in time)", per="/s")
    for name, temperature in temperatures.items():
        change = temperature - temperature[0]
        if np.ptp(change) > 0:
            yield from _profile(a, b, change, "expansion", f"expansion with {name}", per="/K")


def _places(a: Side, b: Side, of: str = "of") -> list[tuple[Side, str]]:
    """Return the datasets whose mistakes differ, with the end of the name of a cause.

    At one functional point a mistake in one of them has the same effect as the inverse one in the other.
    """
    if np.array_equal(a.stored.shift, b.stored.shift):
        return [(a, "")]
    return [(each, f" {of} '{each.name}'") for each in (a, b)]


def _functional_points(a: Side, b: Side) -> Iterator[Mapped]:
    compared = set(DOF[3:]) <= set(a.freedoms)
    for side, name in (
        [(a, "functional point")] if compared else [(each, f"functional point of '{each.name}'") for each in (a, b)]
    ):
        effects = [side.effect(adjoint(shift=axis) - np.eye(6)) for axis in np.eye(3)]
        used = [axis for axis in range(3) if np.abs(effects[axis]).max(initial=0.0) > 0]
        if not used:
            continue

        def matrix(r: Array, used: list[int] = used) -> Array:
            shift = np.zeros(3)
            shift[used] = -r
            return adjoint(shift=shift)

        together = tuple(range(len(used)))
        choices = tuple(dict.fromkeys([*((i,) for i in together), together]))
        labels = tuple(("XYZ"[axis], "m") for axis in used)
        yield Mapped("functional point", name, side, matrix, labels, choices)


def _frames(a: Side, b: Side) -> Iterator[Mapped]:
    for side, suffix in _places(a, b):
        for axis, name in enumerate(FRAMES):

            def matrix(angle: Array, axis: int = axis) -> Array:
                return adjoint(rotation=Rotation.from_rotvec(-angle[0] * np.eye(3)[axis]))

            yield Mapped(
                "orientation of the frame", name + suffix, side, matrix, (("angle", "rad"),), ((0,),), most=LARGEST_TURN
            )


def _scales(a: Side, b: Side) -> Iterator[Mapped]:
    for side, suffix in _places(a, b):
        parts = {"the displacements": DOF[:3], "the rotations": DOF[3:]} | {name: (name,) for name in side.stated}
        for what, names in parts.items():
            inside = np.isin(DOF, names)
            if np.abs(side.effect(np.diag(inside.astype(float)))).max(initial=0.0) > 0:

                def matrix(gain: Array, inside: NDArray[np.bool_] = inside) -> Array:
                    return np.diag(np.where(inside, 1.0 + gain[0], 1.0))

                labels = (("factor - 1", "1"),)
                name = f"scale of {what}{suffix}"
                yield Mapped("scale", name, side, matrix, labels, ((0,),), _factor, stretched=True)


def _factor(gain: Array, u: Array) -> tuple[Array, Array]:
    """Return the factor minus 1 of a dataset whose errors must be multiplied by ``1 + gain``."""
    return 1 / (1 + gain) - 1, u / (1 + gain) ** 2


def _signs(a: Side, b: Side) -> Iterator[Mapped]:
    for side, suffix in _places(a, b):
        for name in side.stated:
            turned = np.diag(np.where(np.isin(DOF, name), -1.0, 1.0))
            yield Mapped("sign", f"sign of {name}{suffix}", side, _always(turned))


def _exchanges(a: Side, b: Side) -> Iterator[Mapped]:
    for side, suffix in _places(a, b, "in"):
        for names in (DOF[:3], DOF[3:]):
            for one, other in combinations([name for name in names if name in side.stated], 2):
                i, j = DOF.index(one), DOF.index(other)
                swap = np.eye(6)
                swap[[i, j]] = swap[[j, i]]
                yield Mapped("exchanged axes", f"{one} and {other} exchanged{suffix}", side, _always(swap))


def _units(a: Side, b: Side) -> Iterator[Mapped]:
    for names, factors in ((DOF[:3], FACTORS), (DOF[3:], TURNS)):
        for side in (a, b):
            if not set(names) & set(side.stated):
                continue
            for what, factor in factors.items():
                back = np.diag(np.where(np.isin(DOF, names), 1 / factor, 1.0))
                yield Mapped("unit", f"unit of '{side.name}': {what}", side, _always(back), stretched=True)


def _straightness(a: Side, b: Side) -> Iterator[Read]:
    for side in (a, b):
        for place, lever in side.stored.levers.items():
            before = tuple(each.estimate(each.stored.line(each.stored.changed(np.eye(6)))) for each in (a, b))
            moved = side.estimate(side.stored.line(side.stored.changed(adjoint(shift=lever))))
            after = (moved, before[1]) if side is a else (before[0], moved)
            name = f"straightness of '{side.name}' read at a point of the {place}"
            effect = side.estimate(side.stored.line(side.stored.changed(adjoint(shift=lever) - np.eye(6))))
            yield Read("reference of the straightness", name, (before[0], before[1]), after, effect)


def _shift(a: Side, b: Side, time: Array, curves: Mapping[str, SmoothCurves]) -> Iterator[Shifted]:
    found = {
        each.sign: curves.get(each.name)
        or smooth(time, each.given.value, np.sqrt(np.diagonal(each.given.own, axis1=1, axis2=2)))
        for each in (a, b)
    }
    known = {sign: each for sign, each in found.items() if each is not None}
    if known:
        sign = max(known, key=lambda sign: known[sign].instants)
        yield Shifted("shift in time", known[sign], sign, time)


def _steps(a: Side, b: Side, time: Array) -> Iterator[Added]:
    """Yield a step at each time: an object was moved or struck."""
    n = time.size
    indices = np.unique(np.linspace(2, max(n - 2, 2), max(min(n - 3, MAX_STEPS), 0)).astype(int)).tolist()
    for i in indices:
        after = np.where(np.arange(n) >= i, 1.0, 0.0)
        name = f"step at {time[i]:.0f} s (something moved)"
        yield from _profile(a, b, after, "step", name, tries=len(indices), kind="step")


def _profile(
    a: Side, b: Side, profile: Array, family: str, name: str, *, per: str = "", tries: int = 1, kind: str = ""
) -> Iterator[Added]:
    """Yield errors with one profile (n,), in some of the freedoms that a dataset states."""
    places = _places(a, b)
    for side, suffix in places:
        names = side.stated
        columns = side.stored.transfer[
            np.ix_([DOF.index(each) for each in side.freedoms], [DOF.index(n) for n in names])
        ]
        seen = [j for j in range(len(names)) if np.abs(columns[:, j]).max() > 0]
        names = [names[j] for j in seen]
        effects = np.einsum("n,ij->jni", profile, columns[:, seen])
        labels = tuple((each, ("m" if each in DOF[:3] else "rad") + per) for each in names)
        choices = _freedom_sets(names)
        if suffix:  # a displacement has the same effect in both
            turning = {j for j, each in enumerate(names) if each in DOF[3:]}
            plain = tuple(each for each in choices if not turning & set(each))
            choices = tuple(each for each in choices if turning & set(each))
            if side is a and plain:
                yield Added(family, name, effects, labels, plain, tries, kind)
        if choices:
            yield Added(family, name + suffix, effects, labels, choices, tries, kind and kind + suffix)


def _freedom_sets(names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Return the sets of freedoms that a cause may affect: one, those of a sensor along an axis, or of a body."""
    parts = [
        tuple(i for i, name in enumerate(names) if name in part) for part in (*SENSOR.values(), DOF[:3], DOF[3:], DOF)
    ]
    singles = [(i,) for i in range(len(names))]
    return tuple(dict.fromkeys([*singles, *(part for part in parts if part)]))


def _always(A: Array) -> Callable[[Array], Array]:
    return lambda _: A
