"""The raw dataset as arrays in a fixed order: approaches forward and backward, targets by position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF, LINEAR_AXES, direction_of, iso_names
from errormotion.methods.linear_positioning.schema import APPROACHES
from errormotion.methods.linear_positioning.settings import Settings

MIN_TARGETS = 3
"""Needed to distinguish a drift proportional to the position from the scatter of the readings."""


@dataclass(frozen=True)
class Readings:
    """Deviations of an axis, SI; NaN for missing readings.

    Attributes
    ----------
    axis : str
    freedoms : tuple of str
        The measured ones of ``EX EY EZ EA EB EC``.
    x : ndarray, (freedom, approach, run, target)
        Deviations as recorded.
    position : ndarray, (target,)
        Increasing, m.
    zero : float
        Position at which the instrument was set to zero, m.
    temperature : mapping of str to ndarray
        Sensor to (approach, run, target), degC.
    point : ndarray, (3,)
        Functional point with the axis at zero, m.
    """

    axis: str
    freedoms: tuple[str, ...]
    x: Array
    position: Array
    zero: float
    temperature: Mapping[str, Array]
    point: Array

    @property
    def along(self) -> str:
        """The freedom along the axis, whose errors are those of positioning."""
        return DOF[direction_of(self.axis)]

    @property
    def columns(self) -> list[int]:
        """Column of each measured freedom among the six."""
        return [DOF.index(name) for name in self.freedoms]

    @property
    def lever(self) -> Array:
        """Distance of the targets from the zero of the instrument, (target,), m."""
        return self.position - self.zero


def read(raw: xr.Dataset, settings: Settings, notes: list[str]) -> Readings:
    """Return the readings of a raw dataset that follows its schema; remarks are appended to ``notes``.

    Raises
    ------
    MethodError
        An unknown axis, freedom or approach; fewer than three targets, duplicate targets, no readings of a freedom.
    """
    axis = axis_of(raw)
    approaches = labels(raw, "approach")
    if not approaches or set(approaches) - set(APPROACHES) or len(set(approaches)) < len(approaches):
        raise MethodError(f"approach: expected the labels forward, backward; found {', '.join(approaches) or 'none'}")
    freedoms = freedoms_of(raw, axis)
    position = np.asarray(raw["target_position"].values, dtype=float)
    _check_positions(position)
    order = np.asarray(np.argsort(position), dtype=np.int64)
    measured = np.asarray(raw["deviation"].transpose("freedom", "approach", "run", "target").values, dtype=float)
    x = _by_approach(measured[..., order], approaches, axis=1)
    if not np.isfinite(x).any(axis=(1, 2, 3)).all():
        raise MethodError("deviation: expected readings of each freedom; found none for one or more of them")
    missing = int(np.isnan(measured).sum())
    if missing:
        notes.append(f"{missing} of {measured.size} readings are missing; the others are evaluated.")
    if set(approaches) != set(APPROACHES):
        notes.append(f"Targets were approached {approaches[0]} only: figures of both directions are unknown.")
    zero = float(raw["zero_position"]) if "zero_position" in raw else float(position[0])
    if not np.isfinite(zero):
        raise MethodError("zero_position: expected a position; found NaN. Omit it if it is unknown")
    return Readings(
        axis=axis,
        freedoms=freedoms,
        x=x,
        position=position[order],
        zero=zero,
        temperature=_temperatures(raw, approaches, order),
        point=point_of(raw, settings, notes),
    )


def per_freedom(raw: xr.Dataset, name: str, count: int) -> Array:
    """Return a variable over the freedoms, zeros if it is not in the data; MethodError if it is NaN or negative."""
    if name not in raw:
        return np.zeros(count)
    values = np.asarray(raw[name].values, dtype=float)
    if not np.isfinite(values).all() or (values < 0).any():
        raise MethodError(f"{name}: expected a value of 0 or more for each freedom; found a negative one, or NaN")
    return values


def length_uncertainty(raw: xr.Dataset, settings: Settings) -> float:
    """Return the relative standard uncertainty of lengths, of the data or else of the settings."""
    return float(raw["length_uncertainty"]) if "length_uncertainty" in raw else settings.uncertainty.length_or_assumed


def axis_of(raw: xr.Dataset) -> str:
    """Return the axis by its attribute, or else by the names of the freedoms."""
    by_names = {label[-1:] for label in labels(raw, "freedom")}
    axis = str(raw.attrs.get("axis", by_names.pop() if len(by_names) == 1 else ""))
    if axis not in LINEAR_AXES:
        raise MethodError(f"attribute axis: expected one of {', '.join(LINEAR_AXES)}; found '{axis}'")
    return axis


def labels(raw: xr.Dataset, dim: str) -> list[str]:
    """Return the labels of a dim; empty if it has none."""
    if dim not in raw.coords:
        return []
    return [label.decode() if isinstance(label, bytes) else str(label) for label in raw[dim].values]


def freedoms_of(raw: xr.Dataset, axis: str) -> tuple[str, ...]:
    """Return the measured freedoms by the ISO 230-1 names of the data; MethodError for other names."""
    by_name = {name: dof for dof, name in iso_names(axis).items()}
    names = labels(raw, "freedom")
    if not names or set(names) - set(by_name) or len(set(names)) < len(names):
        raise MethodError(
            f"freedom: expected different names among {', '.join(by_name)} for axis {axis}; found "
            f"{', '.join(names) or 'none'}"
        )
    return tuple(by_name[name] for name in names)


def _check_positions(position: Array) -> None:
    if not np.isfinite(position).all():
        raise MethodError("target_position: expected a position of each target; found NaN")
    if position.size < MIN_TARGETS:
        raise MethodError(f"target_position: expected {MIN_TARGETS} targets or more; found {position.size}")
    if np.unique(position).size < position.size:
        raise MethodError("target_position: expected different positions; found one of them twice")


def _by_approach(values: Array, approaches: list[str], axis: int) -> Array:
    """Return values with both approaches in their order along ``axis``; NaN for one that was not measured."""
    moved = np.moveaxis(values, axis, 0)
    full = np.full((2, *moved.shape[1:]), np.nan)
    for k, name in enumerate(approaches):
        full[APPROACHES.index(name)] = moved[k]
    return np.moveaxis(full, 0, axis)


def _temperatures(raw: xr.Dataset, approaches: list[str], order: NDArray[np.int64]) -> dict[str, Array]:
    if "temperature" not in raw:
        return {}
    sensors = labels(raw, "sensor") or [str(k + 1) for k in range(raw.sizes["sensor"])]
    values = np.asarray(raw["temperature"].transpose("sensor", "approach", "run", "target").values, dtype=float)
    return {name: _by_approach(values[k][..., order], approaches, axis=0) for k, name in enumerate(sensors)}


def point_of(raw: xr.Dataset, settings: Settings, notes: list[str]) -> Array:
    """Return the functional point of the data or settings, (3,), m; (0, 0, 0) with a note if neither states it."""
    if "functional_point" in raw:
        stated = raw["functional_point"]
        ordered = stated.sel(direction=["x", "y", "z"]) if "direction" in stated.coords else stated
        return np.asarray(ordered.values, dtype=float)
    if settings.functional_point is not None:
        return np.array(settings.functional_point)
    notes.append(
        "The functional point is not stated: (0, 0, 0) is used for the measured line. State it before the errors are "
        "transformed to another point."
    )
    return np.zeros(3)
