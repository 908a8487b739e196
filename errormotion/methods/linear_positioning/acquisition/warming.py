"""Measurement of a moving axis (ISO 230-3): both ends of the stroke are read cold, between the moves, and cooling."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.iso import iso_names
from errormotion.methods.linear_positioning.acquisition.measure import Stand
from errormotion.methods.linear_positioning.moving import Cycle, cycles, ends, moving_of
from errormotion.methods.linear_positioning.schema import SCHEMA

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings
    from errormotion.plugins import Bench


def measure_moving(bench: Bench, settings: Settings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each reading of both ends, to be joined along ``cycle``.

    Raises
    ------
    MethodError
        An interrupted test, a broken beam in the cold state, and what `measure_axis` raises.
    """
    if done is not None:
        raise MethodError(
            "A test of a moving axis cannot be continued: the axis has cooled down meanwhile. Let it cool, and start "
            "a new run."
        )
    low, high = ends(settings)
    stand = Stand(bench, settings, zero=low)
    stand.move(low)
    stand.wait(settings.settle)
    stand.reader.zero()
    stand.fresh = False
    started: float | None = None
    cold = [cycle for cycle in cycles(settings) if cycle.cold]
    read = [_ends(stand, low, high) for _ in cold]
    last = read[-1][0]
    for cycle, found in zip(cold, read, strict=True):
        yield _dataset(stand, cycle, (found[0] - last, *found[1:]))
    for cycle in cycles(settings):
        if cycle.cold:
            continue
        started = _now(stand) if started is None else started
        for _ in range(cycle.strokes):
            stand.move(high, moving_of(settings).feed)
            stand.move(low, moving_of(settings).feed)
        stand.wait(cycle.rest)
        found = _ends(stand, low, high)
        yield _dataset(stand, cycle, (found[0] - started, *found[1:]))


def _ends(stand: Stand, low: float, high: float) -> tuple[float, Array, Array]:
    """Return time, s, deviations (end, freedom) and temperatures of a reading of both ends, forward and backward."""
    found = {}
    for place in (high, low):
        stand.move(place)
        stand.wait(stand.settings.settle)
        found[place] = stand.read(place)
        stand.wait(stand.settings.dwell - stand.settings.settle)
    return _now(stand), np.stack([found[low], found[high]]), stand.temperatures()


def _now(stand: Stand) -> float:
    """Return the time of the control, or of this computer, s."""
    return float(stand.control.state().get("time", time.monotonic()))


def _dataset(stand: Stand, cycle: Cycle, found: tuple[float, Array, Array]) -> xr.Dataset:
    settings, (when, x, T) = stand.settings, found
    names = iso_names(settings.axis)
    variables: dict[str, Any] = {
        "end_deviation": (("cycle", "end", "freedom"), x[None]),
        "end_position": ("end", np.array(ends(settings)), {"units": "m"}),
        "reading_time": ("cycle", np.array([when]), {"units": "s"}),
        "moving": ("cycle", np.array([float(cycle.moving)]), {"units": "1"}),
    }
    coords: dict[str, Any] = {"freedom": [names[name] for name in settings.freedoms]}
    if settings.functional_point is not None:
        variables["functional_point"] = ("direction", np.array(settings.functional_point), {"units": "m"})
        coords["direction"] = list("xyz")
    if stand.sensors:
        variables["temperature"] = (("cycle", "sensor"), T[None], {"units": "degC"})
        coords["sensor"] = list(stand.sensors)
    missing = int(np.isnan(x).sum())
    attrs = {
        "schema": SCHEMA,
        "axis": settings.axis,
        "machine": stand.bench.machine,
        "instrument": stand.reader.id,
        "start": datetime.now(UTC).isoformat(timespec="seconds"),
        "dropped": 0,
        "invalid": {"beam broken": missing} if missing else {},
    }
    return xr.Dataset(variables, coords, attrs)
