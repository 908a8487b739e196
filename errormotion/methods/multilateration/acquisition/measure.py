"""Measurement: a tracker at one station after the other, and for each the machine goes to all targets.

An interferometer counts from the position at which its beam was last acquired. Where the beam breaks during a set-up,
the count restarts (Measurement.dead_path), and earlier readings have another dead path: these targets are visited
again. A repeated set-up, because it was poor or because of the settings, replaces the earlier one.
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
from errormotion.methods.multilateration.names import station_names, target_names
from errormotion.methods.multilateration.schema import SCHEMA

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from errormotion.methods.multilateration.settings import Measuring, Settings
    from errormotion.plugins import Bench

NO_VALUE = "no value"
_AIR = ("air_temperature", "air_pressure", "relative_humidity", "refractive_index")
_UNITS = {"displacement": "m", "reading_time": "s", **dict(zip(_AIR, ("degC", "Pa", "1", "1"), strict=True))}
LOST = "count lost"
_POLL_INTERVAL = 0.05  # s, real time
_FIT = 4
"""Readings from which the tracker's place and direction are reckoned."""
_FAR = 2.0
"""So many times nearer to another station's place than to its own: the tracker has not been moved."""
_THIN = 0.05
"""A spread of targets across their longest extent, relative to it, that is enough for that."""


def measure_stations(
    bench: Bench,
    settings: Settings,
    inputs: Mapping[str, xr.Dataset],  # noqa: ARG001 - the same for every method
    done: xr.Dataset | None,
    measuring: Measuring | None = None,
) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each set-up of the tracker, to be joined along ``station``.

    Parameters
    ----------
    bench : Bench
        With a ``laser_tracker`` (``measure``) and a ``controller`` (``move_to``, ``state``). A control that can also
        place the tracker (``set_station``, of a virtual machine) does; otherwise the operator is asked to.
    settings : Settings
    inputs : mapping
        Not used.
    done : Dataset, optional
        What an interrupted run holds: its set-ups are not measured again. A virtual machine that was restarted repeats
        them, without their data: the others are those of a run without interruption.
    measuring : Measuring, optional
        Default: that of the settings.

    Raises
    ------
    MethodError
        No instrument that can do it, a station that there is not, a tracker that stands at the place of another
        station, an axis that does not arrive.
    """
    stand = Stand(bench, settings, measuring or settings.measuring)
    held = deque(_held(done))
    repeats = False
    if done is not None:
        stand.air_reported = _AIR[0] in done
        last = float(np.nanmax(done["reading_time"].values, initial=-np.inf))
        repeats = hasattr(stand.control, "set_station") and stand.now() < last
    for number in stand.sequence:
        for _ in range(1 + stand.measuring.repeats):
            if held:
                name, share = held.popleft()
                if name != stand.names[number]:
                    raise MethodError(
                        f"The existing set-ups continue with {name}; expected {stand.names[number]}. Continue with "
                        "the sequence with which the run was started, or start a new run."
                    )
                if repeats:
                    stand.measure(number)
            else:
                chunk = stand.measure(number)
                share = _broken(chunk)[0]
                yield chunk
            if share <= stand.measuring.poor:
                break


def latest(raw: xr.Dataset) -> xr.Dataset:
    """Return raw data with the last set-up of each station alone; without names of stations, as they are."""
    if "station" not in raw.coords:
        return raw
    last = {str(name): j for j, name in enumerate(raw["station"].values)}
    kept = sorted(last.values())
    return raw if len(kept) == raw.sizes["station"] else raw.isel(station=kept)


def _held(done: xr.Dataset | None) -> list[tuple[str, float]]:
    if done is None:
        return []
    return list(zip(map(str, done["station"].values), _broken(done), strict=True))


def _broken(raw: xr.Dataset) -> list[float]:
    """Return for each set-up the share of targets without a reading."""
    missing = np.isnan(raw["displacement"].transpose("station", "target").values)
    return [float(share) for share in missing.mean(axis=1)]


class Stand:
    """Machine and tracker of a bench.

    Attributes
    ----------
    position, target : ndarray (m, 3)
        Axis positions, and places of the reflector there, m; returns at the end.
    order : list of int
        In which the targets are visited.
    sequence : list of int
        Stations in the order of their set-ups, from 0.
    """

    def __init__(self, bench: Bench, settings: Settings, measuring: Measuring) -> None:
        self.bench, self.settings, self.measuring = bench, settings, measuring
        self.tracker: Any = bench.of_kind("laser_tracker")
        if not hasattr(self.tracker, "measure"):
            raise MethodError(
                "Expected a tracker that measures one target at a time (measure); found one that reads earlier "
                "measurements. Import its table and identify it."
            )
        self.control: Any = bench.of_kind("controller") if bench.has_kind("controller") else None
        if not hasattr(self.control, "move_to"):
            raise MethodError(
                "Expected an instrument of kind 'controller' that can move the machine to a position (move_to); the "
                "bench has none. Add it, or import a table of the tracker."
            )
        self.position, self.target, self.order = tour(settings, measuring.returns)
        self.station = np.array(settings.layout.stations, np.float64)
        self.names = station_names(len(self.station))
        self.sequence = stations(settings, measuring)
        self.air_reported: bool | None = None  # not known before the first set-up
        self.scales = Scales(bench, measuring.scale_sensors)

    def place(self, number: int) -> None:
        """Have the tracker at a station, and the reflector at the first target."""
        self.move(self.order[0])
        if hasattr(self.control, "set_station"):
            self.control.set_station([float(x) for x in self.station[number]])
            return
        where = "({:.0f}, {:.0f}, {:.0f}) mm".format(*(self.station[number] * 1e3))
        self.bench.ask(
            f"Station {self.names[number]}: set up the tracker near {where} in the machine's coordinates, level it, "
            "turn the reflector to it and let it acquire the beam."
        )

    def move(self, i: int) -> None:
        """Move the machine to a target and wait until it has arrived and settled.

        Raises
        ------
        MethodError
            It does not arrive.
        """
        goal = [float(x) for x in self.position[i]]
        self.control.move_to(goal)
        limit = time.monotonic() + self.measuring.timeout
        while True:
            state = self.control.state()
            off = np.abs(np.array(state["position"], np.float64) - goal).max()
            if not state.get("running", False) and off <= self.measuring.arrival:
                break
            if time.monotonic() > limit:
                raise MethodError(
                    f"Target {i + 1}: the control is {off * 1e3:.4g} mm off after {self.measuring.timeout:g} s. Is the "
                    "feed held, or the position out of travel?"
                )
            time.sleep(_POLL_INTERVAL)
        self.wait(self.measuring.settle)

    def wait(self, seconds: float) -> None:
        """Let time pass: that of the machine, where it has its own."""
        if hasattr(self.control, "elapse"):
            self.control.elapse(seconds)
        else:
            time.sleep(seconds)

    def now(self) -> float:
        """Return the time of the control, or of this computer, s."""
        return float(self.control.state().get("time", steady()))

    def measure(self, number: int) -> xr.Dataset:
        """Set the tracker up at a station and return the raw dataset of it."""
        self.place(number)
        start = datetime.now(UTC).isoformat(timespec="seconds")
        setup = SetUp(self, number)
        found: dict[int, dict[int, tuple[float, Any]]] = {}  # by dead path, then by target
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
            if found and count not in found and len(found) <= self.measuring.renewals:
                queue.extend(k for k in self.order if k in found[last])
            found.setdefault(count, {})[i] = (self.now(), reading)
            last = count
        self.scales.poll()
        kept = max(found.values(), key=len, default={})
        invalid = Counter(reasons.get(i, LOST) for i in self.order if i not in kept)
        return self._dataset(number, kept, invalid, start)

    def _dataset(
        self, number: int, found: dict[int, tuple[float, Any]], invalid: Counter[str], start: str
    ) -> xr.Dataset:
        size, m = len(self.target), {"units": "m"}
        values = {name: np.full(size, np.nan) for name in _UNITS}
        for i, (when, reading) in found.items():
            air = reading.environment
            row = (reading.distance, when, air.temperature, air.pressure, air.humidity / 100, reading.refraction_index)
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
            **self.scales.taken(),
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
        """Return whether the state of the air is recorded: with all set-ups, or with none."""
        read = np.isfinite(values["displacement"])
        reported = all(np.isfinite(values[name][read]).all() for name in _AIR)
        if self.air_reported is None:
            self.air_reported = reported and bool(read.any())
        if self.air_reported and not reported:
            raise MethodError(
                f"Station {self.names[number]}: the tracker no longer reports the state of the air, as it did at the "
                "first. Check its weather station, and resume."
            )
        return self.air_reported

    def noise(self) -> float:
        """Return the standard deviation of a reading, m: of the tracker, else of the settings."""
        stated = getattr(self.tracker.settings, "noise", None)
        return float(stated or self.settings.layout.displacement_noise)


class SetUp:
    """A tracker at one station, and the pose of the machine in its frame where readings determine it."""

    def __init__(self, stand: Stand, number: int) -> None:
        self.stand, self.number = stand, number
        self.follows = bool(getattr(stand.tracker, "distance_is_displacement", True))
        self._machine: list[Array] = []
        self._seen: list[Array] = []
        self._checked = False

    def read(self, i: int) -> Any:
        """Measure a target; where the beam is broken, look for the reflector where it has to be."""
        tracker, goal = self.stand.tracker, self.goal(self.stand.target[i])
        # A tracker that follows the reflector is there already, and goes on counting.
        reading = tracker.measure() if self.follows else tracker.measure(goal)
        for _ in range(self.stand.measuring.attempts):
            if reading.valid:
                break
            reading = tracker.measure(goal)
        if reading.valid and np.isfinite(reading.position).all():
            self._machine.append(self.stand.target[i])
            self._seen.append(np.array(reading.position, np.float64))
            self._check()
        return reading

    def goal(self, place: Array) -> tuple[float, float, float] | None:
        """Return a place of the machine in the tracker's frame, m; None while nothing is known of that."""
        if not self._seen:
            return None
        R, shift = self._pose() or self._levelled()
        x, y, z = R @ place + shift
        return float(x), float(y), float(z)

    def _levelled(self) -> tuple[Array, Array]:
        """Return the tracker's frame from one reading: upright, at its nominal place."""
        station = self.stand.station[self.number]
        way, seen = self._machine[-1] - station, self._seen[-1]
        turn = np.arctan2(seen[1], seen[0]) - np.arctan2(way[1], way[0])
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return R, -R @ station

    def _pose(self) -> tuple[Array, Array] | None:
        """Return the tracker's frame as rotation and shift from places of the machine; None from too few readings."""
        if len(self._seen) < _FIT:
            return None
        a, b = np.array(self._machine), np.array(self._seen)
        extent = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
        if extent[1] < _THIN * extent[0]:
            return None
        U, _, Vt = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        return R, b.mean(axis=0) - R @ a.mean(axis=0)

    def _check(self) -> None:
        """Refuse a tracker at the position of another station, as soon as that is determined.

        Raises
        ------
        MethodError
        """
        if self._checked or (pose := self._pose()) is None:
            return
        self._checked = True
        here = -pose[0].T @ pose[1]
        off = np.linalg.norm(self.stand.station - here, axis=1)
        nearest = int(off.argmin())
        if nearest != self.number and off[self.number] > _FAR * max(
            off[nearest], self.stand.settings.station_tolerance
        ):
            names = self.stand.names
            raise MethodError(
                f"Set-up {names[self.number]}: the tracker is near ({here[0]:.2f}, {here[1]:.2f}, {here[2]:.2f}) "
                f"m, the position of {names[nearest]}. Move it to its position and resume, or correct layout.stations."
            )
