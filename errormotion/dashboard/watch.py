"""The instruments of a bench, read by a monitor in a thread: what they say now, and the last hours in memory."""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.campaign.files import BenchPlan
from errormotion.campaign.monitor.sources import Source
from errormotion.campaign.monitor.watch import Monitor, Snapshot
from errormotion.campaign.storage.journal import cause_of
from errormotion.dashboard.course import thin

SPAN = 8 * 3600.0
"""Time that is kept in memory, s; the log of the monitor holds everything."""
MOST_ROWS = 100_000
"""Rows that are kept, whatever the interval."""
PARAMETERS = (
    ("X", "mm", 1e3),
    ("Y", "mm", 1e3),
    ("Z", "mm", 1e3),
    ("spindle speed", "1/min", 1.0),
    ("spindle load", "%", 100.0),
    ("feed", "mm/min", 60e3),
)
"""Working parameters: name, unit on the page, and number of these in one SI unit."""
_STATES = ("spindle_speed", "spindle_load", "feed")
LONGEST_TEXT = 200
"""Characters of a text from a device."""
RATE_SPAN = 10.0
"""Time over which the rate of readings is counted, s."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Instrument:
    """One instrument: ``state`` is ``answers``, ``waiting`` or ``silent``; since when, and why.

    ``rate`` is the number of readings per second lately, ``missed`` that of rows of the log without a reading.
    """

    name: str
    kind: str
    model: str
    state: str
    since: datetime
    why: str = ""
    missed: int = 0
    rate: float = math.nan


@dataclass(frozen=True)
class Quantity:
    """One value now, NaN if unknown, with its extremes and its change since the monitor started.

    ``place`` is the position of a sensor on the machine, m; None if unknown.
    """

    name: str
    value: float
    unit: str
    flag: str = ""
    low: float = math.nan
    high: float = math.nan
    change: float = math.nan
    place: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class Present:
    """Everything that a bench says now; the same object until something has changed.

    ``running`` is False once the monitor has stopped, for the reason ``error``; ``rows`` counts those of its log.
    """

    time: datetime
    running: bool
    error: str
    rows: int
    run: str
    instruments: tuple[Instrument, ...] = ()
    temperatures: tuple[Quantity, ...] = ()
    parameters: tuple[Quantity, ...] = ()
    mode: str = ""
    program: str = ""
    alarms: tuple[str, ...] = ()


@dataclass
class _History:
    """Rows of the last hours, in a ring of fixed size."""

    names: tuple[str, ...]
    size: int
    count: int = 0
    times: Array = field(init=False)
    rows: Array = field(init=False)

    def __post_init__(self) -> None:
        self.times = np.full(self.size, np.nan)
        self.rows = np.full((self.size, len(self.names)), np.nan)

    def put(self, time: float, row: ArrayLike) -> None:
        at = self.count % self.size
        self.times[at], self.rows[at] = time, row
        self.count += 1

    def last(self, column: int, seconds: float) -> tuple[Array, Array]:
        """Return times and values of a column over the last seconds, in order."""
        n = min(self.count, self.size)
        order = (np.arange(self.count - n, self.count)) % self.size
        begin = int(np.searchsorted(self.times[order], self.times[order[-1]] - seconds)) if n else 0
        return self.times[order[begin:]], self.rows[order[begin:], column]


class Watch:
    """Reads a bench from `start` to `stop`.

    Parameters
    ----------
    plan : BenchPlan
    runs : Path
        Folder of the monitor's run folder.
    interval : float
        Of the rows, s.

    Raises
    ------
    BenchError
        The bench has neither a thermometer nor a controller, or several controllers.
    """

    def __init__(self, plan: BenchPlan, runs: Path, interval: float = 1.0) -> None:
        self.plan, self.interval = plan, interval
        self._monitor = Monitor(plan, runs, interval)
        sensors = self._monitor.sensors
        parameters = PARAMETERS if self._monitor.controller is not None else ()
        self.units = {**dict.fromkeys(sensors, "°C"), **{name: unit for name, unit, _ in parameters}}
        self._places = dict(zip(sensors, self._monitor.places, strict=True))
        self._history = _History(tuple(self.units), min(MOST_ROWS, max(2, math.ceil(SPAN / interval))))
        self._extremes = np.full((3, len(self.units)), np.nan)  # first, lowest, highest
        self._lock, self._end = threading.Lock(), threading.Event()
        self._last: Snapshot | None = None
        self._known: tuple[tuple[Any, ...], Present] | None = None
        self._since: dict[str, tuple[str, datetime]] = {}
        most = 1 + max(2, math.ceil(RATE_SPAN / interval))
        self._counts = {each.name: deque[tuple[float, int]](maxlen=most) for each in self._monitor.sources}
        self._began, self._error, self._running = _now(), "", False
        self._thread = threading.Thread(target=self._work, name="errormotion-watch", daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._running = True
        self._thread.start()

    def stop(self) -> None:
        """Stop reading and finish the log."""
        self._end.set()
        self._thread.join()

    def present(self) -> Present:
        """Return what the bench says now."""
        errors = tuple(source.error for source in self._monitor.sources)
        with self._lock:
            revision = (self._running, self._error, self._last.logged if self._last else 0, *errors)
            if self._known is None or self._known[0] != revision:
                self._known = (revision, self._present())
            return self._known[1]

    def _present(self) -> Present:
        last, running, error, run = self._last, self._running, self._error, self._run_name()
        instruments = tuple(self._instrument(source) for source in self._monitor.sources)
        if last is None:
            return Present(_now(), running, error, 0, run, instruments)
        values = dict(zip(self.units, _row(last, self.units), strict=True))
        quantities = {
            name: Quantity(
                name, value, self.units[name], last.flags.get(name, ""), low, high, value - first, self._place(name)
            )
            for (name, value), first, low, high in zip(values.items(), *self._extremes, strict=True)
        }
        alarms = last.state.get("alarms") or ()
        alarms = alarms if isinstance(alarms, list | tuple) else (alarms,)
        if last.state.get("estop") is True:
            alarms = ("emergency stop", *alarms)
        return Present(
            self._began + timedelta(seconds=last.time),
            running,
            error,
            last.logged,
            run,
            instruments,
            tuple(each for each in quantities.values() if each.name in last.temperatures),
            tuple(each for each in quantities.values() if each.name not in last.temperatures),
            _text(last.state.get("mode")),
            _text(last.state.get("program")),
            tuple(_text(each) for each in alarms[:50]),
        )

    def history(self, names: Sequence[str], seconds: float) -> Mapping[str, tuple[Array, Array]]:
        """Return times (s since 1970, UTC) and values of the last seconds, reduced; unknown values are NaN.

        Names that are not known are left out.
        """
        found = {}
        began, columns = self._began.timestamp(), {name: k for k, name in enumerate(self.units)}
        for name in names:
            if name in columns:
                with self._lock:
                    times, values = self._history.last(columns[name], seconds)
                kept = thin(values)
                found[name] = (began + times[kept], values[kept])
        return found

    def _work(self) -> None:
        try:
            with self._monitor as monitor:
                self._began = _now()
                for snapshot in monitor.watch():
                    self._take(snapshot)
                    if self._end.is_set():
                        break
        except Exception as error:
            log.error("the monitor of the dashboard has stopped", exc_info=error)
            self._error = cause_of(error)
        finally:
            self._running = False

    def _take(self, snapshot: Snapshot) -> None:
        row = np.array(_row(snapshot, self.units))
        with self._lock:
            if self._last is None:
                self._began = _now() - timedelta(seconds=snapshot.time)
            self._last = snapshot
            for source in self._monitor.sources:
                self._counts[source.name].append((snapshot.time, source.readings))
                self._instrument(source)
            self._history.put(snapshot.time, row)
            first, low, high = self._extremes
            self._extremes = np.stack([np.where(np.isnan(first), row, first), np.fmin(low, row), np.fmax(high, row)])

    def _instrument(self, source: Source) -> Instrument:
        """Return the state of a source, and note a change; a failed reading counts before the last one is too old."""
        silent = self._last.silent.get(source.name, "") if self._last is not None else ""
        why = source.error or silent
        state = "answers" if not why else "silent" if source.answer or self._last is not None else "waiting"
        before, since = self._since.get(source.name, ("", _now()))
        if before != state:
            since = _now()
            self._since[source.name] = (state, since)
        identity = source.answer.identity if source.answer is not None else None
        model = f"{identity.manufacturer} {identity.model}" if identity is not None else ""
        missed = self._last.gaps.get(source.name, 0) if self._last is not None else 0
        kind = str(source.instrument.driver.info.kind)
        rate = _rate(self._counts[source.name])
        return Instrument(source.name, kind, _text(model), state, since, _text(why), missed, rate)

    def _place(self, name: str) -> tuple[float, ...] | None:
        place = self._places.get(name)
        return tuple(map(float, place)) if place is not None and np.isfinite(place).all() else None

    def _run_name(self) -> str:
        folder = getattr(self._monitor, "folder", None)
        return folder.path.name if folder is not None else ""


def _rate(counts: Sequence[tuple[float, int]]) -> float:
    """Return the readings per second between the first and the last of (time, number); NaN if unknown."""
    if len(counts) < 2 or not counts[-1][0] > counts[0][0]:
        return math.nan
    return (counts[-1][1] - counts[0][1]) / (counts[-1][0] - counts[0][0])


def _row(snapshot: Snapshot, names: Mapping[str, str]) -> list[float]:
    """Return the values of a snapshot in the units of the page; NaN if unknown."""
    place = list(snapshot.state.get("position") or [])[:3]
    state = [*place, *[math.nan] * (3 - len(place)), *(snapshot.state.get(name) for name in _STATES)]
    parameters = {
        name: math.nan if value is None else factor * float(value)
        for (name, _, factor), value in zip(PARAMETERS, state, strict=True)
    }
    return [float(snapshot.temperatures.get(name, parameters.get(name, math.nan))) for name in names]


def _text(value: Any) -> str:
    """Return a printable text of a device, bounded."""
    text = "" if value is None else str(value)[:LONGEST_TEXT]
    return "".join(each if each.isprintable() else "?" for each in text)


def _now() -> datetime:
    return datetime.now(UTC)
