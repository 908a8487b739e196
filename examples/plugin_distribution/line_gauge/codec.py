"""Lines of the LG7: pure functions between bytes and values, which raise a ProtocolError for anything else.

The answer to ``GET 3`` is three lines such as ``17,+0.946142*57`` (counter, mm) and then ``.*2E``. The two hexadecimal
digits after the asterisk are the sum of all characters before it.
"""

import math
import re

from errormotion.errors import ProtocolError

RATE = 1000.0  # 1/s
LONGEST = 64  # bytes
END = "."
OUT_OF_RANGE = "------"
IDENTITY = re.compile(r"(LG7),(\w{1,16}),([\w.]{1,16})", re.ASCII)
SAMPLE = re.compile(rf"(\d{{1,9}}),([+-]\d{{1,3}}\.\d{{6}}|{OUT_OF_RANGE})", re.ASCII)


def with_check(text: str) -> bytes:
    return f"{text}*{sum(text.encode()) & 0xFF:02X}\r".encode()


def text_of(line: bytes) -> str:
    text = line.partition(b"*")[0].decode("ascii", errors="replace")
    if not text.isascii() or with_check(text) != line:
        raise ProtocolError(f"Expected a line with its check, such as {with_check(END)!r}; found {line!r}")
    return text


def identity_of(text: str) -> tuple[str, ...]:
    """Return model, serial number and firmware."""
    match = IDENTITY.fullmatch(text)
    if match is None:
        raise ProtocolError(f"Expected model, serial number and firmware; the gauge sent {text!r}")
    return match.groups()


def sample_of(text: str) -> tuple[int, float]:
    """Return the counter and the distance, m; NaN out of range."""
    match = SAMPLE.fullmatch(text)
    if match is None:
        raise ProtocolError(f"Expected a counter and a distance in mm; the gauge sent {text!r}")
    return int(match[1]), math.nan if match[2] == OUT_OF_RANGE else float(match[2]) * 1e-3
