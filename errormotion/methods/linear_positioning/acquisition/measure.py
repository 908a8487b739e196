"""Measurement: the control takes the axis through the approaches of the plan, and each target is read at rest.

The instrument is set to zero at the first target, approached forward. Where a beam breaks, the readings up to the next
such approach are missing. Linear cycles yield one dataset a run, pendulum cycles one a target.
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
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF, direction_of, iso_names
from errormotion.methods.linear_positioning.acquisition.instruments import reader
from errormotion.methods.linear_positioning.planning.motions import stops
from errormotion.methods.linear_positioning.planning.targets import Approach, positions, sequence
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA, SENSORS

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings
    from errormotion.plugins import Bench

_POLL_INTERVAL = 0.05  # s, real time
_M = {"units": "m"}


def measure_axis(bench: Bench, settings: Settings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each run, or for each target of a pendulum cycle.

    Parameters
    ----------
    bench : Bench
        With a ``controller`` (``move_to``, ``state``) and an ``interferometer`` or a ``laser_tracker``; a
        ``thermometer``, where the settings name sensors.
    settings : Settings
    done : Dataset, optional
        Data of an interrupted run, which are not measured again. The instrument is then set to zero once more.

    Raises
    ------
    MethodError
        No instrument that can do it, limits that the test would leave, an axis that does not arrive.
    """
    list(stops(settings))  # the limits, before anything moves
    stand = Stand(bench, settings)
    along_runs = settings.cycle == "linear"
    finished = 0 if done is None else int(done.sizes["run" if along_runs else "target"])
    parts = groupby(sequence(settings), key=lambda each: each.run if along_runs else each.target)
    for number, part in parts:
        if number >= finished:
            yield stand.measure(list(part), along_runs)


class Motion:
    """The control of a bench: it moves to positions and lets time pass."""

    def __init__(self, bench: Bench, settings: Settings) -> None:
        self.bench, self.settings = bench, settings
        self.control: Any = bench.of_kind("controller") if bench.has_kind("controller") else None
        if not hasattr(self.control, "move_to"):
            raise MethodError(
                "Expected an instrument of kind 'controller' that can move the axis to a position (move_to); the bench "
                "has none. Run the NC program, write the readings to a table, and use 'errormotion identify FILE'."
            )

    def go(self, goal: Array, feed: float | None = None) -> None:
        """Move to a position (3,), m, with the feed of the approaches or another, and wait until the axes have arrived.

        Raises
        ------
        MethodError
            They do not arrive.
        """
        self.control.move_to([float(value) for value in goal], self.settings.feed if feed is None else feed)
        limit = time.monotonic() + self.settings.timeout
        while True:
            state = self.control.state()
            off = np.abs(np.array(state["position"], np.float64) - goal)
            if not state.get("running", False) and off.max() <= self.settings.arrival:
                return
            if time.monotonic() > limit:
                k = int(off.argmax())
                raise MethodError(
                    f"{'XYZ'[k]} {goal[k] * 1e3:.3f} mm: the control is {off[k] * 1e3:.4g} mm off after "
                    f"{self.settings.timeout:g} s. Is the feed held, or the position out of travel?"
                )
            time.sleep(_POLL_INTERVAL)

    def wait(self, seconds: float) -> None:
        """Let time pass: that of the machine, where it has its own."""
        if hasattr(self.control, "elapse"):
            self.control.elapse(seconds)
        else:
            time.sleep(seconds)


class Stand(Motion):
    """Machine and instrument of a bench, for one axis."""

    def __init__(self, bench: Bench, settings: Settings, zero: float | None = None) -> None:
        super().__init__(bench, settings)
        self.reader = reader(bench, settings)
        self.places = positions(settings)
        self.zero = float(self.places[0]) if zero is None else zero  # position at which the instrument is set to zero
        self.along = DOF[direction_of(settings.axis)]
        self.sensors = (*settings.machine.sensors, *settings.workpiece.sensors)
        self.thermometer = self._thermometer()
        self.fresh = True

    def measure(self, approaches: list[Approach], along_runs: bool) -> xr.Dataset:
        """Return the raw dataset of some approaches: those of one run, or of one target."""
        start = datetime.now(UTC).isoformat(timespec="seconds")
        runs = 1 if along_runs else self.settings.runs
        targets = self.places.size if along_runs else 1
        x = np.full((len(self.settings.freedoms), runs, 2, targets), np.nan)
        T = np.full((runs, 2, targets, len(self.sensors)), np.nan)
        for each in approaches:
            if each.before is not None:
                self.move(each.before)
            self.move(each.place)
            self.wait(self.settings.settle)
            where = (0 if along_runs else each.run, each.approach, each.target if along_runs else 0)
            if (each.target, each.approach) == (0, 0) and (self.fresh or self.reader.lost):
                self.reader.zero()
                self.fresh = False
            x[(slice(None), *where)] = self.read(each.place)
            T[where] = self.temperatures()
            self.wait(self.settings.dwell - self.settings.settle)
        return self._dataset(x, T, approaches, along_runs, start)

    def read(self, place: float) -> Array:
        """Return the deviations (freedom,) at a position, m and rad; NaN while there is no zero."""
        way = place - self.zero
        if self.fresh or self.reader.lost:
            return np.full(len(self.settings.freedoms), np.nan)
        values = self.reader.read(way).copy()
        if self.along in self.settings.freedoms:
            values[self.settings.freedoms.index(self.along)] -= way
        return np.asarray(values)

    def move(self, place: float, feed: float | None = None) -> None:
        """Move the axis to a position, m, with the feed of the approaches or another, and wait until it has arrived.

        Raises
        ------
        MethodError
            It does not arrive.
        """
        goal = np.array(self.settings.start, np.float64)
        goal[direction_of(self.settings.axis)] = place
        self.go(goal, feed)

    def temperatures(self) -> Array:
        """Return the temperatures of the sensors now, degC; NaN where unknown."""
        if self.thermometer is None:
            return np.full(len(self.sensors), np.nan)
        found = self.thermometer.read()
        return np.array([found.get(name, np.nan) for name in self.sensors], np.float64)

    def _thermometer(self) -> Any:
        if not self.sensors:
            return None
        if not self.bench.has_kind("thermometer"):
            raise MethodError(
                f"Sensors {', '.join(self.sensors)} (machine.sensors, workpiece.sensors) need an instrument of kind "
                "'thermometer' on the bench; there is none. Add it, or leave them out."
            )
        found = self.bench.of_kind("thermometer")
        if missing := [name for name in self.sensors if name not in found.channels]:
            raise MethodError(
                f"machine.sensors, workpiece.sensors: the thermometer has no {', '.join(missing)}; expected names from "
                f"{', '.join(found.channels)}."
            )
        return found

    def _dataset(self, x: Array, T: Array, approaches: list[Approach], along_runs: bool, start: str) -> xr.Dataset:
        settings = self.settings
        names = iso_names(settings.axis)
        places = self.places if along_runs else self.places[[approaches[0].target]]
        variables: dict[str, Any] = {
            "deviation": (READINGS, x),
            "target_position": ("target", places, _M),
            "zero_position": ((), self.zero, _M),
        }
        coords: dict[str, Any] = {
            "freedom": [names[name] for name in settings.freedoms],
            "approach": list(APPROACHES),
        }
        if settings.functional_point is not None:
            variables["functional_point"] = ("direction", np.array(settings.functional_point), _M)
            coords["direction"] = list("xyz")
        if self.sensors:
            variables["temperature"] = (SENSORS, T, {"units": "degC"})
            coords["sensor"] = list(self.sensors)
        missing = int(np.isnan(x).sum())
        attrs = {
            "schema": SCHEMA,
            "axis": settings.axis,
            "machine": self.bench.machine,
            "instrument": self.reader.id,
            "start": start,
            "dropped": 0,
            "invalid": {"beam broken": missing} if missing else {},
        }
        return xr.Dataset(variables, coords, attrs)
