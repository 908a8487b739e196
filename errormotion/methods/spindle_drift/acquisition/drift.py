"""Acquisition of a drift: the record of five channels on one clock, and the temperatures.

Every sample of the sensors is stored in the raw dataset before anything is computed from it.
"""

from __future__ import annotations

import json
import logging
import math
import time
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import clock
from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.spindle_drift.schema import CHANNELS, SCHEMA
from errormotion.plugins import Bench, Samples
from errormotion.plugins.virtual import is_virtual, wait

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


log = logging.getLogger(__name__)

CHUNK_DURATION = 0.4
"""Longest duration of a chunk, s; limits the loss of data in a crash."""
CHUNK_SAMPLES = 1 << 18
"""Largest number of samples of a chunk."""
POLL_INTERVAL = 2.0
"""Interval between readings of the thermometer, s of the record."""
MAX_FAILED_POLLS = 30
"""Number of consecutive failed readings of the thermometer after which the record is aborted."""


def record_drift(
    bench: Bench, settings: SpindleDriftSettings, beams: xr.Dataset | None, done: xr.Dataset | None
) -> Iterator[xr.Dataset]:
    """Yield the drift record, chunk by chunk along ``time``.

    Parameters
    ----------
    bench : Bench
        With a ``spindle_frame``; ``controller`` and ``thermometer`` are optional.
    settings : SpindleDriftSettings
    beams : Dataset, optional
        Error dataset of a beam detection; by default, the nominal beams are used.
    done : Dataset, optional
        Data of an interrupted run. On a real machine, the time of the interruption is filled with NaN.
    """
    frame = bench.of_kind("spindle_frame")
    rate = float(frame.rate)
    total = round(settings.duration * rate)
    first = 0 if done is None else int(done.sizes["time"])
    thermometer = bench.of_kind("thermometer") if bench.has_kind("thermometer") else None
    static = _static(bench, frame, settings, beams)
    static.attrs["sensors_warm"] = warmth(frame, done)
    static.attrs["sample_rate"] = rate
    virtual = _start_machine(bench, settings, first / rate)
    pending = _Pending(static, rate, settings, first, thermometer, frame.encoding)
    if done is not None and virtual:
        pending.resume(done)
    elif done is not None:
        due = min(_current_sample(done, rate), total)
        while pending.end < due:
            pending.fill_gap(due)
            yield pending.chunk()
    try:
        for samples in frame.stream():
            pending.add(samples, total)
            if pending.due or pending.end >= total:
                yield pending.chunk()
            if pending.end >= total:
                return
    except InstrumentError:
        if pending.samples:  # samples before the failure are kept
            yield pending.chunk()
        raise
    raise MethodError(
        f"The stream ended at {pending.end / rate:.1f} s of {settings.duration:g} s.", code="stream.ended"
    )


def starts_schedules(bench: Bench) -> bool:
    """Return whether a controller of the bench mounts the bar and executes the schedule; else an operator does."""
    return bench.has_kind("controller") and hasattr(bench.of_kind("controller"), "start")


def _start_machine(bench: Bench, settings: SpindleDriftSettings, elapsed: float) -> bool:
    """Mount the bar and start the schedule; return whether the machine is virtual, with a time that can be set."""
    if not starts_schedules(bench):
        speeds = ", ".join(
            f"{e.spindle_speed:g} /min at {e.at:g} s" for e in settings.schedule if e.spindle_speed is not None
        )
        if elapsed == 0.0:
            bench.ask(f"Mount the bar and start the spindle ({speeds or 'no rotation'}).")
        return False
    controller = bench.of_kind("controller")
    virtual = is_virtual(controller)
    if elapsed == 0.0 or virtual:
        controller.mount("bar")
        controller.start(
            [
                {"time": e.at, "spindle_speed": e.spindle_speed, "compensation": e.compensation}
                for e in settings.schedule
            ]
        )
    if virtual and elapsed > 0.0:
        wait(controller, elapsed)
    return virtual


def _current_sample(done: xr.Dataset, rate: float) -> int:
    """Return the number of the sample at the current time.

    Where the duration of the interruption is unknown, one sample is skipped: its row of NaN separates the records.
    """
    try:
        seconds = clock.age(done)
    except ValueError as error:
        raise MethodError(
            f"The interrupted record cannot be continued: {error}; expected UTC such as 2025-03-01T08:00:00+00:00. "
            "Start a new run.",
            code="run.start.missing",
        ) from error
    return int(done.sizes["time"]) + 1 if math.isnan(seconds) else round(seconds * rate)


def warmth(frame: Any, done: xr.Dataset | None) -> int:
    """Return whether the sensors are warm (1) or not (0), for all data of a record: those of an interrupted one too.

    Raises
    ------
    MethodError
        They were warm before the interruption, and are not any more.
    """
    now = int(bool(frame.warm))
    before = now if done is None else int(done.attrs.get("sensors_warm", now))
    if before > now:
        raise MethodError(
            "The sensors were warm before the interruption, and have been switched on again since. Continue when they "
            "are warm, or start a new run.",
            code="run.sensors.warming",
        )
    return before


def _static(bench: Bench, frame: Any, settings: SpindleDriftSettings, beams: xr.Dataset | None) -> xr.Dataset:
    """Return a raw dataset without its samples."""
    g = frame.geometry
    labels = {"channel": list(CHANNELS), "direction": list("xyz"), "height": ["L1", "L2"]}
    origin, direction = g.nominal_origin, g.nominal_direction
    variables: dict[str, Any] = {
        "nominal_origin": (("channel", "direction"), g.nominal_origin, {"units": "m"}),
        "nominal_direction": (("channel", "direction"), g.nominal_direction, {"units": "1"}),
        "frame_expansion": (("channel", "direction"), g.expansion, {"units": "m/K"}),
        "bar_radius": ((), float(g.bar_radius), {"units": "m"}),
        "distance_noise": ((), float(np.max(g.noise)), {"units": "m"}),
        "level": ("height", np.asarray(g.levels, np.float64), {"units": "m"}),
    }
    if beams is not None:
        used = beams.sel(beam=list(CHANNELS))
        origin, direction = (
            used[name].transpose("beam", "direction").values for name in ("beam_origin", "beam_direction")
        )
        variables["beam_covariance"] = (
            ("channel", "p", "p_"),
            used["beam_covariance"].transpose("beam", "p", "p_").values,
        )
    variables["beam_origin"] = (("channel", "direction"), origin, {"units": "m"})
    variables["beam_direction"] = (("channel", "direction"), direction, {"units": "1"})
    events = [e.model_dump(mode="json", exclude_none=True) for e in settings.schedule]
    attrs = {
        "schema": SCHEMA,
        "machine": bench.machine,
        "events": json.dumps(events),
        "beam_source": "beam detection" if beams is not None else "nominal",
    }
    return xr.Dataset(variables, coords=labels, attrs=attrs)


@dataclass
class _Pending:
    """Samples that were read and are not yet in a chunk."""

    static: xr.Dataset
    rate: float
    settings: SpindleDriftSettings
    end: int
    thermometer: Any
    encoding: Mapping[str, Any]
    blocks: list[Array] = field(default_factory=list)
    temperatures: list[NDArray[np.float32]] = field(default_factory=list)
    samples: int = 0
    dropped: int = 0
    invalid: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._since = time.monotonic()
        self._before: int | None = None  # sample at which the previous block started
        self._overdue = True
        self._failures = 0
        self._sensors: list[str] = []
        self._temperature = np.zeros(0, np.float32)
        if self.thermometer is not None:
            reading = self.thermometer.read()  # for the names; a missing thermometer is detected before the bar turns
            self._sensors = [str(name) for name in reading]

    @property
    def due(self) -> bool:
        """Whether the chunk has its largest duration or size."""
        return self.samples >= CHUNK_SAMPLES or time.monotonic() - self._since >= CHUNK_DURATION

    def resume(self, done: xr.Dataset) -> None:
        """Continue the record of a virtual machine, with its last temperatures until the next reading is due.

        The noise of a simulated thermometer depends on the number of its readings; the previous ones are repeated.
        """
        if "temperature" in done:
            for _ in range(math.ceil(done.sizes["time"] / self.rate / POLL_INTERVAL)):
                with suppress(InstrumentError):
                    self.thermometer.read()
            self._temperature = done["temperature"].isel(time=-1).values.astype(np.float32)
            self._overdue = False

    def _poll_is_due(self, size: int) -> bool:
        """Return whether a multiple of `POLL_INTERVAL` was reached since the previous block, of the same size."""
        before = self.end - size if self._before is None else self._before
        now, last = (math.floor(sample / self.rate / POLL_INTERVAL + 1e-9) for sample in (self.end, before))
        return self._overdue or now > last

    def add(self, block: Samples, total: int) -> None:
        """Add a block of samples, up to ``total`` samples of the record."""
        values = block.values[:, : total - self.end]
        if "start" not in self.static.attrs:
            started = datetime.now(UTC) - timedelta(seconds=values.shape[1] / self.rate)
            self.static.attrs["start"] = started.isoformat(timespec="milliseconds")
        if self.thermometer is not None and self._poll_is_due(block.values.shape[1]):
            self._poll()
        self._before = self.end
        self._take(values, self._temperature)
        self.dropped += block.dropped
        for reason, count in block.invalid.items():
            self.invalid[reason] = self.invalid.get(reason, 0) + count

    def fill_gap(self, until: int) -> None:
        """Fill an interruption with NaN up to a sample number, at most one chunk."""
        missing = min(until - self.end, CHUNK_SAMPLES)
        self._take(np.full((len(CHANNELS), missing), np.nan), np.full(len(self._sensors), np.nan, np.float32))
        self.dropped += missing * len(CHANNELS)

    def _take(self, values: Array, temperature: NDArray[np.float32]) -> None:
        self.blocks.append(values)
        self.temperatures.append(np.tile(temperature, (values.shape[1], 1)))
        self.end += values.shape[1]
        self.samples += values.shape[1]

    def _poll(self) -> None:
        """Read the temperatures; a failure is counted, results in NaN, and does not abort the record."""
        self._overdue = False
        try:
            reading = self.thermometer.read()
        except InstrumentError as error:
            self._failures += 1
            if self._failures > MAX_FAILED_POLLS:
                raise
            log.warning("temperatures missing at %.1f s: %s", self.end / self.rate, error)
            self.invalid["thermometer without answer"] = self.invalid.get("thermometer without answer", 0) + 1
            self._temperature = np.full(len(self._sensors), np.nan, np.float32)
            return
        self._failures = 0
        self._temperature = np.array([reading.get(name, np.nan) for name in self._sensors], np.float32)

    def chunk(self) -> xr.Dataset:
        """Return all pending samples as a dataset, and remove them."""
        first = self.end - self.samples
        ds = self.static.copy()
        ds["distance"] = (("channel", "time"), np.concatenate(self.blocks, axis=1), {"units": "m"})
        ds["distance"].encoding = dict(self.encoding)
        if self.thermometer is not None:
            ds = ds.assign_coords(sensor=self._sensors)
            ds["temperature"] = (("time", "sensor"), np.concatenate(self.temperatures), {"units": "degC"})
        if any(e.spindle_speed is not None for e in self.settings.schedule):
            ds["spindle_speed"] = ("time", self._speed(first), {"units": "1/min"})
        ds.attrs |= {"time_start": first / self.rate, "dropped": self.dropped, "invalid": dict(self.invalid)}
        self.blocks, self.temperatures, self.samples, self.dropped, self.invalid = [], [], 0, 0, {}
        self._since = time.monotonic()
        return ds

    def _speed(self, first: int) -> NDArray[np.float32]:
        """Return the commanded spindle speed of the pending samples, 1/min; zero before the first command."""
        commands = sorted((e.at, e.spindle_speed) for e in self.settings.schedule if e.spindle_speed is not None)
        starts = np.array([at for at, _ in commands]) * self.rate
        speeds = np.array([0.0, *(speed for _, speed in commands)], np.float32)
        return speeds[np.searchsorted(starts, np.arange(first, self.end), side="right")]
