"""Measurement: the control moves the axis to each target in the planned order, and the target is read at rest.

The instrument is set to zero at the first target, approached forward. After a broken beam, readings are missing until
the next such approach. Linear cycles yield one dataset per run, pendulum cycles one per target.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import clock
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF, direction_of, iso_names
from errormotion.methods.linear_positioning.acquisition.instruments import Reader, axis_reader
from errormotion.methods.linear_positioning.planning.motions import stops
from errormotion.methods.linear_positioning.planning.targets import Approach, positions, sequence
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA, SENSORS
from errormotion.plugins.virtual import is_virtual, wait

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings
    from errormotion.plugins import Bench

_POLL_INTERVAL = 0.05  # s, real time
_M = {"units": "m"}


def measure_axis(bench: Bench, settings: LinearPositioningSettings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each run, or for each target of a pendulum cycle.

    Parameters
    ----------
    bench : Bench
        With a ``controller`` (``move_to``, ``state``) and an ``interferometer`` or a ``laser_tracker``; a
        ``thermometer``, where the settings name sensors.
    settings : LinearPositioningSettings
    done : Dataset, optional
        Data of an interrupted run, which are not measured again. The instrument is then set to zero again. A virtual
        machine that was restarted repeats them, without their data.

    Raises
    ------
    MethodError
        The bench lacks an instrument, the test would exceed the limits, or the axis does not reach a target.
    """
    list(stops(settings))  # checks the limits before the axis moves
    axis = AxisMeasurement(bench, settings)
    along_runs = settings.cycle == "linear"
    first, finished = axis.to_repeat(done, "run" if along_runs else "target")
    parts = groupby(sequence(settings), key=lambda approach: approach.run if along_runs else approach.target)
    for number, part in parts:
        if number < first:
            continue
        measured = axis.measure(list(part), along_runs)
        if number >= finished:
            yield measured


class Motion:
    """The control of a bench, with moves that wait for the arrival."""

    def __init__(self, bench: Bench, settings: LinearPositioningSettings) -> None:
        self.bench, self.settings = bench, settings
        self.control: Any = bench.of_kind("controller") if bench.has_kind("controller") else None
        if not hasattr(self.control, "move_to"):
            raise MethodError(
                "Expected an instrument of kind 'controller' that can move the axis to a position (move_to); the bench "
                "has none. Run the NC program, write the readings to a table, and use 'errormotion identify FILE'.",
                code="bench.controller.no_moves",
            )

        self.origin: float | None = None
        """Time of a simulated control at the start of the measurement, s; None before it, and for a real one."""

    def to_repeat(self, done: xr.Dataset | None, dim: str) -> tuple[int, int]:
        """Return the number of the first part to measure, and of the first one to yield, along a dimension.

        A virtual machine that was restarted repeats the parts of an interrupted test, so that the others are those of
        a test without interruption: its errors and its noise depend on what was done before.
        """
        finished = 0 if done is None else int(done.sizes[dim])
        if is_virtual(self.control):
            self.origin = float(self.control.state()["time"])
        repeats = done is not None and self.origin is not None and clock.restarted(done, self.origin)
        return (0 if repeats else finished), finished

    def move_to(self, position: Array, feed: float | None = None) -> None:
        """Move to a position (3,), m, at the feed of the approaches or another, and wait until the axes have arrived.

        Raises
        ------
        MethodError
            The axes have not arrived within the timeout.
        """
        self.control.move_to([float(value) for value in position], self.settings.feed if feed is None else feed)
        deadline = time.monotonic() + self.settings.timeout
        while True:
            state = self.control.state()
            off = np.abs(np.array(state["position"], np.float64) - position)
            if not state.get("running", False) and off.max() <= self.settings.arrival:
                return
            if time.monotonic() > deadline:
                k = int(off.argmax())
                raise MethodError(
                    f"{'XYZ'[k]} {position[k] * 1e3:.3f} mm: the axis is {off[k] * 1e3:.4g} mm from this position "
                    f"after {self.settings.timeout:g} s. Check for feed hold, and that the position is within the "
                    "travel.",
                    code="machine.position.not_reached",
                )
            time.sleep(_POLL_INTERVAL)

    def wait(self, seconds: float) -> None:
        """Wait, in the time of the control where it is simulated, else in real time."""
        wait(self.control, seconds)


class AxisMeasurement(Motion):
    """Machine and instrument of a bench, for one axis."""

    def __init__(self, bench: Bench, settings: LinearPositioningSettings, zero: float | None = None) -> None:
        super().__init__(bench, settings)
        self.reader = axis_reader(bench, settings)
        self.targets = positions(settings)
        self.zero = float(self.targets[0]) if zero is None else zero  # position at which the instrument is set to zero
        self.along = DOF[direction_of(settings.axis)]
        self.sensors = (*settings.machine.sensors, *settings.workpiece.sensors)
        self.thermometer = self._thermometer()

    def measure(self, approaches: list[Approach], along_runs: bool) -> xr.Dataset:
        """Return the raw dataset of the approaches of one run, or of one target."""
        start = datetime.now(UTC).isoformat(timespec="seconds")
        runs = 1 if along_runs else self.settings.runs
        targets = self.targets.size if along_runs else 1
        x = np.full((len(self.settings.freedoms), runs, 2, targets), np.nan)
        T = np.full((runs, 2, targets, len(self.sensors)), np.nan)
        for approach in approaches:
            if approach.before is not None:
                self.move(approach.before)
            self.move(approach.position)
            self.wait(self.settings.settle)
            index = (0 if along_runs else approach.run, approach.direction, approach.target if along_runs else 0)
            if (approach.target, approach.direction) == (0, 0) and self.reader.lost:
                self.reader.zero()
            x[(slice(None), *index)] = self.read(approach.position)
            T[index] = self.temperatures()
            self.wait(self.settings.dwell - self.settings.settle)
        return self._dataset(x, T, approaches, along_runs, start)

    def read(self, position: float) -> Array:
        """Return the deviations (freedom,) at a position, m and rad; NaN while there is no zero."""
        distance = position - self.zero
        if self.reader.lost:
            return np.full(len(self.settings.freedoms), np.nan)
        values = self.reader.read(distance).copy()
        if self.along in self.settings.freedoms:
            values[self.settings.freedoms.index(self.along)] -= distance
        return np.asarray(values)

    def move(self, position: float, feed: float | None = None) -> None:
        """Move the axis to a position, m, as `move_to` does; the other axes are at their positions in ``start``."""
        target = np.array(self.settings.start, np.float64)
        target[direction_of(self.settings.axis)] = position
        self.move_to(target, feed)

    def temperatures(self) -> Array:
        """Return the present temperatures of the sensors, degC; NaN where unknown."""
        if self.thermometer is None:
            return np.full(len(self.sensors), np.nan)
        read = self.thermometer.read()
        return np.array([read.get(name, np.nan) for name in self.sensors], np.float64)

    def _thermometer(self) -> Any:
        if not self.sensors:
            return None
        if not self.bench.has_kind("thermometer"):
            raise MethodError(
                f"machine.sensors, workpiece.sensors: expected an instrument of kind 'thermometer' on the bench for "
                f"{', '.join(self.sensors)}; found none. Add it, or leave the sensors out.",
                code="bench.thermometer.missing",
            )
        thermometer = self.bench.of_kind("thermometer")
        if missing := [name for name in self.sensors if name not in thermometer.channels]:
            raise MethodError(
                f"machine.sensors, workpiece.sensors: expected channels of the thermometer, "
                f"{', '.join(thermometer.channels)}; found {', '.join(missing)}.",
                code="bench.thermometer.channels",
            )
        return thermometer

    def _dataset(self, x: Array, T: Array, approaches: list[Approach], along_runs: bool, start: str) -> xr.Dataset:
        targets = self.targets if along_runs else self.targets[[approaches[0].target]]
        variables: dict[str, Any] = {
            "deviation": (READINGS, x),
            "target_position": ("target", targets, _M),
            "zero_position": ((), self.zero, _M),
        }
        return self.dataset(variables, {"approach": list(APPROACHES)}, x, (SENSORS, T), start)

    def dataset(
        self,
        variables: dict[str, Any],
        labels: dict[str, Any],
        x: Array,
        temperatures: tuple[tuple[str, ...], Array],
        start: str,
    ) -> xr.Dataset:
        """Return a raw dataset of readings ``x`` and temperatures (dims, values), with what the settings state."""
        settings = self.settings
        names = iso_names(settings.axis)
        coords = {"freedom": [names[name] for name in settings.freedoms], **labels}
        if settings.functional_point is not None:
            variables["functional_point"] = ("direction", np.array(settings.functional_point), _M)
            coords["direction"] = list("xyz")
        if self.sensors:
            variables["temperature"] = (*temperatures, {"units": "degC"})
            coords["sensor"] = list(self.sensors)
        attrs = {"schema": SCHEMA, "axis": settings.axis, **measured_attrs(self, self.reader, x, start)}
        return xr.Dataset(variables, coords, attrs)


def measured_attrs(motion: Motion, reader: Reader, x: Array, start: str) -> dict[str, Any]:
    """Return the attributes that state where, when and how readings ``x`` were taken, and how many are missing."""
    missing = int(np.isnan(x).sum())
    return {
        "machine": motion.bench.machine,
        "instrument": reader.id,
        **({} if motion.origin is None else {clock.ORIGIN: motion.origin}),
        "start": start,
        "dropped": 0,
        "invalid": {"beam broken": missing} if missing else {},
    }
