"""Lines that macros of FANUC controls print with DPRNT, one for each touch.

``DPRNT[N12*X#5061[53]*Y#5062[53]*Z#5063[53]*T#3001[80]]`` prints ``N12 X   12.345 Y -  3.210 Z  100.000 T   45210``:
mm, and milliseconds. Leading zeros are blanks or omitted; the sign precedes the blanks (FANUC, from memory) or the
digits.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from errormotion.errors import ProtocolError

MAX_LINE = 256
"""Longest line, bytes; three positions, a time and a label have about 80."""
_NUMBER = r"[-+]?+\s*+(?:\d++\.?+\d*+|\.\d++)"
PATTERN = (
    r"(?:N\s*+(?P<number>\d++)\s*+|[A-MO-W]\w*+\s++)?"
    rf"X\s*+(?P<x>{_NUMBER})\s*+Y\s*+(?P<y>{_NUMBER})\s*+Z\s*+(?P<z>{_NUMBER})\s*+"
    rf"(?:T\s*+(?P<time>{_NUMBER}))?"
)
"""Default pattern of a line: number of the touch or a label, position, time.

Its possessive quantifiers prevent backtracking, so that the time grows with the length of the line. The two optional
groups are not possessive: Python before 3.11.5 accepts parts of such a group.
"""

_CONTROL = bytes(range(32)) + b"\x7f%"  # characters of POPEN and PCLOS around the lines
MM, MILLISECONDS = 1e-3, 1e-3


@dataclass(frozen=True)
class Line:
    """One printed line: position (m), number of the touch (None if not printed), time (s; NaN if not printed)."""

    position: tuple[float, float, float]
    number: int | None = None
    time: float = math.nan


def from_iso_code(raw: bytes) -> bytes:
    """Return characters of ISO code, whose eighth bit makes the number of ones even, as ASCII.

    Raises
    ------
    ProtocolError
        A character with an odd number of ones.
    """
    if any(code.bit_count() & 1 for code in raw):
        raise ProtocolError(
            f"Expected characters with even parity (ISO code); found {raw[:60]!r}", code="protocol.text.parity"
        )
    return bytes(code & 0x7F for code in raw)


def text_of(raw: bytes) -> str:
    """Return a line as text, without control characters; empty if nothing is left.

    Raises
    ------
    ProtocolError
        Bytes that are not ASCII.
    """
    try:
        return raw.strip(_CONTROL).decode("ascii").strip()
    except UnicodeDecodeError:
        raise ProtocolError(f"Expected a line of text; found {raw[:60]!r}", code="protocol.text.form") from None


def parse_line(text: str, pattern: re.Pattern[str], *, length: float = MM, time: float = MILLISECONDS) -> Line:
    """Parse a line.

    Parameters
    ----------
    text : str
    pattern : compiled pattern
        Has the groups x, y, z, and optionally number and time; the whole line must match.
    length, time : float
        Factors from printed lengths and times to m and s.

    Raises
    ------
    ProtocolError
        The line is longer than `MAX_LINE`, or does not match the pattern.
    """
    if len(text) > MAX_LINE:
        raise ProtocolError(
            f"Expected a line of at most {MAX_LINE} characters; found {len(text)}: '{text[:60]}'",
            code="protocol.reply.too_long",
        )
    match = pattern.fullmatch(text.strip())
    if match is None:
        raise ProtocolError(
            f"Expected a line such as 'N12 X12.345 Y-3.210 Z100.000'; found '{text[:60]}'", code="protocol.touch.form"
        )
    groups = match.groupdict()
    try:
        x, y, z = (_value(groups[name]) * length for name in "xyz")
        number = int(groups["number"]) if groups.get("number") else None
        seconds = _value(groups["time"]) * time if groups.get("time") else math.nan
    except (TypeError, ValueError):
        raise ProtocolError(
            f"Expected numbers X, Y, Z in the line; found '{text[:60]}'", code="protocol.touch.form"
        ) from None
    return Line((x, y, z), number, seconds)


def _value(text: str) -> float:
    return float("".join(text.split()))


def format_line(line: Line, *, decimals: int = 3) -> str:
    """Return a line as a control prints it: mm, milliseconds."""
    number = "" if line.number is None else f"N{line.number} "
    x, y, z = (f"{value / MM:.{decimals}f}" for value in line.position)
    time = "" if math.isnan(line.time) else f" T{line.time / MILLISECONDS:.0f}"
    return f"{number}X{x} Y{y} Z{z}{time}"
