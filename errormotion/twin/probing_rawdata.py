"""Cycles in which the machine touches balls, as raw data without any wire."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.twin.balls import Balls, Probe

Moved = tuple[int, float, ArrayLike]

SCHEMA = "errormotion.raw.normal_vector/1"
#: s from touch to touch; how far from the surface a touch begins, m
TOUCH_TIME, CLEARANCE = 6.0, 5e-3

_M, _S = {"units": "m"}, {"units": "s"}
_ROUND_AND_TOP = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)], dtype=float)


def touch_normals(count: int) -> Array:
    """Return where a ball is touched: outward unit normals, (count, 3)."""
    if count < len(_ROUND_AND_TOP):
        raise BenchError(f"A ball is touched {len(_ROUND_AND_TOP)} times or more; found {count}.")
    more = count - len(_ROUND_AND_TOP)
    azimuth = np.pi / 4 + 2 * np.pi * np.arange(more) / max(more, 1)
    slanting = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones(more)], axis=1) / np.sqrt(2)
    return np.vstack([_ROUND_AND_TOP, slanting])


@dataclass(frozen=True, eq=False)
class Cycles:
    """When which ball is touched where.

    Attributes
    ----------
    times : ndarray, (time,)
        Begin of each cycle, s.
    normals : ndarray, (touch, 3)
        Outward unit normals at which each ball is touched.
    balls : int
    duration : float
        Of a cycle, s.
    moved : (int, float, (3,)) or None
        A ball that is pushed at a time, s, by a shift, m.
    missing : float
        Share of the touches that give none.
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
        """Check what is asked for."""
        begins = np.atleast_1d(np.asarray(times, dtype=float))
        duration = TOUCH_TIME * balls * touches if cycle is None else float(cycle)
        if not duration >= 0 or not np.all(np.isfinite(begins)) or np.any(np.diff(begins) < max(duration, 1e-9)):
            raise BenchError(
                f"Cycles of {duration:g} s begin at increasing times, one after the other; found times {begins} s."
            )
        if not 0 <= missing <= 1:
            raise BenchError(f"The share of missing touches is from 0 to 1; found {missing:g}.")
        if moved is not None and not 0 <= moved[0] < balls:
            raise BenchError(f"The ball that moves is one of 0 to {balls - 1}; found {moved[0]}.")
        return cls(begins, touch_normals(touches), int(balls), duration, moved, float(missing))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of cycles, balls and touches."""
        return len(self.times), self.balls, len(self.normals)

    @property
    def touch_times(self) -> Array:
        """When each contact is made, s, (time, ball, touch)."""
        count = self.balls * len(self.normals)
        within = (np.arange(count) + 0.5) * self.duration / count
        return (self.times[:, None] + within).reshape(self.shape)

    def shifts(self) -> Array:
        """Return by how much a ball has been pushed at each contact, m, (time, ball, touch, 3)."""
        shift = np.zeros((*self.shape, 3))
        if self.moved is not None:
            ball, when, way = self.moved
            shift[:, ball][self.touch_times[:, ball] >= when] = np.asarray(way, dtype=float)
        return shift

    def ways(self, balls: Balls) -> tuple[NDArray[np.intp], Array, Array, Array, Array]:
        """Return ball, start (m), unit direction, time (s) and shift of the ball (m) of all touches, (n,)."""
        ball = np.broadcast_to(np.arange(self.balls)[:, None], self.shape).ravel()
        normal = np.broadcast_to(self.normals, (*self.shape, 3)).reshape(-1, 3)
        start = balls.nominal[ball] + (balls.nominal_radius + CLEARANCE) * normal
        return ball, start, -normal, self.touch_times.ravel(), self.shifts().reshape(-1, 3)


def touches_dataset(
    cycles: Cycles,
    balls: Balls,
    probe: Probe,
    contacts: Array,
    noise: float,
    variant: str,
    rng: np.random.Generator,
    more: Mapping[str, Any],
    attrs: Mapping[str, Any],
    origin: Mapping[str, Any],
) -> xr.Dataset:
    """Return the raw dataset of contacts (time, ball, touch, 3), m, or of the centres that they make.

    Parameters
    ----------
    noise : float
        Scatter of a contact along its normal, m.
    variant : {"touches", "centres"}
    rng : Generator
        Of what is missing.
    more, attrs : mapping
        Further variables and attributes.
    origin : mapping
        ``kind`` and ``seed`` of the machine.
    """
    note = [{"id": "virtual touch probe", "address": "twin://{kind}?seed={seed}".format(**origin), "simulated": True}]
    coords = {
        "time": ("time", cycles.times, _S),
        "ball": balls.names,
        "direction": list("xyz"),
        "sensor": more["sensor"],
    }
    labels = {"schema": SCHEMA, **attrs, "instruments": json.dumps(note)}
    variables: dict[str, Any] = {name: value for name, value in more.items() if name != "sensor"}
    variables["ball_nominal"] = (("ball", "direction"), balls.nominal, _M)
    if variant == "touches":
        variables |= _touches(cycles, balls, probe, contacts, noise, rng)
    elif variant == "centres":
        variables |= _centres(cycles, balls, contacts, noise, rng)
        coords["direction_"] = list("xyz")
    else:
        raise BenchError(f"The variants are 'touches' and 'centres'; found {variant!r}.")
    return xr.Dataset(variables, coords, labels)


def _touches(
    cycles: Cycles, balls: Balls, probe: Probe, contacts: Array, noise: float, rng: np.random.Generator
) -> dict[str, Any]:
    lost = rng.uniform(size=cycles.shape) < cycles.missing
    flag = np.where(lost | np.isnan(contacts).any(axis=-1), 1, 0)  # no trip
    approach = np.broadcast_to(-cycles.normals, (cycles.balls, *cycles.normals.shape))
    each = ("time", "ball", "touch")
    return {
        "touch": ((*each, "direction"), np.where(flag[..., None] == 0, contacts, np.nan), _M),
        "touch_time": (each, cycles.touch_times, _S),
        "touch_flag": (each, flag.astype(np.int64), {"units": "1"}),
        "approach": (("ball", "touch", "direction"), approach.copy(), {"units": "1"}),
        "tip_radius": ((), probe.nominal_tip_radius, _M),
        "ball_radius": ("ball", np.full(cycles.balls, balls.nominal_radius), _M),
        "touch_noise": ((), noise, _M),
    }


def _centres(cycles: Cycles, balls: Balls, contacts: Array, noise: float, rng: np.random.Generator) -> dict[str, Any]:
    """Make a centre of the touches of each ball: least squares of a sphere whose radius is free.

    The Jacobian at the normals as planned: they differ from the true ones by 10 mrad at most.
    """
    nominal = balls.nominal[:, None]
    way = contacts - nominal
    distance = np.linalg.norm(way, axis=-1)
    J = np.hstack([cycles.normals, np.ones((len(cycles.normals), 1))])
    inverse = np.linalg.inv(J.T @ J)
    centre = np.zeros((len(cycles.times), cycles.balls, 3))
    for _ in range(20):  # each round leaves 1e-2 of what is left
        distance = np.linalg.norm(way - centre[:, :, None], axis=-1)
        left = distance - distance.mean(axis=-1, keepdims=True)
        centre += (left @ J @ inverse)[..., :3]
    centre += balls.nominal
    centre[rng.uniform(size=centre.shape[:2]) < cycles.missing] = np.nan
    covariance = np.broadcast_to(noise**2 * inverse[:3, :3], (*centre.shape, 3))
    return {
        "centre": (("time", "ball", "direction"), centre, _M),
        "centre_covariance": (("time", "ball", "direction", "direction_"), covariance.copy(), {"units": "m^2"}),
    }
