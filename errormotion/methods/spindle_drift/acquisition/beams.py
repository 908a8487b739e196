"""Acquisition of a beam detection: the machine steps a sphere through each beam.

Every sample is stored; the identification detects the rests in the record.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import clock
from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.spindle_drift.acquisition.drift import CHUNK_DURATION, warmth
from errormotion.methods.spindle_drift.acquisition.motions import sphere_centres
from errormotion.methods.spindle_drift.identification.segmentation import scan_seconds
from errormotion.methods.spindle_drift.schema import CHANNELS, SCHEMA
from errormotion.plugins import Bench
from errormotion.plugins.virtual import is_virtual

if TYPE_CHECKING:
    from collections.abc import Iterator

    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


def detect_beams(bench: Bench, settings: SpindleDriftSettings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield the record of a sphere that is stepped through every beam, chunk by chunk along ``sample``.

    Sensor and machine need no synchronisation, because the rests are detected in the record. An interrupted scan is
    repeated as another attempt. A virtual machine that was restarted repeats the whole detection; samples that are
    recorded already are omitted, and the others are those of a detection without interruption.
    """
    frame = bench.of_kind("spindle_frame")
    controller = control_of(bench)
    static = _scan_plan(bench, frame, settings)
    static.attrs["sensors_warm"] = warmth(frame, done)
    length = round(scan_seconds(settings.steps, settings.dwell) * frame.rate)
    recorded_samples = 0
    if is_virtual(controller):
        static.attrs[clock.ORIGIN] = now = float(controller.state()["time"])
        if done is not None and clock.restarted(done, now) and not done["attempt"].values.any():
            recorded_samples, done = int(done.sizes["sample"]), None
    attempts = {} if done is None else last_attempts(done)
    controller.mount("sphere")
    profiles = static.sizes["profile"]
    for scan in range(len(CHANNELS) * profiles):
        attempt, recorded = attempts.get(scan, (-1, 0))
        if recorded >= length:
            continue
        channel, profile = divmod(scan, profiles)
        controller.run_steps(
            start=[float(x) for x in static["sphere_centre"].values[channel, profile, 0]],
            direction=[float(x) for x in static["scan_direction"].values[channel, profile]],
            step=settings.scan_length / (settings.steps - 1),
            count=settings.steps,
            dwell=settings.dwell,
        )
        for chunk in _record_scan(frame, static, channel, scan, attempt + 1, length):
            omitted = min(recorded_samples, chunk.sizes["sample"])
            recorded_samples -= omitted
            if omitted < chunk.sizes["sample"]:
                yield chunk.isel(sample=slice(omitted, None)) if omitted else chunk


def control_of(bench: Bench) -> Any:
    """Return the controller that moves the sphere.

    Raises
    ------
    MethodError
        The bench has none.
    """
    controller = bench.of_kind("controller") if bench.has_kind("controller") else None
    if not hasattr(controller, "run_steps"):
        raise MethodError(
            "A beam detection needs an instrument of kind 'controller' that moves the sphere in steps (run_steps); the "
            "bench has none. Add one, or use the beams of an earlier detection or the nominal beams.",
            code="bench.controller.no_steps",
        )
    return controller


def last_attempts(raw: xr.Dataset) -> dict[int, tuple[int, int]]:
    """Return for each scan the number of its last attempt and the number of samples of that attempt."""
    scan, attempt = raw["scan"].values.astype(np.int64), raw["attempt"].values.astype(np.int64)
    last: dict[int, tuple[int, int]] = {}
    for number in np.unique(scan):
        attempts = attempt[scan == number]
        last[int(number)] = int(attempts.max()), int((attempts == attempts.max()).sum())
    return last


def _scan_plan(bench: Bench, frame: Any, settings: SpindleDriftSettings) -> xr.Dataset:
    """Return a beam detection without its samples."""
    g = frame.geometry
    centres, scans = sphere_centres(settings, g.nominal_origin, g.nominal_direction)
    m = {"units": "m"}
    return xr.Dataset(
        {
            "sphere_centre": (("channel", "profile", "step", "direction"), centres, m),
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
            "sample_rate": float(frame.rate),
            "dwell": settings.dwell,
        },
    )


def _record_scan(
    frame: Any, static: xr.Dataset, channel: int, scan: int, attempt: int, length: int
) -> Iterator[xr.Dataset]:
    """Yield ``length`` samples of one channel."""
    name = CHANNELS[channel]
    taken, since = 0, time.monotonic()
    pending: list[Array] = []

    def chunk() -> xr.Dataset:
        record = np.concatenate(pending)
        part = static.assign(
            record=("sample", record, {"units": "m"}),
            scan=("sample", np.full(record.size, scan, np.int16)),
            attempt=("sample", np.full(record.size, attempt, np.int16)),
        )
        part["record"].encoding = dict(frame.encoding)
        pending.clear()
        return part

    try:
        for samples in frame.stream([name]):
            pending.append(samples.values[0, : length - taken])
            taken += pending[-1].size
            if taken == length or time.monotonic() - since >= CHUNK_DURATION:
                yield chunk()
                since = time.monotonic()
            if taken == length:
                return
    except InstrumentError:
        if pending:  # samples before the failure are kept
            yield chunk()
        raise
    raise MethodError(
        f"Channel {name}: the stream ended at {taken / frame.rate:.1f} s of {length / frame.rate:.1f} s.",
        code="stream.ended",
    )
