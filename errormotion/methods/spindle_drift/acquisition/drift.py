"""Measuring a drift: the record of five channels on one clock, with what the thermometers say beside it.

Everything that a sensor said goes into the raw dataset, sample by sample, before anything is computed from it.
"""

from __future__ import annotations

import json
import logging
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.spindle_drift.schema import CHANNELS, SCHEMA
from errormotion.plugins import Bench, Samples

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.settings import Settings


log = logging.getLogger(__name__)

HAND_OVER_SECONDS = 0.4
"""A chunk is handed over at least this often, so that a crash loses little."""
HAND_OVER_SAMPLES = 1 << 18
POLL_SECONDS = 2.0
"""Temperatures are asked for this often, in seconds of the record."""
PATIENCE = 30
"""So many polls in a row may a thermometer fail before the record is given up."""


def record_drift(
    bench: Bench, settings: Settings, beams: xr.Dataset | None, done: xr.Dataset | None
) -> Iterator[xr.Dataset]:
    """Yield the drift record, chunk by chunk along ``time``.

    Parameters
    ----------
    bench : Bench
        With a ``spindle_frame``; a ``controller`` and a ``thermometer`` where there are.
    settings : Settings
    beams : Dataset, optional
        Error dataset of a beam detection; without it the nominal beams count.
    done : Dataset, optional
        What an interrupted run holds. On a real machine time went on meanwhile: the gap is filled with NaN.
    """
    frame = bench.of_kind("spindle_frame")
    rate = float(frame.rate)
    total = round(settings.duration * rate)
    first = 0 if done is None else int(done.sizes["time"])
    thermometer = bench.of_kind("thermometer") if bench.has_kind("thermometer") else None
    static = _static(bench, frame, settings, beams)
    static.attrs["sample_rate"] = rate
    virtual = _start_machine(bench, settings, first / rate)
    pending = _Pending(static, rate, settings, first, thermometer, frame.encoding)
    if done is not None and not virtual:
        due = min(_missed(done, rate), total)
        while pending.end < due:
            pending.fill_gap(due)
            yield pending.hand_over()
    try:
        for samples in frame.stream():
            pending.add(samples, total)
            if pending.due or pending.end >= total:
                yield pending.hand_over()
            if pending.end >= total:
                return
    except InstrumentError:
        if pending.samples:  # what came before it went wrong is not lost
            yield pending.hand_over()
        raise
    raise MethodError(f"The stream ended at {pending.end / rate:.1f} s of {settings.duration:g} s.")


def _start_machine(bench: Bench, settings: Settings, elapsed: float) -> bool:
    """Mount the bar and start the schedule; return whether the machine is a virtual one, whose time can be set."""
    if not bench.has_kind("controller"):
        speeds = ", ".join(
            f"{e.spindle_speed:g} /min at {e.at:g} s" for e in settings.schedule if e.spindle_speed is not None
        )
        if elapsed == 0.0:
            bench.ask(f"Mount the bar and start the spindle ({speeds or 'it stands still'}).")
        return False
    controller = bench.of_kind("controller")
    virtual = hasattr(controller, "elapse")
    if elapsed == 0.0 or virtual:
        controller.mount("bar")
        controller.start(
            [
                {"time": e.at, "spindle_speed": e.spindle_speed, "compensation": e.compensation}
                for e in settings.schedule
            ]
        )
    if virtual and elapsed > 0.0:
        controller.elapse(elapsed)
    return virtual


def _missed(done: xr.Dataset, rate: float) -> int:
    """Return the sample number that is due now, from the record's start in UTC."""
    start = str(done.attrs.get("start", ""))
    try:
        begun = datetime.fromisoformat(start)
    except ValueError as error:
        raise MethodError(
            f"The interrupted record does not say when it began (attribute start = '{start}'; expected UTC such as "
            "2025-03-01T08:00:00+00:00), so that it cannot be gone on with. Start a new run."
        ) from error
    return round((datetime.now(UTC) - begun).total_seconds() * rate)


def _static(bench: Bench, frame: Any, settings: Settings, beams: xr.Dataset | None) -> xr.Dataset:
    """Return everything of a raw dataset but its samples."""
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
        found = beams.sel(beam=list(CHANNELS))
        origin, direction = found["beam_origin"].values, found["beam_direction"].values
        variables["beam_covariance"] = (("channel", "p", "p_"), found["beam_covariance"].values)
    variables["beam_origin"] = (("channel", "direction"), origin, {"units": "m"})
    variables["beam_direction"] = (("channel", "direction"), direction, {"units": "1"})
    events = [e.model_dump(mode="json", exclude_none=True) for e in settings.schedule]
    attrs = {
        "schema": SCHEMA,
        "machine": bench.machine,
        "events": json.dumps(events),
        "sensors_warm": int(bool(frame.warm)),
        "beam_source": "beam detection" if beams is not None else "nominal",
    }
    return xr.Dataset(variables, coords=labels, attrs=attrs)


@dataclass
class _Pending:
    """Samples on their way from the instruments to the next chunk."""

    static: xr.Dataset
    rate: float
    settings: Settings
    end: int
    thermometer: Any
    encoding: Mapping[str, Any]
    blocks: list[Array] = field(default_factory=list)
    warmth: list[NDArray[np.float32]] = field(default_factory=list)
    samples: int = 0
    dropped: int = 0
    invalid: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._since = time.monotonic()
        self._polled = -np.inf
        self._failures = 0
        self._sensors: list[str] = []
        self._warmth = np.zeros(0, np.float32)
        if self.thermometer is not None:
            reading = self.thermometer.read()  # the names; a thermometer that is not there shows before the bar turns
            self._sensors = [str(name) for name in reading]

    @property
    def due(self) -> bool:
        """Whether a chunk is large or old enough."""
        return self.samples >= HAND_OVER_SAMPLES or time.monotonic() - self._since >= HAND_OVER_SECONDS

    def add(self, block: Samples, total: int) -> None:
        """Take in a block of samples, up to ``total`` of the whole record."""
        values = block.values[:, : total - self.end]
        if "start" not in self.static.attrs:
            begun = datetime.now(UTC) - timedelta(seconds=values.shape[1] / self.rate)
            self.static.attrs["start"] = begun.isoformat(timespec="milliseconds")
        if self.thermometer is not None and self.end / self.rate - self._polled >= POLL_SECONDS:
            self._poll()
        self._take(values, self._warmth)
        self.dropped += block.dropped
        for reason, count in block.invalid.items():
            self.invalid[reason] = self.invalid.get(reason, 0) + count

    def fill_gap(self, until: int) -> None:
        """Fill with NaN, a chunk at most, up to a sample number: nobody measured there."""
        missing = min(until - self.end, HAND_OVER_SAMPLES)
        self._take(np.full((len(CHANNELS), missing), np.nan), np.full(len(self._sensors), np.nan, np.float32))
        self.dropped += missing * len(CHANNELS)

    def _take(self, values: Array, warmth: NDArray[np.float32]) -> None:
        self.blocks.append(values)
        self.warmth.append(np.tile(warmth, (values.shape[1], 1)))
        self.end += values.shape[1]
        self.samples += values.shape[1]

    def _poll(self) -> None:
        """Ask for the temperatures; a failure is NaN and counted, since hours of readings depend on no thermometer."""
        self._polled = self.end / self.rate
        try:
            reading = self.thermometer.read()
        except InstrumentError as error:
            self._failures += 1
            if self._failures > PATIENCE:
                raise
            log.warning("no temperatures at %.1f s: %s", self._polled, error)
            self.invalid["thermometer silent"] = self.invalid.get("thermometer silent", 0) + 1
            self._warmth = np.full(len(self._sensors), np.nan, np.float32)
            return
        self._failures = 0
        self._warmth = np.array([reading.get(name, np.nan) for name in self._sensors], np.float32)

    def hand_over(self) -> xr.Dataset:
        """Return all pending samples as a dataset."""
        first = self.end - self.samples
        ds = self.static.copy()
        ds["distance"] = (("channel", "time"), np.concatenate(self.blocks, axis=1), {"units": "m"})
        ds["distance"].encoding = dict(self.encoding)
        if self.thermometer is not None:
            ds = ds.assign_coords(sensor=self._sensors)
            ds["temperature"] = (("time", "sensor"), np.concatenate(self.warmth), {"units": "degC"})
        if any(e.spindle_speed is not None for e in self.settings.schedule):
            ds["spindle_speed"] = ("time", self._speed(first), {"units": "1/min"})
        ds.attrs |= {"time_start": first / self.rate, "dropped": self.dropped, "invalid": dict(self.invalid)}
        self.blocks, self.warmth, self.samples, self.dropped, self.invalid = [], [], 0, 0, {}
        self._since = time.monotonic()
        return ds

    def _speed(self, first: int) -> NDArray[np.float32]:
        """Return the commanded spindle speed of the pending samples, 1/min; zero before the first command."""
        orders = sorted((e.at, e.spindle_speed) for e in self.settings.schedule if e.spindle_speed is not None)
        starts = np.array([at for at, _ in orders]) * self.rate
        speeds = np.array([0.0, *(speed for _, speed in orders)], np.float32)
        return speeds[np.searchsorted(starts, np.arange(first, self.end), side="right")]
