"""The plain reader of the subset of RS-274 (ISO 6983) in which every line is executed exactly once.

It tracks the modal state of a control; unsupported words raise an error with the number of the line. Meaning and
order of words are those of LinuxCNC (G code reference, "order of execution").
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

from errormotion.compensation.program.reading import arcs
from errormotion.compensation.program.reading.frames import Frame, Triple
from errormotion.compensation.program.reading.items import LINE, PLANES, RAPID, Item, Move, Setting, Text, Unchanged
from errormotion.compensation.program.reading.offsets import SYSTEMS, UNITS, Offsets
from errormotion.instruments.nc_words import Block, is_title, lines_of, refusal, split

UNKNOWN: Triple = (math.nan, math.nan, math.nan)

_MOTIONS = {0: 0, 10: 1, 20: 2, 30: 3}
_PROBES = {382, 383, 384, 385}
_SYSTEMS = {540: 0, 550: 1, 560: 2, 570: 3, 580: 4, 590: 5, 591: 6, 592: 7, 593: 8}
_PATH = {610, 611, 640}
_HARMLESS = {400, 800, 970, 960, 980, 990, 281, 301}  # G28.1 and G30.1 store the position; see _consumers
_CONSUMERS = {40, 100, 280, 300, 281, 301, 431, 920, 921, 922, 923, *_PROBES}
_CYCLES = {730, *range(810, 900, 10)}
_STOPS = {0, 1, 60}
_ENDS = {2, 30}
_SWITCHES = {3, 4, 5, 6, 7, 8, 9, 19, 48, 49, 50, 51, 52, 53, 61, 62, 63, 64, 65, 67, 68}
_WITH_P = {50, 51, 52, 53, 62, 63, 64, 65}
_AXES = "XYZ"
_OWN = set("NFSTXYZ")
_OF_SWITCHES = set("PQERD")


class Reader:
    """Reads a program line by line.

    Parameters
    ----------
    offsets : Offsets
        Offsets of the control before the program starts.
    unit : str
        ``mm`` or ``inch``: of the program before its first G20 or G21.
    start : (x, y, z), optional
        Position of the machine axes before the program starts, m.
    deleted : bool, optional
        Whether blocks that start with ``/`` are skipped; None: they raise an error.

    Attributes
    ----------
    ended : bool
        Whether the end of the program was read (M2, M30, or the second ``%``).
    after_end : (int, int)
        Lines with code or comments after it: number, and line of the first.
    """

    def __init__(
        self, offsets: Offsets, *, unit: str = "mm", start: Triple | None = None, deleted: bool | None = None
    ) -> None:
        self._offsets = offsets
        self.deleted = deleted
        self._systems = offsets.systems.copy()
        self._rotations = offsets.rotations.copy()
        self._system = offsets.system
        self._stored: Triple = _triple(offsets.stored)
        self._motion: int | None = None
        self._plane = 0
        self._absolute, self._centre_absolute = True, False
        self._feed_mode, self._feed, self._speed = 94, math.nan, math.nan
        self._tool, self._waiting = None, None  # type: tuple[int | None, int | None]
        self._frame = Frame(
            UNITS[unit], float(self._rotations[self._system]), _triple(offsets.g92), self._origin(), (0.0, 0.0, 0.0)
        )
        self._at: Triple = self._frame.program(start) if start is not None else UNKNOWN
        self._why = "no position was commanded yet, and none is stated by --start"
        self._measured: set[int] = set()
        self.ended = False
        self.after_end = (0, 0)

    def items(self, source: Iterable[str]) -> Iterator[Item]:
        """Yield the item of each line of a program.

        Raises
        ------
        ProgramError
            A line is not supported, or its effect is not determined.
        """
        begun = titled = False
        for number, text in lines_of(source):
            plain = text.strip()
            if self.ended:
                if plain not in ("", "%"):
                    self.after_end = self.after_end[0] + 1, self.after_end[1] or number
                yield Text(text)
            elif not plain:
                yield Text(text)
            elif plain == "%":
                self.ended = begun
                begun = True
                yield Text(text)
            elif not titled and is_title(text):
                begun = titled = True
                yield Text(text)
            else:
                begun = True
                titled = titled or plain[0] not in "(;"
                yield self._item(split(number, text))

    def _item(self, block: Block) -> Item:
        if block.skippable:
            if self.deleted is None:
                raise refusal(
                    block.line,
                    block.text,
                    "'/' (block delete): state whether these blocks are skipped",
                    code="program.block_delete.not_stated",
                )
            if self.deleted:
                return Text(block.text)
            block = split(block.line, block.text.replace("/", "", 1))
        codes: list[int] = []
        switches: list[int] = []
        values: dict[str, str] = {}
        for letter, number, _ in block.words:
            if letter == "G":
                codes.append(_code(block, number))
            elif letter == "M":
                switches.append(int(_whole(block, letter, number)))
            elif letter in values:
                raise refusal(block.line, block.text, f"the word {letter} is repeated", code="program.word.repeated")
            else:
                values[letter] = number
        if codes or switches or "S" in values or "T" in values:
            return self._full(block, codes, switches, values)
        if "F" in values:
            self._feed = _positive(block, "F", values["F"])
        if "X" in values or "Y" in values or "Z" in values or "I" in values or "J" in values or "K" in values:
            return self._move(block, values, explicit=False, machine=False)
        if values.keys() - {"N", "F"}:
            raise refusal(
                block.line,
                block.text,
                f"the word {min(values.keys() - {'N', 'F'})} is not allowed here",
                code="program.word.not_allowed",
            )
        return Text(block.text)

    def _full(self, block: Block, codes: list[int], switches: list[int], values: dict[str, str]) -> Item:
        """Process a block with codes, in the order of execution."""
        consumer = motion = None
        machine = False
        later: list[int] = []
        for code in codes:
            if code in _MOTIONS:
                if motion is not None:
                    raise refusal(block.line, block.text, "two motions in one block", code="program.block.two_motions")
                motion = _MOTIONS[code]
            elif code in _CONSUMERS:
                if consumer is not None:
                    raise refusal(
                        block.line,
                        block.text,
                        "two codes that use the axis words in one block",
                        code="program.block.axis_words",
                    )
                consumer = code
            elif code == 530:
                machine = True
            else:
                later.append(code)
        if "F" in values:
            self._feed = _positive(block, "F", values["F"])
        elif 930 in later or 940 in later or 950 in later:
            self._feed = math.nan
        if "S" in values:
            self._speed = _positive(block, "S", values["S"])
        if "T" in values:
            self._waiting = int(_whole(block, "T", values["T"]))
        for code in switches:
            self._switch(block, code, values)
        for code in later:
            self._modal(block, code, values)
        if motion is not None:
            self._motion = motion
        if consumer is not None:
            if motion is not None and set(values) & set("XYZIJK"):
                raise refusal(
                    block.line,
                    block.text,
                    "a motion, and another code that uses its axis words",
                    code="program.block.axis_words",
                )
            item = self._consume(block, consumer, values)
        elif set(values) & set("XYZ") or (set(values) & set("IJK") and 430 not in codes):
            item = self._move(block, values, explicit=motion is not None, machine=machine)
            allowed = _OWN | (set("IJKRP") if item_is_arc(item) else set()) | (_OF_SWITCHES if switches else set())
            allowed |= {"H"} if 430 in codes else set()
            if item_is_arc(item) and switches and (("P" in values and _WITH_P & {*switches}) or 19 in switches):
                raise refusal(
                    block.line,
                    block.text,
                    "an arc and a switch that share a word (P or R)",
                    code="program.block.shared_word",
                )
            if more := values.keys() - allowed:
                raise refusal(
                    block.line, block.text, f"the word {min(more)} is not allowed here", code="program.word.not_allowed"
                )
        else:
            if machine:
                raise refusal(block.line, block.text, "G53 without a position", code="program.machine.no_position")
            known = {"N", "F", "S", "T"} | ({"H"} if 430 in codes else set()) | (_OF_SWITCHES if switches else set())
            known |= {"P", "Q"} if 640 in later else set()
            known |= {"D"} if 960 in later else set()
            if more := values.keys() - known:
                raise refusal(
                    block.line, block.text, f"the word {min(more)} is not allowed here", code="program.word.not_allowed"
                )
            item = Text(block.text, motion)
        if any(code in _ENDS for code in switches):
            self.ended = True
        return item

    def _switch(self, block: Block, code: int, values: dict[str, str]) -> None:
        if code == 6:
            if self._waiting is None:
                raise refusal(
                    block.line, block.text, "M6 before a tool was selected (T)", code="program.tool.not_selected"
                )
            self._tool = self._waiting
        elif code == 61:
            self._tool = int(_whole(block, "Q", values.get("Q", "")))
        elif code not in _SWITCHES and code not in _STOPS and code not in _ENDS:
            raise refusal(
                block.line,
                block.text,
                f"M{code} is not supported by the plain reader",
                code="program.code.not_supported",
            )

    def _modal(self, block: Block, code: int, values: dict[str, str]) -> None:
        """Change the modal state."""
        if code in (170, 180, 190):
            self._plane = (code - 170) // 10
        elif code in (200, 210):
            self._change(replace(self._frame, scale=UNITS["inch" if code == 200 else "mm"]))
        elif code in (900, 910):
            self._absolute = code == 900
        elif code in (901, 911):
            self._centre_absolute = code == 901
        elif code in (930, 940, 950):
            self._feed_mode = code // 10
        elif code in _SYSTEMS:
            self._system = _SYSTEMS[code]
            self._moved_origin()
        elif code == 430:
            self._change(replace(self._frame, tool=self._tool_offset(block, values)))
        elif code == 490:
            self._change(replace(self._frame, tool=(0.0, 0.0, 0.0)))
        elif code in _CYCLES:
            raise refusal(
                block.line,
                block.text,
                f"G{code // 10} is a canned cycle, not supported by the plain reader",
                code="program.cycle.not_supported",
            )
        elif code in (410, 411, 420, 421):
            raise refusal(
                block.line,
                block.text,
                f"G{code / 10:g} (cutter compensation) changes the path",
                code="program.cutter.not_supported",
            )
        elif code not in _HARMLESS and code not in _PATH:
            raise refusal(
                block.line,
                block.text,
                f"G{code / 10:g} is not supported by the plain reader",
                code="program.code.not_supported",
            )
        if code == 800:
            self._motion = None

    def _consume(self, block: Block, code: int, values: dict[str, str]) -> Item:
        """Process a block whose axis words do not belong to a motion."""
        allowed = set("NFST")
        if code == 40:
            allowed |= {"P"}
            seconds = _number(block, "P", values.get("P", ""))
            item: Item = Text(block.text, dwell=seconds)
        elif code == 100:
            allowed |= set("LPXYZR")
            item = self._set_system(block, values)
        elif code in (280, 300):
            allowed |= set(_AXES)
            item = self._home(block, 0 if code == 280 else 1, values)
        elif code in (281, 301):
            raise refusal(
                block.line,
                block.text,
                "stores a position that is unknown before the program runs",
                code="program.position.stored_unknown",
            )
        elif code == 431:
            allowed |= set(_AXES)
            tool = list(self._frame.tool)
            for k, axis in enumerate(_AXES):
                if axis in values:
                    tool[k] = _number(block, axis, values[axis]) * self._frame.scale
            self._change(replace(self._frame, tool=_triple(tool)))
            item = Text(block.text)
        elif code in _PROBES:
            allowed |= set(_AXES)
            axes = _axes(values)
            if not axes:
                raise refusal(
                    block.line, block.text, "a probing move without a position", code="program.probing.no_position"
                )
            self._forget(axes, f"the probing move of line {block.line} ends at the contact")
            self._motion = None
            item = Unchanged(block.text, block.line, axes, -1, True, "probe")
        elif code == 920:
            allowed |= set(_AXES)
            frame = self._frame
            at, g92 = list(self._at), list(frame.g92)
            axes = _axes(values)
            if not axes:
                raise refusal(block.line, block.text, "G92 without a position", code="program.offset.no_position")
            for k in axes:
                value = _number(block, _AXES[k], values[_AXES[k]])
                g92[k] += (at[k] - value) * frame.scale
                at[k] = value
            self._stored = _triple(g92)
            if any(map(math.isnan, g92)):
                self._why = f"line {block.line} sets an offset at a position that is unknown before the program runs"
            self._frame, self._at = replace(frame, g92=self._stored), _triple(at)
            item = Setting(block, frame)
        else:
            if code == 921:
                self._stored = (0.0, 0.0, 0.0)
            if code == 923 and any(map(math.isnan, self._stored)):
                self._why = (
                    f"line {block.line} restores an offset of G92 that is not stated: state --parameters FILE.var"
                )
            self._change(replace(self._frame, g92=self._stored if code == 923 else (0.0, 0.0, 0.0)))
            item = Text(block.text)
        if more := values.keys() - allowed:
            raise refusal(
                block.line, block.text, f"the word {min(more)} is not allowed here", code="program.word.not_allowed"
            )
        return item

    def _set_system(self, block: Block, values: dict[str, str]) -> Item:
        kind = values.get("L", "")
        number = int(_whole(block, "P", values.get("P", ""))) or self._system + 1
        if kind not in ("2", "20") or not 1 <= number <= len(SYSTEMS):
            raise refusal(block.line, block.text, "expected G10 L2 or L20, with P0 to P9", code="program.g10.form")
        index = number - 1
        scale = self._frame.scale
        if kind == "20" and ("R" in values or self._rotations[index] or self._frame.rotation):
            raise refusal(
                block.line, block.text, "G10 L20 with a rotated coordinate system", code="program.g10.rotated"
            )
        for k in _axes(values):
            value = _number(block, _AXES[k], values[_AXES[k]]) * scale
            self._systems[index, k] = (
                value if kind == "2" else self._at[k] * scale + self._systems[self._system, k] - value
            )
        if kind == "20" and any(math.isnan(self._systems[index, k]) for k in _axes(values)):
            self._why = f"line {block.line} sets an origin at a position that is unknown before the program runs"
            self._measured.add(index)
        if "R" in values:
            self._rotations[index] = _number(block, "R", values["R"])
        frame = self._frame
        if index == self._system:
            self._moved_origin()
        return Setting(block, frame) if kind == "20" else Text(block.text)

    def _home(self, block: Block, index: int, values: dict[str, str]) -> Item:
        axes = _axes(values) or (0, 1, 2)
        at, machine = self._at, list(self._frame.machine(self._at))
        home = self._offsets.homes[index]
        for k in axes:
            machine[k] = float(home[k])
        new = self._frame.program(_triple(machine))
        if not self._frame.rotation:  # the other axes do not move, known or not
            new = _triple([new[k] if k in axes else at[k] for k in range(3)])
        self._at = new
        self._why = f"the target position of line {block.line} is unknown; it is stated in the parameter file"
        moved = axes if not self._frame.rotation else (0, 1, 2)
        motion = -1 if self._motion is None else self._motion
        return Unchanged(block.text, block.line, moved, motion, True, "machine")

    def _move(self, block: Block, values: dict[str, str], *, explicit: bool, machine: bool) -> Item:
        motion = self._motion
        if motion is None:
            raise refusal(
                block.line, block.text, "a position without a motion (G0 to G3)", code="program.motion.missing"
            )
        if machine:
            return self._in_machine(block, values, motion, explicit)
        at = self._at
        end = [math.nan] * 3
        for k, axis in enumerate(_AXES):
            if axis in values:
                value = float(values[axis])
                end[k] = value if self._absolute else at[k] + value
            else:
                end[k] = at[k]
        new: Triple = (end[0], end[1], end[2])
        frame = self._frame
        centre, sweep = (0.0, 0.0), 0.0
        if motion <= LINE and ("I" in values or "J" in values or "K" in values or "R" in values):
            raise refusal(block.line, block.text, "I, J, K or R without an arc (G2, G3)", code="program.arc.missing")
        known = frame.known and _known(new)
        if not known and motion == RAPID:
            self._at = new
            axes = _axes(values) if self._absolute else ()
            if not self._absolute:
                self._why = f"line {block.line} moves by an increment from an unknown position"
            return Unchanged(block.text, block.line, axes, motion, explicit, "unknown")
        if not known or not _known(at):
            if known and motion == RAPID:
                at = new  # from an unknown position: only the end is relevant
            else:
                raise refusal(
                    block.line,
                    block.text,
                    f"a cut from or to an unknown position: {self._unknown()}",
                    code="program.position.unknown",
                )
        if motion == LINE and self._feed_mode == 93 and "F" not in values:
            raise refusal(block.line, block.text, "G93 without F", code="program.feed.missing")
        if motion > LINE:
            centre, sweep = arcs.arc(block, values, at, new, PLANES[self._plane], motion, self._centre_absolute)
        self._at = new
        return Move(
            block,
            motion,
            explicit,
            at,
            new,
            centre,
            sweep,
            self._plane,
            frame,
            self._absolute,
            self._centre_absolute,
            self._feed_mode,
            self._feed,
            self._speed,
        )

    def _in_machine(self, block: Block, values: dict[str, str], motion: int, explicit: bool) -> Item:
        """Return the unchanged rapid move of G53 to a position in machine coordinates."""
        if motion != RAPID or not self._absolute:
            raise refusal(block.line, block.text, "G53 is supported with G0 and G90 only", code="program.machine.mode")
        machine = list(self._frame.machine(self._at))
        axes = _axes(values)
        for k in axes:
            machine[k] = _number(block, _AXES[k], values[_AXES[k]]) * self._frame.scale
        new = self._frame.program(_triple(machine))
        if not self._frame.rotation:
            new = _triple([new[k] if k in axes else self._at[k] for k in range(3)])
        elif not {0, 1} <= set(axes) and axes != (2,):
            raise refusal(
                block.line,
                block.text,
                "G53 in a rotated coordinate system: expected both X and Y, or Z",
                code="program.machine.rotated",
            )
        self._at = new
        return Unchanged(block.text, block.line, axes, motion, explicit, "machine")

    def _tool_offset(self, block: Block, values: dict[str, str]) -> Triple:
        number = int(_whole(block, "H", values["H"])) if "H" in values else self._tool
        if number == 0:
            return 0.0, 0.0, 0.0
        if number is None or number not in self._offsets.tools:
            which = "the tool in the spindle" if number is None else f"tool {number}"
            raise refusal(
                block.line,
                block.text,
                f"the length of {which} is unknown: state a tool table with --tools",
                code="program.tool.length_unknown",
            )
        return _triple(self._offsets.tools[number])

    def _origin(self) -> Triple:
        return _triple(self._systems[self._system])

    def _moved_origin(self) -> None:
        self._change(replace(self._frame, origin=self._origin(), rotation=float(self._rotations[self._system])))

    def _change(self, frame: Frame) -> None:
        """Change the frame without a motion of the machine."""
        old, at = self._frame, self._at
        if frame == old:
            return
        self._frame = frame
        if frame.scale != old.scale and frame.rotation == old.rotation and frame.origin is old.origin:
            ratio = old.scale / frame.scale
            self._at = (at[0] * ratio, at[1] * ratio, at[2] * ratio)
        else:
            self._at = frame.program(old.machine(at))

    def _forget(self, axes: Iterable[int], why: str) -> None:
        self._at = _triple([math.nan if k in axes else self._at[k] for k in range(3)])
        self._why = why

    def _unknown(self) -> str:
        name = SYSTEMS[self._system]
        if any(map(math.isnan, self._frame.origin)) and self._system not in self._measured:
            return f"the origin of {name} is unknown; state --parameters FILE.var or --offset {name}=X,Y,Z"
        return self._why


def item_is_arc(item: Item) -> bool:
    """Return whether an item is an arc."""
    return isinstance(item, Move) and item.kind > LINE


_CODES: dict[str, int] = {}


def _code(block: Block, number: str) -> int:
    """Return ten times a G code."""
    found = _CODES.get(number)
    if found is None:
        value = 10 * float(number)
        found = round(value)
        if abs(value - found) > 1e-6 or not 0 <= found < 1000:
            raise refusal(block.line, block.text, f"G{number} is not a code", code="program.code.unknown")
        if len(_CODES) < 1000:
            _CODES[number] = found
    return found


def _number(block: Block, letter: str, text: str) -> float:
    if not text:
        raise refusal(block.line, block.text, f"expected the word {letter}", code="program.word.missing")
    return float(text)


def _positive(block: Block, letter: str, text: str) -> float:
    value = float(text)
    if value < 0:
        raise refusal(
            block.line, block.text, f"expected {letter} not below 0; found {text}", code="program.word.negative"
        )
    return value


def _whole(block: Block, letter: str, text: str) -> float:
    value = _number(block, letter, text)
    if value != int(value) or not 0 <= value < 1 << 31:
        raise refusal(
            block.line, block.text, f"expected a whole number at {letter}; found {text}", code="program.word.not_whole"
        )
    return value


def _axes(values: dict[str, str]) -> tuple[int, ...]:
    return tuple(k for k, axis in enumerate(_AXES) if axis in values)


def _known(point: Triple) -> bool:
    return point[0] == point[0] and point[1] == point[1] and point[2] == point[2]


def _triple(values: Iterable[float]) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
