"""Measurement: a tracker is set up at one station after the other; for each, the machine moves to all targets.

An interferometer counts from the position at which its beam was last acquired. If the beam breaks during a set-up, the
count restarts (Measurement.dead_path), and earlier readings have another dead path: these targets are visited again. A
set-up that is repeated, because it was poor or because of the settings, replaces the earlier one.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.clock import steady
from errormotion.errors import MethodError
from errormotion.methods.multilateration.acquisition.motions import stations, tour
from errormotion.methods.multilateration.acquisition.scales import Scales
from errormotion.methods.multilateration.readings import station_names, target_names
from errormotion.methods.multilateration.schema import SCHEMA
from errormotion.plugins.virtual import is_virtual, wait

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from errormotion.methods.multilateration.settings import Measuring, MultilaterationSettings
    from errormotion.plugins import Bench

NO_VALUE = "no value"
_AIR = ("air_temperature", "air_pressure", "relative_humidity", "refractive_index")
_UNITS = {"displacement": "m", "reading_time": "s", **dict(zip(_AIR, ("degC", "Pa", "1", "1"), strict=True))}
LOST = "count lost"
_POLL_INTERVAL = 0.05  # s, real time
_MIN_READINGS = 4
"""Readings from which on position and direction of the tracker are determined."""
_MIN_SPREAD = 0.05
"""Spread of their targets across the longest extent, relative to it, that is required for this."""
_WRONG_STATION = 2.0
"""Ratio of the distances to its own station and to another one, above which the tracker has not been moved."""


def measure_stations(
    bench: Bench,
    settings: MultilaterationSettings,
    inputs: Mapping[str, xr.Dataset],  # noqa: ARG001 - the same for every method
    done: xr.Dataset | None,
    measuring: Measuring | None = None,
) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each set-up of the tracker, to be joined along ``station``.

    Parameters
    ----------
    bench : Bench
        With a ``laser_tracker`` (``measure``) and a ``controller`` (``move_to``, ``state``). The operator is requested
        to place the tracker; a virtual machine does it.
    settings : MultilaterationSettings
    inputs : mapping
        Not used.
    done : Dataset, optional
        Data of an interrupted run, whose set-ups are not measured again. A virtual machine that was restarted repeats
        them and discards the data, so that the other set-ups are those of a run without interruption.
    measuring : Measuring, optional
        Default: that of the settings.

    Raises
    ------
    MethodError
        The bench lacks an instrument, a station does not exist, the tracker is at the position of another station, or
        an axis does not reach a target.
    """
    setups = SetUps(bench, settings, measuring or settings.measuring)
    finished = deque([] if done is None else zip(map(str, done["station"].values), _broken(done), strict=True))
    repeats = False
    if done is not None:
        setups.air_reported = _AIR[0] in done
        last = float(np.nanmax(done["reading_time"].values, initial=-np.inf))
        repeats = is_virtual(setups.control) and setups.now() < last
    for number in setups.sequence:
        for _ in range(1 + setups.measuring.repeats):
            if finished:
                name, share = finished.popleft()
                if name != setups.names[number]:
                    raise MethodError(
                        f"Expected the next existing set-up at {setups.names[number]}; found {name}. Continue with the "
                        "sequence with which the run was started, or start a new run.",
                        code="network.sequence.changed",
                    )
                if repeats:
                    setups.measure(number)
            else:
                raw = setups.measure(number)
                share = _broken(raw)[0]
                yield raw
            if share <= setups.measuring.poor:
                break


def _broken(raw: xr.Dataset) -> list[float]:
    """Return for each set-up the share of targets without a reading."""
    missing = np.isnan(raw["displacement"].transpose("station", "target").values)
    return [float(share) for share in missing.mean(axis=1)]


class SetUps:
    """Machine and tracker of a bench, for all set-ups.

    Attributes
    ----------
    position, target : ndarray (m, 3)
        Axis positions, and positions of the reflector there, m; targets that are visited again at the end.
    order : list of int
        Of the visits to the targets.
    sequence : list of int
        Stations in the order of their set-ups, from 0.
    """

    def __init__(self, bench: Bench, settings: MultilaterationSettings, measuring: Measuring) -> None:
        self.bench, self.settings, self.measuring = bench, settings, measuring
        self.tracker: Any = bench.of_kind("laser_tracker")
        if not hasattr(self.tracker, "measure"):
            raise MethodError(
                "Expected a tracker that measures one target at a time (measure); found one that imports "
                "measurements. Import its table and identify it.",
                code="network.tracker.imports",
            )
        self.control: Any = bench.of_kind("controller") if bench.has_kind("controller") else None
        if not hasattr(self.control, "move_to"):
            raise MethodError(
                "Expected an instrument of kind 'controller' that can move the machine to a position (move_to); the "
                "bench has none. Add it, or import a table of the tracker.",
                code="bench.controller.no_moves",
            )
        self.position, self.target, self.order = tour(settings, measuring.returns)
        self.station = np.array(settings.layout.stations, np.float64)
        self.names = station_names(len(self.station))
        self.sequence = stations(settings, measuring)
        self.air_reported: bool | None = None  # unknown before the first set-up
        self.scales = Scales(bench, measuring.scale_sensors)

    def place(self, number: int) -> None:
        """Place the tracker at a station, with the reflector at the first target."""
        self.move(self.order[0])
        position = "({:.0f}, {:.0f}, {:.0f}) mm".format(*(self.station[number] * 1e3))
        self.bench.ask(
            f"Station {self.names[number]}: set up the tracker near {position} in machine coordinates, level it, turn "
            "the reflector towards it, and acquire the beam.",
            "set_station",
            position=[float(x) for x in self.station[number]],
        )

    def move(self, i: int) -> None:
        """Move the machine to a target and wait until it has arrived and settled.

        Raises
        ------
        MethodError
            The machine has not arrived within the timeout.
        """
        position = [float(x) for x in self.position[i]]
        self.control.move_to(position)
        deadline = time.monotonic() + self.measuring.timeout
        while True:
            state = self.control.state()
            off = np.abs(np.array(state["position"], np.float64) - position).max()
            if not state.get("running", False) and off <= self.measuring.arrival:
                break
            if time.monotonic() > deadline:
                raise MethodError(
                    f"Target {i + 1}: the machine is {off * 1e3:.4g} mm from this position after "
                    f"{self.measuring.timeout:g} s. Check for feed hold, and that the position is within the travel.",
                    code="machine.position.not_reached",
                )
            time.sleep(_POLL_INTERVAL)
        self.wait(self.measuring.settle)

    def wait(self, seconds: float) -> None:
        """Wait, in the time of the control where it is simulated, else in real time."""
        wait(self.control, seconds)

    def now(self) -> float:
        """Return the time of the control, or of this computer, s."""
        return float(self.control.state().get("time", steady()))

    def measure(self, number: int) -> xr.Dataset:
        """Set up the tracker at a station, and return the raw dataset of this set-up."""
        self.place(number)
        start = datetime.now(UTC).isoformat(timespec="seconds")
        setup = SetUp(self, number)
        readings: dict[int, dict[int, tuple[float, Any]]] = {}  # by dead path, then by target
        reasons: dict[int, str] = {}
        queue, last = deque(self.order), 0
        self.scales.poll()
        while queue:
            i = queue.popleft()
            self.move(i)
            reading = setup.read(i)
            if not reading.valid:
                reasons[i] = reading.reason or NO_VALUE
                continue
            count = int(getattr(reading, "dead_path", 0))
            if readings and count not in readings and len(readings) <= self.measuring.renewals:
                queue.extend(k for k in self.order if k in readings[last])
            readings.setdefault(count, {})[i] = (self.now(), reading)
            last = count
        self.scales.poll()
        kept = max(readings.values(), key=len, default={})
        invalid = Counter(reasons.get(i, LOST) for i in self.order if i not in kept)
        return self._dataset(number, kept, invalid, start)

    def _dataset(
        self, number: int, readings: dict[int, tuple[float, Any]], invalid: Counter[str], start: str
    ) -> xr.Dataset:
        size, m = len(self.target), {"units": "m"}
        values = {name: np.full(size, np.nan) for name in _UNITS}
        for i, (now, reading) in readings.items():
            air = reading.environment
            row = (reading.distance, now, air.temperature, air.pressure, air.humidity / 100, reading.refraction_index)
            for name, value in zip(_UNITS, row, strict=True):
                values[name][i] = value
        wanted = list(_UNITS) if self._reports_air(number, values) else ["displacement", "reading_time"]
        variables: dict[str, Any] = {
            name: (("station", "target"), values[name][None], {"units": _UNITS[name]}) for name in wanted
        }
        variables |= {
            "target_nominal": (("target", "direction"), self.target, m),
            "station_nominal": (("station", "direction"), self.station[number : number + 1], m),
            "reflector": (("target", "direction"), self.target - self.position, m),
            "displacement_noise": ((), self.noise(), m),
            **self.scales.mean(),
        }
        attrs: dict[str, Any] = {
            "schema": SCHEMA,
            "machine": self.bench.machine,
            "tracker": type(self.tracker).info.id,
            "start": start,
            "dropped": 0,
            "invalid": dict(invalid),
        }
        if self.settings.chain is not None:
            attrs["chain"] = self.settings.chain
        coords = {
            "station": [self.names[number]],
            "target": target_names(size),
            "direction": list("xyz"),
        }
        return xr.Dataset(variables, coords, attrs)

    def _reports_air(self, number: int, values: dict[str, Array]) -> bool:
        """Return whether the state of the air is recorded: in all set-ups, or in none."""
        read = np.isfinite(values["displacement"])
        reported = all(np.isfinite(values[name][read]).all() for name in _AIR)
        if self.air_reported is None:
            self.air_reported = reported and bool(read.any())
        if self.air_reported and not reported:
            raise MethodError(
                f"Station {self.names[number]}: expected the state of the air from the tracker, as in earlier "
                "set-ups; found none. Check its weather station, and resume.",
                code="network.air.missing",
            )
        return self.air_reported

    def noise(self) -> float:
        """Return the standard deviation of a reading, m: that of the tracker, or else of the settings."""
        stated = getattr(self.tracker.settings, "noise", None)
        return float(stated or self.settings.layout.displacement_noise)


class SetUp:
    """A tracker at one station, and the pose of the machine in its frame as far as readings determine it."""

    def __init__(self, setups: SetUps, number: int) -> None:
        self.setups, self.number = setups, number
        self.follows = bool(getattr(setups.tracker, "distance_is_displacement", True))
        self._targets: list[Array] = []  # m, in the frame of the machine
        self._measured: list[Array] = []  # m, in the frame of the tracker
        self._checked = False

    def read(self, i: int) -> Any:
        """Measure a target; if the beam is broken, search the reflector at its expected position."""
        tracker, expected = self.setups.tracker, self.expected(self.setups.target[i])
        # A tracker that follows the reflector points at it already, and continues to count.
        reading = tracker.measure() if self.follows else tracker.measure(expected)
        for _ in range(self.setups.measuring.attempts):
            if reading.valid:
                break
            reading = tracker.measure(expected)
        if reading.valid and np.isfinite(reading.position).all():
            self._targets.append(self.setups.target[i])
            self._measured.append(np.array(reading.position, np.float64))
            self._check()
        return reading

    def expected(self, target: Array) -> tuple[float, float, float] | None:
        """Return a position of the machine in the tracker's frame, m; None before the first reading."""
        if not self._measured:
            return None
        R, shift = self._pose() or self._levelled()
        x, y, z = R @ target + shift
        return float(x), float(y), float(z)

    def _levelled(self) -> tuple[Array, Array]:
        """Return the tracker's frame from one reading: levelled, at its nominal position."""
        station = self.setups.station[self.number]
        nominal, measured = self._targets[-1] - station, self._measured[-1]
        angle = np.arctan2(measured[1], measured[0]) - np.arctan2(nominal[1], nominal[0])
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return R, -R @ station

    def _pose(self) -> tuple[Array, Array] | None:
        """Return rotation and shift from the machine's to the tracker's frame; None from too few readings."""
        if len(self._measured) < _MIN_READINGS:
            return None
        a, b = np.array(self._targets), np.array(self._measured)
        extent = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
        if extent[1] < _MIN_SPREAD * extent[0]:
            return None
        U, _, Vt = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        return R, b.mean(axis=0) - R @ a.mean(axis=0)

    def _check(self) -> None:
        """Raise MethodError for a tracker at the position of another station, once its position is determined."""
        if self._checked or (pose := self._pose()) is None:
            return
        self._checked = True
        position = -pose[0].T @ pose[1]
        off = np.linalg.norm(self.setups.station - position, axis=1)
        nearest = int(off.argmin())
        tolerance = self.setups.settings.station_tolerance
        if nearest != self.number and off[self.number] > _WRONG_STATION * max(off[nearest], tolerance):
            names, at = self.setups.names, "({:.2f}, {:.2f}, {:.2f}) m".format(*position)
            raise MethodError(
                f"Set-up {names[self.number]}: the tracker is near {at}, the position of {names[nearest]}. Move it to "
                f"the position of {names[self.number]} and resume, or correct layout.stations.",
                code="network.tracker.elsewhere",
            )
