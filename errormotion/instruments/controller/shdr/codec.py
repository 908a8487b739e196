"""Lines of an SHDR adapter (adapter agent protocol 1.4 to 2.0, cppagent README): data, conditions, commands, assets.

``time|key|value|key|value``. A condition has five fields after its key, a message two, a time series three; each of
them is expected alone on a line, unless the settings state its key. Keys that start with ``@`` (assets) are ignored.

Longest line: 64 KiB; longest asset in several lines: 1 MiB; a line has at most 4096 fields.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Set
from dataclasses import dataclass
from datetime import UTC, datetime

from errormotion.errors import ProtocolError

PING = b"* PING\n"
UNAVAILABLE = "UNAVAILABLE"
LEVELS = ("NORMAL", "WARNING", "FAULT", UNAVAILABLE)
MAX_LINE_BYTES = 65536
MAX_ASSET_BYTES = 1 << 20
MAX_FIELDS = 4096
MAX_MILLISECONDS = 86_400_000  # longest heartbeat: a day
_MAX_TIME = 64  # characters
_MULTILINE = "--multiline--"
_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]{1,4})?", re.ASCII)
_TIME = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}[T ][0-9:.]+(Z|[+-][0-9]{2}:?[0-9]{2})?", re.ASCII)
_MILLISECONDS = re.compile(r"[0-9]{1,9}", re.ASCII)
_PONG = re.compile(r"PONG ([0-9]{1,9})", re.ASCII)


@dataclass(frozen=True)
class Observed:
    """A value of a key.

    Attributes
    ----------
    key, value : str
        As received, ``UNAVAILABLE`` included; for a condition its text, for a time series its last value.
    time : float
        s since 1970 by the adapter's clock; NaN if the line has no absolute time.
    level : str
        For a condition one of `LEVELS`; else empty.
    code : str
        For a condition or message the code of the machine.
    doubt : str
        Why the value, which is ``UNAVAILABLE``, cannot be told from the line; empty if it can.
    """

    key: str
    value: str
    time: float
    level: str = ""
    code: str = ""
    doubt: str = ""


@dataclass(frozen=True)
class Command:
    """A statement of an adapter about itself: ``* name: value``, or ``* PONG milliseconds``."""

    name: str
    value: str


@dataclass(frozen=True)
class Keys:
    """Keys whose values have several fields, as stated in the settings, and all keys that are known."""

    conditions: Set[str] = frozenset()
    messages: Set[str] = frozenset()
    series: Set[str] = frozenset()
    known: Set[str] = frozenset()


class Lines:
    """Splits received bytes into lines; skips assets of several lines."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._searched = 0
        self._asset_end = b""
        self._asset_bytes = 0

    def clear(self) -> None:
        """Discard incomplete data, after a connection was lost."""
        self.__init__()  # type: ignore[misc]

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield each complete line that is not part of an asset, without its line end.

        Raises
        ------
        ProtocolError
            A line or asset is longer than its limit; all received data are discarded.
        """
        self._buffer += data
        while (end := self._buffer.find(b"\n", self._searched)) >= 0:
            line = bytes(self._buffer[:end]).rstrip(b"\r")
            del self._buffer[: end + 1]
            self._searched = 0
            self._check(end)
            if not self._skips(line) and line:
                yield line
        self._searched = len(self._buffer)
        self._check(self._searched)

    def _check(self, size: int) -> None:
        if size > MAX_LINE_BYTES:
            start = bytes(self._buffer[:40])
            self.clear()
            raise ProtocolError(
                f"Expected lines of at most {MAX_LINE_BYTES} bytes; found {size}, near {start!r}",
                code="protocol.shdr.line",
            )

    def _skips(self, line: bytes) -> bool:
        if self._asset_end:
            self._asset_bytes += len(line) + 1
            if line == self._asset_end:
                self._asset_end = b""
            elif self._asset_bytes > MAX_ASSET_BYTES:
                end = self._asset_end[:60]
                self.clear()
                raise ProtocolError(
                    f"Expected the end {end!r} of an asset within {MAX_ASSET_BYTES} bytes", code="protocol.shdr.asset"
                )
            return True
        if b"|@ASSET@|" in line:
            mark = line.rpartition(b"|")[2]
            if mark.startswith(_MULTILINE.encode()):
                self._asset_end, self._asset_bytes = mark, 0
        return False


def parse_line(line: bytes, keys: Keys = Keys()) -> Command | list[Observed]:
    """Return the content of a line: a command of the adapter, or values in their order; no values for an asset.

    A separator within a value, which the adapter has not escaped, makes the value doubtful: it is that between two
    known keys.

    Raises
    ------
    ProtocolError
        The line has another format.
    """
    text = line.decode("utf-8", "replace").rstrip("\r\n")
    if text.startswith("*"):
        name, _, value = text[1:].strip().partition(":")
        if pong := _PONG.match(name):
            return Command("PONG", pong[1])
        return Command(name.strip(), value.strip())
    fields = split_fields(text)
    if len(fields) < 3:
        raise ProtocolError(f"Expected time|key|value; found '{text[:60]}'", code="protocol.shdr.line")
    time = parse_time(fields[0])
    if fields[1].startswith("@"):
        return []
    several = keys.conditions | keys.messages | keys.series
    simple = fields[1] in keys.known and not several & set(fields)
    try:
        observations = list(_observed(fields[1:], time, keys, text))
    except ProtocolError:
        if not simple or len(fields) % 2:
            raise
        return list(_between_known(fields[1:], time, keys.known))
    if simple and any(
        each.key not in keys.known and each.value in keys.known for each in observations
    ):  # shifted by one
        return list(_between_known(fields[1:], time, keys.known))
    return observations


def split_fields(text: str) -> list[str]:
    r"""Return the fields of a line; a value in double quotes may contain ``\|``.

    Raises
    ------
    ProtocolError
        The line has more than `MAX_FIELDS` fields.
    """
    parts = text.split("|", MAX_FIELDS + 1)
    if len(parts) > MAX_FIELDS:
        raise ProtocolError(
            f"Expected at most {MAX_FIELDS} fields; the line starts '{text[:60]}'", code="protocol.shdr.line"
        )
    fields: list[str] = []
    quoted: list[str] = []
    for part in parts:
        if quoted or (part.lstrip().startswith('"') and part.endswith("\\")):
            quoted.append(part)
            if not part.endswith("\\"):
                fields.append(_unquoted("|".join(each.removesuffix("\\") for each in quoted)))
                quoted = []
        else:
            fields.append(_unquoted(part))
    return [*fields, *(each.strip() for each in quoted)]


def _unquoted(part: str) -> str:
    text = part.strip()
    return text[1:-1] if len(text) > 1 and text.startswith('"') and text.endswith('"') else text


def parse_time(text: str) -> float:
    """Return a time such as ``2009-06-15T00:00:00.25Z@100``, s since 1970; NaN for no time, or a relative one.

    Raises
    ------
    ProtocolError
        The text is not a time.
    """
    word = text.partition("@")[0].strip()
    if not word or (_NUMBER.fullmatch(word) and len(word) <= _MAX_TIME):
        return math.nan
    try:
        if len(word) > _MAX_TIME or not _TIME.fullmatch(word):
            raise ValueError
        time = datetime.fromisoformat(word)
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise ProtocolError(
            f"Expected a time such as 2009-06-15T00:00:00.25Z; found '{text[:40]}'", code="protocol.time.form"
        ) from None


def parse_numbers(text: str) -> list[float]:
    """Return the numbers of a value such as ``1.5``, ``1 2 3`` or ``0:DAY``; one NaN if it is unavailable or empty.

    Raises
    ------
    ProtocolError
        The value is not numeric.
    """
    if text.upper() == UNAVAILABLE:
        return [math.nan]
    numbers = []
    for word in text.partition(":")[0].split():
        if not _NUMBER.fullmatch(word) or math.isinf(float(word)):
            raise ProtocolError(f"Expected a number; found '{text[:40]}'", code="protocol.shdr.number")
        numbers.append(float(word))
    return numbers or [math.nan]


def _observed(fields: list[str], time: float, keys: Keys, text: str) -> Iterator[Observed]:
    index = 0
    while index < len(fields):
        key, rest = fields[index], fields[index + 1 :]
        alone = index == 0
        size = _size(key, rest, keys, alone=alone)
        if not key or len(rest) < size:
            raise ProtocolError(
                f"Expected a key and {size} fields after it; found '{text[:60]}'", code="protocol.shdr.line"
            )
        if size == 5:
            level, code, _, _, message = rest[:5]
            if level.upper() not in LEVELS:
                raise ProtocolError(
                    f"The condition '{key[:40]}': expected {', '.join(LEVELS)}; found '{level[:40]}'",
                    code="protocol.shdr.condition",
                )
            yield Observed(key, message, time, level.upper(), code)
        elif size == 3:
            words = rest[2].split()
            yield Observed(key, words[-1] if words else UNAVAILABLE, time)
        elif size == 2:
            yield Observed(key, rest[1], time, code=rest[0])
        else:
            yield Observed(key, rest[0], time)
        index += 1 + size


def _between_known(fields: list[str], time: float, known: Set[str]) -> Iterator[Observed]:
    """Yield the values of a line in which a separator is not escaped.

    An odd number of fields from one known key to the next are its value and further pairs; with an even number, or
    none, it cannot be told which of them are its value.
    """
    index = 0
    while index < len(fields):
        end = next((i for i in range(index + 2, len(fields)) if fields[i] in known), len(fields))
        span = fields[index + 1 : end]
        if len(span) % 2:
            yield from (
                Observed(*pair, time) for pair in zip(fields[index:end:2], fields[index + 1 : end : 2], strict=True)
            )
        else:
            found = "|".join(span)[:60]
            doubt = (
                f"the value has a separator that is not escaped: '{found}'" if span else "the line ends behind the key"
            )
            yield Observed(fields[index], UNAVAILABLE, time, doubt=doubt)
        index = end


def _size(key: str, rest: list[str], keys: Keys, *, alone: bool) -> int:
    """Return the number of fields of a key; for keys that the settings do not state, from the form of the line."""
    for size, stated in ((5, keys.conditions), (2, keys.messages), (3, keys.series)):
        if key in stated:
            return size
    if not alone:
        return 1
    if len(rest) == 5 and rest[0].upper() in LEVELS and (rest[0].upper() != UNAVAILABLE or not rest[1]):
        return 5
    if len(rest) == 2:
        return 2
    if len(rest) == 3 and rest[0].isascii() and rest[0].isdigit() and len(rest[0]) < 7:
        count = int(rest[0])
        return 3 if count > 1 and len(rest[2].split()) == count else 1
    return 1


def pong(command: Command) -> float | None:
    """Return the heartbeat of ``* PONG``, s; None for another command, or without a number."""
    if command.name != "PONG" or not _MILLISECONDS.fullmatch(command.value):
        return None
    return min(int(command.value), MAX_MILLISECONDS) / 1000
