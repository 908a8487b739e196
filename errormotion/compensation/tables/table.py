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

MAX_POINTS = 100_000
"""Maximum number of points of a table, before the limits of its format are applied."""

MAX_COMMENT = 160
"""Maximum length of a comment, characters."""

_FINE = 10
"""Points between two of the table at which its error is computed."""

_AXES = "XYZ"


@dataclass(frozen=True)
class AxisTable:
    """Corrections along an axis.

    Attributes
    ----------
    axis, component : str
        ``X``, ``Y`` or ``Z``: the axis of the points, and the corrected axis.
    positions : (n,)
        Commanded positions of the axis, increasing, m.
    forward, backward : (n,)
        Offset added to the command of the component after a motion in the positive and in the negative direction,
        m; equal if the errors state no reversal.
    uncertainty : (n,)
        Standard uncertainty of the offset, m; NaN = unknown.
    fine, fine_forward, fine_backward, fine_uncertainty : (m,)
        The same at many positions over the measured range, to compute the error of the table.
    name : str
        For file names: machine and axis.
    comments : tuple of str
        Comments of every file: machine, date, run, method, sign, unit, reference temperature, uncertainty.
    notes : tuple of str
        Notes for the user.
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
        """Distance between points, m; NaN if it is not constant."""
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
        Error dataset over position or targets, and optionally time. With ``reversal(freedom, position)`` (mean forward
        less mean backward) the corrections of both directions of approach differ.
    axis : str
        ``X``, ``Y`` or ``Z``.
    component : str
        Corrected axis: ``X``, ``Y`` or ``Z``; default: ``axis``.
    step : float, optional
        Distance between points, m; they are multiples of it. Default: the measured positions.
    at : (3,)
        Positions of the other axes, m.
    time : float, optional
        Time of the correction for errors over time, s.
    functional_point : (3,), optional
        See `errormotion.compensation.correction.correction`.
    chain : str
        See `errormotion.compensation.correction.correction`.
    run : str
        Name of the run, for the comments.

    Raises
    ------
    DatasetError
        Unknown axis or component, errors that do not depend on the position of the axis, no or too many points.
    """
    component = component or axis
    for what, letter in (("axis", axis), ("component", component)):
        if letter not in _AXES:
            raise DatasetError(f"{what}: expected X, Y or Z; found '{letter}'", code="table.axis.unknown")
    made = correction(errors, functional_point, chain=chain, partial=True)
    k, c = _AXES.index(axis), _AXES.index(component)
    if DOF[c] in made.left:
        raise DatasetError(
            f"{DOF[c]} is unknown: {component} cannot be corrected by these errors", code="table.freedom.unknown"
        )
    measured = _measured(errors, axis)
    positions = measured if step is None else _multiples(measured, step)
    fine = np.unique(np.concatenate([np.linspace(a, b, _FINE, endpoint=False) for a, b in _pairs(measured, positions)]))
    fine = np.append(fine, max(measured[-1], positions[-1]))
    offset, u, _ = _along(made, positions, k, c, at, time)
    fine_offset, fine_u, valid = _along(made, fine, k, c, at, time)
    half, half_fine = (_reversal(errors, axis, component, x) / 2 for x in (positions, fine))
    notes = [note for note in made.notes if "not corrected" not in note]
    if not valid.all():
        notes.append("Parts of the table lie outside the measured range: the correction there is that at its limit.")
    elif not np.isfinite(fine_u).all():
        notes.append("The uncertainty between measured positions is unknown: their number is too small.")
    return AxisTable(
        axis, component, positions, offset - half, offset + half, u, fine, fine_offset - half_fine,
        fine_offset + half_fine, fine_u, _file_name(f"{errors.attrs['machine']}-{axis}{component.strip(axis)}"),
        _comments(errors, axis, component, fine_u, run), tuple(notes),
    )  # fmt: skip


def _measured(errors: xr.Dataset, axis: str) -> Array:
    letter = axis.lower()
    if letter not in errors.variables or errors[letter].dims not in (("position",), ("target",)):
        raise DatasetError(
            f"The errors have no positions of {axis}; a table of {axis} requires errors along it",
            code="table.axis.no_positions",
        )
    if errors[letter].dims == ("position",) and str(errors.attrs["component"]) in _AXES.replace(axis, ""):
        raise DatasetError(
            f"The errors are those of {errors.attrs['component']}; a table of {axis} requires errors along it",
            code="table.axis.other",
        )
    found: Array = np.unique(np.round(np.asarray(errors[letter].values, dtype=float), 9))
    found = found[np.isfinite(found)]
    if found.size < 2:
        raise DatasetError(
            f"Expected at least two positions of {axis}; found {found.size}", code="table.positions.too_few"
        )
    return found


def _multiples(measured: Array, step: float) -> Array:
    low, high = measured[0], measured[-1]
    if not (np.isfinite(step) and step > 0):
        raise DatasetError(
            f"step: expected a length above 0; found {1e3 * step:g} mm", code="table.distance.not_positive"
        )
    first, last = np.ceil(low / step - 1e-6), np.floor(high / step + 1e-6)
    if last - first < 1:
        raise DatasetError(
            f"step: {1e3 * step:g} mm: fewer than two points from {1e3 * low:g} to {1e3 * high:g} mm; reduce it",
            code="table.distance.too_large",
        )
    if last - first >= MAX_POINTS:
        raise DatasetError(
            f"step: {1e3 * step:g} mm: {last - first + 1:.0f} points; expected at most {MAX_POINTS}",
            code="table.points.too_many",
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
    """Return mean forward minus mean backward error at positions, m; 0 if the errors state none."""
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
    return tuple("".join(letter if letter.isprintable() else " " for letter in line)[:MAX_COMMENT] for line in lines)


def _file_name(text: str) -> str:
    kept = "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in text)
    return "-".join(part for part in kept.split("-") if part)[:60] or "machine"


def applied(x: Array, positions: Array, values: Array, between: str) -> Array:
    """Return the offsets of a control at positions x, (m,): linear or nearest point, constant outside the table."""
    if between == "steps":
        nearest = np.abs(x[:, None] - positions).argmin(axis=1)
        return np.asarray(values[nearest])
    return np.interp(x, positions, values)
