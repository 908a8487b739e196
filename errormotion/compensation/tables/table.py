"""The correction of one component at points along one axis."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.compensation.correction import Correction, correction
from errormotion.datasets import provenance
from errormotion.datasets.schemas import DOF, SIGN
from errormotion.errors import DatasetError
from errormotion.kinematics.iso import iso_names

MOST_POINTS = 100_000
"""Points of a table before the limits of its format are applied."""

LINE = 160
"""Longest comment."""

_FINE = 10
"""Points between two of the table at which its error is computed."""

_AXES = "XYZ"


@dataclass(frozen=True)
class AxisTable:
    """Corrections along an axis.

    Attributes
    ----------
    axis, component : str
        ``X``, ``Y`` or ``Z``: the axis along which the points are, and that which is corrected.
    positions : (n,)
        Commanded positions of the axis, increasing, m.
    forward, backward : (n,)
        Offset that is added to the command of the component after a motion in the positive and in the negative
        direction, m; alike where the errors state no reversal.
    uncertainty : (n,)
        Standard uncertainty of the offset, m; NaN = unknown.
    fine, fine_forward, fine_backward, fine_uncertainty : (m,)
        The same at many positions over all of the measured range, for the error of the table.
    name : str
        For file names: machine and axis.
    comments : tuple of str
        What every file states: machine, date, run, method, sign, unit, reference temperature, uncertainty.
    notes : tuple of str
        Sentences for the reader.
    """

    axis: str
    component: str
    positions: Array
    forward: Array
    backward: Array
    uncertainty: Array
    fine: Array
    fine_forward: Array
    fine_backward: Array
    fine_uncertainty: Array
    name: str
    comments: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def step(self) -> float:
        """Distance between points, m; NaN where it is not constant."""
        steps = np.diff(self.positions)
        return float(steps.mean()) if np.ptp(steps) <= 1e-8 else float("nan")

    @property
    def reversal(self) -> float:
        """Largest difference between the directions, m."""
        return float(np.abs(self.forward - self.backward).max())

    @property
    def mean(self) -> Array:
        """Mean of both directions, (n,), m."""
        return np.asarray((self.forward + self.backward) / 2)


def axis_table(
    errors: xr.Dataset,
    axis: str,
    *,
    component: str = "",
    step: float | None = None,
    at: ArrayLike = (0.0, 0.0, 0.0),
    time: float | None = None,
    functional_point: ArrayLike | None = None,
    chain: str = "",
    run: str = "",
) -> AxisTable:
    """Return the corrections along an axis.

    Parameters
    ----------
    errors : Dataset
        Error dataset over position or targets, and perhaps time. Where it has ``reversal(freedom, position)`` (mean
        forward less mean backward), both directions of approach have corrections of their own.
    axis : str
        ``X``, ``Y`` or ``Z``.
    component : str
        What is corrected: ``X``, ``Y`` or ``Z``; default: the axis itself.
    step : float, optional
        Distance between points, m; they are multiples of it. Default: the measured positions.
    at : (3,)
        Positions of the other axes, m.
    time : float, optional
        Instant of errors over time, s.
    functional_point : (3,), optional
        See `errormotion.compensation.correction.correction`.
    chain : str
        See `errormotion.compensation.correction.correction`.
    run : str
        Name of the run, for the comments.

    Raises
    ------
    DatasetError
        No such axis, errors that do not depend on its position, an unknown component, no or too many points.
    """
    component = component or axis
    for what, letter in (("axis", axis), ("component", component)):
        if letter not in _AXES:
            raise DatasetError(f"{what}: expected X, Y or Z; found '{letter}'")
    made = correction(errors, functional_point, chain=chain, partial=True)
    k, c = _AXES.index(axis), _AXES.index(component)
    if DOF[c] in made.left:
        raise DatasetError(f"{DOF[c]} is not known: no correction of {component} follows from these errors")
    measured = _measured(errors, axis)
    positions = measured if step is None else _multiples(measured, step)
    fine = np.unique(np.concatenate([np.linspace(a, b, _FINE, endpoint=False) for a, b in _pairs(measured, positions)]))
    fine = np.append(fine, max(measured[-1], positions[-1]))
    offset, u, _ = _along(made, positions, k, c, at, time)
    fine_offset, fine_u, valid = _along(made, fine, k, c, at, time)
    half, half_fine = (_reversal(errors, axis, component, x) / 2 for x in (positions, fine))
    notes = [note for note in made.notes if "left as they are" not in note]
    if not valid.all():
        notes.append("Parts of the table lie outside of what was measured: the correction is held at the edge there.")
    elif not np.isfinite(fine_u).all():
        notes.append("The uncertainty between measured places is unknown: there are too few of them.")
    return AxisTable(
        axis, component, positions, offset - half, offset + half, u, fine, fine_offset - half_fine,
        fine_offset + half_fine, fine_u, _file_name(f"{errors.attrs['machine']}-{axis}{component.strip(axis)}"),
        _comments(errors, axis, component, fine_u, run), tuple(notes),
    )  # fmt: skip


def _measured(errors: xr.Dataset, axis: str) -> Array:
    letter = axis.lower()
    if letter not in errors.variables or errors[letter].dims not in (("position",), ("target",)):
        raise DatasetError(f"The errors have no positions of {axis}; a table of {axis} needs errors along it")
    if errors[letter].dims == ("position",) and str(errors.attrs["component"]) in _AXES.replace(axis, ""):
        raise DatasetError(
            f"The errors are those of {errors.attrs['component']}; a table of {axis} needs errors along it"
        )
    found: Array = np.unique(np.round(np.asarray(errors[letter].values, dtype=float), 9))
    found = found[np.isfinite(found)]
    if found.size < 2:
        raise DatasetError(f"Expected at least two positions of {axis}; found {found.size}")
    return found


def _multiples(measured: Array, step: float) -> Array:
    low, high = measured[0], measured[-1]
    if not (np.isfinite(step) and step > 0):
        raise DatasetError(f"step: expected a length above 0; found {1e3 * step:g} mm")
    first, last = np.ceil(low / step - 1e-6), np.floor(high / step + 1e-6)
    if last - first < 1:
        raise DatasetError(
            f"step: {1e3 * step:g} mm gives fewer than two points from {1e3 * low:g} to {1e3 * high:g} mm; state less"
        )
    if last - first >= MOST_POINTS:
        raise DatasetError(
            f"step: {1e3 * step:g} mm gives {last - first + 1:.0f} points; expected at most {MOST_POINTS}"
        )
    return np.asarray(np.arange(first, last + 1) * step)


def _pairs(measured: Array, positions: Array) -> list[tuple[float, float]]:
    edges = np.union1d(measured, positions)
    return list(pairwise(edges))


def _along(
    made: Correction, x: Array, k: int, c: int, at: ArrayLike, time: float | None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    points = np.tile(np.asarray(at, dtype=float), (x.size, 1))
    points[:, k] = x
    values = made.at(points, time, covariance=True)
    variance = np.zeros(x.size) if values.covariance is None else values.covariance[:, c, c]
    return values.offset[:, c], np.sqrt(np.maximum(variance, 0.0)), values.valid


def _reversal(errors: xr.Dataset, axis: str, component: str, x: Array) -> Array:
    """Return mean forward less mean backward error at positions, m; 0 where the errors state none."""
    if "reversal" not in errors.variables or set(errors["reversal"].dims) != {"freedom", "position"}:
        return np.zeros(x.size)
    name = iso_names(axis)[f"E{component}"]
    if name not in errors["freedom"].values:
        return np.zeros(x.size)
    values = np.asarray(errors["reversal"].sel(freedom=name).values, dtype=float)
    known = np.isfinite(values)
    position = np.asarray(errors[axis.lower()].values, dtype=float)[known]
    order = np.argsort(position)
    return np.interp(x, position[order], values[known][order]) if known.any() else np.zeros(x.size)


def _comments(errors: xr.Dataset, axis: str, component: str, u: Array, run: str) -> tuple[str, ...]:
    attrs = errors.attrs
    raw = provenance.of(errors).get("raw") or {}
    known = u[np.isfinite(u)]
    name = iso_names(axis)[f"E{component}"]
    temperature = attrs.get("reference_temperature")
    if temperature is None and "temperature" in errors.variables and np.isfinite(errors["temperature"].values).any():
        temperature = float(np.nanmean(errors["temperature"].values))
        mean = " (mean of the measurement)"
    else:
        mean = ""
    lines = (
        f"machine: {attrs['machine']}",
        f"correction of {component} along {axis} ({name})",
        f"date: {attrs.get('start') or 'unknown'}",
        f"run: {run or 'unknown'}, raw data {str(raw.get('hash') or 'unknown')[:16]}",
        f"method: {attrs['method']} {attrs['method_version']}, errors of {attrs['component']}",
        f"errors: {SIGN}; reference: {attrs['reference']}",
        f"reference temperature: {'unknown' if temperature is None else f'{float(temperature):.2f} degC'}{mean}",
        f"uncertainty of the correction (k = 2): {f'{2e6 * known.max():.2f} um' if known.size else 'unknown'}",
    )
    return tuple("".join(letter if letter.isprintable() else " " for letter in line)[:LINE] for line in lines)


def _file_name(text: str) -> str:
    kept = "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in text)
    return "-".join(part for part in kept.split("-") if part)[:60] or "machine"


def applied(x: Array, positions: Array, values: Array, between: str) -> Array:
    """Return what a control applies at positions x, (m,): lines between points or the nearest one, held outside."""
    if between == "steps":
        nearest = np.abs(x[:, None] - positions).argmin(axis=1)
        return np.asarray(values[nearest])
    return np.interp(x, positions, values)
