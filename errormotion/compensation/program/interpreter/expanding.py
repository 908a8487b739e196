"""Expansion of a program to one without variables, loops, subroutines and cycles, by LinuxCNC's interpreter.

Each canonical command becomes a block of the plain reader; a command without such a block raises an error with its
line. Comments, messages, switches and tool changes keep their order; line numbers remain on the first block of their
line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from errormotion.compensation.program.interpreter.canonical import Command, own_number
from errormotion.compensation.program.reading.frames import Frame, Triple
from errormotion.compensation.program.reading.items import PLANES
from errormotion.compensation.program.reading.offsets import SYSTEMS, UNITS, Offsets
from errormotion.errors import ProgramError
from errormotion.instruments.nc_words import SourceLine, codes_of, refusal, words_of

_DIGIT = 5e-5  # half of the last digit that the interpreter prints
_CYCLES = {"G73", *(f"G{number}" for number in range(81, 90))}
_SIDES = {"G40", "G41", "G42", "G41.1", "G42.1"}
_FAR = 1e3
"""Largest coordinate, m; larger ones follow from a value that is unknown."""
_WORDS = {
    "MIST_ON": "M7",
    "FLOOD_ON": "M8",
    "OPTIONAL_PROGRAM_STOP": "M1",
    "CHANGE_TOOL": "M6",
    "ENABLE_FEED_OVERRIDE": "M50 P1",
    "DISABLE_FEED_OVERRIDE": "M50 P0",
    "ENABLE_SPEED_OVERRIDE": "M51 P1",
    "DISABLE_SPEED_OVERRIDE": "M51 P0",
    "ENABLE_ADAPTIVE_FEED": "M52 P1",
    "DISABLE_ADAPTIVE_FEED": "M52 P0",
    "ENABLE_FEED_HOLD": "M53 P1",
    "DISABLE_FEED_HOLD": "M53 P0",
    "SET_MOTION_OUTPUT_BIT": "M62 P{0:.0f}",
    "CLEAR_MOTION_OUTPUT_BIT": "M63 P{0:.0f}",
    "SET_AUX_OUTPUT_BIT": "M64 P{0:.0f}",
    "CLEAR_AUX_OUTPUT_BIT": "M65 P{0:.0f}",
    "SET_MOTION_OUTPUT_VALUE": "M67 E{0:.0f} Q{1:g}",
    "SET_AUX_OUTPUT_VALUE": "M68 E{0:.0f} Q{1:g}",
    "SELECT_TOOL": "T{0:.0f}",
    "CHANGE_TOOL_NUMBER": "M61 Q{0:.0f}",
    "DWELL": "G4 P{0:g}",
    "ORIENT_SPINDLE": "M19 R{1:g}",
}
_NOTHING = {
    "SET_FEED_REFERENCE",
    "ON_RESET",
    "TURN_PROBE_ON",
    "TURN_PROBE_OFF",
    "START_CHANGE",
    "FINISH",
    "PALLET_SHUTTLE",
}
_RESET = {
    *("SET_G5X_OFFSET", "SET_XY_ROTATION", "SET_FEED_MODE", "SET_FEED_RATE", "STOP_SPINDLE_TURNING"),
    *("SET_SPINDLE_MODE", "FLOOD_OFF", "MIST_OFF", "SELECT_PLANE", "SET_G92_OFFSET"),
    *("ENABLE_FEED_OVERRIDE", "ENABLE_SPEED_OVERRIDE"),
}


class Expansion:
    """Converts canonical commands to plain code.

    Parameters
    ----------
    source : sequence of str
        Lines of the program, without their ends.
    offsets : Offsets
        Offsets of the interpreter.
    tolerance : float
        m; checked for inches, whose last digit printed by the interpreter is larger than most tolerances.

    Attributes
    ----------
    end : int
        Line of the end of the program (M2, M30) once it was expanded; 0: none.
    """

    def __init__(self, source: Sequence[str], offsets: Offsets, tolerance: float) -> None:
        self._source, self._offsets, self._tolerance = source, offsets, tolerance
        self._systems = [_triple(each) for each in offsets.systems]
        self._rotations: list[float] = offsets.rotations.tolist()
        self._frame = Frame(
            UNITS["mm"],
            float(offsets.rotations[offsets.system]),
            _triple(offsets.g92),
            _triple(0.0 if value != value else value for value in offsets.systems[offsets.system]),
            (0.0, 0.0, 0.0),
        )
        self._system = offsets.system
        self._at = self._frame.program((0.0, 0.0, 0.0))  # where the interpreter starts
        self._plane = 0
        self._numbered = 0
        self._line = 0
        self._compensated = _compensated(source)
        self.end = 0
        self._begun = False
        self._changing = False
        self._blend = ""
        self._known = [False] * 3
        self._incremental = self._homing = False
        self._handlers: dict[str, Callable[[Command], list[str]]] = {
            "USE_LENGTH_UNITS": self._units,
            "SELECT_PLANE": self._select,
            "SET_G5X_OFFSET": self._origin,
            "SET_XY_ROTATION": self._rotation,
            "SET_G92_OFFSET": self._shift,
            "USE_TOOL_LENGTH_OFFSET": self._tool,
            "SET_FEED_MODE": lambda c: ["G95" if c.numbers()[1] else "G94"],
            "SET_FEED_RATE": lambda c: [f"F{c.numbers()[0]:g}"] if c.numbers()[0] else [],
            "SET_SPINDLE_SPEED": lambda c: [f"S{self._spindle(c)[1]:g}"],
            "SET_SPINDLE_MODE": self._spindle_mode,
            "START_SPINDLE_CLOCKWISE": lambda c: ["M3"] if self._spindle(c) else [],
            "START_SPINDLE_COUNTERCLOCKWISE": lambda c: ["M4"] if self._spindle(c) else [],
            "STOP_SPINDLE_TURNING": lambda c: [] if self._changing else ["M5"] if self._spindle(c) else [],
            "MIST_OFF": lambda _: ["M9"],
            "FLOOD_OFF": lambda _: [],
            "SET_MOTION_CONTROL_MODE": self._control,
            "SET_NAIVECAM_TOLERANCE": self._naive,
            "COMMENT": self._comment,
            "MESSAGE": lambda c: [f"(MSG,{self._words(c)})"],
            "STRAIGHT_TRAVERSE": self._straight,
            "STRAIGHT_FEED": self._straight,
            "STRAIGHT_PROBE": self._probe,
            "ARC_FEED": self._arc,
        }

    def lines(self, commands: Iterable[Command]) -> Iterator[str]:
        """Yield the blocks of the plain program.

        Raises
        ------
        ProgramError
            A command without a block.
        """
        yield SourceLine("%", 0)
        yield SourceLine("G21 G90 G17 G94 G40 G49 G91.1", 0)
        ended = False
        for command in commands:
            if ended:
                continue
            if not self._begun:
                self._begun = command.name == "ON_RESET"
                continue
            if command.name == "PROGRAM_END":
                ended = True
                self.end = command.line
                yield self._with_number(command, "M30" if "M30" in self._codes(command) else "M2")
                continue
            if command.name in _RESET and {"M2", "M30"} & self._codes(command):
                continue  # what the end of a program resets
            for text in self._blocks(command):
                yield self._with_number(command, text)
        if not ended:
            yield SourceLine("M2", self._line)
        yield SourceLine("%", self._line)

    def _blocks(self, command: Command) -> list[str]:
        name = command.name
        if name in _NOTHING:
            self._changing = name == "START_CHANGE"
            return []
        if name in _WORDS:
            self._changing = False
            return [_WORDS[name].format(*command.numbers())]
        if name == "PROGRAM_STOP":
            return ["M60" if "M60" in self._codes(command) else "M0"]
        handler = self._handlers.get(name)
        if handler is None:
            raise self._refusal(command, f"{name} cannot be expanded", code="program.code.not_supported")
        return handler(command)

    def _text(self, command: Command) -> str:
        return self._source[command.line - 1] if 0 < command.line <= len(self._source) else ""

    def _stated(self, command: Command) -> dict[str, str]:
        """Return the numbers of the words of its line by their letters; a number is empty if it is computed."""
        return dict(words_of(self._text(command)))

    def _codes(self, command: Command) -> set[str]:
        return set(codes_of(self._text(command)))

    def _with_number(self, command: Command, text: str) -> SourceLine:
        self._line = command.line or self._line
        if command.line and command.line != self._numbered:
            self._numbered = command.line
            number, _ = own_number(self._source[command.line - 1])
            if number:
                text = f"N{number} {text}"
        return SourceLine(text, self._line)

    def _refusal(self, command: Command, why: str, *, code: str) -> ProgramError:
        if command.line:
            return refusal(command.line, self._source[command.line - 1], why, code=code)
        return ProgramError(f"a control word (O) after line {self._line}: {why}", code=code)

    def _units(self, command: Command) -> list[str]:
        unit = "inch" if "INCH" in command.text else "mm"
        if "CM" in command.text:
            raise self._refusal(command, "centimetres", code="program.unit.unknown")
        if unit == "inch" and self._tolerance < 2 * _DIGIT * UNITS["inch"]:
            raise self._refusal(
                command,
                "inches: LinuxCNC's interpreter prints 0.0001 inch; expected a tolerance of at least 2.6 um",
                code="program.tolerance.too_small",
            )
        ratio = self._frame.scale / UNITS[unit]
        self._frame = replace(self._frame, scale=UNITS[unit])
        self._at = _triple(value * ratio for value in self._at)
        return ["G20" if unit == "inch" else "G21"]

    def _select(self, command: Command) -> list[str]:
        self._plane = ("CANON_PLANE_XY", "CANON_PLANE_XZ", "CANON_PLANE_YZ").index(command.text)
        return [f"G{17 + self._plane}"]

    def _origin(self, command: Command) -> list[str]:
        given = self._three(command, command.numbers()[1:])
        k, scale = int(command.numbers()[0]) - 1, self._frame.scale
        codes, stated = self._codes(command), self._stated(command)
        known = list(self._systems[k])
        words = ""
        for axis, (value, old) in enumerate(zip(given, known, strict=True)):
            has_value = old == old or ("G10" in codes and "XYZ"[axis] in stated)
            if not has_value or abs(value - old / scale) <= 1.5 * _DIGIT:
                continue
            if stated.get("L") and float(stated["L"]) == 20 and not self._known[axis]:
                raise self._refusal(
                    command,
                    "an origin at a position that is unknown before the program runs",
                    code="program.origin.unknown",
                )
            words += f" {'XYZ'[axis]}{value:.4f}"
            known[axis] = value * scale
        blocks = [f"G10 L2 P{k + 1}{words}"] if words else []
        self._systems[k] = _triple(known)
        if k != self._system:
            blocks.append(SYSTEMS[k])
        self._system = k
        self._change(replace(self._frame, origin=_triple(0.0 if value != value else value for value in known)))
        return blocks

    def _rotation(self, command: Command) -> list[str]:
        (angle,) = command.numbers()
        blocks = []
        if abs(angle - self._rotations[self._system]) > 1.5 * _DIGIT:
            blocks.append(f"G10 L2 P{self._system + 1} R{angle:g}")
            self._rotations[self._system] = angle
        self._change(replace(self._frame, rotation=self._rotations[self._system]))
        return blocks

    def _shift(self, command: Command) -> list[str]:
        new = _triple(value * self._frame.scale for value in self._three(command, command.numbers()))
        codes = self._codes(command)
        same = all(abs(a - b) <= 1.5 * _DIGIT * self._frame.scale for a, b in zip(new, self._frame.g92, strict=True))
        self._change(replace(self._frame, g92=new))
        if kept := codes & {"G92.1", "G92.2", "G92.3"}:
            return [min(kept)]
        if "G92" in codes:
            stated = self._stated(command)
            axes = [k for k, axis in enumerate("XYZ") if axis in stated]
            return ["G92 " + " ".join(f"{'XYZ'[k]}{self._at[k]:.4f}" for k in axes)]
        if same:
            return []
        raise self._refusal(
            command, "an offset (G92) that no line of the program states", code="program.offset.not_stated"
        )

    def _tool(self, command: Command) -> list[str]:
        x, y, z = self._three(command, command.numbers())
        scale = self._frame.scale
        new = (x * scale, y * scale, z * scale)
        codes, height = self._codes(command), self._stated(command).get("H")
        if "G43" in codes and height and float(height).is_integer():
            number = int(float(height))
            if number in self._offsets.tools:
                new = _triple(self._offsets.tools[number])
            self._change(replace(self._frame, tool=new))
            return [f"G43 H{number}"]
        self._change(replace(self._frame, tool=new))
        if not any(new):
            return ["G49"]
        if "G43" in codes and height is None:
            return ["G43"]
        return [f"G43.1 X{x:.4f} Y{y:.4f} Z{z:.4f}"]

    def _three(self, command: Command, numbers: Sequence[float]) -> Triple:
        """Return the first three of the numbers of nine axes; the others are 0."""
        if any(numbers[3:9]):
            raise self._refusal(command, "another axis than X, Y, Z", code="program.axis.not_supported")
        return numbers[0], numbers[1], numbers[2]

    def _change(self, frame: Frame) -> None:
        if frame == self._frame:
            return
        at = self._frame.machine(self._at)
        self._frame = frame
        self._at = frame.program(at)

    def _spindle(self, command: Command) -> list[float]:
        numbers = command.numbers()
        if numbers[0] != 0:
            raise self._refusal(command, "a second spindle", code="program.spindle.not_supported")
        return numbers

    def _spindle_mode(self, command: Command) -> list[str]:
        if self._spindle(command)[1]:
            raise self._refusal(command, "constant surface speed (G96)", code="program.speed.not_supported")
        return []

    def _control(self, command: Command) -> list[str]:
        mode = command.text.split(",")[0].strip()
        if mode == "CANON_CONTINUOUS":
            tolerance = float(command.text.split(",")[1])
            self._blend = f"G64 P{tolerance:g}" if tolerance else "G64"
            return [self._blend]
        self._blend = ""
        return ["G61" if mode == "CANON_EXACT_PATH" else "G61.1"]

    def _naive(self, command: Command) -> list[str]:
        (tolerance,) = command.numbers()
        return [f"{self._blend} Q{tolerance:g}"] if tolerance and " P" in self._blend else []

    def _words(self, command: Command) -> str:
        return command.text[1:-1].replace("(", "[").replace(")", "]")

    def _comment(self, command: Command) -> list[str]:
        text = self._words(command)
        if text.startswith("interpreter: distance mode changed to"):
            self._incremental = text.endswith("incremental")
        return [] if text.startswith("interpreter:") else [f"({text})"]

    def _place(self, command: Command, new: Triple) -> str:
        """Return the words of a position: axes that move, and axes at an unknown position that the line states.

        The interpreter starts at zero, and assumes that a probing move reaches its end: the position of an axis is
        unknown until it is moved to a stated position.
        """
        if any(not abs(value) * self._frame.scale <= _FAR for value in new):
            raise self._refusal(
                command, "moves too far: the size of the tool or another value is unknown", code="program.move.too_far"
            )
        stated: dict[str, str] = {}
        if not all(self._known):
            stated = self._stated(command)
            a, b, c = PLANES[self._plane]
            if not self._known[c] and _CYCLES & self._codes(command):
                raise self._refusal(
                    command,
                    f"a canned cycle while the position of {'XYZ'[c]} is unknown",
                    code="program.cycle.unknown_position",
                )
            if not (self._known[a] and self._known[b]) and command.line in self._compensated:
                raise self._refusal(
                    command,
                    "cutter compensation that starts at an unknown position",
                    code="program.cutter.unknown_position",
                )
        words = []
        for k, axis in enumerate("XYZ"):
            if self._known[k]:
                if abs(new[k] - self._at[k]) > _DIGIT:
                    words.append(f"{axis}{new[k]:.4f}")
            elif axis in stated:
                if self._incremental:
                    raise self._refusal(
                        command, f"an increment of {axis} from an unknown position", code="program.position.unknown"
                    )
                self._known[k] = True
                words.append(f"{axis}{new[k]:.4f}")
            elif abs(new[k] - self._at[k]) > _DIGIT:
                raise self._refusal(command, f"{axis} moves from an unknown position", code="program.position.unknown")
        self._at = new
        return " ".join(words)

    def _straight(self, command: Command) -> list[str]:
        new = self._three(command, command.numbers())
        code = "G0" if command.name == "STRAIGHT_TRAVERSE" else "G1"
        if code == "G0" and (found := self._codes(command) & {"G53", "G28", "G30"}):
            return self._in_machine(command, new, min(found))
        words = self._place(command, new)
        return [f"{code} {words}"] if words else []

    def _in_machine(self, command: Command, new: Triple, code: str) -> list[str]:
        """Return the block of G53, G28 or G30, a move to a position in machine coordinates."""
        if self._frame.rotation:
            raise self._refusal(
                command, "a position in machine coordinates with a rotated work offset", code="program.machine.rotated"
            )
        stated = self._stated(command)
        axes = [k for k in range(3) if "XYZ"[k] in stated]
        if code != "G53":
            return self._home(new, code, axes)
        if any(v != v for v in self._systems[self._system]):
            raise self._refusal(
                command, "a position in machine coordinates with an unknown work offset", code="program.origin.unknown"
            )
        place = self._frame.machine(new)
        for k in axes:
            self._known[k] = True
        self._at = new
        return ["G53 G0 " + " ".join(f"{'XYZ'[k]}{place[k] / self._frame.scale:.4f}" for k in axes)]

    def _home(self, new: Triple, code: str, axes: list[int]) -> list[str]:
        """Return the blocks of G28 or G30, which the interpreter prints as two moves: to a position, and from there.

        The position may be an increment from one that is unknown.
        """
        old, self._at = self._at, new
        self._homing = not self._homing
        if not self._homing:
            home = self._offsets.homes[0 if code == "G28" else 1]
            origin = self._systems[self._system]
            for k in axes or range(3):
                self._known[k] = home[k] == home[k] and origin[k] == origin[k]
            return []
        base = old if self._incremental else (0.0, 0.0, 0.0)
        block = " ".join([code, *(f"{'XYZ'[k]}{new[k] - base[k]:.4f}" for k in axes)])
        return ["G91", block, "G90"] if self._incremental and axes else [block]

    def _probe(self, command: Command) -> list[str]:
        found = self._codes(command) & {"G38.2", "G38.3", "G38.4", "G38.5"}
        if not found:
            raise self._refusal(
                command, "a probing move that no line of the program states", code="program.probing.not_stated"
            )
        words = self._place(command, self._three(command, command.numbers()))
        for word in words.split():
            self._known["XYZ".index(word[0])] = False
        return [f"{min(found)} {words}"]

    def _arc(self, command: Command) -> list[str]:
        first, second, x, y, turns, third, *more = command.numbers()
        self._three(command, [0.0, 0.0, 0.0, *more])
        a, b, c = PLANES[self._plane]
        place = [0.0, 0.0, 0.0]
        place[a], place[b], place[c] = first, second, third
        at = self._at
        if not (self._known[a] and self._known[b]):
            raise self._refusal(command, "an arc from an unknown position", code="program.position.unknown")
        words = self._place(command, _triple(place))
        words += f" {'IJK'[a]}{x - at[a]:.4f} {'IJK'[b]}{y - at[b]:.4f}"
        words += f" P{abs(turns):.0f}" if abs(turns) > 1 else ""
        return [f"{'G3' if turns > 0 else 'G2'} {words}"]


def _compensated(source: Iterable[str]) -> set[int]:
    """Return the lines from one with cutter compensation (G41, G42) to the one that ends it."""
    found: set[int] = set()
    active = False
    for line, text in enumerate(source, 1):
        sides = [code for code in codes_of(text) if code in _SIDES]
        if active or any(side != "G40" for side in sides):
            found.add(line)
        active = sides[-1] != "G40" if sides else active
    return found


def _triple(values: Iterable[float]) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
