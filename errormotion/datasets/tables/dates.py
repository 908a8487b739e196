"""Dates and times of day in text: order of day, month and year, and local times with daylight saving."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone, tzinfo

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array

TIMESTAMP = "iso8601"
"""Unit of a time column with dates and times of day after ISO 8601."""
ELAPSED = "hh:mm:ss"
"""Unit of a time column with the time since a beginning, hours that may exceed 24."""
EXCEL, UNIX, UNIX_MS = "excel", "unix", "unix ms"
"""Units of numbers: days of a spreadsheet, and seconds or milliseconds since 1970 in UTC."""
COUNTED = {
    EXCEL: (datetime(1899, 12, 30), 86400.0),
    UNIX: (datetime(1970, 1, 1, tzinfo=UTC), 1.0),
    UNIX_MS: (datetime(1970, 1, 1, tzinfo=UTC), 1e-3),
}
"""Origin and seconds of a number in each of these units; Excel counts a day 60 (29 February 1900) that was none."""

_PARTS = {"dd": 2, "mm": 1, "mmm": 1, "yyyy": 0, "yy": 0}
_PATTERN = re.compile(r"(dd|mmm|mm|yyyy|yy)([./ -])(dd|mmm|mm|yyyy|yy)\2(dd|mmm|mm|yyyy|yy)")
# Instruments also write "_" or "-" before the time of day, and ":" before the milliseconds (Keysight 34970A).
_TIME = (
    r"(?:(?:\s*[T,]\s*|\s+|[_-])([0-9]{1,2})[:.]([0-9][0-9])(?:[:.]([0-9][0-9])(?:[.,:]([0-9]{1,9}))?)?"
    r"(?:\s*([AaPp])\.?[Mm]\.?)?)?"
)
_DIGITS = {
    "dd": "([0-9]{1,2})",
    "mm": r"([0-9]{1,2}|[^\W\d_]{3,9}\.?)",
    "yyyy": "([0-9]{4})",
    "yy": "([0-9]{2})",
    "mmm": r"([^\W\d_]{3,9})\.?",
}
_ELAPSED = re.compile(r"(?:([0-9]{1,6}):)?([0-9]{1,2}):([0-9][0-9])(?:[.,:]([0-9]{1,9}))?", flags=re.ASCII)
_OFFSET = re.compile(r"([+-])(\d\d):(\d\d)")
_EXAMPLE = datetime(2024, 5, 31, 14, 5, 9)
_MANY = 2000
"""Number of dates from which they are converted at once."""
_NAMES = (
    *("jan january januar", "feb february februar", "mar march mär märz mrz", "apr april", "may mai", "jun june juni"),
    *("jul july juli", "aug august", "sep sept september", "oct october okt oktober", "nov november"),
    "dec december dez dezember",
)
_MONTHS = {name: k for k, names in enumerate(_NAMES, 1) for name in names.split()}
_ORDERS = (
    *("dd.mm.yyyy", "dd.mm.yy", "yyyy.mm.dd", "mm/dd/yyyy", "dd/mm/yyyy", "mm/dd/yy", "dd/mm/yy", "yyyy/mm/dd"),
    *("dd-mm-yyyy", "mm-dd-yyyy", "dd-mm-yy", "dd-mmm-yyyy", "dd-mmm-yy", "dd mmm yyyy", "mmm dd yyyy", "dd.mmm.yyyy"),
)


def is_date(unit: str) -> bool:
    """Return whether the unit of a column states dates or times of a clock.

    These are ``iso8601``, an order such as ``dd.mm.yyyy`` or ``dd-mmm-yyyy`` (month with its name), ``hh:mm:ss``, and
    the numbers of `COUNTED`.
    """
    match = _PATTERN.fullmatch(unit.lower())
    ordered = match is not None and {_PARTS[match[k]] for k in (1, 3, 4)} == {0, 1, 2}
    return unit in (TIMESTAMP, ELAPSED) or unit in COUNTED or ordered


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


def instant(value: float, unit: str) -> datetime | None:
    """Return the date of a number that is plausible as one; None for other numbers.

    Days from 2000 to 2100 are those of a spreadsheet; seconds to nanoseconds of these years are since 1970.
    """
    day = 86400.0
    scale = {"d": day, "day": day, "days": day, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}.get(unit)
    if scale is None or not np.isfinite(value):
        return None
    kind = EXCEL if scale == day else UNIX
    origin, _ = COUNTED[kind]
    low, high = (datetime(year, 1, 1, tzinfo=origin.tzinfo) - origin for year in (2000, 2100))
    if not low.total_seconds() <= value * scale < high.total_seconds():
        return None
    return origin + timedelta(seconds=round(value * scale, 3 if kind == EXCEL else 6))


def fitting(texts: Sequence[str]) -> list[str]:
    """Return the units of dates and times with which every text of a sample can be read, the most usual first.

    More than one order of day and month is left where the texts do not show it, as in 03/04/2026; dates with points
    are those of countries that write the day first.
    """
    if not texts:
        return []
    found = []
    for unit in (TIMESTAMP, ELAPSED, *_ORDERS):
        clock = Clock(unit, repeats=True)
        try:
            for text in texts:
                clock.seconds(text)
        except ValueError:
            continue
        found.append(unit)
    return [unit for unit in found if "mmm" in unit] or found


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
    _days: int = field(default=0, repr=False)
    _elapsed_last: float = field(default=0.0, repr=False)

    def seconds(self, text: str) -> float:
        """Return the seconds since the first date; ValueError states what was expected."""
        if self.unit == ELAPSED:
            return self._elapsed(text)
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

    def many(self, texts: Sequence[str]) -> Array | None:
        """Return the seconds of many dates since the first one at once, (n,); None where they need `seconds`.

        That is the case with empty or wrong texts, of different lengths, with names of months or offsets, and in a zone
        whose offset changes between the dates.
        """
        if len(texts) < _MANY or self.unit == ELAPSED:
            return None
        stamps = _fixed(texts, "yyyy-mm-dd" if self.unit == TIMESTAMP else self.unit.lower())
        if stamps is None:
            return None
        first, last = self._parsed(texts[0]), self._parsed(texts[-1])
        if first.tzinfo is None and self.zone is not None:
            low, high = (each.astype("datetime64[us]").astype(datetime) for each in (stamps.min(), stamps.max()))
            between = [low + k * (high - low) / 64 for k in range(65)]
            offsets = {each.replace(tzinfo=self.zone, fold=fold).utcoffset() for each in between for fold in (0, 1)}
            if len(offsets) > 1 or high - low > timedelta(days=4 * 365):  # steps of less than a month
                return None
            first, last = first.replace(tzinfo=self.zone), last.replace(tzinfo=self.zone)
        self.start, self._last, self._last_text = first, last, texts[-1]
        return np.asarray((stamps - stamps[0]) / np.timedelta64(1, "s"), dtype=float)

    def _elapsed(self, text: str) -> float:
        match = _ELAPSED.fullmatch(text)
        if match is None or int(match[2]) > 59 or int(match[3]) > 59:
            raise ValueError(f"expected {self._example()}; found '{text}'")
        value = int(match[1] or 0) * 3600 + int(match[2]) * 60 + int(match[3]) + float(f"0.{match[4] or 0}")
        if value < self._elapsed_last - 43200:  # a time of day after midnight
            self._days += 1
        self._elapsed_last = value
        return value + 86400.0 * self._days

    def _parsed(self, text: str) -> datetime:
        expected = f"expected {self._example()}; found '{text}'"
        if self.unit == TIMESTAMP:
            try:
                return datetime.fromisoformat(text)
            except ValueError as error:
                raise ValueError(expected) from error
        first, sign, second, third = _PATTERN.fullmatch(self.unit.lower()).groups()  # type: ignore[union-attr]
        date = re.escape(sign).join(_DIGITS[part] for part in (first, second, third))
        match = re.fullmatch(date + _TIME, text) if len(text) < 100 else None
        if match is None:
            raise ValueError(expected)
        numbers = {}
        for k, part in enumerate((first, second, third), 1):
            number = int(match[k]) if match[k].isdigit() else _MONTHS.get(match[k].rstrip(".").lower())
            if number is None:
                raise ValueError(expected)
            numbers[_PARTS[part]] = number
        year = numbers[0] + (2000 if "yyyy" not in (first, second, third) else 0)
        hour, minute, second_ = (int(match[k] or 0) for k in (4, 5, 6))
        if match[8]:
            if not 1 <= hour <= 12:
                raise ValueError(expected)
            hour = hour % 12 + (12 if match[8] in "Pp" else 0)
        midnight = hour == 24 and minute == second_ == 0  # the end of a day
        try:
            whole = datetime(year, numbers[1], numbers[2], 0 if midnight else hour, minute, second_)
        except ValueError as error:
            raise ValueError(expected) from error
        return whole + timedelta(days=midnight, microseconds=int(f"{match[7] or 0:0<6}"[:6]))

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
        if self.unit == ELAPSED:
            return "a time such as 00:05:09.5"
        codes = {"dd": "%d", "mm": "%m", "mmm": "%b", "yyyy": "%Y", "yy": "%y"}
        pattern = re.sub("dd|mmm|mm|yyyy|yy", lambda match: codes[match[0]], self.unit.lower())
        return f"a date and time such as {_EXAMPLE.strftime(f'{pattern} %H:%M:%S')}"


def _fixed(texts: Sequence[str], unit: str) -> NDArray[np.datetime64] | None:
    """Return dates with times of day whose digits all have the same places, (n,); None for others.

    ``unit`` is an order with four digits of the year; the time of day is hh:mm:ss, with up to nine decimals.
    """
    match = re.fullmatch(
        rf"[0-9{re.escape('./-')}]{{10}}[T _-][0-9]{{2}}:[0-9]{{2}}:[0-9]{{2}}(?:[.,:][0-9]{{1,9}})?", texts[0]
    )
    if match is None or "yyyy" not in unit or "mmm" in unit:
        return None
    length = len(texts[0])
    joined = "".join(texts)
    if set(map(len, texts)) != {length} or not joined.isascii():
        return None
    signs = np.frombuffer(joined.encode("ascii"), dtype=np.uint8).reshape(len(texts), length)
    template = signs[0]
    for k in range(length):
        column = signs[:, k]
        if 48 <= template[k] <= 57:
            if column.min() < 48 or column.max() > 57:
                return None
        elif (column != template[k]).any():
            return None

    def number(begin: int, count: int) -> NDArray[np.int64]:
        found = np.zeros(len(signs), dtype=np.int64)
        for k in range(begin, begin + count):
            found = 10 * found + (signs[:, k] - 48)
        return found

    year, month, day = (number(unit.index(part), len(part)) for part in ("yyyy", "mm", "dd"))
    hour, minute, second = number(11, 2), number(14, 2), number(17, 2)
    if (month < 1).any() or (month > 12).any() or (hour > 23).any() or (minute > 59).any() or (second > 59).any():
        return None
    months = (year - 1970).astype("datetime64[Y]").astype("datetime64[M]") + (month - 1)
    days = months.astype("datetime64[D]") + (day - 1)
    if (days.astype("datetime64[M]") != months).any() or (day < 1).any():
        return None
    decimals = length - 20
    parts = number(20, decimals) * 10 ** (9 - decimals) if decimals > 0 else 0
    clock = ((hour * 60 + minute) * 60 + second) * 10**9 + parts
    stamps: NDArray[np.datetime64] = days.astype("datetime64[ns]") + np.asarray(clock).astype("timedelta64[ns]")
    return stamps


def _difference(later: datetime, earlier: datetime) -> float:
    """Return the seconds between two dates; within one zone, where Python neglects daylight saving, as well."""
    if later.tzinfo is not None and earlier.tzinfo is not None:
        later, earlier = later.astimezone(UTC), earlier.astimezone(UTC)
    return (later - earlier).total_seconds()
