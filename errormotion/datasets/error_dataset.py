"""The error dataset: the one exit through which every method's result passes, and what it must be."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.datasets.checks import (
    dims as dims_text,
)
from errormotion.datasets.checks import (
    label_violations,
    magnitude_violations,
    number,
    storable_violations,
    time_violations,
    unit_violations,
)
from errormotion.datasets.schemas import DOF, ERROR_ATTRIBUTES, ERROR_DIMS, ERROR_ROWS, SCHEMA, SIGN, Row
from errormotion.errors import DatasetError

UNITS = ("m", "m", "m", "rad", "rad", "rad")

# Rounding of a 6x6 covariance relative to its diagonal, after moves over some metres and back.
ROUNDING = 1e-8

_COMPONENTS = (*"XYZABCUVW", "spindle", "tool", "beam")
_ROWS = {row.name: row for row in ERROR_ROWS}
_FARTHEST = 50.0  # m; a functional point beyond is written in mm

Coordinate = (
    ArrayLike | tuple[str | Sequence[str], ArrayLike] | tuple[str | Sequence[str], ArrayLike, Mapping[str, Any]]
)


def build_errors(
    values: ArrayLike,
    covariance: ArrayLike,
    *,
    dims: Sequence[str],
    coords: Mapping[str, Any],
    component: str,
    machine: str,
    frame: str,
    functional_point: ArrayLike,
    reference: str,
    method: str,
    method_version: str,
    provenance: Mapping[str, Any],
    influence: ArrayLike | None = None,
    sources: Sequence[str] | None = None,
    source_groups: Sequence[str] | None = None,
    extras: Mapping[str, xr.DataArray] | None = None,
) -> xr.Dataset:
    """Return an error dataset that follows its schema.

    Parameters
    ----------
    values : array_like, (..., 6)
        EX EY EZ in m, EA EB EC in rad; NaN for what the method does not see.
    covariance : array_like, (..., 6, 6)
        Total, influences included; m^2, m rad, rad^2. Rows and columns of NaN values become NaN.
    dims : sequence of str
        Of ``values`` before the last axis: from time, position, target, beam; empty for one place.
    coords : mapping
        Name to array, or to ``(dims, array)`` or ``(dims, array, attrs)``.
    component, machine, frame, reference, method, method_version : str
        The attributes of the schema.
    functional_point : array_like, (3,)
        m, in ``frame``.
    provenance : mapping
        From `errormotion.datasets.provenance.make`.
    influence : array_like, (source, ..., 6), optional
        Effect of one standard uncertainty of each source that is one draw for many values; m, rad.
    sources, source_groups : sequence of str, optional
        Name of each source, and what it belongs to in the budget; with ``influence``.
    extras : mapping of str to DataArray, optional
        Further results, with their own units.

    Returns
    -------
    Dataset

    Raises
    ------
    DatasetError
        Shapes that do not fit, or any violation of the schema; all of them at once.
    """
    dims = tuple(dims)
    E = np.asarray(values, dtype=float)
    C = np.asarray(covariance, dtype=float)
    _check_shapes(E, C, dims)
    unseen = np.isnan(E)
    C = np.where(unseen[..., :, None] | unseen[..., None, :], np.nan, C)
    variables: dict[str, Any] = {
        name: (dims, E[..., k].copy(), {"units": unit}) for k, (name, unit) in enumerate(zip(DOF, UNITS, strict=True))
    }
    variables["covariance"] = ((*dims, "dof", "dof_"), C, {"long_name": "total covariance; m^2, m rad, rad^2"})
    own_coords: dict[str, Any] = {"dof": list(DOF), "dof_": list(DOF)}
    if influence is not None:
        variables["influence"], source_coords = _influence(influence, unseen, dims, sources, source_groups)
        own_coords |= source_coords
    own_coords |= {name: _coordinate(name, value) for name, value in coords.items()}
    attrs = {
        "schema": SCHEMA,
        "component": component,
        "machine": machine,
        "frame": frame,
        "functional_point": np.array(functional_point, dtype=float),
        "reference": reference,
        "method": method,
        "method_version": method_version,
        "sign": SIGN,
        "provenance": json.dumps(provenance),
    }
    try:
        ds = xr.Dataset(variables, coords=own_coords, attrs=attrs)
        clash = sorted(set(extras or {}) & set(ds.variables))
        if clash:
            raise DatasetError(f"Extra results need names of their own; taken already: {', '.join(clash)}.")
        ds = ds.assign(dict(extras or {}))
    except ValueError as error:
        raise DatasetError(f"Values, coordinates and extra results do not fit together: {error}") from error
    found = error_violations(ds)
    if found:
        raise DatasetError(f"The result of method '{method}' breaks the schema {SCHEMA}:", found)
    return ds


def _check_shapes(E: Array, C: Array, dims: tuple[str, ...]) -> None:
    found = []
    if E.ndim != len(dims) + 1 or E.shape[-1] != 6:
        found.append(f"values: expected shape ({', '.join([*dims, '6'])}); found {E.shape}")
    elif (*E.shape, 6) != C.shape:
        found.append(f"covariance: expected shape {(*E.shape, 6)}; found {C.shape}")
    if found:
        raise DatasetError("Arrays do not fit together:", found)


def _influence(
    influence: ArrayLike,
    unseen: NDArray[np.bool_],
    dims: tuple[str, ...],
    sources: Sequence[str] | None,
    groups: Sequence[str] | None,
) -> tuple[Any, dict[str, Any]]:
    F = np.asarray(influence, dtype=float)
    names = list(sources or ())
    expected = (len(names), *unseen.shape)
    if F.shape != expected:
        raise DatasetError(f"influence: expected shape {expected} for {len(names)} named sources; found {F.shape}")
    if groups is None or len(groups) != len(names):
        raise DatasetError(f"source_groups: expected {len(names)}, one for each source; found {len(groups or ())}")
    variable = (("source", *dims, "dof"), np.where(unseen, np.nan, F), {"long_name": "of one standard uncertainty"})
    return variable, {"source": names, "source_group": ("source", list(groups))}


def _coordinate(name: str, value: Any) -> Any:
    if not isinstance(value, tuple):
        value = (name, value)
    names, array, attrs = (*value, {})[:3]
    row = _ROWS.get(name)
    if row is not None and row.unit:
        attrs = {"units": row.unit, **attrs}
    return (names, array, attrs)


def error_violations(ds: xr.Dataset) -> list[str]:
    """Return every violation of the error schema, one sentence each."""
    found = [*_attribute_violations(ds), *storable_violations(ds)]
    missing = [name for name in DOF if name not in ds.data_vars]
    if missing:
        return [*found, f"{' '.join(missing)}: missing; expected all of {' '.join(DOF)}, NaN where not seen"]
    dims = ds["EX"].dims
    wrong = [str(dim) for dim in dims if dim not in ERROR_DIMS]
    if wrong:
        found.append(f"EX: expected dims from {', '.join(ERROR_DIMS)}; found {', '.join(wrong)}")
    complaints = []
    for name, unit in zip(DOF, UNITS, strict=True):
        variable = ds.variables[name]
        if variable.dims != dims:
            complaints.append(f"{name}: expected the dims of EX {dims_text(ds.variables['EX'])}; found {variable.dims}")
        if variable.attrs.get("units") is None:
            complaints.append(f"{name}: expected the attribute units = '{unit}'; found none")
        complaints += magnitude_violations(name, variable, _ROWS[name])
    found += complaints + _coordinate_violations(ds)
    shape_complaints = _shape_violations(ds, dims)
    found += shape_complaints
    if not complaints and not shape_complaints:
        found += _covariance_violations(ds)
    return found


def _attribute_violations(ds: xr.Dataset) -> list[str]:
    found = []
    for name, meaning in ERROR_ATTRIBUTES.items():
        value = ds.attrs.get(name)
        if value is None:
            found.append(f"attribute '{name}': missing; expected {meaning}")
        elif name == "functional_point":
            found += _point_violations(value)
        elif not isinstance(value, str) or not value.strip():
            found.append(f"attribute '{name}': expected {meaning}; found {value!r}")
        elif name == "sign" and value != SIGN:
            found.append(f"attribute 'sign': expected '{SIGN}'; found '{value}'. Turn the values and set it")
        elif name == "schema" and value != SCHEMA:
            found.append(f"attribute 'schema': expected '{SCHEMA}'; found '{value}'")
        elif name == "component" and value not in _COMPONENTS:
            found.append(f"attribute 'component': expected one of {', '.join(_COMPONENTS)}; found '{value}'")
        elif name == "provenance" and not _is_json_object(value):
            found.append("attribute 'provenance': expected a JSON object; found other text")
    return found


def _point_violations(value: Any) -> list[str]:
    try:
        point = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        return [f"attribute 'functional_point': expected three finite coordinates in m; found {value!r}"]
    if np.abs(point).max() > _FARTHEST:
        far = number(float(point[np.argmax(np.abs(point))]))
        return [f"attribute 'functional_point': {far} m: expected within {_FARTHEST:g} m; is it in mm?"]
    return []


def _is_json_object(text: str) -> bool:
    try:
        return isinstance(json.loads(text), dict)
    except ValueError:
        return False


def _coordinate_violations(ds: xr.Dataset) -> list[str]:
    found = []
    if "time" in ds.sizes:
        if "time" not in ds.variables:
            found.append("time: missing; expected seconds since the reference state")
        else:
            found += unit_violations("time", ds.variables["time"].attrs, "s")
            found += time_violations("time", ds.variables["time"])
    for name in ("x", "y", "z"):
        if name in ds.variables:
            if not set(ds.variables[name].dims) <= {"position", "target"}:
                found.append(f"{name}: expected dims position or target; found {dims_text(ds.variables[name])}")
            found += magnitude_violations(name, ds.variables[name], _ROWS[name])
    if "temperature" in ds.coords and "sensor" in ds["temperature"].dims:
        row = Row("temperature", ("...", "sensor"), "degC", -60.0, 200.0, "")
        found += magnitude_violations("temperature", ds.variables["temperature"], row)
    return found


def _shape_violations(ds: xr.Dataset, dims: tuple[Any, ...]) -> list[str]:
    found = []
    for dim in ("dof", "dof_"):
        if dim in ds.sizes:
            found += label_violations(ds, dim, DOF)
    expected = {"covariance": (*dims, "dof", "dof_"), "influence": ("source", *dims, "dof")}
    for name, names in expected.items():
        if name not in ds.variables:
            if name == "covariance":
                found.append(f"covariance({', '.join(names)}): missing; expected the total covariance")
            continue
        variable = ds.variables[name]
        if variable.dims != names:
            found.append(f"{name}: expected dims ({', '.join(names)}); found {dims_text(variable)}")
        elif variable.dtype.kind != "f":
            found.append(f"{name}: expected float64; found {variable.dtype}")
    if "influence" in ds.variables:
        for name in ("source", "source_group"):
            if name not in ds.variables or ds.variables[name].dims != ("source",):
                found.append(f"{name}(source): missing; expected a text for each source of influence")
    return found


def _covariance_violations(ds: xr.Dataset) -> list[str]:
    """Return what is wrong with covariance and influence; vectorised over all places."""
    unseen = np.stack([np.isnan(ds.variables[name].values) for name in DOF], axis=-1).reshape(-1, 6)
    C = np.asarray(ds.variables["covariance"].values, dtype=float).reshape(-1, 6, 6)
    unknown = unseen[:, :, None] | unseen[:, None, :]
    found = []
    if not np.array_equal(np.isnan(C), unknown):
        found.append(_pattern("covariance", np.isnan(C) != unknown))
    if np.isinf(C).any():
        found.append("covariance: expected finite numbers; found an infinite one")
    if found:
        return found
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
        found += _influence_violations(ds, unseen, correlation, scale)
    return found


def _influence_violations(ds: xr.Dataset, unseen: NDArray[np.bool_], correlation: Array, scale: Array) -> list[str]:
    F = np.asarray(ds.variables["influence"].values, dtype=float)
    F = F.reshape(F.shape[0], -1, 6)
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
        return ["influence: expected the covariance less the influences to be a covariance; found one that is not"]
    return []


def _pattern(name: str, wrong: NDArray[np.bool_]) -> str:
    names = sorted({DOF[k] for k in np.argwhere(wrong)[:, -1]}, key=DOF.index)
    return f"{name}: expected NaN exactly where the value is NaN; not so for {' '.join(names)}"


def _is_positive(matrices: Array) -> bool:
    """Whether no eigenvalue is below rounding; by Cholesky first, which is fast and mostly enough."""
    try:
        np.linalg.cholesky(matrices + ROUNDING * np.eye(6))
    except np.linalg.LinAlgError:
        return bool(np.linalg.eigvalsh(matrices).min(initial=0.0) >= -ROUNDING)
    return True
