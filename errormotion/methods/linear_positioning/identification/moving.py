"""Thermal distortion by a moving axis (ISO 230-3): errors at both ends of the stroke over time, and their ranges.

The errors are the deviations minus their mean in the cold state. The noise of a reading follows from second differences
over time, ``var(x_1 - 2 x_2 + x_3) = 6 s^2``, in which a smooth drift of the machine vanishes. Ranges are those of
single readings, and of the value after exactly 60 min, between two readings: a mean over cycles lags behind the drift.
A range of noisy readings is too large; its mean excess is stated as bias, and is contained in its uncertainty
(`errormotion.estimation.extremes`).
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.certificates import certified
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.estimation.extremes import expanded, range_from_reference
from errormotion.kinematics.iso import DOF, direction_of, iso_names
from errormotion.methods.linear_positioning.identification.budget import assumed_length
from errormotion.methods.linear_positioning.identification.reading import (
    axis_of,
    freedoms_of,
    length_uncertainty,
    point_of,
)
from errormotion.methods.linear_positioning.settings import Settings

if TYPE_CHECKING:
    from errormotion.plugins import MethodInfo

QUANTITIES = ("P1", "P2", "P2 - P1")
"""The two ends, in the order of their positions, and the change of the length between them."""
MEASURES = ("range_60min", "range_moving", "range_total", "end_of_moving")
HOUR = 3600.0
MIN_DIFFERENCES = 3
"""Smallest number of second differences for the noise."""
MIN_CYCLES = 6
"""Smallest number of cycles after the cold state."""
COLD, LENGTH = "cold reference", "scale of the lengths"


def identify_moving(raw: xr.Dataset, settings: Settings, info: MethodInfo, stated: float | None = None) -> xr.Dataset:
    """Return the errors of the axis at both ends over ``time`` and ``position``, relative to the cold state.

    ``stated`` is the standard deviation of a reading, m or rad, for a plan; by default it is estimated.

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
    x = np.asarray(raw["end_deviation"].transpose("freedom", "cycle", "end").values, dtype=float)[..., order]
    cold = time <= 0.0
    noise = np.array([_noise(values[~cold]) if stated is None else stated for values in x])  # (freedom,)
    known = np.isfinite(x[:, cold]).sum(axis=1)  # (freedom, end)
    if not known.all():
        raise MethodError("end_deviation: expected a reading of each freedom and end in the cold state; found none")
    if missing := int(np.isnan(x).sum()):
        notes.append(f"{missing} of {x.size} readings are missing.")
    change = x - np.nanmean(x[:, cold], axis=1, keepdims=True)
    t = np.concatenate([[0.0], time[~cold]])
    value = np.concatenate([np.zeros_like(change[:, :1]), change[:, ~cold]], axis=1)  # (freedom, time, end)
    u_cold = noise[:, None] / np.sqrt(known)
    relative = length_uncertainty(raw, settings)
    if note := assumed_length(raw, settings):
        notes.append(note)
    along = DOF[direction_of(axis)]
    lever = np.array([relative * (P[order] - P[order][0]) if name == along else np.zeros(2) for name in freedoms])
    names = iso_names(axis)
    sources, groups, rows = [], [], []
    for k, name in enumerate(freedoms):
        for end in range(2):
            effect = np.zeros((t.size, 2, 6))
            effect[1:, end, DOF.index(name)] = -u_cold[k, end]
            sources.append(f"cold reference of {names[name]} at P{end + 1}")
            groups.append(COLD)
            rows.append(effect)
    if (lever > 0).any():
        effect = np.zeros((t.size, 2, 6))
        effect[1:, :, DOF.index(along)] = lever[freedoms.index(along)]
        sources.append(LENGTH)
        groups.append(LENGTH)
        rows.append(effect)
    values, own = np.full((t.size, 2, 6), np.nan), np.zeros((t.size, 2, 6))
    for k, name in enumerate(freedoms):
        values[..., DOF.index(name)] = value[k]
        own[1:, :, DOF.index(name)] = noise[k] ** 2
    influence = np.array(rows)
    covariance = np.einsum("stpi,stpj->tpij", influence, influence)
    covariance[..., range(6), range(6)] += own
    is_moving = np.concatenate([[False], moving[~cold] > 0.5])
    figures = [_figures(v, t, is_moving, n, c, h) for v, n, c, h in zip(value, noise, u_cold, lever, strict=True)]
    return build_errors(
        values,
        covariance,
        dims=("time", "position"),
        coords={"time": t, "xyz"[direction_of(axis)]: ("position", P[order], {"units": "m"})},
        component=axis,
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=point_of(raw, settings, notes),
        reference="cold state before the axis moved, at each end",
        reference_interval=(0.0, 0.0),
        method=info.id,
        method_version=info.version,
        provenance=provenance.make(settings, raw, None, steps=["less the mean of the cold state"]),
        influence=influence,
        sources=sources,
        source_groups=groups,
        reference_sources=[name for name, group in zip(sources, groups, strict=True) if group == COLD],
        source_ids=certified(raw.attrs, {LENGTH: ("tracker", "scale")} if LENGTH in sources else {}),
        extras=_extras(figures, [names[name] for name in freedoms], is_moving, noise),
        start=start_of(raw),
        measured=raw.attrs,
        notes=notes,
    )


def _check(time: Array, moving: Array, P: Array) -> None:
    if not np.isfinite(time).all() or any(second <= first for first, second in pairwise(time)):
        raise MethodError("reading_time: expected increasing times; found NaN, or a time that does not increase")
    if not np.isfinite(moving).all():
        raise MethodError("moving: expected 0 or 1 for each cycle; found NaN")
    if not (time <= 0).any():
        raise MethodError("reading_time: expected a cold state at times of 0 or less; found none")
    if (time > 0).sum() < MIN_CYCLES:
        raise MethodError(f"cycle: expected {MIN_CYCLES} cycles or more after the cold state; found {(time > 0).sum()}")
    if not (np.isfinite(P).all() and np.ptp(P) > 0):
        raise MethodError("end_position: expected two different positions; found NaN, or one position twice")


def _noise(values: Array) -> float:
    """Return the standard deviation of one reading, from readings (cycle, end) under a smooth drift."""
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    second = second[np.isfinite(second)]
    if second.size < MIN_DIFFERENCES:
        raise MethodError("end_deviation: expected more readings in successive cycles; found too few for their noise")
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
            found = range_from_reference(inside, variance, np.tile(shared[:, None], inside.size))
            figures[q, k], bias[q, k] = float(found.value), float(found.bias)
            u[q, k] = float(expanded(found.bias, found.u)) / 2.0
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


def _extras(
    figures: list[tuple[Array, Array, Array]], freedoms: list[str], moving: NDArray[np.bool_], noise: Array
) -> dict[str, xr.DataArray]:
    coords: dict[str, Any] = {"freedom": freedoms, "quantity": list(QUANTITIES), "measure": list(MEASURES)}
    dims = tuple(coords)
    attrs = {"long_name": "ISO 230-3, thermal distortion by the moving axis; m, rad"}
    return {
        name: xr.DataArray(np.array(values), coords, dims, attrs=attrs)
        for name, values in zip(
            ("distortion", "distortion_bias", "distortion_u"), zip(*figures, strict=True), strict=True
        )
    } | {
        "moving": xr.DataArray(moving.astype(float), dims="time", attrs={"long_name": "1 while the axis moved"}),
        "reading_noise": xr.DataArray(noise, {"freedom": freedoms}, "freedom", attrs={"long_name": "m, rad"}),
    }
