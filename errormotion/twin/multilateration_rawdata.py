"""Distances from a laser tracker to a reflector in the spindle: raw data without any wire, and the truth behind them.

The tracker stands on the table, in the workpiece's frame; it is set up at one place after the other, and the machine
goes to all targets for each.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.kinematics.twists import cross_matrix, move
from errormotion.twin import truth
from errormotion.twin.geometry import GeometricErrors

SCHEMA = "errormotion.raw.multilateration/1"
#: where the reflector is with all axes at zero, m
REFLECTOR = (0.02, -0.01, -0.08)
#: of a tracking interferometer: one reading, m; relative error of its length (one sigma)
NOISE = 0.5e-6
#: s from target to target, and from set-up to set-up
READING_TIME, SET_UP_TIME = 8.0, 1800.0
#: how well a person knows where the tracker stands, m (one sigma)
ROUGHLY = 5e-3

_M, _S = {"units": "m"}, {"units": "s"}


class TrackerMeasurements:
    """What a machine with a reflector in its spindle and a tracker on its table can measure."""

    name: str
    kind: str
    seed: int
    travel: Mapping[str, tuple[float, float]]
    chain: str
    geometry: GeometricErrors

    def _origin(self) -> truth.Origin:
        raise NotImplementedError

    def target_grid(self, count: Sequence[int] = (5, 5, 4), share: float = 0.7) -> Array:
        """Return axis positions of a grid of targets in the middle of the travel, m, (target, 3)."""
        axes = []
        for axis, number in zip("XYZ", count, strict=True):
            low, high = self.travel[axis]
            axes.append((low + high) / 2 + share * (high - low) / 2 * np.linspace(-1, 1, number))
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def tracker_places(self) -> Array:
        """Return four places of the tracker around the targets, not in one plane, m, (4, 3)."""
        middle = np.array([sum(self.travel[axis]) / 2 for axis in "XYZ"])
        half = np.array([np.ptp(self.travel[axis]) / 2 for axis in "XYZ"])
        around = np.array([(-1.1, -1.2, -1.6), (1.2, -1.1, -1.2), (1.1, 1.2, -1.5), (-1.2, 1.0, 1.3)])
        return np.asarray(middle + around * half)

    def reflector_places(self, position: ArrayLike, reflector: ArrayLike = REFLECTOR) -> Array:
        """Return where the reflector truly is at commanded axis positions (n, 3), m, in the workpiece's frame."""
        q, at = np.atleast_2d(np.asarray(position, dtype=float)), np.asarray(reflector, dtype=float)
        twist = self.geometry.twist(q)
        return np.asarray(q + at + twist[:, :3] + np.cross(twist[:, 3:], np.broadcast_to(at, q.shape)))

    def truth_multilateration(self, position: ArrayLike, reflector: ArrayLike = REFLECTOR) -> xr.Dataset:
        """Return the errors of the reflector at axis positions (n, 3), m, less the rigid motion that fits them best.

        Distances do not see that motion: it is where one says that the workpiece is.
        """
        q, at = np.atleast_2d(np.asarray(position, dtype=float)), np.asarray(reflector, dtype=float)
        twist = move(self.geometry.twist(q), at)
        place = q + at
        lever = place - place.mean(axis=0)
        G = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), -cross_matrix(lever)], axis=2)
        motion = np.linalg.lstsq(G.reshape(-1, 6), twist[:, :3].ravel())[0]
        twist[:, :3] -= G @ motion
        twist[:, 3:] -= motion[3:]
        coords: dict[str, Any] = {name: ("target", q[:, i], _M) for i, name in enumerate("xyz")}
        return truth.dataset(
            twist, "target", coords, "tool", at, "best rigid fit to the commanded points", self._origin()
        ).assign_coords(target=target_names(len(q)))

    def raw_multilateration(
        self,
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
        position : (target, 3), optional
            Commanded axis positions, m; `target_grid` where not given. A position may come again.
        station : (station, 3), optional
            True places of the tracker, m, in the workpiece's frame; `tracker_places` where not given. The dataset
            states them roughly.
        seed : int
            Of noise, repeatability and what is stated; the machine stays the same.
        reflector : (3,)
            Where the reflector is with all axes at zero, m.
        noise : float
            Standard deviation of one reading, m.
        dead_path : (station,), optional
            m; random where not given.
        repeatability : float
            Standard deviation of each coordinate each time the machine goes to a target, m.
        scale : float
            Relative error of the tracker's length.
        drift : (station, 4), optional
            Of the dead path, and of the machine along X, Y, Z relative to the tracker, during each set-up, m/s.
        missing : float
            Share of the readings at which the beam was broken.

        Raises
        ------
        BenchError
            Positions out of the travel.
        """
        rng = np.random.default_rng([abs(self.seed), 40, seed])
        q = self.target_grid() if position is None else np.atleast_2d(np.asarray(position, dtype=float))
        U = self.tracker_places() if station is None else np.atleast_2d(np.asarray(station, dtype=float))
        self._within_travel(q)
        n, m = len(U), len(q)
        L = rng.uniform(0.0, 0.3, n) if dead_path is None else np.asarray(dead_path, dtype=float)
        time = SET_UP_TIME * np.arange(n)[:, None] + READING_TIME * (m * np.arange(n)[:, None] + np.arange(m))
        rate = np.zeros((n, 4)) if drift is None else np.asarray(drift, dtype=float)
        since = time - time.mean(axis=1, keepdims=True)
        place = self.reflector_places(q, reflector) + since[:, :, None] * rate[:, None, 1:]
        place = place + repeatability * rng.normal(size=(n, m, 3))
        way = np.linalg.norm(place - U[:, None], axis=2) - L[:, None] + since * rate[:, :1]
        d = way * (1 + scale) + noise * rng.normal(size=(n, m))
        d[rng.uniform(size=(n, m)) < missing] = np.nan
        at = np.asarray(reflector, dtype=float)
        variables = {
            "displacement": (("station", "target"), d, _M),
            "target_nominal": (("target", "direction"), q + at, _M),
            "station_nominal": (("station", "direction"), U + ROUGHLY * rng.normal(size=U.shape), _M),
            "displacement_noise": ((), noise, _M),
            "reflector": (("target", "direction"), np.tile(at, (m, 1)), _M),
            "reading_time": (("station", "target"), time, _S),
        }
        coords = {
            "station": [f"S{j + 1}" for j in range(n)],
            "target": target_names(m),
            "direction": list("xyz"),
        }
        note = [
            {"id": "virtual tracker", "address": f"twin://{self.kind}?seed={self.seed}", "simulated": True},
        ]
        attrs = {"schema": SCHEMA, "machine": self.name, "chain": self.chain, "instruments": json.dumps(note)}
        return xr.Dataset(variables, coords, attrs)

    def _within_travel(self, q: Array) -> None:
        for axis, column in zip("XYZ", q.T, strict=True):
            low, high = self.travel[axis]
            if column.min() < low - 1e-9 or column.max() > high + 1e-9:
                raise BenchError(
                    f"Axis {axis} travels from {low:g} to {high:g} m; found targets from {column.min():g} to "
                    f"{column.max():g} m."
                )


def target_names(count: int) -> list[str]:
    """Return the names of targets: T001, T002 ..."""
    digits = max(3, len(str(count)))
    return [f"T{i + 1:0{digits}}" for i in range(count)]
