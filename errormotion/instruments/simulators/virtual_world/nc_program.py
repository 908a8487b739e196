"""The control's interpreter of NC programs: a part of ISO 6983; other words are refused, with their line.

It also understands what macros of common controls need for probing: a skip move (G31), and printing of lines.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal, Protocol

import numpy as np

from errormotion.errors import ErrormotionError, InstrumentError
from errormotion.instruments.nc_words import COMMENT, BlockError, printing, split
from errormotion.instruments.simulators.virtual_world.printing import PortCommand, parse_block
from errormotion.twin.paths import Path

UNDERSTOOD = (
    "% , (comments), ; comments, N, G0 and G1 with X, Y, Z (mm) and F (mm/min), G4 P (s), G21, G90, G94, G31, "
    "M3 S (/min), M5, POPEN, DPRNT[...] with #5061 to #5063 (mm) and #3001 (ms), PCLOS, M2, M30"
)
MM, MINUTE, MILLI = 1000.0, 60.0, 1000.0  # per m; s; per s

_REFUSED = {
    "G20": "inches are not supported; use mm and G21",
    "G91": "incremental positions are not supported; use G90 and positions of the axes",
    "M0": "a simulated machine has no operator who continues the program; remove the stop",
    "M1": "a simulated machine has no operator who continues the program; remove the stop",
}
_WITHOUT_EFFECT = ("G21", "G90", "G94")  # the only supported units, positions and feeds
_ROUNDING = 1e-9  # m

_SKIPPED = {"5061": 0, "5062": 1, "5063": 2}  # end position of the last skip move
_CLOCK = "3001"  # clock of the control, ms

Array = np.ndarray[Any, Any]


class Peripherals(Protocol):
    """Actions of a program in addition to its path, at times (s) since its start; they may be refused."""

    def pass_by(self, start: Array, goal: Array, feed: float, time: float) -> None:
        """Check for obstacles on a straight move (m, m/s)."""

    def skip(self, start: Array, goal: Array, feed: float, time: float) -> Array:
        """Return the end of a straight move (m, m/s): where the probe stops it, or its goal."""

    def spindle(self, speed: float, time: float) -> None:
        """Turn the spindle, 1/min."""

    def print(self, command: PortCommand, time: float) -> None:
        """Open or close the printer port, or send a block."""

    def clock(self, time: float) -> float:
        """Return the time of the control's clock, s."""


def interpret(
    text: str,
    start: tuple[float, float, float],
    travel: Mapping[str, tuple[float, float]],
    rapid: float,
    peripherals: Peripherals | None = None,
) -> Path:
    """Return the path of a program, started at time 0.

    The duration of a move is its length divided by its feed: there is no acceleration, and no rounding of corners.

    Parameters
    ----------
    text : str
        The program; G90, G21 and G94 are active at its start.
    start : (float, float, float)
        Position of the machine, m.
    travel : mapping
        Axis to (lowest, highest) position, m.
    rapid : float
        Feed of G0, and largest feed of G1, m/s.
    peripherals : Peripherals, optional
        Spindle, probe and printer; without them a program that needs one is refused.

    Raises
    ------
    InstrumentError
        An unknown word, a position out of travel, a move without feed, or a program without end; the message has the
        line number.
    """
    control = _Control(start, travel, rapid, peripherals)
    for number, line in enumerate(text.splitlines(), 1):
        try:
            command, template = printing(line) or ("", "")
            if command == "DPRNT":
                control.print(template)
            elif command:
                control.switch_port("POPEN" if command == "POPEN" else "PCLOS")
            else:
                control.execute(_words(number, line))
        except ErrormotionError as error:
            raise InstrumentError(f"Line {number} '{line.strip()[:60]}': {error}", code=error.code) from None
        if control.ended:
            return control.path()
    raise InstrumentError(
        "The program ends without M30 or M2; check that it is complete", code="machine.program.no_end"
    )


def title(text: str) -> str:
    """Return the first comment of a program, which states its purpose; "program" if it has none."""
    match = re.search(r"\(([^()\n]*)\)|;(.*)", text)
    return ((match[1] or match[2] or "").strip() if match else "") or "program"


def _words(number: int, line: str) -> list[tuple[str, float]]:
    """Return letters and numbers of a line."""
    if COMMENT.sub("", line).strip() == "%":
        return []
    try:
        block = split(number, line)
    except BlockError as error:
        raise InstrumentError(
            f"{error.why}; supported are {UNDERSTOOD}", code="machine.program.not_supported"
        ) from None
    if block.skippable:
        raise InstrumentError(
            f"'/' is not a word of a program; supported are {UNDERSTOOD}", code="machine.program.not_supported"
        )
    return [(letter, float(value)) for letter, value, _ in block.words]


class _Control:
    """State of the control between lines."""

    def __init__(
        self,
        start: tuple[float, float, float],
        travel: Mapping[str, tuple[float, float]],
        rapid: float,
        peripherals: Peripherals | None,
    ) -> None:
        self.ended = False
        self._peripherals = peripherals
        self._skipped: Array | None = None
        self._turning = False
        self._travel = travel
        self._rapid = rapid
        self._move = ""  # G0 or G1; empty before the first one
        self._feed: float | None = None
        self._times = [0.0]
        self._positions = [np.array(start, dtype=float)]
        self._fast: list[bool] = []

    def path(self) -> Path:
        """Return the commanded path."""
        return Path(np.array(self._times), np.array(self._positions), np.array(self._fast, dtype=bool))

    def execute(self, words: list[tuple[str, float]]) -> None:
        """Execute one line."""
        codes = [f"{letter}{value:g}" for letter, value in words if letter in "GM"]
        numbers = [(letter, value) for letter, value in words if letter not in "GMN"]
        values = dict(numbers)
        if len(values) < len(numbers):
            raise InstrumentError("the same letter twice in one line", code="machine.program.repeated")
        for code in codes:
            self._set(code, codes)
        if unknown := set(values) - set("XYZFPS"):
            raise InstrumentError(
                f"'{min(unknown)}' is not supported; supported are {UNDERSTOOD}", code="machine.program.not_supported"
            )
        self._turn(codes, values.pop("S", None))
        if "G4" in codes:
            self._dwell(values)
        elif "P" in values:
            raise InstrumentError("expected P (s) only with a dwell, G4", code="machine.program.dwell")
        else:
            self._advance(values, skipping="G31" in codes)

    def print(self, template: str) -> None:
        """Print a block, with positions of the last skip move (mm) and the clock (ms)."""
        printer = self._require_peripherals("a printer")

        def value(variable: str) -> float:
            if variable == _CLOCK:
                return float(round(printer.clock(self._times[-1]) * MILLI))  # in ms
            if variable not in _SKIPPED:
                known = ", ".join(f"#{each}" for each in (*_SKIPPED, _CLOCK))
                raise InstrumentError(
                    f"#{variable} is not supported; supported are {known}", code="machine.program.variable"
                )
            if self._skipped is None:
                raise InstrumentError(
                    "expected a skip move, G31, before its position is printed", code="machine.program.no_skip"
                )
            return float(self._skipped[_SKIPPED[variable]]) * MM

        printer.print(parse_block(template, value), self._times[-1])

    def switch_port(self, command: Literal["POPEN", "PCLOS"]) -> None:
        """Open or close the printer port, if there is one."""
        if self._peripherals is not None:
            self._peripherals.print(command, self._times[-1])

    def _require_peripherals(self, what: str) -> Peripherals:
        if self._peripherals is None:
            raise InstrumentError(f"{what} is not available here", code="machine.program.variable")
        return self._peripherals

    def _turn(self, codes: list[str], speed: float | None) -> None:
        """Turn the spindle, stop it, or change its speed."""
        if "M3" in codes and "M5" in codes:
            raise InstrumentError("M3 and M5 in one line", code="machine.program.spindle")
        if "M3" in codes and speed is None:
            raise InstrumentError(
                "expected the spindle speed, 1/min, with M3, as in M3 S8000", code="machine.program.spindle"
            )
        if "M5" in codes:
            self._turning = False
            self._require_peripherals("a spindle").spindle(0.0, self._times[-1])
        elif "M3" in codes or (speed is not None and self._turning):
            self._turning = True
            self._require_peripherals("a spindle").spindle(float(speed or 0.0), self._times[-1])
        elif speed is not None:
            raise InstrumentError(
                "a speed S while the spindle does not turn; expected M3 with it", code="machine.program.spindle"
            )

    def _set(self, code: str, codes: list[str]) -> None:
        if code in _REFUSED:
            raise InstrumentError(_REFUSED[code], code="machine.program.not_supported")
        if code in ("G0", "G1"):
            if "G0" in codes and "G1" in codes:
                raise InstrumentError("G0 and G1 in one line", code="machine.program.two_motions")
            self._move = code
        elif code in ("M2", "M30"):
            self.ended = True
        elif code not in (*_WITHOUT_EFFECT, "G4", "G31", "M3", "M5"):
            raise InstrumentError(
                f"'{code}' is not supported; supported are {UNDERSTOOD}", code="machine.program.not_supported"
            )

    def _dwell(self, values: Mapping[str, float]) -> None:
        if set(values) != {"P"} or values["P"] < 0:
            raise InstrumentError(
                "expected a dwell such as G4 P2.5, P in s, and no other words", code="machine.program.dwell"
            )
        self._append(values["P"], self._positions[-1], fast=False)

    def _advance(self, values: Mapping[str, float], *, skipping: bool) -> None:
        """Set the feed, and move if a position is given; a skip move ends where the probe trips."""
        if "F" in values:
            self._feed = values["F"] / MM / MINUTE
            if not 0 < self._feed <= self._rapid + _ROUNDING:
                raise InstrumentError(
                    f"expected a feed above 0 and at most {self._rapid * MM * MINUTE:g} mm/min; found {values['F']:g}",
                    code="machine.feed.outside",
                )
        goal = self._positions[-1].copy()
        for number, axis in enumerate("XYZ"):
            if axis in values:
                goal[number] = self._within(axis, values[axis])
        if not set(values) & set("XYZ"):
            return
        move = "G31" if skipping else self._move
        if not move:
            raise InstrumentError("a position before G0 or G1", code="machine.program.no_motion")
        feed = self._rapid if move == "G0" else self._feed
        if feed is None:
            raise InstrumentError(f"a move with {move} before a feed F", code="machine.program.no_feed")
        now = self._positions[-1], goal, feed, self._times[-1]
        if skipping:
            goal = self._skipped = self._require_peripherals("a probe").skip(*now)
        elif self._peripherals is not None:
            self._peripherals.pass_by(*now)
        self._append(float(np.linalg.norm(goal - self._positions[-1])) / feed, goal, fast=move == "G0")

    def _within(self, axis: str, value: float) -> float:
        low, high = self._travel[axis]
        if not low - _ROUNDING <= value / MM <= high + _ROUNDING:
            raise InstrumentError(
                f"{axis} travels from {low * MM:g} to {high * MM:g} mm; found {value:g}",
                code="machine.position.outside",
            )
        return value / MM

    def _append(self, seconds: float, position: Array, *, fast: bool) -> None:
        if seconds > 0:
            self._times.append(self._times[-1] + seconds)
            self._positions.append(position)
            self._fast.append(fast)
