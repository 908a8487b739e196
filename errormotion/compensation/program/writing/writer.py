"""Lines of the new program: words of the old ones with other numbers, and further blocks for divided moves.

A number whose correction is below the last printed digit is not changed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from errormotion.compensation.program.reading.frames import Frame, Triple
from errormotion.compensation.program.reading.items import LINE, PLANES, RAPID, Move, Setting, Text, Unchanged
from errormotion.compensation.program.reading.offsets import UNITS
from errormotion.instruments.nc_words import STRIDE

DECIMALS = {UNITS["mm"]: 4, UNITS["inch"]: 5}
"""Printed digits after the decimal point for each unit of programs."""

_STOPS = {0.0, 1.0, 2.0, 30.0, 60.0}
_NUMBER = re.compile(r"^\s*(?:[nN]\s*\d+\s*)?")
_OF_MOVE = set("XYZIJKxyzijk")
_AXES = "XYZ"
_OFFSETS = "IJK"


class Writer:
    """Writes moves in their order, and tracks the present correction of each axis.

    Attributes
    ----------
    added : int
        Added lines.
    divided : int
        Divided moves.
    uncorrected : int
        Cuts that start at a position without correction, after a position in machine coordinates or a probing move.
    first_uncorrected : int
        Line of the first of them.
    """

    def __init__(self) -> None:
        self.added = self.divided = self.uncorrected = self.first_uncorrected = 0
        self._applied = [0.0, 0.0, 0.0]
        self._frame: Frame | None = None
        self._motion = -1

    def text(self, item: Text) -> str:
        """Return a line without a move."""
        if item.motion is not None:
            self._motion = item.motion
        return item.text

    def unchanged(self, item: Unchanged) -> str:
        """Return the line of a move without correction."""
        for k in item.axes:
            self._applied[k] = 0.0
        text = item.text
        if not item.explicit and self._motion not in (item.motion, -1):
            text = _ahead(f"G{item.motion} ", text)
        self._motion = item.motion
        return text

    def setting(self, item: Setting) -> str:
        """Return the line that sets the axes to values, including their present correction."""
        self._in(item.frame)
        new: dict[int, str] = {}
        decimals = DECIMALS[item.frame.scale]
        for letter, number, index in item.block.words:
            if letter in _AXES:
                change = round(self._applied[_AXES.index(letter)], decimals)
                if change:
                    new[index] = _text(float(number) + change, max(decimals, _decimals(number)))
        return _joined(item.block.parts, new) if new else item.block.text

    def move(
        self,
        move: Move,
        u: Sequence[float],
        offset: Sequence[Sequence[float]],
        middle: Sequence[Sequence[float]],
        start: Sequence[float],
        shifted: bool,
        tolerance: float,
    ) -> list[str]:
        """Return the lines of a move.

        Parameters
        ----------
        move : Move
        u : sequence of float
            Ends of its pieces, fractions.
        offset, middle : sequences of (3,)
            Corrections at the ends, and in the middle of the pieces of an arc; units of the program.
        start : (3,)
            Correction at the start; NaN if unknown.
        shifted : bool
            Whether the correction of an arc is constant.
        tolerance : float
            m; a cut that starts farther from its corrected start is counted.
        """
        self._in(move.frame)
        decimals = DECIMALS[move.frame.scale]
        rounded = [[round(value, decimals) for value in each] for each in offset]
        if move.kind != RAPID and start[0] == start[0]:
            away = math.dist(start, self._applied) * move.frame.scale
            if away > tolerance + 2 * 10.0**-decimals * move.frame.scale:
                self.uncorrected += 1
                self.first_uncorrected = self.first_uncorrected or move.block.line
        if move.kind <= LINE:
            lines = self._line(move, u, rounded, decimals)
        elif shifted and all(abs(a - b) < 10.0**-decimals / 4 for a, b in zip(self._applied, rounded[-1], strict=True)):
            lines = [self._shifted(move, rounded[-1], decimals)]
        else:
            lines = self._arc(move, u, rounded, middle, decimals)
        if len(lines) > 1:
            self.divided += 1
            self.added += len(lines) - 1
        self._applied = rounded[-1]
        return lines

    def _in(self, frame: Frame) -> None:
        """Express the present correction in another frame."""
        if self._frame is not None and frame is not self._frame:
            old = self._frame
            if frame.scale != old.scale or frame.rotation != old.rotation:
                self._applied = list(frame.own(old.vector((self._applied[0], self._applied[1], self._applied[2]))))
        self._frame = frame

    def _modal(self, kind: int) -> str:
        """Return the word of a motion; empty if the control is already in this mode."""
        before, self._motion = self._motion, kind
        return "" if before in (kind, -1) else f"G{kind} "

    def _line(self, move: Move, u: Sequence[float], offset: Sequence[Sequence[float]], decimals: int) -> list[str]:
        applied = self._applied
        half = 10.0**-decimals / 4
        new: dict[int, str] = {}
        tail = ""
        last = offset[-1]
        whole = len(u) == 1
        given = [False, False, False]
        if whole:
            for letter, number, index in move.block.words:
                k = _AXES.find(letter)
                if k >= 0:
                    given[k] = True
                    change = last[k] if move.absolute else last[k] - applied[k]
                    if abs(change) > half:
                        new[index] = _text(float(number) + change, max(decimals, _decimals(number)))
            for k in range(3):
                if not given[k] and abs(last[k] - applied[k]) > half:
                    value = move.end[k] + last[k] if move.absolute else last[k] - applied[k]
                    tail += f" {_AXES[k]}{_text(value, decimals)}"
            word = "" if move.explicit else self._modal(move.kind)
            self._motion = move.kind
            if not new and not tail and not word:
                return [move.block.text]
            return [_ahead(word, _joined(move.block.parts, new, tail))]
        more = _most_decimals(move, decimals)
        points = [self._point(move, fraction, change) for fraction, change in zip(u, offset, strict=True)]
        return self._pieces(move, points, [(LINE, "")] * len(points), u, more)

    def _point(self, move: Move, fraction: float, change: Sequence[float]) -> Triple:
        s, e = move.start, move.end
        if fraction == 1.0:
            return e[0] + change[0], e[1] + change[1], e[2] + change[2]
        x, y, z = (s[k] + fraction * (e[k] - s[k]) + change[k] for k in range(3))
        return x, y, z

    def _pieces(
        self,
        move: Move,
        points: Sequence[Triple],
        motions: Sequence[tuple[int, str]],
        u: Sequence[float],
        decimals: int,
    ) -> list[str]:
        """Return one block for each piece: the first with all words of the old one, except stops, which follow."""
        here = [round(move.start[k] + self._applied[k], decimals) for k in range(3)]
        whole = [move.end[k] - move.start[k] + points[-1][k] - move.end[k] - self._applied[k] for k in range(3)]
        done = [0.0, 0.0, 0.0]
        lines: list[str] = []
        before = 0.0
        stops = [f"{letter}{number}" for letter, number, _ in move.block.words if _is_stop(letter, number)]
        for number, (point, (kind, words)) in enumerate(zip(points, motions, strict=True)):
            last = number == len(points) - 1
            place = [round(value, decimals) for value in point]
            axes = ""
            for k in range(3):
                step = place[k] - here[k]
                if last and not move.absolute:  # the sum of the increments does not change
                    step = whole[k] - done[k]
                step = round(step, decimals)
                if step:
                    axes += f" {_AXES[k]}{_text(place[k] if move.absolute else step, decimals)}"
                    done[k] += step
            if not axes and not words:
                continue
            axes += words
            if move.feed_mode == 93 and move.kind != RAPID:
                axes += f" F{move.feed / (u[number] - before):.6g}"
            if lines:
                lines.append(self._modal(kind) + axes[1:])
            else:
                lines.append(self._first(move, kind, axes))
            here, before = place, u[number]
        if not lines:
            lines.append(self._first(move, move.kind, ""))
        lines += stops
        return lines

    def _first(self, move: Move, kind: int, axes: str) -> str:
        """Return the block of the first piece."""
        drop = set(_AXES) | set(_OFFSETS) | {"R"} | ({"P"} if move.kind > LINE else set())
        drop |= {"F"} if move.feed_mode == 93 else set()
        new: dict[int, str] = {}
        for letter, number, index in move.block.words:
            if letter in drop or _is_stop(letter, number):
                new[index] = ""
            elif letter == "G" and float(number) == move.kind and kind != move.kind:
                new[index] = str(kind)
        text = _joined(move.block.parts, new, axes)
        before, self._motion = self._motion, kind
        if not move.explicit and before not in (kind, -1):
            return _ahead(f"G{kind} ", text)
        if not move.explicit and before == -1 and kind != move.kind:
            return _ahead(f"G{kind} ", text)
        return text

    def _shifted(self, move: Move, change: Sequence[float], decimals: int) -> str:
        """Return an arc with a constant correction."""
        half = 10.0**-decimals / 4
        centre = {_OFFSETS[axis]: axis for axis in PLANES[move.plane][:2]} if move.centre_absolute else {}
        new: dict[int, str] = {}
        for letter, number, index in move.block.words:
            k = _AXES.find(letter)
            if k < 0:
                k = centre.get(letter, -1)
            elif not move.absolute:
                continue
            if k >= 0 and abs(change[k]) > half:
                new[index] = _text(float(number) + change[k], max(decimals, _decimals(number)))
        word = "" if move.explicit else self._modal(move.kind)
        self._motion = move.kind
        return _ahead(word, _joined(move.block.parts, new)) if new or word else move.block.text

    def _arc(
        self,
        move: Move,
        u: Sequence[float],
        offset: Sequence[Sequence[float]],
        middle: Sequence[Sequence[float]],
        decimals: int,
    ) -> list[str]:
        a, b, _ = PLANES[move.plane]
        more = _most_decimals(move, decimals)
        points, motions = [], []
        here = [round(move.start[k] + self._applied[k], more) for k in range(3)]
        before = 0.0
        for fraction, change, between in zip(u, offset, middle, strict=True):
            point = self._on_arc(move, fraction, change)
            place = [round(value, more) for value in point]
            centre = _centre(
                (here[a], here[b]),
                self._in_plane(move, (before + fraction) / 2, between),
                (place[a], place[b]),
                move.kind,
                10.0**-decimals,
            )
            if centre is None:
                motions.append((LINE, ""))
            else:
                reference = (0.0, 0.0) if move.centre_absolute else (here[a], here[b])
                words = "".join(
                    f" {_OFFSETS[axis]}{_text(centre[k] - reference[k], more)}" for k, axis in ((0, a), (1, b))
                )
                motions.append((move.kind, words))
            points.append(point)
            here, before = place, fraction
        return self._pieces(move, points, motions, u, more)

    def _on_arc(self, move: Move, fraction: float, change: Sequence[float]) -> Triple:
        if fraction == 1.0:
            return self._point(move, fraction, change)
        a, b, c = PLANES[move.plane]
        place = [0.0, 0.0, 0.0]
        s, e = move.start, move.end
        x, y = s[a] - move.centre[0], s[b] - move.centre[1]
        r0, r1 = math.hypot(x, y), math.hypot(e[a] - move.centre[0], e[b] - move.centre[1])
        angle, r = math.atan2(y, x) + fraction * move.sweep, r0 + fraction * (r1 - r0)
        place[a] = move.centre[0] + r * math.cos(angle) + change[a]
        place[b] = move.centre[1] + r * math.sin(angle) + change[b]
        place[c] = s[c] + fraction * (e[c] - s[c]) + change[c]
        return place[0], place[1], place[2]

    def _in_plane(self, move: Move, fraction: float, change: Sequence[float]) -> tuple[float, float]:
        point = self._on_arc(move, fraction, change)
        a, b, _ = PLANES[move.plane]
        return point[a], point[b]


def _centre(
    s: tuple[float, float], m: tuple[float, float], e: tuple[float, float], kind: int, digit: float
) -> tuple[float, float] | None:
    """Return the centre of the arc through three points; None if a straight line is equal to the last digit."""
    dx, dy = e[0] - s[0], e[1] - s[1]
    length = math.hypot(dx, dy)
    if length < 10 * digit:
        return None
    x, y = (s[0] + e[0]) / 2, (s[1] + e[1]) / 2
    h = ((m[1] - y) * dx - (m[0] - x) * dy) / length  # to the left of the chord
    if abs(h) < digit or (h < 0) != (kind == 3):
        return None
    yc = (h * h - length * length / 4) / (2 * h)
    return x - yc * dy / length, y + yc * dx / length


def _most_decimals(move: Move, decimals: int) -> int:
    return max([decimals, *(_decimals(number) for letter, number, _ in move.block.words if letter in _AXES)])


def _is_stop(letter: str, number: str) -> bool:
    return letter == "M" and float(number) in _STOPS


def _decimals(number: str) -> int:
    point = number.find(".")
    return 0 if point < 0 else len(number) - point - 1


def _text(value: float, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text


def _ahead(word: str, text: str) -> str:
    """Return a line with a word before all others except its number."""
    return _NUMBER.sub(lambda found: found[0] + word, text, count=1) if word else text


def _joined(parts: Sequence[str | None], new: dict[int, str], tail: str = "") -> str:
    """Return a line with other numbers; an empty one deletes the word. ``tail`` follows its last word of a position."""
    found = [part or "" for part in parts]
    end = axis = -1
    for index in range(2, len(found), STRIDE):
        if found[index]:
            end = index
            if found[index - 1] in _OF_MOVE:
                axis = index
    end = axis if axis >= 0 else end
    for index, number in new.items():
        found[index] = number
        if not number:
            found[index - 1] = ""
            if found[index - 2].isspace():
                found[index - 2] = ""
    if tail:
        if end >= 0:
            found[end] += tail
        else:
            found[0] = tail.lstrip() + found[0]
    return "".join(found)
