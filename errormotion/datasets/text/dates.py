"""Dates and times of day in text: order of day, month and year, and local times with daylight saving."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone, tzinfo

TIMESTAMP = "iso8601"
"""Unit of a time column with dates and times of day after ISO 8601."""

_PARTS = {"dd": 2, "mm": 1, "yyyy": 0, "yy": 0}
_PATTERN = re.compile(r"(dd|mm|yyyy|yy)([./-])(dd|mm|yyyy|yy)\2(dd|mm|yyyy|yy)")
_TIME = r"(?:[T,\s]\s*(\d{1,2}):(\d\d)(?::(\d\d)(?:[.,](\d{1,9}))?)?(?:\s*([AaPp])\.?[Mm]\.?)?)?"
_OFFSET = re.compile(r"([+-])(\d\d):(\d\d)")
_EXAMPLE = datetime(2024, 5, 31, 14, 5, 9)


def is_date(unit: str) -> bool:
    """Return whether the unit of a column states dates: ``iso8601``, or an order such as ``dd.mm.yyyy``."""
    match = _PATTERN.fullmatch(unit.lower())
    return unit == TIMESTAMP or (match is not None and {_PARTS[match[k]] for k in (1, 3, 4)} == {0, 1, 2})


def zone_of(name: str) -> tzinfo:
    """Return the time zone of a name such as ``Europe/Berlin``, or of an offset such as ``+01:00``.

    Raises
    ------
    ValueError
        Unknown.
    """
    import zoneinfo

    if match := _OFFSET.fullmatch(name):
        offset = timedelta(hours=int(match[2]), minutes=int(match[3]))
        if offset < timedelta(days=1):
            return timezone(offset if match[1] == "+" else -offset)
    try:
        return zoneinfo.ZoneInfo(name)
    except (OSError, ValueError, zoneinfo.ZoneInfoNotFoundError) as error:
        raise ValueError("expected a time zone such as 'Europe/Berlin', 'UTC' or '+01:00'") from error


@dataclass
class Clock:
    """Dates of successive lines as seconds from the first one on.

    Local times of a zone with daylight saving are resolved by the order of the lines: of the two meanings of a time in
    the hour that occurs twice, the first is used unless it is before the previous line. The time is refused if no
    previous line determines the hour, or if it does not exist.

    Attributes
    ----------
    unit : str
        ``iso8601``, or an order such as ``dd.mm.yyyy``, after which a time of day may follow.
    zone : tzinfo, optional
        Zone of dates without an offset.
    repeats : bool
        Whether several lines may have one time; otherwise a repeated time in the hour that occurs twice is the second.
    start : datetime, optional
        First date.
    resolved : int
        Number of times that the order of the lines has resolved.
    """

    unit: str = TIMESTAMP
    zone: tzinfo | None = None
    repeats: bool = False
    start: datetime | None = None
    resolved: int = 0
    _last: datetime | None = field(default=None, repr=False)
    _last_text: str = field(default="", repr=False)

    def seconds(self, text: str) -> float:
        """Return the seconds since the first date; ValueError states what was expected."""
        if self.repeats and text == self._last_text and self._last is not None and self.start is not None:
            return _difference(self._last, self.start)
        try:
            now = self._parsed(text)
            if now.tzinfo is None and self.zone is not None:
                now = self._local(now, self.zone, text)
            start = self.start or now
            if (now.tzinfo is None) != (start.tzinfo is None):
                raise ValueError(f"expected {self._example()}, all with an offset from UTC or none; found '{text}'")
            value = _difference(now, start)
        except OverflowError as error:
            raise ValueError(f"expected {self._example()}; found '{text}'") from error
        self.start, self._last, self._last_text = start, now, text
        return value

    def _parsed(self, text: str) -> datetime:
        expected = f"expected {self._example()}; found '{text}'"
        if self.unit == TIMESTAMP:
            try:
                return datetime.fromisoformat(text)
            except ValueError as error:
                raise ValueError(expected) from error
        first, sign, second, third = _PATTERN.fullmatch(self.unit.lower()).groups()  # type: ignore[union-attr]
        digits = {"dd": r"(\d{1,2})", "mm": r"(\d{1,2})", "yyyy": r"(\d{4})", "yy": r"(\d\d)"}
        date = re.escape(sign).join(digits[part] for part in (first, second, third))
        match = re.fullmatch(date + _TIME, text, flags=re.ASCII) if len(text) < 100 else None
        if match is None:
            raise ValueError(expected)
        numbers = {_PARTS[part]: int(match[k]) for k, part in enumerate((first, second, third), 1)}
        year = numbers[0] + (2000 if "yyyy" not in (first, second, third) else 0)
        hour, minute, second_ = (int(match[k] or 0) for k in (4, 5, 6))
        if match[8]:
            if not 1 <= hour <= 12:
                raise ValueError(expected)
            hour = hour % 12 + (12 if match[8] in "Pp" else 0)
        try:
            whole = datetime(year, numbers[1], numbers[2], hour, minute, second_)
        except ValueError as error:
            raise ValueError(expected) from error
        return whole + timedelta(microseconds=int(f"{match[7] or 0:0<6}"[:6]))

    def _local(self, wall: datetime, zone: tzinfo, text: str) -> datetime:
        """Return a local time with its zone and the right one of its two meanings."""
        first, second = (wall.replace(tzinfo=zone, fold=fold) for fold in (0, 1))
        if first.utcoffset() == second.utcoffset():
            return first
        if first.astimezone(UTC).astimezone(zone).replace(tzinfo=None) != wall:
            raise ValueError(f"'{text}' does not exist in {zone}: the clocks were set forward there")
        if self._last is None:
            raise ValueError(
                f"'{text}' occurs twice in {zone}, where the clocks were set back, and no line before it shows which "
                "one it is; remove the lines before the repeated hour ends, or use dates with an offset from UTC"
            )
        self.resolved += 1
        passed = _difference(first, self._last)
        return first if passed > 0 or (passed == 0 and self.repeats) else second

    def _example(self) -> str:
        if self.unit == TIMESTAMP:
            return "a date and time such as 2024-05-31T14:05:09.5"
        codes = {"dd": "%d", "mm": "%m", "yyyy": "%Y", "yy": "%y"}
        pattern = re.sub("dd|mm|yyyy|yy", lambda match: codes[match[0]], self.unit.lower())
        return f"a date and time such as {_EXAMPLE.strftime(f'{pattern} %H:%M:%S')}"


def _difference(later: datetime, earlier: datetime) -> float:
    """Return the seconds between two dates; within one zone, where Python neglects daylight saving, as well."""
    if later.tzinfo is not None and earlier.tzinfo is not None:
        later, earlier = later.astimezone(UTC), earlier.astimezone(UTC)
    return (later - earlier).total_seconds()
