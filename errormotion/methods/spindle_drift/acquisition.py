"""Measuring: a drift record from five channels on one clock, and the readings of a stepped sphere.

Everything that a sensor said goes into the raw dataset before anything is computed from it: the drift record sample by
sample, the scans of the sphere as whole records beside the means of their steps.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.beams import across
from errormotion.methods.spindle_drift.segmentation import segment_steps
from errormotion.methods.spindle_drift.uncertainty import CHANNELS
from errormotion.plugins import Bench, Samples

if TYPE_CHECKING:
    from collections.abc import Iterator

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
    pending = _Pending(static, rate, settings, first, thermometer)
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
    """Yield the readings of a stepped sphere, one beam at a time along ``channel``.

    The machine needs no synchronous reading: it steps by its own clock, and the steps are found in the record.
    """
    frame = bench.of_kind("spindle_frame")
    if not bench.has_kind("controller"):
        raise MethodError(
            "A beam detection steps a sphere through the beams and needs an instrument of kind 'controller' to move "
            "it; the bench has none. Give the beams of an earlier detection, or measure with the nominal ones."
        )
    controller = bench.of_kind("controller")
    finished = [] if done is None else [str(name) for name in done["channel"].values]
    controller.mount("sphere")
    for name in CHANNELS:
        if name not in finished:
            yield _detect_beam(bench, frame, controller, settings, name)


def _detect_beam(bench: Bench, frame: Any, controller: Any, settings: Settings, name: str) -> xr.Dataset:
    g = frame.geometry
    i = CHANNELS.index(name)
    origin, direction = g.nominal_origin[i], g.nominal_direction[i]
    offsets = np.linspace(-0.5, 0.5, settings.steps) * settings.scan_length
    step = settings.scan_length / (settings.steps - 1)
    scans = np.array([v for _ in settings.depths for v in _machine_axes(direction)])
    depths = np.repeat(settings.depths, 2)
    middle = origin + (depths + settings.sphere_radius)[:, None] * direction
    centre = middle[:, None] + offsets[:, None] * scans[:, None]
    length = round((settings.steps * settings.dwell * 1.25 + LEAD) * frame.rate)
    record = np.full((len(scans), length), np.nan, np.float32)
    means = np.full((len(scans), settings.steps), np.nan)
    problems = []
    for profile, v in enumerate(scans):
        controller.run_steps(
            start=[float(x) for x in centre[profile, 0]],
            direction=[float(x) for x in v],
            step=step,
            count=settings.steps,
            dwell=settings.dwell,
        )
        record[profile] = _take_record(frame, name, length)
        try:
            means[profile] = segment_steps(
                record[profile].astype(np.float64), frame.rate, settings.steps, settings.dwell, settings.step_average
            ).mean
        except MethodError as error:
            problems.append(f"profile {profile}: {error}")
    one = {"channel": [name], "direction": list("xyz")}
    m = {"units": "m"}
    return xr.Dataset(
        {
            "distance": (("channel", "profile", "step"), means[None], m),
            "record": (("channel", "profile", "sample"), record[None], {**m, "rate": float(frame.rate)}),
            "problems": ("channel", np.array(["; ".join(problems)]).astype("U500")),
            "sphere_centre": (("channel", "profile", "step", "direction"), centre[None], m),
            "scan_direction": (("channel", "profile", "direction"), scans[None], {"units": "1"}),
            "nominal_origin": (("channel", "direction"), origin[None], m),
            "nominal_direction": (("channel", "direction"), direction[None], {"units": "1"}),
            "sphere_radius": ((), settings.sphere_radius, m),
        },
        coords=one,
        attrs={
            "schema": SCHEMA,
            "machine": bench.machine,
            "start": datetime.now(UTC).isoformat(timespec="seconds"),
            "sensors_warm": int(bool(frame.warm)),
        },
    )


def _machine_axes(direction: Array) -> Array:
    """Return the two machine axes across a beam; for a beam far from all axes, two vectors across it."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < 0.9:
        return across(direction)
    return np.delete(np.eye(3), axis, axis=0)


def _take_record(frame: Any, channel: str, length: int) -> NDArray[np.float32]:
    """Return ``length`` samples of one channel, m."""
    record = np.empty(length, np.float32)
    taken = 0
    for samples in frame.stream([channel]):
        part = samples.values[0, : length - taken]
        record[taken : taken + part.size] = part
        taken += part.size
        if taken == length:
            return record
    raise MethodError(
        f"Channel {channel}: the stream ended at {taken / frame.rate:.1f} s of {length / frame.rate:.1f} s."
    )
