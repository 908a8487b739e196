"""Simulated raw data: cycles in which the virtual machine touches the balls on its table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import BenchError, MethodError
from errormotion.methods.normal_vector.schema import SCHEMA
from errormotion.plugins import replaced
from errormotion.twin import Event, VirtualMachine
from errormotion.twin.artefacts.balls import Balls, Probe

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import NormalVectorSettings

Moved = tuple[int, float, ArrayLike]

BALLS = 4
"""Number of balls where none is given."""
TOUCH_TIME = 6.0
"""Time from one touch to the next, s."""
STANDOFF = 5e-3
"""Distance from the surface at which a touch starts, m."""
WARM_UP_SPEED = 12000.0
"""Spindle speed during the warm-up where the settings have no schedule, 1/min."""
TRUTH_STEP = 20.0
"""Interval of the true errors, s."""
STREAM = 60
"""Number of the stream of random numbers."""

_M, _S = {"units": "m"}, {"units": "s"}
_AROUND_AND_TOP = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)], dtype=float)


def simulate(settings: NormalVectorSettings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return touches during a warm-up of the virtual machine, and its true errors relative to the cold cycle.

    ``tool_axes`` selects the machine: the gantry (``XYZ``) or the C-frame (``Z``). The balls are those of the virtual
    machine: four, or as many as the settings have if these are more.

    Parameters
    ----------
    settings : NormalVectorSettings
        Of these, ``tool_axes``, ``functional_point``, ``touches``, ``interval``, ``duration``, ``schedule`` and the
        number of ``balls`` are used.
    seed : int
        Selects the individual machine and the noise.

    Raises
    ------
    MethodError
        No virtual machine has these tool axes.
    """
    kinds = {"XYZ": "gantry", "Z": "cframe"}
    if settings.tool_axes not in kinds:
        raise MethodError(
            f"tool_axes: expected XYZ or Z for a simulation; found '{settings.tool_axes}'.",
            code="probing.tool_axes.form",
        )
    machine = VirtualMachine(kinds[settings.tool_axes], seed=seed)
    balls, touches = max(BALLS, len(settings.balls)), max(len(_AROUND_AND_TOP), settings.touches)
    cycle = TOUCH_TIME * balls * touches
    planned = [(event.at, event.spindle_speed) for event in settings.schedule] or [(0.0, WARM_UP_SPEED)]
    machine.start([Event(cycle + at, speed, None) for at, speed in planned])
    count = int(settings.duration / settings.interval + 1e-9) + 1
    data = raw(machine, settings.interval * np.arange(count), seed=seed, balls=balls, touches=touches)
    point = settings.functional_point
    if point is None:  # as in the identification: the mean of the centres probed in the cold cycle
        centre = machine.balls_on_table(balls).centre
        point = np.round((centre - machine.probe_error(centre, np.zeros(balls))).mean(axis=0), 4)
    steps = int((settings.interval * (count - 1) + cycle) / TRUTH_STEP) + 4
    truth = machine.truth_probing(cycle / 2 + TRUTH_STEP * np.arange(steps), point)
    over_time = {str(name): array.values for name, array in truth.data_vars.items() if array.dims == ("time",)}
    return data, replaced(truth, {name: values - values[0] for name, values in over_time.items()})


def truth_of(machine: VirtualMachine, errors: xr.Dataset, clock: float) -> xr.Dataset:
    """Return the true errors at the times of an error dataset with its time 0 at ``clock`` (s) of the machine."""
    truth = machine.truth_probing(errors["time"].values + clock, errors.attrs["functional_point"])
    return truth.assign_coords(time=("time", errors["time"].values, {"units": "s"}))


def raw(
    machine: VirtualMachine,
    times: ArrayLike,
    *,
    seed: int,
    balls: int = BALLS,
    touches: int = 5,
    cycle: float | None = None,
    variant: str = "touches",
    moved: Moved | None = None,
    missing: float = 0.0,
    noise: float | None = None,
) -> xr.Dataset:
    """Return a raw dataset of balls that a virtual machine probes in cycles during its current schedule.

    Parameters
    ----------
    machine : VirtualMachine
    times : (n,)
        Start of each cycle, s, increasing; the first cycle is the cold one and the reference.
    seed : int
        Seed of the noise only; machine and balls do not depend on it.
    balls : int
        1 to 8.
    touches : int
        Of each ball, 5 or more: four around it, one from above, the others from above at 45 degrees.
    cycle : float, optional
        Duration of a cycle, s; default 6 s for each touch.
    variant : {"touches", "centres"}
        Contacts, or the centres that a controller computes from them.
    moved : (int, float, (3,)), optional
        A ball (counted from 0) is displaced at a time, s, by a shift, m.
    missing : float
        Fraction of the touches (or centres) that are missing.
    noise : float, optional
        Standard deviation of the trigger, m; default that of the probe.

    Raises
    ------
    BenchError
        An argument is out of range.
    """
    cycles = Cycles.of(times, balls, touches, cycle, moved, missing)
    rng = np.random.default_rng([abs(machine.seed), STREAM, seed])
    table = machine.balls_on_table(balls)
    sigma = machine.probe.noise if noise is None else float(noise)
    ball, start, direction, t, shift = cycles.paths(table)
    scatter = sigma * rng.normal(size=cycles.shape).ravel()
    contacts = machine.trip_positions(ball, start, direction, t, table, scatter, shift).reshape(*cycles.shape, 3)
    variables: dict[str, Any] = {
        "temperature": (("time", "sensor"), machine.sensor_temperatures(cycles.times, seed=seed), {"units": "degC"}),
        "spindle_speed": ("time", machine.spindle_speed(cycles.times), {"units": "1/min"}),
        "feed": ("time", np.zeros(len(cycles.times)), {"units": "m/s"}),
        "ball_nominal": (("ball", "direction"), table.nominal, _M),
    }
    coords = {
        "time": ("time", cycles.times, _S),
        "ball": table.names,
        "direction": list("xyz"),
        "sensor": list(machine.temperature_sensors),
    }
    if variant == "touches":
        variables |= _touches(cycles, table, machine.probe, contacts, sigma, rng)
    elif variant == "centres":
        variables |= _centres(cycles, table, contacts, sigma, rng)
        coords["direction_"] = list("xyz")
    else:
        raise BenchError(f"variant: expected 'touches' or 'centres'; found {variant!r}.", code="simulation.variant")
    address = f"twin://{machine.kind}?seed={machine.seed}"
    attrs: Mapping[str, Any] = {
        "schema": SCHEMA,
        "machine": machine.name,
        "chain": machine.chain,
        "tool_axes": machine.tool_axes,
        "instruments": json.dumps([{"id": "virtual touch probe", "address": address, "simulated": True}]),
    }
    return xr.Dataset(variables, coords, attrs)


def touch_normals(count: int) -> Array:
    """Return the outward unit normals at which a ball is touched, (count, 3)."""
    if count < len(_AROUND_AND_TOP):
        raise BenchError(
            f"touches: expected {len(_AROUND_AND_TOP)} or more for each ball; found {count}.",
            code="simulation.touches.count",
        )
    more = count - len(_AROUND_AND_TOP)
    azimuth = np.pi / 4 + 2 * np.pi * np.arange(more) / max(more, 1)
    slanting = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(more)], axis=1) / np.sqrt(2)
    return np.vstack([_AROUND_AND_TOP, slanting])


@dataclass(frozen=True, eq=False)
class Cycles:
    """Times, balls and directions of all touches.

    Attributes
    ----------
    times : ndarray, (time,)
        Start of each cycle, s.
    normals : ndarray, (touch, 3)
        Outward unit normals at which each ball is touched.
    balls : int
    duration : float
        Of a cycle, s.
    moved : (int, float, (3,)) or None
        A ball that is displaced at a time, s, by a shift, m.
    missing : float
        Fraction of the touches that are missing.
    """

    times: Array
    normals: Array
    balls: int
    duration: float
    moved: Moved | None
    missing: float

    @classmethod
    def of(
        cls, times: ArrayLike, balls: int, touches: int, cycle: float | None, moved: Moved | None, missing: float
    ) -> Cycles:
        """Check the arguments."""
        starts = np.atleast_1d(np.asarray(times, dtype=float))
        duration = TOUCH_TIME * balls * touches if cycle is None else float(cycle)
        if not duration >= 0 or not np.all(np.isfinite(starts)) or np.any(np.diff(starts) < max(duration, 1e-9)):
            raise BenchError(
                f"times: expected increasing starts at least {duration:g} s apart, the duration of a cycle; found "
                f"{starts} s.",
                code="simulation.times.not_increasing",
            )
        if not 0 <= missing <= 1:
            raise BenchError(
                f"missing: expected a fraction from 0 to 1; found {missing:g}.", code="simulation.missing.fraction"
            )
        if moved is not None and not 0 <= moved[0] < balls:
            raise BenchError(
                f"moved: expected a ball from 0 to {balls - 1}; found {moved[0]}.", code="simulation.ball.number"
            )
        return cls(starts, touch_normals(touches), int(balls), duration, moved, float(missing))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of cycles, balls and touches."""
        return len(self.times), self.balls, len(self.normals)

    @property
    def touch_times(self) -> Array:
        """Time of each contact, s, (time, ball, touch)."""
        count = self.balls * len(self.normals)
        within = (np.arange(count) + 0.5) * self.duration / count
        return (self.times[:, None] + within).reshape(self.shape)

    def shifts(self) -> Array:
        """Return the displacement of the ball at each contact, m, (time, ball, touch, 3)."""
        shift = np.zeros((*self.shape, 3))
        if self.moved is not None:
            ball, time, displacement = self.moved
            shift[:, ball][self.touch_times[:, ball] >= time] = np.asarray(displacement, dtype=float)
        return shift

    def paths(self, balls: Balls) -> tuple[NDArray[np.intp], Array, Array, Array, Array]:
        """Return ball, start (m), unit direction, time (s) and shift of the ball (m) of all touches, (n,)."""
        ball = np.broadcast_to(np.arange(self.balls)[:, None], self.shape).ravel()
        normal = np.broadcast_to(self.normals, (*self.shape, 3)).reshape(-1, 3)
        start = balls.nominal[ball] + (balls.nominal_radius + STANDOFF) * normal
        return ball, start, -normal, self.touch_times.ravel(), self.shifts().reshape(-1, 3)


def _touches(
    cycles: Cycles, balls: Balls, probe: Probe, contacts: Array, noise: float, rng: np.random.Generator
) -> dict[str, Any]:
    lost = rng.uniform(size=cycles.shape) < cycles.missing
    flag = np.where(lost | np.isnan(contacts).any(axis=-1), 1, 0)  # no trip
    approach = np.broadcast_to(-cycles.normals, (cycles.balls, *cycles.normals.shape))
    dims = ("time", "ball", "touch")
    return {
        "touch": ((*dims, "direction"), np.where(flag[..., None] == 0, contacts, np.nan), _M),
        "touch_time": (dims, cycles.touch_times, _S),
        "touch_flag": (dims, flag.astype(np.int64), {"units": "1"}),
        "approach": (("ball", "touch", "direction"), approach.copy(), {"units": "1"}),
        "tip_radius": ((), probe.nominal_tip_radius, _M),
        "ball_radius": ("ball", np.full(cycles.balls, balls.nominal_radius), _M),
        "touch_noise": ((), noise, _M),
    }


def _centres(cycles: Cycles, balls: Balls, contacts: Array, noise: float, rng: np.random.Generator) -> dict[str, Any]:
    """Fit a sphere with free radius to the touches of each ball by least squares.

    The Jacobian is taken at the planned normals, which differ from the true ones by 10 mrad at most.
    """
    nominal = balls.nominal[:, None]
    offset = contacts - nominal
    J = np.hstack([cycles.normals, np.ones((len(cycles.normals), 1))])
    inverse = np.linalg.inv(J.T @ J)
    centre = np.zeros((len(cycles.times), cycles.balls, 3))
    for _ in range(20):  # the remaining error decreases by a factor of 100 in each iteration
        distance = np.linalg.norm(offset - centre[:, :, None], axis=-1)
        residual = distance - distance.mean(axis=-1, keepdims=True)
        centre += (residual @ J @ inverse)[..., :3]
    centre += balls.nominal
    centre[rng.uniform(size=centre.shape[:2]) < cycles.missing] = np.nan
    covariance = np.broadcast_to(noise**2 * inverse[:3, :3], (*centre.shape, 3))
    return {
        "centre": (("time", "ball", "direction"), centre, _M),
        "centre_covariance": (("time", "ball", "direction", "direction_"), covariance.copy(), {"units": "m^2"}),
    }
