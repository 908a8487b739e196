"""Raw data of a virtual machine, and its true errors: a tracker on the table, a reflector in the spindle.

The tracker is fixed in the workpiece's frame. It is set up at one station after the other, and the machine moves to all
targets for each.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.kinematics.twists import move, rigid_motions
from errormotion.methods.multilateration.readings import station_names, target_names
from errormotion.methods.multilateration.schema import SCHEMA
from errormotion.methods.multilateration.start import Stations, readings
from errormotion.twin import VirtualMachine, truth

if TYPE_CHECKING:
    from errormotion.methods.multilateration.settings import MultilaterationSettings

REFLECTOR = (0.02, -0.01, -0.08)
"""Position of the reflector with all axes at zero, m."""
NOISE = 0.5e-6
"""Standard deviation of one reading of a tracking interferometer, m."""
READING_INTERVAL, SETUP_INTERVAL = 8.0, 1800.0
"""Time from target to target, and from set-up to set-up, s."""
STATION_UNCERTAINTY = 5e-3
"""Standard uncertainty of the stated position of a station, m."""

_M, _S = {"units": "m"}, {"units": "s"}


def simulate(settings: MultilaterationSettings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return raw data of the layout of the settings on a virtual C-frame, and the true errors of its targets.

    Every source of the measurement model is drawn once.

    Parameters
    ----------
    settings : MultilaterationSettings
    seed : int
        Of the machine and of the measurement.

    Raises
    ------
    BenchError
        Targets out of the travel of the machine.
    """
    from errormotion.measurement.drawing import simulate as drawn
    from errormotion.methods.multilateration.method import Multilateration

    machine = VirtualMachine("cframe", seed=seed)

    class OnMachine(Multilateration):
        """The method with readings of the machine as expected ones."""

        def expected(self, settings: MultilaterationSettings) -> xr.Dataset:
            exact = super().expected(settings)
            position = (exact["target_nominal"] - exact["reflector"]).transpose("target", "direction").values
            _require_within_travel(machine, position)
            point = reflector_positions(machine, position, settings.layout.reflector)
            d = readings(point, Stations(exact["station_nominal"].values, np.zeros(exact.sizes["station"])))
            return exact.assign(displacement=exact["displacement"].copy(data=d))

    return drawn(OnMachine(), settings, seed, Multilateration.info)


def target_grid(machine: VirtualMachine, count: Sequence[int] = (5, 5, 4), share: float = 0.7) -> Array:
    """Return axis positions of a grid of targets in the middle of the travel, m, (target, 3)."""
    axes = []
    for axis, number in zip("XYZ", count, strict=True):
        low, high = machine.travel[axis]
        axes.append((low + high) / 2 + share * (high - low) / 2 * np.linspace(-1, 1, number))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def stations(machine: VirtualMachine) -> Array:
    """Return four positions of the tracker around the targets, not in one plane, m, (4, 3)."""
    middle = np.array([sum(machine.travel[axis]) / 2 for axis in "XYZ"])
    half = np.array([np.ptp(machine.travel[axis]) / 2 for axis in "XYZ"])
    around = np.array([(-1.1, -1.2, -1.6), (1.2, -1.1, -1.2), (1.1, 1.2, -1.5), (-1.2, 1.0, 1.3)])
    return np.asarray(middle + around * half)


def reflector_positions(machine: VirtualMachine, position: ArrayLike, reflector: ArrayLike = REFLECTOR) -> Array:
    """Return the true positions of the reflector at commanded axis positions (n, 3), m, in the workpiece's frame."""
    q, at = np.atleast_2d(np.asarray(position, dtype=float)), np.asarray(reflector, dtype=float)
    twist = machine.geometry.twist(q)
    return np.asarray(q + at + twist[:, :3] + np.cross(twist[:, 3:], np.broadcast_to(at, q.shape)))


def truth_of(machine: VirtualMachine, errors: xr.Dataset, clock: float) -> xr.Dataset:
    """Return the true errors at the targets of an error dataset, in the thermal state at ``clock`` (s)."""
    position = np.stack([errors[axis].values for axis in "xyz"], axis=-1)
    return true_errors(machine, position, errors.attrs["functional_point"], clock)


def true_errors(
    machine: VirtualMachine, position: ArrayLike, reflector: ArrayLike = REFLECTOR, time: float | None = None
) -> xr.Dataset:
    """Return the errors of the reflector at axis positions (n, 3), m, minus their best-fit rigid motion.

    Distances do not determine that motion. With a time, s, the thermal errors at that time are included.
    """
    q, at = np.atleast_2d(np.asarray(position, dtype=float)), np.asarray(reflector, dtype=float)
    twist = machine.geometry.twist(q)
    if time is not None:
        twist = twist + machine.thermal_twist(q, time)
    twist = move(twist, at)
    point = q + at
    G = rigid_motions(point, point.mean(axis=0))
    motion = np.linalg.lstsq(G.reshape(-1, 6), twist[:, :3].ravel())[0]
    twist[:, :3] -= G @ motion
    twist[:, 3:] -= motion[3:]
    coords: dict[str, Any] = {name: ("target", q[:, i], _M) for i, name in enumerate("xyz")}
    origin = truth.Origin(machine.name, machine.kind, machine.seed, machine.state.schedule.events)
    return truth.dataset(
        twist, "target", coords, "tool", at, "best rigid fit to the commanded points", origin
    ).assign_coords(target=target_names(len(q)))


def raw(
    machine: VirtualMachine,
    position: ArrayLike | None = None,
    station: ArrayLike | None = None,
    *,
    seed: int,
    reflector: ArrayLike = REFLECTOR,
    noise: float = NOISE,
    dead_path: ArrayLike | None = None,
    repeatability: float = 0.0,
    scale: float = 0.0,
    drift: ArrayLike | None = None,
    missing: float = 0.0,
) -> xr.Dataset:
    """Return a raw dataset of multilateration.

    Parameters
    ----------
    machine : VirtualMachine
    position : (target, 3), optional
        Commanded axis positions, m; default: `target_grid`. A position may occur more than once.
    station : (station, 3), optional
        True positions of the tracker, m, in the workpiece's frame; default: `stations`. The dataset states them with
        ``STATION_UNCERTAINTY``.
    seed : int
        Of noise, repeatability and stated positions; it does not affect the machine.
    reflector : (3,)
        Position of the reflector with all axes at zero, m.
    noise : float
        Standard deviation of one reading, m.
    dead_path : (station,), optional
        m; default: random.
    repeatability : float
        Standard deviation of each coordinate at each move to a target, m.
    scale : float
        Relative error of the tracker's length.
    drift : (station, 4), optional
        Of the dead path, and of the machine along X, Y, Z relative to the tracker, during each set-up, m/s.
    missing : float
        Fraction of readings with an interrupted beam.

    Raises
    ------
    BenchError
        Positions out of the travel.
    """
    rng = np.random.default_rng([abs(machine.seed), 40, seed])
    q = target_grid(machine) if position is None else np.atleast_2d(np.asarray(position, dtype=float))
    U = stations(machine) if station is None else np.atleast_2d(np.asarray(station, dtype=float))
    _require_within_travel(machine, q)
    n, m = len(U), len(q)
    L = rng.uniform(0.0, 0.3, n) if dead_path is None else np.asarray(dead_path, dtype=float)
    time = SETUP_INTERVAL * np.arange(n)[:, None] + READING_INTERVAL * (m * np.arange(n)[:, None] + np.arange(m))
    rate = np.zeros((n, 4)) if drift is None else np.asarray(drift, dtype=float)
    since = time - time.mean(axis=1, keepdims=True)
    point = reflector_positions(machine, q, reflector) + since[:, :, None] * rate[:, None, 1:]
    point = point + repeatability * rng.normal(size=(n, m, 3))
    way = np.linalg.norm(point - U[:, None], axis=2) - L[:, None] + since * rate[:, :1]
    d = way * (1 + scale) + noise * rng.normal(size=(n, m))
    d[rng.uniform(size=(n, m)) < missing] = np.nan
    at = np.asarray(reflector, dtype=float)
    variables = {
        "displacement": (("station", "target"), d, _M),
        "target_nominal": (("target", "direction"), q + at, _M),
        "station_nominal": (("station", "direction"), U + STATION_UNCERTAINTY * rng.normal(size=U.shape), _M),
        "displacement_noise": ((), noise, _M),
        "reflector": (("target", "direction"), np.tile(at, (m, 1)), _M),
        "reading_time": (("station", "target"), time, _S),
    }
    coords = {"station": station_names(n), "target": target_names(m), "direction": list("xyz")}
    note = [
        {"id": "virtual tracker", "address": f"twin://{machine.kind}?seed={machine.seed}", "simulated": True},
    ]
    attrs = {"schema": SCHEMA, "machine": machine.name, "chain": machine.chain, "instruments": json.dumps(note)}
    return xr.Dataset(variables, coords, attrs)


def _require_within_travel(machine: VirtualMachine, q: Array) -> None:
    for axis, column in zip("XYZ", q.T, strict=True):
        low, high = machine.travel[axis]
        if column.min() < low - 1e-9 or column.max() > high + 1e-9:
            raise BenchError(
                f"Axis {axis}: expected targets within the travel, {low:g} to {high:g} m; found {column.min():g} to "
                f"{column.max():g} m.",
                code="simulation.targets.outside_travel",
            )
