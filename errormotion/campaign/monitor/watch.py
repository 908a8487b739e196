"""Monitoring of a machine for hours or weeks: temperatures and working parameters on one clock, in a run folder.

Every instrument is read by a separate thread. At each interval the latest reading of each instrument is logged if it
is recent; a missing reading is logged as NaN and marked in ``gap`` until the instrument answers again. Rows are on disk
within a second, and only the last readings are kept in memory.
"""

from __future__ import annotations

import json
import logging
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from uuid import uuid4

import numpy as np
import xarray as xr

from errormotion.campaign.bench import Answer
from errormotion.campaign.files import BenchPlan
from errormotion.campaign.folder import FolderGoneError, RunFolder, Status, new_entries, now
from errormotion.campaign.monitor.clock import Clock
from errormotion.campaign.monitor.liveness import Liveness
from errormotion.campaign.monitor.schema import SCHEMA
from errormotion.campaign.monitor.sources import Source
from errormotion.campaign.storage.journal import cause_of, journal
from errormotion.campaign.storage.recorder import Recorder
from errormotion.campaign.storage.store import RawStore
from errormotion.datasets import provenance
from errormotion.errors import BenchError, RunError

TEST = "monitor"

FLAGS = ("known", "open", "shorted", "out of range", "no answer", "unknown", "faulty")
"""Reasons of unknown temperatures; the log contains the index in this list, and the list itself."""

OLDEST_READING = 2.5
"""Greatest age of a reading that is logged, in intervals: one interval may pass without a new reading, two may not."""

START_TIMEOUT = 10.0
"""Longest wait for the first reading of an instrument, s; afterwards a gap is logged until it answers."""

BLOCK = 4096
"""Rows of one chunk on disk: about an hour at 1 s; every commit rewrites the last chunk."""

NUMBERS = ("spindle_speed", "spindle_load", "feed")
"""Working parameters that are logged in addition to the position, by their names in a controller's state."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Snapshot:
    """Readings of a monitor at one time.

    Attributes
    ----------
    time : float
        Time since the start, s.
    temperatures : mapping of str to float
        degC; NaN = unknown.
    flags : mapping of str to str
        Reasons of unknown temperatures.
    state : mapping
        State of the controller; empty without one, or while it does not answer.
    silent : mapping of str to str
        Instruments without a recent reading, and the cause.
    logged : int
        Rows in the log.
    gaps : mapping of str to int
        Rows without a reading, by instrument.
    doubtful : mapping of str to str
        Temperatures whose sensors no longer measure, and why; their values are those that the instruments state.
    """

    time: float
    temperatures: Mapping[str, float]
    flags: Mapping[str, str]
    state: Mapping[str, Any]
    silent: Mapping[str, str]
    logged: int
    gaps: Mapping[str, int] = field(default_factory=dict)
    doubtful: Mapping[str, str] = field(default_factory=dict)


class Monitor:
    """Reads the thermometers and the controller of a bench; a context manager.

    Parameters
    ----------
    plan : BenchPlan
        The bench; its thermometers and its controller are opened.
    runs : Path
        Folder of the run folder.
    interval : float
        Interval of the rows of the log, s.
    clock : Clock, optional
        Clock; default: that of the computer.
    test : str
        Name of the test in the run folder.

    Attributes
    ----------
    folder : RunFolder
        The run folder, once entered.
    sensors : tuple of str
        Names of the temperatures: those of the thermometers, preceded by the instrument where names are equal.
    doubted : dict of str to str
        Temperatures that were doubtful at any time, and why.

    Raises
    ------
    BenchError
        The bench has neither a thermometer nor a controller, or several controllers.
    """

    def __init__(
        self, plan: BenchPlan, runs: Path, interval: float = 1.0, clock: Clock | None = None, test: str = TEST
    ) -> None:
        self._clock = clock or Clock()
        self.plan, self.runs, self.interval, self.test = plan, runs, float(interval), test
        kinds = ("thermometer", "controller")
        instruments = [each for each in plan.instruments if each.driver.info.kind in kinds]
        self.sources = [Source(each, self.interval, self._clock) for each in instruments]
        controllers = [source for source in self.sources if _kind(source) == "controller"]
        if not self.sources or len(controllers) > 1:
            names = ", ".join(source.name for source in controllers) or ", ".join(plan.kinds)
            wanted = "thermometers, a controller, or both" if not self.sources else "one controller at most"
            raise BenchError(f"{plan.source}: expected {wanted}; found {names}", code="monitor.quantities.missing")
        self.controller = controllers[0] if controllers else None
        self._columns = _columns([source for source in self.sources if source is not self.controller])
        self.sensors = tuple(self._columns.values())
        self._gaps: Counter[str] = Counter()
        self._liveness = Liveness()
        self._taken: dict[str, float] = {}  # time of the last reading of each thermometer
        self._doubtful: dict[str, str] = {}
        self.doubted: dict[str, str] = {}
        self._noted: tuple[Answer, ...] = ()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self.folder = self._new_folder()
        try:
            self._start()
        except BaseException as error:
            with suppress(OSError, RunError):
                failed = isinstance(error, Exception)
                reason = cause_of(error) if failed else "stopped by the operator"
                self.folder.save(status="failed" if failed else "interrupted", reason=reason)
            raise
        return self

    def _start(self) -> None:
        with ExitStack() as stack:
            stack.enter_context(self.folder.locked())
            stack.enter_context(journal(self.folder.log))
            stack.callback(self._stop)
            for source in self.sources:
                source.start()
            attrs = {"schema": SCHEMA, "machine": self.plan.machine, "start": now(), "interval": self.interval}
            attrs |= {"flag_meanings": json.dumps(list(FLAGS)), "instruments": "[]"}
            # The store is created before the clock starts: this takes longer than a short interval.
            empty = self._row(
                Snapshot(0.0, dict.fromkeys(self.sensors, math.nan), dict.fromkeys(self.sensors, ""), {}, {}, 0)
            )
            RawStore.create(self.folder.raw, empty.assign_attrs(attrs), "time", BLOCK)
            self._recorder = stack.enter_context(Recorder(self.folder.raw, "time", BLOCK, attrs))
            self._stack = stack.pop_all()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        failure = error if isinstance(error, Exception) else None
        try:
            self._stack.__exit__(kind, error, trace)
        except Exception as late:  # the last rows could not be written
            failure = failure or late
            raise
        finally:
            self._state_end(failure)

    def _state_end(self, failure: Exception | None) -> None:
        """Write the end of the log to ``run.json``; if this fails as well, the earlier failure is the cause."""
        if failure is not None:
            log.error("the monitor stopped", exc_info=failure)
        status: Status = "finished" if failure is None else "failed"
        reason = "" if failure is None else cause_of(failure)
        self.folder.data["instruments"] = [source.answer.record() for source in self.sources if source.answer]
        self.folder.data["samples"] = {
            "dim": "time",
            "count": self._recorder.committed,
            "dropped": 0,
            "invalid": {f"no answer of {name}": count for name, count in self._gaps.items()},
        }
        self.folder.step("monitor", "done" if failure is None else status, samples=self._recorder.committed)
        if isinstance(failure, FolderGoneError):  # nothing is written to its former path
            return
        try:
            self.folder.save(status=status, reason=reason, acquired=failure is None)
        except (OSError, RunError):
            if failure is None:
                raise
            log.exception("run.json cannot be written")

    def watch(self, duration: float = math.inf) -> Iterator[Snapshot]:
        """Log rows, and yield each as a snapshot.

        Parameters
        ----------
        duration : float
            Duration, s.

        Raises
        ------
        RunError
            The log cannot be written; committed rows remain complete.
        """
        for source in self.sources:
            source.wait(START_TIMEOUT)
        start, tick, rows = self._clock.now(), 0, 0
        while tick * self.interval <= duration:
            due = start + tick * self.interval
            if (ahead := due - self._clock.now()) > 0:
                self._clock.sleep(ahead)
            rows += 1
            snapshot = self._snapshot(self._clock.now() - start, rows)
            self._recorder.put(self._row(snapshot))
            self._note_instruments()
            yield snapshot
            # Intervals missed by a suspended computer give no rows; the times of the log show them.
            tick = max(tick + 1, math.ceil((self._clock.now() - start) / self.interval))

    def _note_instruments(self) -> None:
        """Store the identities of the instruments in the log whenever one has been opened."""
        answers = tuple(source.answer for source in self.sources if source.answer)
        attrs = self._recorder.attrs  # those of the store, which the next commit writes
        if "instruments" in attrs and answers != self._noted:
            attrs["instruments"] = json.dumps(provenance.plain([answer.record() for answer in answers]))
            self._noted = answers

    def _snapshot(self, at: float, logged: int) -> Snapshot:
        oldest = self._clock.now() - OLDEST_READING * self.interval
        temperatures = dict.fromkeys(self.sensors, math.nan)
        flags = dict.fromkeys(self.sensors, "no answer")
        state: dict[str, Any] = {}
        silent = {}
        new: dict[str, float] = {}
        for source in self.sources:
            reading = source.fresh(oldest)
            if reading is None:
                silent[source.name] = source.error or f"no answer for {OLDEST_READING * self.interval:g} s"
                self._gaps[source.name] += 1
            elif source is self.controller:
                state = dict(reading.values)
            else:
                for channel, value in reading.values.items():
                    name = self._columns[source.name, channel]
                    temperatures[name], flags[name] = float(value), reading.flags.get(channel, "")
                    if self._taken.get(source.name) != reading.at:
                        new[name] = float(value)
                self._taken[source.name] = reading.at
        return Snapshot(at, temperatures, flags, state, silent, logged, dict(self._gaps), self._doubt(new))

    def _doubt(self, new: Mapping[str, float]) -> dict[str, str]:
        """Return the temperatures whose sensors no longer measure; log each change."""
        self._liveness.put(new)
        doubts = self._liveness.found()
        for name in doubts.keys() - self._doubtful.keys():
            log.warning("%s %s", name, doubts[name])
            if name not in self.doubted:
                self.doubted[name] = doubts[name]
                self.folder.step("readings", "doubtful", sensor=name, reason=doubts[name])
        for name in self._doubtful.keys() - doubts.keys():
            log.info("%s measures again", name)
        self._doubtful = doubts
        return dict(doubts)

    def _row(self, snapshot: Snapshot) -> xr.Dataset:
        gap = np.array([[source.name in snapshot.silent for source in self.sources]], dtype=np.int8)
        data: dict[str, Any] = {"gap": (("time", "source"), gap, {"units": "1"})}
        coords: dict[str, Any] = {
            "time": ("time", [snapshot.time], {"units": "s"}),
            "source": [source.name for source in self.sources],
        }
        if self.sensors:
            values = np.array([[snapshot.temperatures[name] for name in self.sensors]])
            flags = np.array([[_code(snapshot.flags[name]) for name in self.sensors]], dtype=np.int8)
            coords["sensor"] = list(self.sensors)
            data["temperature"] = (("time", "sensor"), values, {"units": "degC"})
            data["temperature_flag"] = (("time", "sensor"), flags, {"units": "1"})
            data["sensor_place"] = (("sensor", "direction"), self.places, {"units": "m"})
            coords["direction"] = ["x", "y", "z"]
        if self.controller is not None:
            coords["direction"] = ["x", "y", "z"]
            position = snapshot.state.get("position") or [math.nan] * 3
            data["position"] = (("time", "direction"), np.array([position[:3]], dtype=float), {"units": "m"})
            for name, unit in zip(NUMBERS, ("1/min", "1", "m/s"), strict=True):
                value = snapshot.state.get(name, math.nan)
                data[name] = ("time", np.array([math.nan if value is None else value], dtype=float), {"units": unit})
        return xr.Dataset(data, coords)

    @property
    def places(self) -> np.ndarray[Any, Any]:
        """Return the positions of the temperature sensors on the machine, (sensor, 3), m; NaN if unknown."""
        places = {
            name: place
            for source in self.sources
            if source is not self.controller
            for name, place in ((self._columns[source.name, c], p) for c, p in source.places.items())
        }
        return np.array([places[name] or (math.nan,) * 3 for name in self.sensors], dtype=float)

    def _stop(self) -> None:
        for source in self.sources:
            source.stop()
        for source in self.sources:
            source.join()

    def _new_folder(self) -> RunFolder:
        data = new_entries(self.plan) | {"settings": {"interval": self.interval}, "instruments": []}
        return RunFolder.create(self.runs, self.test, uuid4().hex[:8], data)


def _kind(source: Source) -> str:
    return str(source.instrument.driver.info.kind)


def _code(flag: str) -> int:
    if not flag:
        return 0
    return FLAGS.index(flag) if flag in FLAGS else FLAGS.index("unknown")


def _columns(thermometers: Sequence[Source]) -> dict[tuple[str, str], str]:
    """Return the name of each sensor in the log by its instrument and channel."""
    channels = [(source.name, channel) for source in thermometers for channel in source.channels]
    count = Counter(channel for _, channel in channels)
    return {
        (source, channel): channel if count[channel] == 1 else f"{source}.{channel}" for source, channel in channels
    }
