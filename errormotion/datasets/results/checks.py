"""Validation of error datasets.

A ballbar, a diagonal or a line of sight determines one value at each position: the deviation ``h . E`` of the six
freedoms E along a known direction. No freedom follows from it alone, so that all six are unknown; the dataset contains
the deviation and its sensitivity h.
"""

from __future__ import annotations

import json
import math
from collections.abc import Hashable, Sequence
from datetime import datetime
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.checks import (
    dims as dims_text,
)
from errormotion.datasets.checks import (
    label_violations,
    magnitude_violations,
    number,
    storable_violations,
    straightness_reference_violations,
    time_violations,
    unit_violations,
)
from errormotion.datasets.schemas import (
    COMPONENTS,
    DOF,
    ERROR_ATTRIBUTES,
    ERROR_DIMS,
    ERROR_ROWS,
    ERROR_UNITS,
    INDEX,
    OPTIONAL_ATTRIBUTES,
    SCHEMA,
    SIGN,
    Row,
)
from errormotion.kinematics.chains import parse_chain

ROUNDING = 1e-8
"""Rounding of a 6x6 covariance relative to its diagonal, after moves over some metres and back."""

FARTHEST = 50.0
"""Largest plausible coordinate of a functional point, m; larger ones are probably in mm."""

UNIT_LENGTH = 1e-6
"""Tolerance of the length of a unit vector."""

_DEVIATION = ("deviation", "deviation_variance", "sensitivity", "deviation_influence")
_ROWS = {row.name: row for row in ERROR_ROWS}


def error_violations(ds: xr.Dataset) -> list[str]:
    """Return every violation of the error schema, one sentence each."""
    messages = [*_attribute_violations(ds), *storable_violations(ds)]
    missing = [name for name in DOF if name not in ds.data_vars]
    if missing:
        return [*messages, f"{' '.join(missing)}: missing; expected all of {' '.join(DOF)}, NaN if unknown"]
    dims = ds["EX"].dims
    messages += _dim_violations(ds, dims)
    complaints = []
    for name, unit in zip(DOF, ERROR_UNITS, strict=True):
        variable = ds.variables[name]
        if variable.dims != dims:
            complaints.append(f"{name}: expected the dims of EX {dims_text(ds.variables['EX'])}; found {variable.dims}")
        if variable.attrs.get("units") is None:
            complaints.append(f"{name}: expected the attribute units = '{unit}'; found none")
        complaints += magnitude_violations(name, variable, _ROWS[name])
    messages += complaints + _coordinate_violations(ds) + _comparison_violations(ds, dims)
    shape_complaints = _shape_violations(ds, dims)
    messages += shape_complaints
    if not complaints and not shape_complaints:
        messages += _covariance_violations(ds)
        messages += _deviation_violations(ds, dims)
    return messages


def _attribute_violations(ds: xr.Dataset) -> list[str]:
    messages = []
    for name, meaning in ERROR_ATTRIBUTES.items():
        value = ds.attrs.get(name)
        if value is None:
            messages.append(f"attribute '{name}': missing; expected {meaning}")
        elif name == "functional_point":
            messages += _point_violations(value)
        elif not isinstance(value, str) or not value.strip():
            messages.append(f"attribute '{name}': expected {meaning}; found {value!r}")
        elif name == "sign" and value != SIGN:
            messages.append(f"attribute 'sign': expected '{SIGN}'; found '{value}'. Reverse the values and set it")
        elif name == "schema" and value != SCHEMA:
            messages.append(f"attribute 'schema': expected '{SCHEMA}'; found '{value}'")
        elif name == "component" and value not in COMPONENTS and not str(ds.attrs.get("component_description", "")):
            messages.append(
                f"attribute 'component': expected one of {', '.join(COMPONENTS)}; found '{value}'. Describe another "
                "one in the attribute 'component_description'"
            )
        elif name == "provenance" and not _is_json_object(value):
            messages.append("attribute 'provenance': expected a JSON object; found other text")
    return messages


def _point_violations(value: Any, name: str = "functional_point") -> list[str]:
    try:
        point = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        return [f"attribute '{name}': expected three finite coordinates in m; found {value!r}"]
    if np.abs(point).max() > FARTHEST:
        far = number(float(point[np.argmax(np.abs(point))]))
        return [f"attribute '{name}': {far} m: expected within {FARTHEST:g} m; is it in mm?"]
    return []


def _is_json_object(text: str) -> bool:
    try:
        return isinstance(json.loads(text), dict)
    except (ValueError, RecursionError):
        return False


def _coordinate_violations(ds: xr.Dataset) -> list[str]:
    messages = []
    if "time" in ds.sizes:
        if "time" not in ds.variables:
            messages.append("time: missing; expected seconds since the reference state")
        else:
            messages += unit_violations("time", ds.variables["time"].attrs, "s")
            messages += time_violations("time", ds.variables["time"])
    for name in ("x", "y", "z"):
        if name in ds.variables:
            if not set(ds.variables[name].dims) <= {"position", "target"}:
                messages.append(f"{name}: expected dims position or target; found {dims_text(ds.variables[name])}")
            messages += magnitude_violations(name, ds.variables[name], _ROWS[name])
    if "temperature" in ds.coords and "sensor" in ds["temperature"].dims:
        row = Row("temperature", ("...", "sensor"), "degC", -60.0, 200.0, "")
        messages += magnitude_violations("temperature", ds.variables["temperature"], row)
    return messages


def _comparison_violations(ds: xr.Dataset, dims: Sequence[Hashable]) -> list[str]:
    """Return violations in the requirements of a comparison: start, reference, identities, unchanged values."""
    messages = []
    start = ds.attrs.get("start")
    if start is not None and not _is_instant(start):
        messages.append(f"attribute 'start': expected {OPTIONAL_ATTRIBUTES['start']}; found {start!r}")
    for name, size in (("reference_interval", 2), ("reference_position", 1)):
        if name in ds.attrs and not _is_rising(ds.attrs[name], size):
            messages.append(f"attribute '{name}': expected {OPTIONAL_ATTRIBUTES[name]}; found {ds.attrs[name]!r}")
    messages += _machine_violations(ds)
    for name in ("source_id", "source_reference"):
        if name in ds.variables and ds.variables[name].dims != ("source",):
            messages.append(f"{name}: expected dims (source); found {dims_text(ds.variables[name])}")
    if "source_id" in ds.coords and ds.variables["source_id"].dims == ("source",):
        ids = [each for each in ds["source_id"].values.tolist() if each]
        if len(set(ids)) < len(ids):
            messages.append("source_id: expected texts that differ, or empty ones; found one repeated")
    for name in (f"{dim}{INDEX}" for dim in dims):
        if name not in ds.variables:
            continue
        variable = ds.variables[name]
        numbers = np.asarray(variable.values, dtype=float) if variable.dtype.kind in "iuf" else np.empty(0)
        if variable.dims != (name.removesuffix(INDEX),) or not (numbers % 1 == 0).all():
            messages.append(_TOUCHED.format(name))
    lost = [name for name in ds.variables if str(name).endswith(INDEX) and str(name).removesuffix(INDEX) not in dims]
    # A selected value, as by isel(position=3), keeps its number; a mean converts it to a float.
    messages += [_TOUCHED.format(name) for name in lost if ds[name].ndim or ds[name].dtype.kind not in "iu"]
    return messages


def _machine_violations(ds: xr.Dataset) -> list[str]:
    """Return violations in the attributes of the machine and its frame."""
    messages = []
    if "chain" in ds.attrs:
        try:
            parse_chain(ds.attrs["chain"])
        except (ValueError, AttributeError, TypeError) as error:
            messages.append(f"attribute 'chain': {error}")
    if "frame_origin" in ds.attrs:
        messages += _point_violations(ds.attrs["frame_origin"], "frame_origin")
    axes = ds.attrs.get("lever_axes", "Z")
    if axes not in _LEVERS:
        messages.append(f"attribute 'lever_axes': expected one of {', '.join(_LEVERS)}; found {axes!r}")
    return messages + straightness_reference_violations(ds)


_LEVERS = ("X", "Y", "Z", "XY", "XZ", "YZ", "XYZ")

_TOUCHED = (
    "{}: expected whole numbers along its own dimension; a mean or an interpolation of plain xarray changed them and "
    "did not propagate the covariance. Use ds.em.mean, ds.em.to_times or ds.em.to_positions"
)


def _is_instant(value: Any) -> bool:
    try:
        return datetime.fromisoformat(value).tzinfo is not None
    except (TypeError, ValueError):
        return False


def _is_rising(value: Any, size: int) -> bool:
    try:
        numbers = np.atleast_1d(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        return False
    return numbers.shape == (size,) and bool(np.isfinite(numbers).all() and (np.diff(numbers) >= 0).all())


def _shape_violations(ds: xr.Dataset, dims: tuple[Any, ...]) -> list[str]:
    messages = []
    for dim in ("dof", "dof_"):
        if dim in ds.sizes:
            messages += label_violations(ds, dim, DOF)
    expected = {"covariance": (*dims, "dof", "dof_"), "influence": ("source", *dims, "dof")}
    for name, names in expected.items():
        if name not in ds.variables:
            if name == "covariance":
                messages.append(f"covariance({', '.join(names)}): missing; expected the total covariance")
            continue
        variable = ds.variables[name]
        if variable.dims != names:
            messages.append(f"{name}: expected dims ({', '.join(names)}); found {dims_text(variable)}")
        elif variable.dtype.kind != "f":
            messages.append(f"{name}: expected float64; found {variable.dtype}")
    if {"influence", "deviation_influence"} & set(ds.variables):
        for name in ("source", "source_group"):
            if name not in ds.variables or ds.variables[name].dims != ("source",):
                messages.append(f"{name}(source): missing; expected a text for each source")
    return messages


def _covariance_violations(ds: xr.Dataset) -> list[str]:
    """Return violations in covariance and influence; vectorised over all places."""
    unseen = np.stack([np.isnan(ds.variables[name].values) for name in DOF], axis=-1).reshape(-1, 6)
    C = np.asarray(ds.variables["covariance"].values, dtype=float).reshape(-1, 6, 6)
    unknown = unseen[:, :, None] | unseen[:, None, :]
    messages = []
    if not np.array_equal(np.isnan(C), unknown):
        messages.append(_pattern("covariance", np.isnan(C) != unknown))
    if np.isinf(C).any():
        messages.append("covariance: expected finite numbers; found an infinite one")
    if messages:
        return messages
    C = np.where(unknown, 0.0, C)
    variance = np.diagonal(C, axis1=1, axis2=2)
    if (variance < 0).any():
        name = DOF[int(np.argwhere(variance < 0)[0, 1])]
        return [f"covariance: expected variances of 0 or more; found {number(float(variance.min()))} of {name}"]
    scale = np.sqrt(variance)
    scale = np.where(scale == 0, 1.0, scale)
    correlation = C / scale[:, :, None] / scale[:, None, :]
    if np.abs(correlation - np.swapaxes(correlation, 1, 2)).max(initial=0.0) > ROUNDING:
        return ["covariance: expected symmetric matrices; found one that is not"]
    if not _is_positive(correlation):
        return ["covariance: expected no negative variance in any direction (positive semidefinite); found one"]
    if "influence" in ds.variables:
        messages += _influence_violations(ds, unseen, correlation, scale)
    return messages


def _influence_violations(ds: xr.Dataset, unseen: NDArray[np.bool_], correlation: Array, scale: Array) -> list[str]:
    F = np.asarray(ds.variables["influence"].values, dtype=float)
    F = F.reshape(F.shape[0], math.prod(F.shape[1:-1]), 6)
    if not np.array_equal(np.isnan(F), np.broadcast_to(unseen, F.shape)):
        return [_pattern("influence", np.isnan(F) != unseen)]
    F = np.where(unseen, 0.0, F) / scale
    shared = np.einsum("spi,spj->pij", F, F, optimize=True)
    excess = np.diagonal(shared - correlation, axis1=1, axis2=2)
    if excess.max(initial=0.0) > ROUNDING:
        name = DOF[int(np.argwhere(excess == excess.max())[0, 1])]
        return [
            f"influence: expected squares that sum to no more than the variance; for {name} they exceed it by "
            f"{number(100 * float(excess.max()))} %"
        ]
    if not _is_positive(correlation - shared):
        return ["influence: expected the covariance minus the influences to be a covariance; found one that is not"]
    return []


def _pattern(name: str, wrong: NDArray[np.bool_]) -> str:
    names = sorted({DOF[k] for k in np.argwhere(wrong)[:, -1]}, key=DOF.index)
    return f"{name}: expected NaN exactly where the value is NaN; violated for {' '.join(names)}"


def _is_positive(matrices: Array) -> bool:
    """Return whether no eigenvalue is below rounding; by Cholesky first, which is fast and mostly sufficient."""
    try:
        np.linalg.cholesky(matrices + ROUNDING * np.eye(6))
    except np.linalg.LinAlgError:
        return bool(np.linalg.eigvalsh(matrices).min(initial=0.0) >= -ROUNDING)
    return True


def _dim_violations(ds: xr.Dataset, dims: Sequence[Hashable]) -> list[str]:
    """Return violations in further dimensions of the errors, each of which needs a coordinate."""
    messages = []
    for dim in (str(dim) for dim in dims if dim not in ERROR_DIMS):
        if dim not in ds.coords or not str(ds.coords[dim].attrs.get("long_name", "")).strip():
            messages.append(
                f"EX: expected dims from {', '.join(ERROR_DIMS)}, or declared by a coordinate of the same name with "
                f"the attribute long_name; found {dim}"
            )
            continue
        values = ds.coords[dim].values
        if values.dtype.kind in "iuf":
            if not ds.coords[dim].attrs.get("units"):
                messages.append(f"{dim}: expected the attribute units; found none")
            if not (np.isfinite(values).all() and (np.diff(values) > 0).all()):
                messages.append(f"{dim}: expected finite values that increase")
        elif len(set(values.tolist())) < values.size:
            messages.append(f"{dim}: expected labels that differ; found one repeated")
    return messages


def _deviation_violations(ds: xr.Dataset, dims: tuple[Hashable, ...]) -> list[str]:
    """Return violations in `deviation` and its variables; none if the dataset has none of them.

    Parameters
    ----------
    dims : tuple
        Of the errors.
    """
    present = [name for name in _DEVIATION if name in ds.variables]
    if not present:
        return []
    missing = [name for name in _DEVIATION[:3] if name not in ds.variables]
    if missing:
        return [f"{' '.join(missing)}: missing; expected with {present[0]}"]
    messages = []
    for name in present:
        variable = ds.variables[name]
        expected = {"deviation_influence": ("source", *dims)}.get(name, dims)
        if name == "sensitivity":
            if variable.dims[-1:] != ("dof",) or not set(variable.dims[:-1]) <= set(dims):
                messages.append(f"sensitivity: expected dims of deviation, and dof; found {dims_text(variable)}")
        elif variable.dims != expected:
            messages.append(f"{name}: expected dims ({', '.join(map(str, expected))}); found {dims_text(variable)}")
        messages += magnitude_violations(name, variable, _ROWS[name])
    return messages or _value_violations(ds)


def _value_violations(ds: xr.Dataset) -> list[str]:
    messages = []
    unknown = np.isnan(ds.variables["deviation"].values)
    known_freedoms = [name for name in DOF if np.isfinite(ds.variables[name].values).any()]
    if known_freedoms:
        messages.append(f"{' '.join(known_freedoms)}: expected NaN in a dataset with deviation, their combination")
    for name in ("deviation_variance", "deviation_influence"):
        if name in ds.variables:
            gaps = np.isnan(ds.variables[name].values)
            if not np.array_equal(gaps, np.broadcast_to(unknown, gaps.shape)):
                messages.append(f"{name}: expected NaN exactly where deviation is NaN")
    length = np.linalg.norm(ds.variables["sensitivity"].values[..., :3], axis=-1)
    if not (np.abs(length - 1) <= UNIT_LENGTH).all():
        worst = float(length.ravel()[np.argmax(np.abs(length.ravel() - 1))])
        messages.append(f"sensitivity: expected a unit vector for EX EY EZ; found one of length {number(worst)}")
    if messages or "deviation_influence" not in ds.variables:
        return messages
    shared = (ds.variables["deviation_influence"].values ** 2).sum(axis=0)
    total = ds.variables["deviation_variance"].values
    if (shared > total * (1 + ROUNDING)).any():
        messages.append("deviation_influence: expected squares that sum to no more than deviation_variance")
    return messages
