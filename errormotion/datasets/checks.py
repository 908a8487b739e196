"""Checks for all schemas: units, magnitudes, attributes, labels.

Each returns one sentence for each violation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from errormotion.datasets.files.sampling import sample, steps
from errormotion.datasets.schemas import STRAIGHTNESS_REFERENCES, Row
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError

_MISTAKES = {
    "m": ((1e-3, 0.0, "mm"), (1e-6, 0.0, "um"), (0.0254, 0.0, "inches")),
    "rad": ((np.pi / 180 / 3600, 0.0, "arcsec"), (1e-6, 0.0, "urad"), (np.pi / 180, 0.0, "deg")),
    "degC": ((1.0, -273.15, "K"),),
}

ROUNDING = 1e-8
"""Rounding of a covariance relative to its diagonal, after transformations over some metres and back."""


def number(value: float) -> str:
    """Return a number as text with six digits."""
    return f"{value:.6g}"


def magnitude_violations(name: str, variable: xr.Variable, row: Row) -> list[str]:
    """Return violations of type, unit and magnitude of the values of a variable, of a sample if it is large."""
    if variable.dtype.kind not in "fiu":
        return [f"{name}: expected numbers (float64); found {_dtype(variable)}"]
    messages = unit_violations(name, variable.attrs, row.unit) + _of_several(name, variable.attrs, row.units)
    values = sample(variable).astype(float)
    if np.isinf(values).any():
        messages.append(f"{name}: expected finite numbers, NaN where unknown; found an infinite one")
    values = values[np.isfinite(values)]
    outside = values[(values < row.low) | (values > row.high)]
    if outside.size and not messages:
        worst = float(outside[np.argmax(np.abs(outside))])
        unit = f" {row.unit}" if row.unit not in ("", "1") else ""
        messages.append(f"{name} = {number(worst)}{unit}: expected {_range(row)}{unit}{_guess(worst, row)}")
    return messages


def _range(row: Row) -> str:
    return f"{number(row.low)}..{number(row.high)}"


def _guess(value: float, row: Row) -> str:
    mistakes = _MISTAKES.get(row.unit, ())
    # If a whole turn is plausible, the value is not in seconds of arc.
    for factor, offset, unit in mistakes[::-1] if row.unit == "rad" and row.high > 1 else mistakes:
        if row.low <= value * factor + offset <= row.high:
            return f"; is it in {unit}?"
    return ""


def _of_several(name: str, attrs: Mapping[Any, Any], units: tuple[str, ...]) -> list[str]:
    """Return a sentence if a stated unit is none of those of a variable of several quantities, such as m and rad."""
    stated = attrs.get("units")
    if not units or stated is None or set(re.findall(r"[^\s,;]+", str(stated))) <= {*units, "and", "or"}:
        return []
    expected = " or ".join(f"'{unit}'" for unit in units)
    return [f"{name}: expected units {expected}; found '{stated}'. Convert the values and set the attribute"]


def unit_violations(name: str, attrs: Mapping[Any, Any], unit: str) -> list[str]:
    """Return a sentence if the attribute ``units`` exists and is not the unit of the schema."""
    unit_found = attrs.get("units")
    if unit_found is None or not unit:
        return []
    if not isinstance(unit_found, str):
        return [f"{name}: expected units '{unit}'; found {unit_found!r:.100}"]
    if unit_found == unit:
        return []
    if unit == "1":
        if unit_found.strip().lower() in ("", "dimensionless", "none"):
            return []
        return [f"{name}: expected units '1' (a pure number); found '{unit_found}'"]
    try:
        same = convert(1.0, unit_found, unit) == 1.0 and convert(0.0, unit_found, unit) == 0.0
    except DatasetError as error:
        return [f"{name}: expected units '{unit}'; found '{unit_found}': {error}"]
    if same:
        return []
    return [f"{name}: expected units '{unit}'; found '{unit_found}'. Convert the values and set the attribute"]


def matrix_violations(name: str, matrices: np.ndarray, unknown: np.ndarray) -> list[str]:
    """Return a sentence if matrices are not covariances.

    Parameters
    ----------
    name : str
    matrices : ndarray (..., k, k)
    unknown : ndarray of bool (..., k)
        Whether the values are unknown; rows and columns must be NaN exactly there.
    """
    if matrices.dtype.kind != "f" or matrices.shape != (*unknown.shape, unknown.shape[-1]):
        return [f"{name}: expected a square matrix of numbers for each place"]
    gaps = unknown[..., :, None] | unknown[..., None, :]
    if not np.array_equal(np.isnan(matrices), gaps):
        return [f"{name}: expected NaN exactly where the value is NaN"]
    C = np.where(gaps, 0.0, matrices).astype(float)
    if not np.isfinite(C).all():
        return [f"{name}: expected finite numbers; found an infinite one"]
    variance = np.diagonal(C, axis1=-2, axis2=-1)
    if (variance < 0).any():
        return [f"{name}: expected variances of 0 or more; found {number(float(variance.min()))}"]
    scale = np.where(variance > 0, np.sqrt(variance), 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = C / scale[..., :, None] / scale[..., None, :]
        even = np.abs(correlation - np.swapaxes(correlation, -1, -2)).max(initial=0.0) <= ROUNDING
    if not even:
        return [f"{name}: expected symmetric matrices; found one that is not"]
    if np.linalg.eigvalsh(correlation).min(initial=0.0) < -ROUNDING:
        return [f"{name}: expected no negative variance in any direction (positive semidefinite); found one"]
    return []


def label_violations(ds: xr.Dataset, dim: str, labels: tuple[str, ...], *, ordered: bool = True) -> list[str]:
    """Return violations of the labels of a dimension: missing, unknown, repeated, or in another order."""
    if dim not in ds.variables:
        return [f"{dim}: expected a coordinate with the labels {' '.join(labels)}; found none"]
    variable = ds.variables[dim]
    if variable.dims != (dim,):
        return [f"{dim}: expected a coordinate along '{dim}'; found dims {dims(variable)}"]
    labels_found = tuple(
        label.decode() if isinstance(label, bytes) else str(label) for label in variable.values.tolist()
    )
    missing = [label for label in labels if label not in labels_found]
    unknown = [label for label in labels_found if label not in labels]
    twice = sorted({label for label in labels_found if labels_found.count(label) > 1})
    what = f"{dim}: expected {' '.join(labels)}; found {' '.join(labels_found) or 'nothing'}"
    complaints = [
        f"{word} {' '.join(names)}"
        for word, names in (("missing", missing), ("unknown", unknown), ("repeated", twice))
        if names
    ]
    if complaints:
        return [f"{what}: {', '.join(complaints)}"]
    return [f"{what}: in another order"] if ordered and labels_found != labels else []


def time_violations(name: str, variable: xr.Variable) -> list[str]:
    """Return a sentence if times are not finite, or do not increase."""
    if variable.dtype.kind not in "fiu":
        return [f"{name}: expected seconds (float64); found {_dtype(variable)}"]
    last = -np.inf
    for run in steps(variable):
        values = run.astype(float)
        if not np.isfinite(values).all():
            return [f"{name}: expected finite seconds; found {number(values[~np.isfinite(values)][0])}"]
        wrong = np.flatnonzero(np.diff(values) <= 0)
        if wrong.size:
            before, after = values[wrong[0]], values[wrong[0] + 1]
            return [f"{name}: expected increasing seconds; found {number(after)} s after {number(before)} s"]
        if values.size and values[0] < last:
            return [f"{name}: expected increasing seconds; found {number(values[0])} s after {number(last)} s"]
        last = values[-1] if values.size else last
    return []


def storable_violations(ds: xr.Dataset) -> list[str]:
    """Return what a NetCDF file cannot store: attributes except text, numbers, flat arrays of them; text with NUL."""
    owners: list[tuple[str, Mapping[Any, Any]]] = [("", ds.attrs)]
    owners += [(f"{name}: ", variable.attrs) for name, variable in ds.variables.items()]
    messages = [
        f"{owner}attribute '{name}': expected text, a number or a flat array of them; found {_what(value)}"
        for owner, attrs in owners
        for name, value in attrs.items()
        if not _storable(value)
    ]
    for name, variable in ds.variables.items():
        if variable.dtype.kind in "UTO" and any("\0" in str(text) for text in variable.values.flat):
            messages.append(f"{name}: expected text without the character NUL")
    return messages


def _storable(value: Any) -> bool:
    if isinstance(value, str):
        return "\0" not in value
    if isinstance(value, (int, float, np.integer, np.floating)):
        return not isinstance(value, bool)
    if isinstance(value, np.ndarray):
        return value.ndim <= 1 and value.dtype.kind in "fiuU"
    if isinstance(value, (list, tuple)):
        kinds = {str if isinstance(item, str) else float for item in value}
        return len(kinds) == 1 and all(not isinstance(item, (list, tuple)) and _storable(item) for item in value)
    return False


def _what(value: Any) -> str:
    if value is None or isinstance(value, (bool, np.bool_)):
        return str(value)
    if isinstance(value, str):
        return "text with the character NUL"
    return type(value).__name__


def _dtype(variable: xr.Variable) -> str:
    return "text" if variable.dtype.kind in "UTSO" else str(variable.dtype)


def dims(variable: xr.Variable) -> str:
    """Return the dimensions of a variable as text."""
    return f"({', '.join(map(str, variable.dims))})"


def straightness_reference_violations(ds: xr.Dataset) -> list[str]:
    """Return the violation in the attribute ``straightness_reference`` of a raw or error dataset."""
    value = ds.attrs.get("straightness_reference", STRAIGHTNESS_REFERENCES[0])
    if isinstance(value, str) and value in STRAIGHTNESS_REFERENCES:
        return []
    expected = " or ".join(STRAIGHTNESS_REFERENCES)
    return [f"attribute 'straightness_reference': expected {expected}; found {value!r}. Leave it out if unknown"]
