"""Measurement of a moving axis (ISO 230-3): both ends of the stroke are read cold, during warm-up, and cooling."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.acquisition.measure import AxisMeasurement
from errormotion.methods.linear_positioning.moving import Cycle, cycles, ends, moving_of

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings
    from errormotion.plugins import Bench


NOT_CONTINUED = (
    "A test of a moving axis cannot be continued, since the axis has cooled down in the meantime. Let it cool "
    "completely, and start a new run."
)


def measure_moving(bench: Bench, settings: LinearPositioningSettings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each reading of both ends, to be joined along ``cycle``.

    Raises
    ------
    MethodError
        An interrupted test, a broken beam in the cold state, and as of `measure_axis`.
    """
    if done is not None:
        raise MethodError(NOT_CONTINUED, code="run.not_continuable")
    low, high = ends(settings)
    axis = AxisMeasurement(bench, settings, zero=low)
    axis.move(low)
    axis.wait(settings.settle)
    axis.reader.zero()
    cold = [cycle for cycle in cycles(settings) if cycle.cold]
    readings = [_read_ends(axis, low, high) for _ in cold]
    end_of_cold = readings[-1][0]
    for cycle, reading in zip(cold, readings, strict=True):
        yield _dataset(axis, cycle, end_of_cold, reading)
    start: float | None = None
    for cycle in cycles(settings):
        if cycle.cold:
            continue
        start = _now(axis) if start is None else start
        for _ in range(cycle.strokes):
            axis.move(high, moving_of(settings).feed)
            axis.move(low, moving_of(settings).feed)
        axis.wait(cycle.rest)
        yield _dataset(axis, cycle, start, _read_ends(axis, low, high))


def _read_ends(axis: AxisMeasurement, low: float, high: float) -> tuple[float, Array, Array]:
    """Return time, s, deviations (end, freedom) and temperatures of a reading of both ends, forward and backward."""
    deviations = {}
    for position in (high, low):
        axis.move(position)
        axis.wait(axis.settings.settle)
        deviations[position] = axis.read(position)
        axis.wait(axis.settings.dwell - axis.settings.settle)
    return _now(axis), np.stack([deviations[low], deviations[high]]), axis.temperatures()


def _now(axis: AxisMeasurement) -> float:
    """Return the time of the control, or of this computer, s."""
    return float(axis.control.state().get("time", time.monotonic()))


def _dataset(axis: AxisMeasurement, cycle: Cycle, start: float, reading: tuple[float, Array, Array]) -> xr.Dataset:
    """Return the raw dataset of one reading; its time counts from ``start``, s."""
    now, x, T = reading
    variables: dict[str, Any] = {
        "end_deviation": (("cycle", "end", "freedom"), x[None]),
        "end_position": ("end", np.array(ends(axis.settings)), {"units": "m"}),
        "reading_time": ("cycle", np.array([now - start]), {"units": "s"}),
        "moving": ("cycle", np.array([float(cycle.moving)]), {"units": "1"}),
    }
    start_time = datetime.now(UTC).isoformat(timespec="seconds")
    return axis.dataset(variables, {}, x, (("cycle", "sensor"), T[None]), start_time)
