"""Check of an NC program (ISO 6983) against the limits, line by line; a block that may exceed them is refused.

The check accepts straight moves in absolute machine coordinates and mm: G0, G1, G31, G38.2 to G38.5 with X, Y, Z
and F, G4 alone on a line, G17, G21, G40, G49, G53, G80, G90, G94, M0 to M9, M30, S, T, comments, and the printing of
positions. A program must state its units, G1 and its feed before it depends on them; the modes that a control keeps
from earlier programs are unknown. Arcs, incremental moves, inches, offsets, variables, macros and subprograms are
refused: their path depends on the state of the control.
"""

from __future__ import annotations

from errormotion.errors import InstrumentError, ProgramError
from errormotion.instruments.interlock import Interlock
from errormotion.instruments.nc_words import COMMENT, printing, split

MAX_CHARACTERS = 1 << 24
_MOVES = {"0", "1", "31", "38.2", "38.3", "38.4", "38.5"}
_STRAIGHT = {f"G{code}" for code in _MOVES}
_OTHERS = {"4", "17", "21", "40", "49", "53", "80", "90", "94"}
_SWITCHES = {"0", "1", "2", "3", "4", "5", "6", "7", "8", "9", "30"}
_MM, _MM_MIN = 1e-3, 1e-3 / 60  # m, m/s


def check_program(text: str, interlock: Interlock) -> None:
    """Check that a program stays within the limits of the bench.

    Raises
    ------
    InstrumentError
        A line exceeds the limits, or its path is unknown; the message has its number. Without limits only the length is
        checked.
    """
    if len(text) > MAX_CHARACTERS:
        raise InstrumentError(
            f"expected a program of at most {MAX_CHARACTERS} characters; found {len(text)}",
            code="motion.program.too_long",
        )
    limits = interlock.limits
    if not limits.spans and limits.feed is None and limits.spindle_speed is None:
        return
    stated: set[str] = set()
    for number, line in enumerate(text.splitlines(), 1):
        if COMMENT.sub("", line).strip() in ("", "%") or printing(line):
            continue
        try:
            _check_line(_words(number, line), interlock, stated)
        except InstrumentError as error:
            raise InstrumentError(
                f"line {number} '{line.strip()[:60]}' of the program: {error}", code=error.code
            ) from None


def _words(number: int, line: str) -> list[tuple[str, str]]:
    try:
        block = split(number, line)
    except ProgramError:
        raise _unknown(line.strip()[:20]) from None
    if block.skippable:
        raise _unknown("/")
    return [(letter, value) for letter, value, _ in block.words]


def _check_line(words: list[tuple[str, str]], interlock: Interlock, stated: set[str]) -> None:
    codes = {f"{letter}{float(value):g}" for letter, value in words}
    dwell = "G4" in codes
    for letter, value in words:
        code = f"{letter}{float(value):g}"
        if letter == "G" and code[1:] not in _MOVES | _OTHERS:
            raise _unknown(code)
        if letter == "M" and code[1:] not in _SWITCHES:
            raise _unknown(code)
        if letter not in "GMNXYZFSTP" or (letter == "P" and not dwell):
            raise _unknown(f"{letter}{value}")
    if dwell:  # a control may also move if a dwell has other words beside it
        if sorted(letter for letter, _ in words if letter != "N") not in (["G", "P"], ["G", "X"]):
            raise InstrumentError(
                "a dwell with other words on its line; write G4 P alone on a line", code="motion.program.dwell"
            )
        return
    if interlock.limits.feed is not None and "G0" in codes:
        raise InstrumentError(
            "a rapid move at the feed of the machine; write G1 with a feed within the limit",
            code="motion.program.rapid",
        )
    if interlock.limits.feed is not None and any(letter == "F" for letter, _ in words) and not {"G21", "G94"} <= stated:
        raise InstrumentError(
            "a feed F before a line with G21 and G94; whether it is within the limit is unknown",
            code="motion.program.feed_unknown",
        )
    stated |= {letter for letter, _ in words if letter in "FS"} | {code for code in codes if code[0] == "G"}
    if interlock.limits.spindle_speed is not None and {"M3", "M4"} & codes and "S" not in stated:
        raise InstrumentError(
            "the spindle is started before a speed S; whether it is within the limit is unknown",
            code="motion.program.speed_unknown",
        )
    for letter, value in words:
        if letter in "XYZ":
            if not {"G21", "G90"} <= stated:
                raise InstrumentError(
                    "a position before G21 and G90; whether it is within the limits is unknown",
                    code="motion.program.position_unknown",
                )
            if not _STRAIGHT & codes and not {"G0", "G1"} & stated:
                raise InstrumentError(
                    "a position before G0 or G1; the path of the machine is unknown", code="motion.program.move_unknown"
                )
            if interlock.limits.feed is not None and "F" not in stated:
                raise InstrumentError(
                    "a move before a feed F; whether it is within the limit is unknown",
                    code="motion.program.feed_unknown",
                )
            interlock.coordinate(letter, float(value) * _MM)
        elif letter == "F":
            interlock.feed(float(value) * _MM_MIN)
        elif letter == "S":
            interlock.speed(float(value))


def _unknown(what: str) -> InstrumentError:
    return InstrumentError(
        f"'{what}': whether it stays within the limits of the bench is unknown", code="motion.program.word_unknown"
    )
