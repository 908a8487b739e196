"""The control's interpreter of NC programs: a part of ISO 6983, every other word refused with its line.

Beside it understands what macros of widespread controls need to probe: a skip move (G31) and the lines that they print.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal, Protocol

import numpy as np

from errormotion.errors import ErrormotionError, InstrumentError
from errormotion.instruments.simulators.virtual_world.printing import Order, parse_block
from errormotion.twin.paths import Path

UNDERSTOOD = (
    "% , (comments), ; comments, N, G0 and G1 with X, Y, Z (mm) and F (mm/min), G4 P (s), G21, G90, G94, G31, "
    "M3 S (/min), M5, POPEN, DPRNT[...] with #5061 to #5063 (mm) and #3001 (ms), PCLOS, M2, M30"
)
MM, MINUTE, MILLI = 1000.0, 60.0, 1000.0  # per m; s; per s

_WORD = re.compile(r"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+))\s*")
_COMMENT = re.compile(r"\([^()]*\)")
_REFUSED = {
    "G20": "inches are not understood; write mm and G21",
    "G91": "positions relative to the last one are not understood; write G90 and positions of the axes",
    "M0": "a simulated machine has no operator who continues the program; remove the stop",
    "M1": "a simulated machine has no operator who continues the program; remove the stop",
}
_WITHOUT_EFFECT = ("G21", "G90", "G94")  # the only thing there is, in units, positions and feeds
_ROUNDING = 1e-9  # m

_PRINT = re.compile(r"(?:N\d+\s*)?DPRNT\s*\[(.*)\]")
_PORT = re.compile(r"(?:N\d+\s*)?(POPEN|PCLOS)")
_SKIPPED = {"5061": 0, "5062": 1, "5063": 2}  # where the last skip move has ended
_CLOCK = "3001"  # of the control, milliseconds

Array = np.ndarray[Any, Any]


class Peripherals(Protocol):
    """What a program orders beside its path, at times (s) since its start; an order may be refused."""

    def pass_by(self, start: Array, goal: Array, feed: float, time: float) -> None:
        """See whether something is in the way of a straight move (m, m/s)."""

    def skip(self, start: Array, goal: Array, feed: float, time: float) -> Array:
        """Return where a straight move ends that the probe stops (m, m/s): there, or at its goal."""

    def spindle(self, speed: float, time: float) -> None:
        """Turn the spindle, 1/min."""

    def print(self, order: Order, time: float) -> None:
        """Open or close the printer port, or send a block."""

    def clock(self, time: float) -> float:
        """Return what the control's clock shows, s."""


def interpret(
    text: str,
    start: tuple[float, float, float],
    travel: Mapping[str, tuple[float, float]],
    rapid: float,
    peripherals: Peripherals | None = None,
) -> Path:
    """Return the path of a program, started at time 0.

    Each move takes its way over its feed: there is no acceleration, and no rounding of corners.

    Parameters
    ----------
    text : str
        The program; G90, G21 and G94 hold from its start.
    start : (float, float, float)
        Where the machine is, m.
    travel : mapping
        Axis to (lowest, highest) position, m.
    rapid : float
        Feed of G0, and the greatest of G1, m/s.
    peripherals : Peripherals, optional
        Spindle, probe and printer; without them a program that needs one is refused.

    Raises
    ------
    InstrumentError
        A word that is not understood, a position out of travel, a move without feed, a program without end; with the
        number of the line.
    """
    control = _Control(start, travel, rapid, peripherals)
    for number, line in enumerate(text.splitlines(), 1):
        plain = _COMMENT.sub(" ", line).partition(";")[0].strip().upper()
        try:
            if printed := _PRINT.fullmatch(plain):
                control.print(printed[1])
            elif port := _PORT.fullmatch(plain):
                control.switch_port("POPEN" if port[1] == "POPEN" else "PCLOS")
            else:
                control.obey(_words(plain))
        except ErrormotionError as error:
            raise InstrumentError(f"Line {number} '{line.strip()[:60]}': {error}") from None
        if control.ended:
            return control.path()
    raise InstrumentError("The program ends without M30 or M2: is it whole?")


def title(text: str) -> str:
    """Return the first comment of a program, which states what it does; "program" where it has none."""
    found = re.search(r"\(([^()\n]*)\)|;(.*)", text)
    return ((found[1] or found[2] or "").strip() if found else "") or "program"


def _words(plain: str) -> list[tuple[str, float]]:
    """Return letters and numbers of a line."""
    if plain == "%":
        return []
    words, place = [], 0
    while place < len(plain):
        word = _WORD.match(plain, place)
        if word is None:
            raise InstrumentError(f"'{plain[place:][:20]}' is no word of a program; understood are {UNDERSTOOD}")
        words.append((word[1], float(word[2])))
        place = word.end()
    return words


class _Control:
    """What the control keeps from line to line."""

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
        self._move = ""  # G0 or G1, once one of them was given
        self._feed: float | None = None
        self._times = [0.0]
        self._places = [np.array(start, dtype=float)]
        self._fast: list[bool] = []

    def path(self) -> Path:
        """Return what has been commanded."""
        return Path(np.array(self._times), np.array(self._places), np.array(self._fast, dtype=bool))

    def obey(self, words: list[tuple[str, float]]) -> None:
        """Take over one line."""
        codes = [f"{letter}{value:g}" for letter, value in words if letter in "GM"]
        numbers = [(letter, value) for letter, value in words if letter not in "GMN"]
        values = dict(numbers)
        if len(values) < len(numbers):
            raise InstrumentError("the same letter twice in one line")
        for code in codes:
            self._set(code, codes)
        if unknown := set(values) - set("XYZFPS"):
            raise InstrumentError(f"'{min(unknown)}' is not understood; understood are {UNDERSTOOD}")
        self._turn(codes, values.pop("S", None))
        if "G4" in codes:
            self._dwell(values)
        elif "P" in values:
            raise InstrumentError("P (s) belongs to a dwell, G4")
        else:
            self._advance(values, skipping="G31" in codes)

    def print(self, template: str) -> None:
        """Print a block, with positions of the last skip move (mm) and the clock (ms)."""
        printer = self._needed("a printer")

        def value(variable: str) -> float:
            if variable == _CLOCK:
                return float(round(printer.clock(self._times[-1]) * MILLI))  # counts milliseconds
            if variable not in _SKIPPED:
                known = ", ".join(f"#{each}" for each in (*_SKIPPED, _CLOCK))
                raise InstrumentError(f"#{variable} is not understood; printed are {known}")
            if self._skipped is None:
                raise InstrumentError("no skip move, G31, has ended yet")
            return float(self._skipped[_SKIPPED[variable]]) * MM

        printer.print(parse_block(template, value), self._times[-1])

    def switch_port(self, order: Literal["POPEN", "PCLOS"]) -> None:
        """Open or close the printer port, if there is one."""
        if self._peripherals is not None:
            self._peripherals.print(order, self._times[-1])

    def _needed(self, what: str) -> Peripherals:
        if self._peripherals is None:
            raise InstrumentError(f"nothing is connected here that could be {what}")
        return self._peripherals

    def _turn(self, codes: list[str], speed: float | None) -> None:
        """Turn the spindle, stop it, or change its speed."""
        if "M3" in codes and "M5" in codes:
            raise InstrumentError("M3 and M5 in one line")
        if "M3" in codes and speed is None:
            raise InstrumentError("expected the spindle's speed as M3 S8000, /min")
        if "M5" in codes:
            self._turning = False
            self._needed("a spindle").spindle(0.0, self._times[-1])
        elif "M3" in codes or (speed is not None and self._turning):
            self._turning = True
            self._needed("a spindle").spindle(float(speed or 0.0), self._times[-1])
        elif speed is not None:
            raise InstrumentError("a speed S, but the spindle does not turn; M3 belongs to it")

    def _set(self, code: str, codes: list[str]) -> None:
        if code in _REFUSED:
            raise InstrumentError(_REFUSED[code])
        if code in ("G0", "G1"):
            if "G0" in codes and "G1" in codes:
                raise InstrumentError("G0 and G1 in one line")
            self._move = code
        elif code in ("M2", "M30"):
            self.ended = True
        elif code not in (*_WITHOUT_EFFECT, "G4", "G31", "M3", "M5"):
            raise InstrumentError(f"'{code}' is not understood; understood are {UNDERSTOOD}")

    def _dwell(self, values: Mapping[str, float]) -> None:
        if set(values) != {"P"} or values["P"] < 0:
            raise InstrumentError("expected a dwell as G4 P2.5, P in s, and nothing beside it")
        self._append(values["P"], self._places[-1], fast=False)

    def _advance(self, values: Mapping[str, float], *, skipping: bool) -> None:
        """Set the feed, and move where a position is given; a skip move up to where the probe trips."""
        if "F" in values:
            self._feed = values["F"] / MM / MINUTE
            if not 0 < self._feed <= self._rapid + _ROUNDING:
                raise InstrumentError(
                    f"the feed is above 0 and at most {self._rapid * MM * MINUTE:g} mm/min; found {values['F']:g}"
                )
        goal = self._places[-1].copy()
        for number, axis in enumerate("XYZ"):
            if axis in values:
                goal[number] = self._within(axis, values[axis])
        if not set(values) & set("XYZ"):
            return
        move = "G31" if skipping else self._move
        if not move:
            raise InstrumentError("a position, but neither G0 nor G1 has been given")
        feed = self._rapid if move == "G0" else self._feed
        if feed is None:
            raise InstrumentError(f"a move with {move}, but no feed F has been given")
        now = self._places[-1], goal, feed, self._times[-1]
        if skipping:
            goal = self._skipped = self._needed("a probe").skip(*now)
        elif self._peripherals is not None:
            self._peripherals.pass_by(*now)
        self._append(float(np.linalg.norm(goal - self._places[-1])) / feed, goal, fast=move == "G0")

    def _within(self, axis: str, value: float) -> float:
        low, high = self._travel[axis]
        if not low - _ROUNDING <= value / MM <= high + _ROUNDING:
            raise InstrumentError(f"{axis} travels from {low * MM:g} to {high * MM:g} mm; found {value:g}")
        return value / MM

    def _append(self, seconds: float, place: Array, *, fast: bool) -> None:
        if seconds > 0:
            self._times.append(self._times[-1] + seconds)
            self._places.append(place)
            self._fast.append(fast)
