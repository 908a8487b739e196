"""Comparison of the cuts of an original and a corrected program, as LinuxCNC's interpreter reads both.

The interpreter reads the parameters and the tool table of the machine as they are in their files, in units of the
machine: nothing that the correction derives from them is used. The cuts must have the same order, and every end of the
new program must be within the largest correction of the original cut.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

from errormotion.compensation.program.interpreter.canonical import Command, commands, in_units_of_the_machine
from errormotion.compensation.program.reading.files import UNITS
from errormotion.compensation.program.reading.frames import Frame, Triple
from errormotion.compensation.program.reading.items import PLANES
from errormotion.compensation.program.reading.offsets import Offsets
from errormotion.errors import ProgramError

_DIGITS = 6e-4
"""Largest sum of the rounding of printed positions and offsets, in units of the machine."""

_RETRACTED = 3e-4
"""Distance above a reached depth from which a canned cycle (G73, G83) goes on, m; it depends on the unit."""

_CLOSED = 1e-5
"""Chord of an arc that may be a full circle, because of the rounding of its ends, m."""

_PLANES = ("CANON_PLANE_XY", "CANON_PLANE_XZ", "CANON_PLANE_YZ")
_NONE: Triple = (0.0, 0.0, 0.0)


@dataclass(slots=True)
class Cut:
    """A cut in coordinates of the program.

    Attributes
    ----------
    line : int
    frame : Frame
    start, end : (x, y, z)
    centre : (float, float), optional
        Of an arc, in the two axes of its plane.
    plane : int
        Index in ``PLANES``.
    turns : int
        Of an arc, with its sense.
    """

    line: int
    frame: Frame
    start: Triple
    end: Triple
    centre: tuple[float, float] | None = None
    plane: int = 0
    turns: int = 0

    def length(self) -> float:
        """Return the length, m; of an arc in its plane."""
        if self.centre is None:
            return math.dist(self.start, self.end) * self.frame.scale
        return self._radius() * self._sweep() * self.frame.scale

    def contains(self, places: Sequence[Triple], bound: float) -> bool:
        """Return whether positions of the machine, m, are on the cut."""
        return all(self._has(place, bound) for place in reversed(places))

    def _has(self, place: Triple, bound: float) -> bool:
        p, scale = self.frame.program(place), self.frame.scale
        if self.centre is None:
            return _from_segment(p, self.start, self.end, _RETRACTED / scale) * scale <= bound
        a, b, c = PLANES[self.plane]
        s, e, m = self.start, self.end, self.centre
        r0, r1 = self._radius(), math.dist((e[a], e[b]), m)
        r = math.dist((p[a], p[b]), m)
        near = bound / scale
        if not min(r0, r1) - near <= r <= max(r0, r1) + near:
            return False
        if not min(s[c], e[c]) - near <= p[c] <= max(s[c], e[c]) + near:
            return False
        angle = self._angle((p[a], p[b])) % (2 * math.pi)
        wide = near / max(r, near)
        return angle <= self._sweep() + wide or angle >= 2 * math.pi - wide

    def ends_at(self, place: Triple, bound: float) -> bool:
        """Return whether a position of the machine, m, is the end of the cut."""
        return math.dist(self.frame.machine(self.end), place) <= bound

    def places(self) -> list[Triple]:
        """Return positions of the machine on the cut, m; the last one is its end."""
        s, e = self.start, self.end
        if self.centre is None:
            x, y, z = ((a + b) / 2 for a, b in zip(s, e, strict=True))
            return [self.frame.machine((x, y, z)), self.frame.machine(e)]
        a, b, c = PLANES[self.plane]
        sweep, sense = self._sweep(), 1 if self.turns > 0 else -1
        first = math.atan2(s[b] - self.centre[1], s[a] - self.centre[0])
        r0, r1 = self._radius(), math.dist((e[a], e[b]), self.centre)
        found = []
        for part in (1 / 3, 2 / 3):
            place = [0.0, 0.0, 0.0]
            angle, r = first + sense * part * sweep, r0 + part * (r1 - r0)
            place[a] = self.centre[0] + r * math.cos(angle)
            place[b] = self.centre[1] + r * math.sin(angle)
            place[c] = s[c] + part * (e[c] - s[c])
            found.append(self.frame.machine((place[0], place[1], place[2])))
        return [*found, self.frame.machine(e)]

    def _radius(self) -> float:
        a, b, _ = PLANES[self.plane]
        return math.dist((self.start[a], self.start[b]), self.centre or (0.0, 0.0))

    def _angle(self, point: tuple[float, float]) -> float:
        a, b, _ = PLANES[self.plane]
        x, y = self.centre or (0.0, 0.0)
        turn = math.atan2(point[1] - y, point[0] - x) - math.atan2(self.start[b] - y, self.start[a] - x)
        return turn if self.turns > 0 else -turn

    def _sweep(self) -> float:
        a, b, _ = PLANES[self.plane]
        s, e = (self.start[a], self.start[b]), (self.end[a], self.end[b])
        whole = math.dist(s, e) * self.frame.scale <= _CLOSED
        angle = 2 * math.pi if whole else self._angle(e) % (2 * math.pi)
        return angle + 2 * math.pi * (abs(self.turns) - 1)


def compare(
    original: Sequence[str],
    new: Sequence[str],
    offsets: Offsets,
    largest: float,
    *,
    deleted: bool | None = None,
) -> int:
    """Return the number of cuts of a program, which the new program makes within the largest correction.

    Parameters
    ----------
    original, new : sequence of str
        Lines of the programs.
    offsets : Offsets
    largest : float
        Largest distance of the new cuts from the original ones, m.
    deleted : bool, optional
        Whether blocks that start with ``/`` are skipped.

    Raises
    ------
    ProgramError
        The interpreter reports an error, or a cut differs.
    """
    bound = largest + _DIGITS * UNITS[offsets.unit]
    old = list(_cuts(original, offsets, deleted))
    states: set[tuple[int, bool]] = {(-1, True)}  # cuts at which the new program may be, and whether it reached the end
    for cut in _cuts(new, offsets, deleted):
        places = cut.places()
        place = places[-1]
        found: set[tuple[int, bool]] = set()
        for k, reached in states:
            if k >= 0 and old[k].contains(places, bound):
                found.add((k, reached or old[k].ends_at(place, bound)))
            if reached:
                found |= {
                    (j, old[j].ends_at(place, bound)) for j in _next(old, k, bound) if old[j].contains(places, bound)
                }
        if not found:
            expected = old[min(max(k + reached for k, reached in states), len(old) - 1)] if old else None
            raise _differ(expected, cut, place)
        states = found
    if not any(reached and all(cut.length() <= bound for cut in old[k + 1 :]) for k, reached in states):
        expected = old[min(max(k + reached for k, reached in states), len(old) - 1)]
        raise ProgramError(f"{_shown(expected)}; the new program does not make this cut", code="program.cut.differs")
    return len(old)


def _next(old: Sequence[Cut], k: int, bound: float) -> Iterator[int]:
    """Yield the cuts that may follow: the next one, and those after cuts of no length."""
    for j in range(k + 1, len(old)):
        yield j
        if old[j].length() > bound:
            return


def _cuts(source: Sequence[str], offsets: Offsets, deleted: bool | None) -> Iterator[Cut]:
    lines = in_units_of_the_machine(source, offsets.unit)
    own = lines is not None
    inch = UNITS[offsets.unit] if own else UNITS["inch"]
    with closing(commands(source if lines is None else lines, offsets, deleted=deleted, own=own)) as found:
        yield from _tracked(found, inch)


def _tracked(found: Iterable[Command], inch: float) -> Iterator[Cut]:
    """Yield the cuts of canonical commands; ``inch`` is the length of an inch of the interpreter, m."""
    frame = Frame(inch / 25.4, 0.0, _NONE, _NONE, _NONE)
    plane = 0
    at = frame.machine(_NONE)
    for command in found:
        name = command.name
        if name == "USE_LENGTH_UNITS":
            frame = replace(frame, scale=inch if "INCH" in command.text else inch / 25.4)
        elif name == "SELECT_PLANE":
            plane = _PLANES.index(command.text)
        elif name == "SET_XY_ROTATION":
            frame = replace(frame, rotation=command.numbers()[0])
        elif name in ("SET_G5X_OFFSET", "SET_G92_OFFSET", "USE_TOOL_LENGTH_OFFSET"):
            first = 1 if name == "SET_G5X_OFFSET" else 0
            x, y, z = (value * frame.scale for value in command.numbers()[first : first + 3])
            if name == "SET_G5X_OFFSET":
                frame = replace(frame, origin=(x, y, z))
            elif name == "SET_G92_OFFSET":
                frame = replace(frame, g92=(x, y, z))
            else:
                frame = replace(frame, tool=(x, y, z))
        elif name in ("STRAIGHT_TRAVERSE", "STRAIGHT_PROBE", "STRAIGHT_FEED"):
            x, y, z = command.numbers()[:3]
            if name == "STRAIGHT_FEED":
                yield Cut(command.line, frame, frame.program(at), (x, y, z))
            at = frame.machine((x, y, z))
        elif name == "ARC_FEED":
            first_end, second_end, u, v, turns, third = command.numbers()[:6]
            a, b, c = PLANES[plane]
            end = [0.0, 0.0, 0.0]
            end[a], end[b], end[c] = first_end, second_end, third
            cut = Cut(command.line, frame, frame.program(at), (end[0], end[1], end[2]), (u, v), plane, int(turns))
            yield cut
            at = frame.machine(cut.end)


def _from_segment(p: Triple, s: Triple, e: Triple, before: float) -> float:
    """Return the distance of a point from a segment that is longer at its start."""
    length = math.dist(s, e)
    if not length:
        return math.dist(p, e)
    direction = [(b - a) / length for a, b in zip(s, e, strict=True)]
    along = sum((a - b) * d for a, b, d in zip(p, s, direction, strict=True))
    along = min(max(along, -before), length)
    return math.dist(p, [a + along * d for a, d in zip(s, direction, strict=True)])


def _differ(expected: Cut | None, cut: Cut, place: Triple) -> ProgramError:
    where = f"the new program cuts to {_millimetres(place)} in line {cut.line}"
    return ProgramError(
        f"{_shown(expected)}; {where}" if expected is not None else f"{where}, the original does not cut",
        code="program.cut.differs",
    )


def _shown(cut: Cut) -> str:
    end = _millimetres(cut.frame.machine(cut.end))
    return f"line {cut.line}: the original cuts to {end} of the machine's axes, as LinuxCNC reads it"


def _millimetres(place: Triple) -> str:
    return "(" + ", ".join(f"{1e3 * value:.4f}" for value in place) + ") mm"
