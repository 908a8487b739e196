"""Limits of an NC program (ISO 6983), read line by line; a block that may leave them is refused.

Understood are straight moves in absolute machine coordinates and mm: G0, G1, G31, G38.2 to G38.5 with X, Y, Z and F,
G4, G17, G21, G40, G49, G53, G80, G90, G94, M0 to M9, M30, S, T, comments, and the printing of positions. Arcs,
incremental moves, inches, offsets, variables, macros and subprograms are not: where they lead is known to the control.
"""

from __future__ import annotations

import re

from errormotion.errors import InstrumentError
from errormotion.instruments.door import Door

MOST_CHARACTERS = 1 << 24
_WORD = re.compile(r"([A-Z])\s*([-+]?(?:\d{1,15}(?:\.\d{0,15})?|\.\d{1,15}))\s*")
_COMMENT = re.compile(r"\([^()]*\)")
_PRINTING = ("POPEN", "PCLOS", "DPRNT")
_MOVES = {"0", "1", "31", "38.2", "38.3", "38.4", "38.5"}
_OTHERS = {"4", "17", "21", "40", "49", "53", "80", "90", "94"}
_SWITCHES = {"0", "1", "2", "3", "4", "5", "6", "7", "8", "9", "30"}
_MM, _MM_MIN = 1e-3, 1e-3 / 60  # m, m/s


def check_program(text: str, door: Door) -> None:
    """Hold a program to the limits of a door.

    Raises
    ------
    InstrumentError
        A line leaves the limits, or it is unknown where it leads; with its number. Without limits only the length is
        checked.
    """
    if len(text) > MOST_CHARACTERS:
        raise InstrumentError(f"expected a program of at most {MOST_CHARACTERS} characters; found {len(text)}")
    limits = door.limits
    if not limits.spans and limits.feed is None and limits.spindle_speed is None:
        return
    stated: set[str] = set()
    for number, line in enumerate(text.splitlines(), 1):
        plain = _COMMENT.sub(" ", line.upper()).partition(";")[0].strip()
        if plain in ("", "%") or re.sub(r"^N\d{1,9}\s*", "", plain).startswith(_PRINTING):
            continue
        try:
            _check_line(plain, door, stated)
        except InstrumentError as error:
            raise InstrumentError(f"line {number} '{line.strip()[:60]}' of the program: {error}") from None


def _check_line(plain: str, door: Door, stated: set[str]) -> None:
    words, position = [], 0
    while position < len(plain):
        word = _WORD.match(plain, position)
        if word is None:
            raise _unknown(plain[position:][:20])
        words.append((word[1], word[2]))
        position = word.end()
    dwell = False
    for letter, value in words:
        code = f"{float(value):g}"
        if letter == "G":
            if code not in _MOVES | _OTHERS:
                raise _unknown(f"G{code}")
            dwell = dwell or code == "4"
            stated.add(code)
        elif letter == "M" and code not in _SWITCHES:
            raise _unknown(f"M{code}")
        elif letter not in "GMNXYZFSTP" or (letter == "P" and "G4" not in {f"{a}{float(b):g}" for a, b in words}):
            raise _unknown(f"{letter}{value}")
    if door.limits.feed is not None and any(letter == "G" and float(value) == 0 for letter, value in words):
        raise InstrumentError("a rapid move, whose feed is that of the machine; write G1 with a feed within the limit")
    stated |= {letter for letter, _ in words if letter == "F"}
    for letter, value in words:
        if letter in "XYZ" and not dwell:
            if not {"21", "90"} <= stated:
                raise InstrumentError("a position before G21 and G90; whether it is within the limits is unknown")
            if door.limits.feed is not None and "F" not in stated:
                raise InstrumentError("a move before a feed F; whether it is within the limit is unknown")
            door.coordinate(letter, float(value) * _MM)
        elif letter == "F":
            door.feed(float(value) * _MM_MIN)
        elif letter == "S":
            door.speed(float(value))


def _unknown(what: str) -> InstrumentError:
    return InstrumentError(f"'{what}': whether it stays within the limits of the bench is unknown")
