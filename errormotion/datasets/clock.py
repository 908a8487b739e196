"""Duration of records across interruptions, from monotonic clocks.

The wall clock of a computer may be set, by a person or by a time server, while a record runs and while it is
interrupted. The time since the start of the computer (including suspension) cannot be set, but ends with a restart.
Every commit of a raw store stores both, with the identity of the start of the computer (attribute ``clock``). A
continuation compares them: the duration of the interruption is known if they agree or if the computer was not
restarted, and unknown if they contradict each other. Every interruption is an entry of the attribute ``joins``.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import xarray as xr

from errormotion.datasets.plausibility import of_raw, with_doubts
from errormotion.datasets.raw import variant_of

CLOCK, JOINS = "clock", "joins"
"""Attributes of raw data (JSON): the clocks at the last commit, and the interruptions of the record."""

ORIGIN = "clock_origin"
"""Attribute of raw data of a virtual machine: its clock at the start of the record, s."""

START = "clock_start"
"""Attribute of raw data of a virtual machine (JSON): its clock and the state of its axes at the start of the record."""

TOLERANCE = 2.0
"""Largest accepted difference of two clocks, s."""
DRIFT = 1e-3
"""The same in addition for each second between two readings, s/s."""
LONGEST = 30 * 86400.0
"""Longest interruption that is accepted from the wall clock alone, s."""


def steady() -> float:
    """Return a time that cannot be set, s; it includes suspensions of the computer, and is never negative."""
    if hasattr(time, "CLOCK_BOOTTIME"):  # Linux
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


@cache
def _boot() -> str:
    """Return the identity of the start of the computer; empty if the system does not state it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""


@dataclass(frozen=True)
class Reading:
    """Clocks at one instant of a record.

    Attributes
    ----------
    wall : float
        Wall clock, s since 1970-01-01 UTC.
    steady : float
        Time since the start of the computer, s.
    boot : str
        Identity of that start; empty if unknown.
    began : float
        Wall clock at the start of the record, s.
    elapsed : float
        Duration of the record, including interruptions of known duration, s.
    """

    wall: float
    steady: float
    boot: str
    began: float
    elapsed: float


def read(began: float = math.nan, elapsed: float = 0.0) -> Reading:
    """Return the present reading; by default that of a record that starts now."""
    wall = time.time()
    return Reading(wall, steady(), _boot(), wall if math.isnan(began) else began, elapsed)


def interval(first: Reading, last: Reading) -> tuple[float, str]:
    """Return the time between two readings, s, and a contradiction of the clocks, empty if there is none.

    NaN if the clocks contradict each other and the computer was restarted between the readings.
    """
    wall, run = last.wall - first.wall, last.steady - first.steady
    if first.boot and first.boot == last.boot and run >= 0:
        if abs(wall - run) <= TOLERANCE + DRIFT * run:
            return run, ""
        return (
            run,
            f"the wall clock was changed by {wall - run:+.3g} s; the duration is that of the computer's own clock",
        )
    since_start = last.steady if last.boot and first.boot else 0.0
    if wall < since_start - TOLERANCE:
        return math.nan, (
            f"the wall clock states {wall:.3g} s since the last data, and the computer has run for {since_start:.3g} s "
            "since then: it was set back, and the duration is unknown"
        )
    if wall > LONGEST:
        return math.nan, (
            f"the wall clock states {wall / 86400:.3g} days since the last data; beyond {LONGEST / 86400:.0f} days it "
            "is assumed to be wrong, and the duration is unknown"
        )
    return max(wall, 0.0), ""


@dataclass(frozen=True)
class Join:
    """An interruption of a record.

    Attributes
    ----------
    index : int
        Number of the first sample after it.
    seconds : float or None
        Duration; None if unknown.
    reason : str
        The contradiction of the clocks; empty if there is none.
    time : float or None
        Time of the last sample before it on the time axis of the record, s, if it has one.
    """

    index: int
    seconds: float | None
    reason: str
    time: float | None = None


class RecordClock:
    """The clock of a record that is being written.

    Parameters
    ----------
    attrs : mapping
        Attributes of the store so far; empty for a new record.
    index : int
        Number of the next sample.
    at : float, optional
        Time of the last sample on the time axis of the record, s.
    """

    def __init__(self, attrs: Mapping[Any, Any], index: int = 0, at: float | None = None) -> None:
        self._joins = joins(attrs)
        self._first, before = read(), _stored(attrs)
        if before is not None:
            seconds, reason = interval(before, self._first)
            known = None if math.isnan(seconds) else round(seconds, 3)
            self._first = read(before.began, before.elapsed + (known or 0.0))
            self._joins.append(Join(index, known, reason, at))

    def attributes(self) -> dict[str, str]:
        """Return the attributes of the store at this instant."""
        now, first = steady(), self._first
        state = asdict(read(first.began, first.elapsed + max(now - first.steady, 0.0)))
        attributes = {CLOCK: json.dumps(state)}
        return attributes | ({JOINS: json.dumps([asdict(join) for join in self._joins])} if self._joins else {})


def age(done: xr.Dataset) -> float:
    """Return the time since the attribute ``start`` of an interrupted record, s; NaN if that is unknown.

    Raises
    ------
    ValueError
        The record does not state its start.
    """
    try:
        start = datetime.fromisoformat(str(done.attrs.get("start", ""))).astimezone(UTC).timestamp()
    except (ValueError, OverflowError):
        raise ValueError(f"attribute start = '{done.attrs.get('start', '')}'") from None
    before, now = _stored(done.attrs), read()
    if before is None:  # written by a version that did not store its clocks
        seconds = now.wall - start
        return seconds if 0 <= seconds <= LONGEST else math.nan
    return before.began + before.elapsed - start + interval(before, now)[0]


def restarted(done: xr.Dataset, now: float) -> bool:
    """Return whether a virtual machine was restarted since the start of a record, from its present clock, s.

    True for a record that does not state its attribute ``clock_origin``.
    """
    return not now > float(done.attrs.get(ORIGIN, math.inf))


def _stored(attrs: Mapping[Any, Any]) -> Reading | None:
    """Return the reading at the last commit; None if it is missing or damaged."""
    try:
        state = json.loads(attrs[CLOCK])
        wall, since, began, elapsed = (float(state[name]) for name in ("wall", "steady", "began", "elapsed"))
        boot = str(state["boot"])
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        return None
    if not all(map(math.isfinite, (wall, since, began, elapsed))):
        return None
    return Reading(wall, since, boot, began, elapsed)


def joins(attrs: Mapping[Any, Any]) -> list[Join]:
    """Return the interruptions that raw data state; none if the attribute is damaged."""
    try:
        return [Join(**each) for each in json.loads(attrs.get(JOINS, "[]"))]
    except (TypeError, ValueError, RecursionError):
        return []


def notes(attrs: Mapping[Any, Any]) -> list[str]:
    """Return a sentence for each interruption of unknown duration."""
    return [
        f"The record was interrupted{f' at {join.time:.6g} s' if join.time is not None else ''}, before sample "
        f"{join.index}, for an unknown time: {join.reason}. Times after it do not count from the start of the record."
        for join in joins(attrs)
        if join.seconds is None
    ]


def noted(errors: xr.Dataset, raw: xr.Dataset) -> xr.Dataset:
    """Return errors whose notes state what their raw data show: interruptions of unknown duration, frozen readings."""
    stated = errors.attrs.get("notes", [])
    before = [note for note in ([stated] if isinstance(stated, str) else stated) if note]
    missing = [note for note in notes(raw.attrs) if note not in before]
    table = variant_of(raw)
    errors = errors.assign_attrs(notes=[*before, *missing]) if missing else errors
    return errors if table is None else with_doubts(errors, of_raw(raw, table))
