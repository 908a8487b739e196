"""The instruments of a bench, read by a monitor in a thread: present readings, and those of the last hours.

While another program has claimed the instruments, they are closed, and the record of that program is shown.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.campaign.background.recorded import Recorded, Value, recorded
from errormotion.campaign.claims import Claim, holder, uses, watching
from errormotion.campaign.files import BenchPlan
from errormotion.campaign.monitor.clock import Clock
from errormotion.campaign.monitor.sources import Source
from errormotion.campaign.monitor.watch import Monitor, Snapshot
from errormotion.campaign.storage.journal import cause_of
from errormotion.dashboard.curves import thin
from errormotion.errors import ErrormotionError

SPAN = 8 * 3600.0
"""Time span in memory, s; the log of the monitor is complete."""
MAX_ROWS = 100_000
"""Largest number of rows in memory."""
PARAMETERS = (
    ("X", "mm", 1e3),
    ("Y", "mm", 1e3),
    ("Z", "mm", 1e3),
    ("spindle speed", "1/min", 1.0),
    ("spindle load", "%", 100.0),
    ("feed", "mm/min", 60e3),
)
"""Working parameters: name, unit on the page, and factor from the SI unit to it."""
_STATES = ("spindle_speed", "spindle_load", "feed")
_OF_A_LOG = ("gap", "temperature_flag")
"""Variables of the log of a monitor that are not readings."""
MAX_TEXT = 200
"""Longest text from a device, characters."""
RATE_SPAN = 10.0
"""Period over which the rate of readings is determined, s."""
CLAIM_INTERVAL = 0.2
"""Interval between checks for claims of other programs, s."""
RECORD_INTERVAL = 1.0
"""Shortest interval between readings of the record of another program, s."""
EMERGENCY_STOP = "emergency stop"
"""Text of the alarm; a controller may also report it among its alarms."""
OLDEST_SAMPLE = 5.0
"""Age from which the last sample of a record is outdated, s."""
_FIELD = {"m": ("mm", 1e3), "rad": ("arcsec", 3600 * 180 / math.pi), "degC": ("°C", 1.0), "1": ("", 1.0)}
"""Unit on the page, and factor from the unit of a record to it."""

log = logging.getLogger(__name__)


InstrumentState = Literal["answers", "silent", "waiting", "lent"]
"""State of an instrument; ``lent`` is in use by another program."""


@dataclass(frozen=True)
class Instrument:
    """One instrument: ``state`` with its start ``since`` and its cause ``why``.

    ``rate`` is the present number of readings per second, ``missed`` the number of rows of the log without a reading.
    """

    name: str
    kind: str
    model: str
    state: InstrumentState
    since: datetime
    why: str = ""
    missed: int = 0
    rate: float = math.nan


@dataclass(frozen=True)
class Quantity:
    """One present value, NaN if unknown, with its extremes and its change since the start of the monitor.

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
    """Present readings of a bench; the same object until a change.

    ``running`` is False after the monitor has stopped, with the cause ``error``; ``rows`` is the length of its log.
    ``lent`` states the other program that uses the instruments, if any: the values are then those of its record in
    ``run``, with ``rows`` samples, and ``recorded`` contains those that are no temperature or parameter of this bench.
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
    lent: str = ""
    recorded: tuple[Quantity, ...] = ()


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
        start = int(np.searchsorted(self.times[order], self.times[order[-1]] - seconds)) if n else 0
        return self.times[order[start:]], self.rows[order[start:], column]


class Watch:
    """Reader of a bench, from `start` to `stop`.

    Parameters
    ----------
    plan : BenchPlan
    runs : Path
        Folder for the run folder of the monitor.
    interval : float
        Interval of the rows, s.

    Raises
    ------
    BenchError
        The bench has neither a thermometer nor a controller, or several controllers.
    """

    def __init__(self, plan: BenchPlan, runs: Path, interval: float = 1.0) -> None:
        self.plan, self.runs, self.interval = plan, runs, interval
        self._uses = uses(plan)
        self._lock, self._end = threading.Lock(), threading.Event()
        self._clock = _InterruptibleClock(self._must_release)
        self._monitor = Monitor(plan, runs, interval, self._clock)
        sensors = self._monitor.sensors
        parameters = PARAMETERS if self._monitor.controller is not None else ()
        self.units = {**dict.fromkeys(sensors, "°C"), **{name: unit for name, unit, _ in parameters}}
        self._places = dict(zip(sensors, self._monitor.places, strict=True))
        self._history = _History(tuple(self.units), min(MAX_ROWS, max(2, math.ceil(SPAN / interval))))
        self._extremes = np.full((3, len(self.units)), np.nan)  # first, lowest, highest
        self._last: Snapshot | None = None
        self._shift = 0.0  # time of the history minus time of the present monitor, s
        self._used = False
        self._lent: Claim | None = None
        self._record: Recorded | None = None
        self._record_time = (
            self._looked
        ) = -math.inf  # times of the history: of the last sample, and of its last reading
        self._known: tuple[tuple[Any, ...], Present] | None = None
        self._since: dict[str, tuple[str, datetime]] = {}
        most = 1 + max(2, math.ceil(RATE_SPAN / interval))
        self._counts = {each.name: deque[tuple[float, int]](maxlen=most) for each in self._monitor.sources}
        self._began: datetime | None = None
        self._error, self._running, self._revision = "", False, 0
        self._thread = threading.Thread(target=self._work, name="errormotion-watch", daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._running = True
        self._clock.owner = self._thread
        self._thread.start()

    def stop(self) -> None:
        """Stop reading and finish the log."""
        self._end.set()
        self._thread.join()

    def present(self) -> Present:
        """Return the present readings of the bench."""
        errors = tuple(source.error for source in self._monitor.sources)
        with self._lock:
            revision = (self._running, self._error, self._revision, *errors)
            if self._known is None or self._known[0] != revision:
                self._known = (revision, self._present())
            return self._known[1]

    def _present(self) -> Present:
        instruments = tuple(self._instrument(source) for source in self._monitor.sources)
        if self._lent is not None:
            return self._of_record(self._lent, instruments)
        last, running, error, run = self._last, self._running, self._error, self._run_name()
        if last is None:
            return Present(_now(), running, error, 0, run, instruments)
        temperatures, parameters = self._quantities(_row(last, self.units), last.flags)
        alarms = last.state.get("alarms") or ()
        alarms = alarms if isinstance(alarms, list | tuple) else (alarms,)
        if last.state.get("estop") is True and EMERGENCY_STOP not in alarms:
            alarms = (EMERGENCY_STOP, *alarms)
        alarms = (*alarms, *(f"{name} {why}" for name, why in last.doubtful.items()))
        return Present(
            self._start_time() + timedelta(seconds=self._shift + last.time),
            running,
            error,
            last.logged,
            run,
            instruments,
            temperatures,
            parameters,
            _text(last.state.get("mode")),
            _text(last.state.get("program")),
            tuple(_text(each) for each in alarms[:50]),
        )

    def _of_record(self, claim: Claim, instruments: tuple[Instrument, ...]) -> Present:
        found = self._record or Recorded("", 0)
        age = self._elapsed() - self._record_time
        row, others = self._split(found.values if age <= OLDEST_SAMPLE else ())
        temperatures, parameters = self._quantities(row, {})
        title = f" ({_text(found.title)})" if found.title else ""
        words = f"{_text(claim.what)}{title} uses the instruments. "
        if not found.samples:
            words += "It has recorded no samples yet."
        elif age > OLDEST_SAMPLE:
            words += f"Its last sample is {age:.0f} s old."
        else:
            words += "The values are taken from its record."
        return Present(
            _now(),
            self._running,
            self._error,
            found.samples,
            claim.run.name if claim.run is not None else "",
            instruments,
            temperatures,
            parameters,
            program=_text(found.program),
            alarms=(EMERGENCY_STOP,) if found.estop else (),
            lent=words[:1].upper() + words[1:],
            recorded=others,
        )

    def _quantities(
        self, row: Sequence[float], flags: Mapping[str, str]
    ) -> tuple[tuple[Quantity, ...], tuple[Quantity, ...]]:
        """Return temperatures and parameters with their extremes."""
        found = [
            Quantity(name, value, self.units[name], flags.get(name, ""), low, high, value - first, self._place(name))
            for name, value, first, low, high in zip(self.units, row, *self._extremes, strict=True)
        ]
        return tuple(e for e in found if e.name in self._places), tuple(e for e in found if e.name not in self._places)

    def _split(self, values: Sequence[Value]) -> tuple[list[float], tuple[Quantity, ...]]:
        """Return a row of the history from a record, and the values without a column in the history."""
        row, others = dict.fromkeys(self.units, math.nan), []
        factors = {name: factor for name, _, factor in PARAMETERS}
        for each in values:
            if each.unit == "degC":
                name = each.label if each.label in self._places else ""
            elif each.variable in _STATES:
                name = each.variable.replace("_", " ")
            else:
                name = each.label.upper() if each.variable == "position" else ""
            if name in row:
                row[name] = factors.get(name, 1.0) * each.value
            elif each.variable not in _OF_A_LOG:
                unit, factor = _FIELD.get(each.unit, (each.unit, 1.0))
                label = _text(f"{each.variable.replace('_', ' ')} {each.label}".strip())
                others.append(Quantity(label, factor * each.value, _text(unit)))
        return list(row.values()), tuple(others)

    def history(self, names: Sequence[str], seconds: float) -> Mapping[str, tuple[Array, Array]]:
        """Return times (s since 1970, UTC) and values of the last seconds, reduced; unknown values are NaN.

        Unknown names are left out.
        """
        found = {}
        began, columns = self._start_time().timestamp(), {name: k for k, name in enumerate(self.units)}
        for name in names:
            if name in columns:
                with self._lock:
                    times, values = self._history.last(columns[name], seconds)
                kept = thin(values)
                found[name] = (began + times[kept], values[kept])
        return found

    def _work(self) -> None:
        try:
            while not self._end.is_set():
                with watching(self._uses) as free:
                    if free:
                        self._read()
                while not self._end.is_set() and (claim := holder(self._uses)) is not None:
                    self._look(claim)
                    self._end.wait(CLAIM_INTERVAL)
                with self._lock:
                    self._lent, self._record = None, None
                    self._revision += 1
        except Exception as error:
            log.error("the monitor of the dashboard has stopped", exc_info=error)
            self._error = cause_of(error)
        finally:
            self._running = False

    def _read(self) -> None:
        """Read the instruments until the end, or until another program claims them."""
        if self._used:  # a monitor can be used once only
            self._monitor = Monitor(self.plan, self.runs, self.interval, self._clock)
        self._used = True
        with self._lock:
            self._last = None
            for counts in self._counts.values():
                counts.clear()
        with self._monitor as monitor:
            for snapshot in monitor.watch():
                self._take(snapshot)
                if self._must_release():
                    break

    def _must_release(self) -> bool:
        return self._end.is_set() or holder(self._uses) is not None

    def _start_time(self) -> datetime:
        """Return time 0 of the history."""
        if self._began is None:
            self._began = _now()
        return self._began

    def _elapsed(self) -> float:
        return (_now() - self._start_time()).total_seconds()

    def _take(self, snapshot: Snapshot) -> None:
        row = np.array(_row(snapshot, self.units))
        with self._lock:
            if self._last is None:
                self._shift = 0.0 if self._began is None else self._elapsed() - snapshot.time
                self._began = self._began or _now() - timedelta(seconds=snapshot.time)
            self._last = snapshot
            for source in self._monitor.sources:
                self._counts[source.name].append((snapshot.time, source.readings))
                self._instrument(source)
            self._put(self._shift + snapshot.time, row)

    def _look(self, claim: Claim) -> None:
        """Take the last sample of the record of another program."""
        now = self._elapsed()
        if self._lent == claim and now < self._looked + RECORD_INTERVAL:
            return
        self._looked, found = now, None
        if claim.run is not None:
            try:
                found = recorded(claim.run)
            except ErrormotionError as error:  # not written yet, or gone
                log.debug("%s: %s", claim.run, error)
        with self._lock:
            before = self._record if self._lent == claim else None
            new = found is not None and found.samples > 0 and (before is None or found.samples != before.samples)
            if new:
                self._record_time = now
            self._lent, self._record = claim, found
            self._revision += 1
            if new or now - self._record_time > OLDEST_SAMPLE:  # the time between two samples is no gap
                row, _ = self._split(found.values if found is not None and new else ())
                self._put(now, np.array(row))

    def _put(self, time: float, row: Array) -> None:
        """Add a row to the history."""
        self._revision += 1
        self._history.put(time, row)
        first, low, high = self._extremes
        self._extremes = np.stack([np.where(np.isnan(first), row, first), np.fmin(low, row), np.fmax(high, row)])

    def _instrument(self, source: Source) -> Instrument:
        """Return the state of a source, and store a change; a failed reading counts at once."""
        silent = self._last.silent.get(source.name, "") if self._last is not None else ""
        why = source.error or silent
        heard = source.answer or self._last is not None
        state: InstrumentState = "answers" if not why else "silent" if heard else "waiting"
        if self._lent is not None:
            state, why = "lent", ""
        before, since = self._since.get(source.name, ("", _now()))
        if before != state:
            since = _now()
            self._since[source.name] = (state, since)
        identity = source.answer.identity if source.answer is not None else None
        model = f"{identity.manufacturer} {identity.model}" if identity is not None else ""
        missed = self._last.gaps.get(source.name, 0) if self._last is not None else 0
        kind = str(source.instrument.driver.info.kind)
        rate = _rate(self._counts[source.name]) if self._lent is None else math.nan
        return Instrument(source.name, kind, _text(model), state, since, _text(why), missed, rate)

    def _place(self, name: str) -> tuple[float, ...] | None:
        place = self._places.get(name)
        return tuple(map(float, place)) if place is not None and np.isfinite(place).all() else None

    def _run_name(self) -> str:
        folder = getattr(self._monitor, "folder", None)
        return folder.path.name if folder is not None else ""


class _InterruptibleClock(Clock):
    """The clock of the computer; waits of the owning thread end when the instruments must be released."""

    def __init__(self, must_release: Callable[[], bool]) -> None:
        self._must_release = must_release
        self.owner: threading.Thread | None = None

    def sleep(self, seconds: float) -> None:
        """Wait, in short steps."""
        end = self.now() + seconds
        while (left := end - self.now()) > 0 and not self._must_release():
            super().sleep(min(left, CLAIM_INTERVAL))

    def wait(self, event: threading.Event, seconds: float) -> None:
        """Wait for an event, in short steps; waits of other threads are not interrupted."""
        if threading.current_thread() is not self.owner:
            super().wait(event, seconds)
            return
        end = self.now() + seconds
        while not event.is_set() and (left := end - self.now()) > 0 and not self._must_release():
            event.wait(min(left, CLAIM_INTERVAL))


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
    """Return a text of a device, printable and of limited length."""
    text = "" if value is None else str(value)[:MAX_TEXT]
    return "".join(each if each.isprintable() else "?" for each in text)


def _now() -> datetime:
    return datetime.now(UTC)
