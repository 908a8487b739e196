"""Raw datasets as readings along lines, in a fixed order: approaches forward and backward, targets by position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF, LINEAR_AXES, direction_of, iso_names
from errormotion.methods.linear_positioning.identification.expansion import Side, sides_of
from errormotion.methods.linear_positioning.schema import APPROACHES
from errormotion.methods.linear_positioning.settings import ASSUMED_ALIGNMENT, ASSUMED_LENGTH, LinearPositioningSettings

LENGTHS = ("EX", "EY", "EZ")
MIN_TARGETS = 3
"""Needed to distinguish a drift proportional to the position from the scatter of the readings."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Readings:
    """Deviations along lines, SI: those of the freedoms of an axis, or along diagonals; NaN for missing readings.

    Attributes
    ----------
    names : sequence of str, (line,)
        Of a freedom by ISO 230-1, such as EXX, or of a diagonal.
    x : ndarray, (line, approach, run, target)
        Deviations as recorded.
    position : ndarray, (line, target)
        Increasing, m.
    lever : ndarray, (line, target)
        Distance of the targets from the zero of the instrument, m; 0 where lengths have no effect.
    length, alignment : float
        Standard uncertainties: relative, of the instrument's lengths, and rad, of the line in each of two directions.
    stated_alignment : float or None
        The latter if data or settings state it.
    scatter, drift : ndarray, (line,)
        Stated standard deviation of a reading, and range of the readings at rest during one run; NaN if not stated.
    gain, at_target : ndarray, (line,)
        Standard uncertainties by the instrument: relative, and independent from target to target.
    straight : ndarray of bool, (line,)
        Whether the deviation is a straightness, whose reference line depends on the instrument.
    sides : sequence of Side
        What expands.
    approach, order : ndarray of int
        Number of each recorded approach, and place of each recorded target among the ordered ones.
    axis : str
        "" for diagonals.
    attrs : mapping
        Of the raw dataset.
    """

    names: Sequence[str]
    x: Array
    position: Array
    lever: Array
    length: float
    alignment: float
    stated_alignment: float | None
    scatter: Array
    drift: Array
    gain: Array
    at_target: Array
    straight: NDArray[np.bool_]
    sides: Sequence[Side]
    approach: NDArray[np.intp]
    order: NDArray[np.intp]
    axis: str
    attrs: Mapping[Any, Any]

    @cached_property
    def corrected(self) -> Array:
        """Deviations at the reference temperature, (line, approach, run, target)."""
        change = sum((side.sign * side.coefficient * side.excess for side in self.sides), np.zeros(self.x.shape[1:]))
        return np.asarray(self.x - change * self.lever[:, None, None])

    @property
    def z(self) -> Array:
        """Positions scaled to -1 ... 1 about their mean, in units of half their range, (line, target)."""
        half = np.ptp(self.position, axis=1, keepdims=True) / 2.0
        return np.asarray((self.position - self.position.mean(axis=1, keepdims=True)) / half)


def read(raw: xr.Dataset, settings: LinearPositioningSettings, notes: list[str]) -> Readings:
    """Return the readings of an axis from raw data that follow their schema; remarks are appended to ``notes``.

    Raises
    ------
    MethodError
        An unknown axis, freedom or approach; fewer than three targets, duplicate targets, no readings of a freedom; a
        coefficient of expansion without a temperature, or a temperature without a coefficient.
    """
    axis = axis_of(raw)
    along = DOF[direction_of(axis)]
    approach = approaches_of(raw)
    freedoms = freedoms_of(raw, axis)
    position = np.asarray(raw["target_position"].values, dtype=float)
    _check_positions(position)
    measured = np.asarray(raw["deviation"].transpose("freedom", "approach", "run", "target").values, dtype=float)
    if not np.isfinite(measured).any(axis=(1, 2, 3)).all():
        raise MethodError(
            "deviation: expected readings of each freedom; found none for one or more of them",
            code="position.no_readings",
        )
    ordered = np.argsort(position)
    zero = zero_of(raw)
    is_along = np.array([name == along for name in freedoms])
    sides = sides_of(raw, temperatures(raw, approach, ordered), measured.shape[1:], settings, notes)
    notes += missing(measured, raw)
    lever = np.where(is_along[:, None], position[ordered] - zero, 0.0)
    return Readings(
        names=[iso_names(axis)[name] for name in freedoms],
        x=by_approach(measured[..., ordered], approach, axis=1),
        position=np.tile(position[ordered], (len(freedoms), 1)),
        lever=lever,
        **instrument(raw, settings, is_along, notes),
        at_target=per_line(raw, "target_uncertainty", len(freedoms)),
        gain=per_line(raw, "gain_uncertainty", len(freedoms)),
        straight=np.array([name in LENGTHS and name != along for name in freedoms]),
        sides=sides if is_along.any() else (),
        approach=approach,
        order=np.argsort(ordered),
        axis=axis,
        attrs=raw.attrs,
    )


def zero_of(raw: xr.Dataset) -> float:
    """Return the position at which the instrument was set to zero, m; the first target if it is not stated."""
    zero = float(raw["zero_position"]) if "zero_position" in raw else float(raw["target_position"].values[0])
    if not np.isfinite(zero):
        raise MethodError(
            "zero_position: expected a position; found NaN. Omit it if it is unknown", code="raw.value.unknown"
        )
    return zero


def missing(measured: Array, raw: xr.Dataset) -> list[str]:
    """Return a note on readings that are missing, and on a direction that was not measured."""
    notes = []
    if count := int(np.isnan(measured).sum()):
        notes.append(f"{count} of {measured.size} readings are missing; the others are evaluated.")
    approaches = labels(raw, "approach")
    if set(approaches) != set(APPROACHES):
        notes.append(f"Targets were approached {approaches[0]} only: figures of both directions are unknown.")
    return notes


def instrument(
    raw: xr.Dataset, settings: LinearPositioningSettings, lengths: NDArray[np.bool_], notes: list[str]
) -> dict[str, Any]:
    """Return what data or settings state about instrument and scatter; each assumption about lengths has a note."""
    stated, count = settings.uncertainty, len(lengths)
    alignment = float(raw["alignment_uncertainty"]) if "alignment_uncertainty" in raw else stated.alignment
    if lengths.any():
        if note := assumed_length(raw, settings):
            notes.append(note)
        if alignment is None:
            notes.append(
                f"Assumed, because it is not stated: an alignment of {1e3 * ASSUMED_ALIGNMENT:g} mrad "
                "(uncertainty.alignment). It contributes to the uncertainties only."
            )
    return {
        "length": length_uncertainty(raw, settings),
        "alignment": stated.alignment_or_assumed if alignment is None else alignment,
        "stated_alignment": alignment,
        "scatter": _stated(raw, "reading_scatter", stated.scatter, lengths, count),
        "drift": _stated(raw, "run_drift", stated.drift, lengths, count),
    }


def _stated(raw: xr.Dataset, name: str, setting: float | None, lengths: NDArray[np.bool_], count: int) -> Array:
    """Return what the data state of each line, or else the setting for lengths; NaN if neither does."""
    of_setting = np.where(lengths, np.nan if setting is None else setting, np.nan)
    if name not in raw:
        return of_setting
    values = np.broadcast_to(np.asarray(raw[name].values, dtype=float), count)
    return np.where(np.isfinite(values), values, of_setting)


def per_line(raw: xr.Dataset, name: str, count: int) -> Array:
    """Return a variable over the freedoms, zeros if it is not in the data; MethodError if it is NaN or negative."""
    if name not in raw:
        return np.zeros(count)
    values = np.asarray(raw[name].values, dtype=float)
    if not np.isfinite(values).all() or (values < 0).any():
        raise MethodError(
            f"{name}: expected a value of 0 or more for each freedom; found a negative one, or NaN",
            code="raw.value.negative",
        )
    return values


def assumed_length(raw: xr.Dataset, settings: LinearPositioningSettings) -> str:
    """Return a note if the uncertainty of lengths is assumed; else an empty text."""
    if "length_uncertainty" in raw or settings.uncertainty.length is not None:
        return ""
    return (
        "Assumed, because it is not stated: an uncertainty of the instrument's lengths of "
        f"{1e6 * ASSUMED_LENGTH:g} um/m (uncertainty.length). It contributes to the uncertainties only."
    )


def length_uncertainty(raw: xr.Dataset, settings: LinearPositioningSettings) -> float:
    """Return the relative standard uncertainty of lengths, of the data or else of the settings."""
    return float(raw["length_uncertainty"]) if "length_uncertainty" in raw else settings.uncertainty.length_or_assumed


def axis_of(raw: xr.Dataset) -> str:
    """Return the axis by its attribute, or else by the names of the freedoms."""
    by_names = {label[-1:] for label in labels(raw, "freedom")}
    axis = str(raw.attrs.get("axis", by_names.pop() if len(by_names) == 1 else ""))
    if axis not in LINEAR_AXES:
        raise MethodError(
            f"attribute axis: expected one of {', '.join(LINEAR_AXES)}; found '{axis}'", code="raw.axis.unknown"
        )
    return axis


def labels(raw: xr.Dataset, dim: str) -> list[str]:
    """Return the labels of a dim; empty if it has none."""
    if dim not in raw.coords:
        return []
    return [label.decode() if isinstance(label, bytes) else str(label) for label in raw[dim].values]


def approaches_of(raw: xr.Dataset) -> NDArray[np.intp]:
    """Return the number of each recorded approach, 0 forward and 1 backward; MethodError for other labels."""
    approaches = labels(raw, "approach")
    if not approaches or set(approaches) - set(APPROACHES) or len(set(approaches)) < len(approaches):
        raise MethodError(
            f"approach: expected the labels forward, backward; found {', '.join(approaches) or 'none'}",
            code="position.approach.labels",
        )
    return np.array([APPROACHES.index(name) for name in approaches])


def freedoms_of(raw: xr.Dataset, axis: str) -> tuple[str, ...]:
    """Return the measured freedoms by the ISO 230-1 names of the data; MethodError for other names."""
    by_name = {name: dof for dof, name in iso_names(axis).items()}
    names = labels(raw, "freedom")
    if not names or set(names) - set(by_name) or len(set(names)) < len(names):
        raise MethodError(
            f"freedom: expected different names among {', '.join(by_name)} for axis {axis}; found "
            f"{', '.join(names) or 'none'}",
            code="position.freedoms.names",
        )
    return tuple(by_name[name] for name in names)


def _check_positions(position: Array) -> None:
    if not np.isfinite(position).all():
        raise MethodError(
            "target_position: expected a position of each target; found NaN", code="position.targets.unknown"
        )
    if position.size < MIN_TARGETS:
        raise MethodError(
            f"target_position: expected {MIN_TARGETS} targets or more; found {position.size}",
            code="position.targets.too_few",
        )
    if np.unique(position).size < position.size:
        raise MethodError(
            "target_position: expected different positions; found one of them twice", code="position.targets.repeated"
        )


def by_approach(values: Array, approach: NDArray[np.intp], axis: int) -> Array:
    """Return values with both approaches in their order along ``axis``; NaN for one that was not measured."""
    moved = np.moveaxis(values, axis, 0)
    full = np.full((2, *moved.shape[1:]), np.nan)
    full[approach] = moved
    return np.moveaxis(full, 0, axis)


def temperatures(raw: xr.Dataset, approach: NDArray[np.intp], ordered: NDArray[np.intp]) -> dict[str, Array]:
    """Return the temperatures of each sensor, (approach, run, target), degC."""
    if "temperature" not in raw:
        return {}
    sensors = labels(raw, "sensor") or [str(k + 1) for k in range(raw.sizes["sensor"])]
    values = np.asarray(raw["temperature"].transpose("sensor", "approach", "run", "target").values, dtype=float)
    return {name: by_approach(values[k][..., ordered], approach, axis=0) for k, name in enumerate(sensors)}


def point_of(raw: xr.Dataset, settings: LinearPositioningSettings, notes: list[str]) -> Array:
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
