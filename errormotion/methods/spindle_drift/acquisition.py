"""Measuring: a drift record from five channels on one clock, and the readings of a stepped sphere.

Everything that a sensor said goes into the raw dataset, sample by sample, before anything is computed from it.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.datasets.schemas import CHANNELS
from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.beams import across
from errormotion.plugins import Bench, Samples

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.settings import Settings

    Array = NDArray[np.float64]

SCHEMA = "errormotion.raw.spindle_drift/1"
HAND_OVER_SECONDS = 0.4
"""A chunk is handed over at least this often, so that a crash loses little."""
HAND_OVER_SAMPLES = 1 << 18
POLL_SECONDS = 2.0
"""Temperatures are asked for this often, in seconds of the record."""
LEAD = 10.0
"""A scan is recorded this much longer than its rests, s; its moves may take a quarter of them."""


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
        pending.fill_gap(min(_missed(done, rate), total))
        while pending.samples:
            yield pending.hand_over()
    for samples in frame.stream():
        pending.add(samples, total)
        if pending.due or pending.end >= total:
            yield pending.hand_over()
        if pending.end >= total:
            return
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
        "start": datetime.now(UTC).isoformat(timespec="seconds"),
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
    warmth: list[Array] = field(default_factory=list)
    samples: int = 0
    dropped: int = 0
    invalid: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._since = time.monotonic()
        self._polled = -np.inf
        self._temperature: dict[str, float] = {}
        if self.thermometer is not None:
            self._poll()

    @property
    def due(self) -> bool:
        """Whether a chunk is large or old enough."""
        return self.samples >= HAND_OVER_SAMPLES or time.monotonic() - self._since >= HAND_OVER_SECONDS

    def add(self, block: Samples, total: int) -> None:
        values = block.values[:, : total - self.end]
        if self.thermometer is not None and self.end / self.rate - self._polled >= POLL_SECONDS:
            self._poll()
        self._take(values)
        self.dropped += block.dropped
        for reason, count in block.invalid.items():
            self.invalid[reason] = self.invalid.get(reason, 0) + count

    def fill_gap(self, until: int) -> None:
        """Fill with NaN up to a sample number."""
        missing = until - self.end
        if missing > 0:
            self._take(np.full((len(CHANNELS), missing), np.nan))
            self.dropped += missing * len(CHANNELS)

    def _take(self, values: Array) -> None:
        self.blocks.append(values)
        self.warmth.append(np.tile(np.array(list(self._temperature.values()), np.float32), (values.shape[1], 1)))
        self.end += values.shape[1]
        self.samples += values.shape[1]

    def _poll(self) -> None:
        reading = self.thermometer.read()
        self._temperature = {str(name): float(value) for name, value in reading.items()}
        self._polled = self.end / self.rate

    def hand_over(self) -> xr.Dataset:
        """Return all pending samples as a dataset."""
        first = self.end - self.samples
        ds = self.static.copy()
        ds["distance"] = (("channel", "time"), np.concatenate(self.blocks, axis=1), {"units": "m"})
        ds["distance"].encoding = dict(self.encoding)
        if self.thermometer is not None:
            ds = ds.assign_coords(sensor=list(self._temperature))
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


def detect_beams(bench: Bench, settings: Settings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield the record of a sphere that is stepped through every beam, chunk by chunk along ``sample``.

    The machine needs no synchronous reading: it steps by its own clock, and the steps are found in the record. A scan
    that an interruption cut off is made anew; of its samples the last ones count.
    """
    frame = bench.of_kind("spindle_frame")
    if not bench.has_kind("controller"):
        raise MethodError(
            "A beam detection steps a sphere through the beams and needs an instrument of kind 'controller' to move "
            "it; the bench has none. Give the beams of an earlier detection, or measure with the nominal ones."
        )
    controller = bench.of_kind("controller")
    static = _scan_plan(bench, frame, settings)
    length = round(scan_seconds(settings) * frame.rate)
    recorded = np.zeros(0, np.int64) if done is None else np.bincount(done["scan"].values)
    controller.mount("sphere")
    profiles = static.sizes["profile"]
    for scan in range(len(CHANNELS) * profiles):
        if scan < recorded.size and recorded[scan] >= length:
            continue
        channel, profile = divmod(scan, profiles)
        controller.run_steps(
            start=[float(x) for x in static["sphere_centre"].values[channel, profile, 0]],
            direction=[float(x) for x in static["scan_direction"].values[channel, profile]],
            step=settings.scan_length / (settings.steps - 1),
            count=settings.steps,
            dwell=settings.dwell,
        )
        yield from _record_scan(frame, static, CHANNELS[channel], scan, length)


def scan_seconds(settings: Settings) -> float:
    """Return how long one scan is recorded: its rests, a quarter more for the moves, and a lead."""
    return settings.steps * settings.dwell * 1.25 + LEAD


def _scan_plan(bench: Bench, frame: Any, settings: Settings) -> xr.Dataset:
    """Return everything of a beam detection but its samples."""
    g = frame.geometry
    offsets = np.linspace(-0.5, 0.5, settings.steps) * settings.scan_length
    scans = np.array([[v for _ in settings.depths for v in machine_axes(u)] for u in g.nominal_direction])
    ahead = np.repeat(settings.depths, 2) + settings.sphere_radius
    middle = g.nominal_origin[:, None] + ahead[:, None] * g.nominal_direction[:, None]
    m = {"units": "m"}
    return xr.Dataset(
        {
            "sphere_centre": (
                ("channel", "profile", "step", "direction"),
                middle[:, :, None] + offsets[:, None] * scans[:, :, None],
                m,
            ),
            "scan_direction": (("channel", "profile", "direction"), scans, {"units": "1"}),
            "nominal_origin": (("channel", "direction"), g.nominal_origin, m),
            "nominal_direction": (("channel", "direction"), g.nominal_direction, {"units": "1"}),
            "sphere_radius": ((), settings.sphere_radius, m),
        },
        coords={"channel": list(CHANNELS), "direction": list("xyz")},
        attrs={
            "schema": SCHEMA,
            "machine": bench.machine,
            "start": datetime.now(UTC).isoformat(timespec="seconds"),
            "sensors_warm": int(bool(frame.warm)),
            "sample_rate": float(frame.rate),
            "dwell": settings.dwell,
        },
    )


def machine_axes(direction: Array) -> Array:
    """Return the two machine axes across a beam; for a beam far from all axes, two vectors across it."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < 0.9:
        return across(direction)
    return np.delete(np.eye(3), axis, axis=0)


def _record_scan(frame: Any, static: xr.Dataset, channel: str, scan: int, length: int) -> Iterator[xr.Dataset]:
    """Yield ``length`` samples of one channel."""
    taken, since = 0, time.monotonic()
    waiting: list[Array] = []
    for samples in frame.stream([channel]):
        waiting.append(samples.values[0, : length - taken])
        taken += waiting[-1].size
        if taken == length or time.monotonic() - since >= HAND_OVER_SECONDS:
            record = np.concatenate(waiting)
            chunk = static.assign(
                record=("sample", record, {"units": "m"}), scan=("sample", np.full(record.size, scan, np.int16))
            )
            chunk["record"].encoding = dict(frame.encoding)
            yield chunk
            waiting, since = [], time.monotonic()
        if taken == length:
            return
    raise MethodError(
        f"Channel {channel}: the stream ended at {taken / frame.rate:.1f} s of {length / frame.rate:.1f} s."
    )
