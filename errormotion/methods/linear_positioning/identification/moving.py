"""Thermal distortion by a moving axis (ISO 230-3): errors at both ends of the stroke over time, and their ranges.

A reading y at an end with the distance l from the lower one is ``y + s l = m + e``: m is its mean in the cold state and
e the error since then, 0 in the cold state; s is the change of the instrument's scale since then. The noise of a
reading follows from second differences over time, ``var(x_1 - 2 x_2 + x_3) = 6 s^2``, in which a smooth drift of the
machine vanishes. Ranges are those of single readings, and of the value after exactly 60 min, between two readings: a
mean over cycles lags behind the drift. A range of noisy readings is too large; its mean excess is stated as bias, and
is contained in its uncertainty (`errormotion.estimation.extremes`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.certificates import certified
from errormotion.errors import MethodError
from errormotion.estimation.extremes import expanded, range_from_reference
from errormotion.kinematics.iso import DOF, direction_of, iso_names
from errormotion.measurement import Block, Constant, Noise, Observed, Places, Problem
from errormotion.methods.linear_positioning.identification.reading import (
    assumed_length,
    axis_of,
    freedoms_of,
    length_uncertainty,
    point_of,
)
from errormotion.methods.linear_positioning.identification.scatter import EQUAL
from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

if TYPE_CHECKING:
    from errormotion.measurement.observed import Solved

T = TypeVar("T")

QUANTITIES = ("P1", "P2", "P2 - P1")
"""The two ends, in the order of their positions, and the change of the length between them."""
MEASURES = ("range_60min", "range_moving", "range_total", "end_of_moving")
HOUR = 3600.0
MIN_DIFFERENCES = 3
"""Smallest number of second differences for the noise."""
MIN_CYCLES = 6
"""Smallest number of cycles after the cold state."""
COLD, LENGTH = "cold reference", "scale of the lengths"


class Unknowns(NamedTuple, Generic[T]):
    """Errors of each time at each end, and the mean of each end in the cold state; columns are freedoms."""

    error: T
    cold: T


class Known(NamedTuple, Generic[T]):
    """The scale of the instrument since the cold state."""

    length: T


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Readings of a moving axis.

    Attributes
    ----------
    axis : str
    freedoms : tuple of str
    time : ndarray, (cycle,)
        Since the axis started to move, s; 0 or less in the cold state.
    moving : ndarray, (cycle,)
    position : ndarray, (end,)
        In their order, m.
    x : ndarray, (cycle, end, freedom)
        m or rad, with the ends in their order.
    order : ndarray of int, (end,)
        The recorded ends in their order.
    noise : ndarray, (freedom,)
        Standard deviation of a reading, m or rad.
    length : float
        Relative standard uncertainty of lengths.
    """

    axis: str
    freedoms: tuple[str, ...]
    time: Array
    moving: Array
    position: Array
    x: Array
    order: NDArray[np.intp]
    noise: Array
    length: float
    notes: list[str]

    steps = ("less the mean of the cold state",)

    @property
    def cold(self) -> NDArray[np.bool_]:
        """Which cycles are in the cold state."""
        return np.asarray(self.time <= 0.0)

    @property
    def t(self) -> Array:
        """Times of the result, s: the cold state, and the cycles after it."""
        return np.concatenate([[0.0], self.time[~self.cold]])

    @property
    def is_moving(self) -> NDArray[np.bool_]:
        """Whether the axis moved before each time of the result."""
        return np.concatenate([[False], self.moving[~self.cold] > 0.5])

    @property
    def lever(self) -> Array:
        """Distances from the lower end, (end, freedom), m; 0 where lengths have no effect."""
        along = np.array([name == DOF[direction_of(self.axis)] for name in self.freedoms])
        return np.asarray((self.position - self.position[0])[:, None] * along)


def evaluate(raw: xr.Dataset, settings: LinearPositioningSettings) -> Evaluated:
    """Return the readings of a moving axis that follow their schema.

    Raises
    ------
    MethodError
        No cold state, too few cycles, or ends that do not differ.
    """
    notes: list[str] = []
    axis = axis_of(raw)
    freedoms = freedoms_of(raw, axis)
    time, moving = (np.asarray(raw[name].values, dtype=float) for name in ("reading_time", "moving"))
    P = np.asarray(raw["end_position"].values, dtype=float)
    _check(time, moving, P)
    order = np.argsort(P)
    x = np.asarray(raw["end_deviation"].transpose("cycle", "end", "freedom").values, dtype=float)[:, order]
    if not np.isfinite(x[time <= 0.0]).any(axis=0).all():
        raise MethodError(
            "end_deviation: expected a reading of each freedom and end in the cold state; found none",
            code="moving_axis.cold.no_readings",
        )
    if missing := int(np.isnan(x).sum()):
        notes.append(f"{missing} of {x.size} readings are missing.")
    stated = raw["reading_scatter"].values if "reading_scatter" in raw else np.zeros(len(freedoms))
    noise = np.array([_noise(x[time > 0.0, :, k]) for k in range(len(freedoms))])
    if note := assumed_length(raw, settings):
        notes.append(note)
    length = length_uncertainty(raw, settings)
    return Evaluated(axis, freedoms, time, moving, P[order], x, order, np.fmax(noise, stated), length, notes)


def observe(raw: xr.Dataset, evaluated: Evaluated, settings: LinearPositioningSettings) -> Observed:
    """Return the readings of a moving axis as a measurement model, with its errors over time at both ends."""
    t, lever, count = evaluated.t, evaluated.lever, len(evaluated.freedoms)
    names = [iso_names(evaluated.axis)[name] for name in evaluated.freedoms]
    notes = [*evaluated.notes]
    cycle, place = (i.ravel() for i in np.indices(evaluated.x.shape[:2]))
    end = np.argsort(evaluated.order)[place]  # in the order of the record
    warm = ~evaluated.cold[cycle]
    row = 2 * np.where(warm, np.cumsum(~evaluated.cold)[cycle], 0) + end
    y = evaluated.x[cycle, end]
    known = np.zeros((2 * t.size, count))
    known[row[warm]] = np.where(np.isfinite(y[warm]), 0.0, np.nan)
    free = np.isfinite(known)
    free[:2] = False
    of_scale = lever[end] * warm[:, None]

    def equation(y: Array, u: Unknowns[Array], c: Known[Array]) -> Array:
        return np.asarray(y + c.length * of_scale - u.cold - u.error)

    names_of_length = [LENGTH] if lever.any() and evaluated.length > 0 else []
    ids = certified(raw.attrs, {LENGTH: ("tracker", "scale")} if names_of_length else {})
    return Observed(
        problem=Problem(
            equation=equation,
            readings=y,
            unknowns=Unknowns(
                error=Block(start=np.zeros(known.shape), index=row, scale=1.0, free=free),
                cold=Block(start=np.zeros((2, count)), index=end, scale=1.0, group=COLD),
            ),
            constants=Known(
                Constant(
                    value=np.zeros((1, 1)),
                    factor=np.full((1, 1, len(names_of_length)), evaluated.length),
                    index=np.zeros_like(row),
                    scale=1.0,
                    group=LENGTH,
                    names=names_of_length,
                    identity=[ids.get(name, "") for name in names_of_length],
                )
            ),
            noise=Noise(sd=np.broadcast_to(np.maximum(evaluated.noise, EQUAL), y.shape)),
            linear=True,
        ),
        places=Places(lambda x, _: x.error + known, len(known)),
        recorded=("end_deviation", ("cycle", "end", "freedom")),
        freedoms=evaluated.freedoms,
        dims=("time", "position"),
        coords={
            "time": t,
            "xyz"[direction_of(evaluated.axis)]: ("position", evaluated.position, {"units": "m"}),
            "freedom": names,
            "quantity": list(QUANTITIES),
            "measure": list(MEASURES),
        },
        component=evaluated.axis,
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=point_of(raw, settings, notes).tolist(),
        reference="cold state before the axis moved, at each end",
        shared=COLD,
        robust=False,  # nothing contradicts a reading of an instant
        reliability=False,
        noise_increases=False,
        finish=lambda solved: _finished(solved, names),
        extras={
            "moving": xr.DataArray(
                evaluated.is_moving.astype(float), dims="time", attrs={"long_name": "1 while the axis moved"}
            ),
            "reading_noise": xr.DataArray(evaluated.noise, dims="freedom", attrs={"long_name": "m, rad"}),
        },
        attributes={"reference_interval": (0.0, 0.0)},
        notes=notes,
    )


def _finished(solved: Solved, names: list[str]) -> Solved:
    """Return a solution whose cold reference has the name of its freedom and end."""
    sources = []
    for source in solved.relative.errors.sources:
        place, k = np.unravel_index(int(np.nanargmax(np.abs(source.effect))), source.effect.shape)
        name = f"cold reference of {names[k]} at P{place % 2 + 1}" if source.group == COLD else source.name
        sources.append(replace(source, name=name))
    reference = {"reference_sources": [source.name for source in sources if source.group == COLD]}
    observed = replace(solved.observed, attributes={**solved.observed.attributes, **reference})
    relative = replace(solved.relative, errors=replace(solved.relative.errors, sources=sources))
    return replace(solved, observed=observed, relative=relative, scatter=replace(solved.scatter, note=""))


def extras(evaluated: Evaluated, solved: Solved, settings: LinearPositioningSettings) -> dict[str, xr.DataArray]:  # noqa: ARG001
    """Return the figures of ISO 230-3: ranges and changes at both ends and of the length between them."""
    value = solved.relative.errors.value.reshape(evaluated.t.size, 2, -1)
    u_cold = evaluated.noise / np.sqrt(np.isfinite(evaluated.x[evaluated.cold]).sum(axis=0))  # (end, freedom)
    lever = evaluated.length * evaluated.lever
    notes = [
        _figures(value[..., k], evaluated.t, evaluated.is_moving, float(noise), u_cold[:, k], lever[:, k])
        for k, noise in enumerate(evaluated.noise)
    ]
    attrs = {"long_name": "ISO 230-3, thermal distortion by the moving axis; m, rad"}
    return {
        name: xr.DataArray(np.array(values), dims=("freedom", "quantity", "measure"), attrs=attrs)
        for name, values in zip(
            ("distortion", "distortion_bias", "distortion_u"), zip(*notes, strict=True), strict=True
        )
    }


def _check(time: Array, moving: Array, P: Array) -> None:
    if not np.isfinite(time).all() or any(second <= first for first, second in pairwise(time)):
        raise MethodError(
            "reading_time: expected increasing times; found NaN, or a time that does not increase",
            code="moving_axis.times.not_increasing",
        )
    if not np.isfinite(moving).all():
        raise MethodError("moving: expected 0 or 1 for each cycle; found NaN", code="moving_axis.moving.unknown")
    if not (time <= 0).any():
        raise MethodError(
            "reading_time: expected a cold state at times of 0 or less; found none", code="moving_axis.cold.missing"
        )
    if (time > 0).sum() < MIN_CYCLES:
        raise MethodError(
            f"cycle: expected {MIN_CYCLES} cycles or more after the cold state; found {(time > 0).sum()}",
            code="moving_axis.cycles.too_few",
        )
    if not (np.isfinite(P).all() and np.ptp(P) > 0):
        raise MethodError(
            "end_position: expected two different positions; found NaN, or one position twice",
            code="moving_axis.ends.form",
        )


def _noise(values: Array) -> float:
    """Return the standard deviation of one reading, from readings (cycle, end) under a smooth drift."""
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    second = second[np.isfinite(second)]
    if second.size < MIN_DIFFERENCES:
        raise MethodError(
            "end_deviation: expected more readings in successive cycles; found too few for their noise",
            code="moving_axis.readings.too_few",
        )
    return float(np.sqrt(np.mean(second**2) / 6.0))


def _figures(
    value: Array, t: Array, moving: NDArray[np.bool_], noise: float, u_cold: Array, lever: Array
) -> tuple[Array, Array, Array]:
    """Return figures, biases and standard uncertainties of one freedom, (quantity, measure); ``value`` is (time, end).

    Half of the bias of a range is contained in its uncertainty, so that the expanded uncertainty contains all of it.
    """
    both = np.concatenate([value, value[:, 1:] - value[:, :1]], axis=1)
    noises = noise * np.array([1.0, 1.0, np.sqrt(2.0)])
    effects = [(u_cold[0], 0.0, lever[0]), (0.0, u_cold[1], lever[1]), (-u_cold[0], u_cold[1], lever[1] - lever[0])]
    last = float(t[moving].max()) if moving.any() else float(t[-1])
    figures, bias, u = np.full((3, 3, len(MEASURES)), np.nan)
    for q in range(3):
        warm = np.flatnonzero(np.isfinite(both[:, q]))[1:]  # the first instant is the cold state, 0 by definition
        x, times = both[warm, q], t[warm]
        shared = np.array(effects[q])
        for k, end in enumerate((HOUR, last, float(t[-1]))):
            if t[-1] < end - 1e-9 or not (times <= end + 1e-9).any():
                continue
            inside, variance = _until(x, times, end, noises[q] ** 2)
            extremes = range_from_reference(inside, variance, np.tile(shared[:, None], inside.size))
            figures[q, k], bias[q, k] = float(extremes.value), float(extremes.bias)
            u[q, k] = float(expanded(extremes.bias, extremes.u)) / 2.0
        moved = np.flatnonzero(times <= last + 1e-9)
        if moved.size:
            figures[q, 3], bias[q, 3] = x[moved[-1]], 0.0
            u[q, 3] = np.hypot(noises[q], np.linalg.norm(shared))
    return figures, bias, u


def _until(x: Array, t: Array, end: float, variance: float) -> tuple[Array, Array]:
    """Return readings until ``end`` and their variances; the last one is the value at ``end``, between two readings."""
    before = int((t <= end + 1e-9).sum())
    inside, variances = x[:before], np.full(before, variance)
    if before == t.size or t[before - 1] > end - 1e-9:
        return inside, variances
    share = (end - t[before - 1]) / (t[before] - t[before - 1])
    value = (1.0 - share) * x[before - 1] + share * x[before]
    return np.append(inside, value), np.append(variances, variance * ((1.0 - share) ** 2 + share**2))
