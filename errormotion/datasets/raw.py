"""Validation of raw datasets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr

from errormotion.datasets.checks import (
    dims,
    label_violations,
    magnitude_violations,
    number,
    storable_violations,
    straightness_reference_violations,
    time_violations,
)
from errormotion.datasets.schemas import RawSchema, Row, variants

# A relative error of the length of a direction of 1e-6 causes 1 nm for a reading of 1 mm.
_UNIT_NORM = 1e-6
# Rounding of a 6x6 covariance, relative to its diagonal.
_ROUNDING = 1e-8


def variant_of(ds: xr.Dataset, tables: Sequence[RawSchema] = ()) -> RawSchema | None:
    """Return the raw schema of a dataset: its id by the attribute, the variant by the content; None if unknown.

    ``tables`` are searched before the raw schemas of the installed plugins.
    """
    schema = str(ds.attrs.get("schema"))
    candidates = tuple(table for table in tables if table.id == schema) or variants(schema)
    for raw in candidates:
        if raw.marker in ds.variables or raw.marker in ds.dims:
            return raw
    return candidates[0] if candidates else None


def raw_violations(ds: xr.Dataset, raw: RawSchema) -> list[str]:
    """Return every violation of a raw schema, one sentence each.

    Large variables are checked in samples distributed over the record; they are never loaded completely.
    """
    messages = [*storable_violations(ds), *straightness_reference_violations(ds)]
    for dim, size in raw.sizes.items():
        if dim in ds.sizes and ds.sizes[dim] != size and dim not in raw.labels:
            messages.append(f"dimension {dim}: expected {size}; found {ds.sizes[dim]}")
    for dim, labels in raw.labels.items():
        if dim not in ds.sizes:
            continue
        if dim in ds.variables or dim == "channel":
            messages += label_violations(ds, dim, labels, ordered=dim != "channel")
        elif ds.sizes[dim] != len(labels):
            messages.append(f"dimension {dim}: expected {len(labels)} ({' '.join(labels)}); found {ds.sizes[dim]}")
    for row in raw.rows:
        messages += list(_row_violations(ds, row))
    return messages


def _row_violations(ds: xr.Dataset, row: Row) -> Iterator[str]:
    if row.name not in ds.variables:
        if row.name == "time" and row.dims == ("time",) and "sample_rate" in ds.attrs:
            yield from _rate_violations(ds)
        elif row.required:
            unit = f" in {row.unit}" if row.unit else ""
            yield f"{row.name}({', '.join(row.dims)}): missing; expected{unit}: {row.meaning}"
        return
    variable = ds.variables[row.name]
    if set(variable.dims) != set(row.dims):
        yield f"{row.name}: expected dims ({', '.join(row.dims)}); found {dims(variable)}"
        return
    if variable.size == 0:
        yield f"{row.name}: expected values; found none (a dimension has length 0)"
        return
    complaints = magnitude_violations(row.name, variable, row)
    yield from complaints
    if complaints:
        return
    if row.name == "time":
        yield from time_violations(row.name, variable)
    elif row.unit == "1" and row.dims[-1:] == ("direction",):
        yield from _norm_violations(row.name, variable)
    elif row.name.endswith("_covariance"):
        yield from _covariance_violations(variable.transpose(*row.dims), row)
    elif row.required and not row.missing and np.isnan(np.asarray(variable.values)).any():
        yield f"{row.name}: expected numbers; found NaN"


def _rate_violations(ds: xr.Dataset) -> Iterator[str]:
    for name, low in (("sample_rate", 0.0), ("time_start", -np.inf)):
        value = ds.attrs.get(name, 1.0)
        if not isinstance(value, (int, float, np.number)) or not low < float(value) < np.inf:
            yield f"attribute '{name}': expected a {'positive ' if low == 0 else ''}number; found {value!r}"


def _norm_violations(name: str, variable: xr.Variable) -> Iterator[str]:
    norms = np.linalg.norm(variable.transpose(..., "direction").values, axis=-1).ravel()
    wrong = norms[~(np.abs(norms - 1) <= _UNIT_NORM)]
    if wrong.size:
        yield f"{name}: expected unit vectors; found one of length {number(wrong[0])}. Divide it by its length"


def _covariance_violations(variable: xr.Variable, row: Row) -> Iterator[str]:
    C = np.asarray(variable.values, dtype=float)
    if row.name == "beam_covariance" and np.isnan(C).any():
        yield f"{row.name}: expected numbers; found NaN. Omit the variable if it is unknown"
        return
    if C.shape[-1] != C.shape[-2]:
        yield f"{row.name}: expected square matrices; found {C.shape[-2]} x {C.shape[-1]}"
        return
    C = C[~np.isnan(C).any(axis=(-2, -1))]
    scale = np.sqrt(np.abs(np.diagonal(C, axis1=-2, axis2=-1)))
    scale[scale == 0] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = C / scale[..., :, None] / scale[..., None, :]
        symmetric = np.abs(correlation - np.swapaxes(correlation, -1, -2)).max(initial=0.0) <= _ROUNDING
    if not symmetric:
        yield f"{row.name}: expected a symmetric matrix; found one that is not"
    elif np.linalg.eigvalsh(correlation).min(initial=0.0) < -_ROUNDING:
        yield f"{row.name}: expected no negative variance in any direction; found one"
