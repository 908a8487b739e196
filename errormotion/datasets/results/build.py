"""Building of error datasets, the results of all methods."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.datasets.plausibility import of_result, with_doubts
from errormotion.datasets.results.checks import error_violations
from errormotion.datasets.schemas import CARRIED, DOF, ERROR_ROWS, ERROR_UNITS, INDEX, SCHEMA, SIGN
from errormotion.errors import DatasetError

_ROWS = {row.name: row for row in ERROR_ROWS}


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
    component_description: str = "",
    source_ids: Mapping[str, str] | None = None,
    reference_sources: Sequence[str] = (),
    reference_interval: tuple[float, float] | None = None,
    reference_position: float | None = None,
    start: str = "",
    notes: Sequence[str] = (),
    doubts: Sequence[str] = (),
    measured: Mapping[Any, Any] | None = None,
    lever_axes: str = "",
) -> xr.Dataset:
    """Return an error dataset that follows its schema.

    Parameters
    ----------
    values : array_like, (..., 6)
        EX EY EZ in m, EA EB EC in rad; NaN for unknown ones.
    covariance : array_like, (..., 6, 6)
        Total covariance, including influences; m^2, m rad, rad^2. Rows and columns of NaN values are set to NaN.
    dims : sequence of str
        Dims of ``values`` before the last axis: time, position, target, beam, or dims declared by a coordinate of the
        same name with ``long_name`` and, for numbers, ``units``; empty for one place.
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
        Name of each source, and its group in the budget; with ``influence``.
    extras : mapping of str to DataArray, optional
        Further results, with units.
    component_description : str, optional
        Description of a component that the schema does not list.
    source_ids : mapping of str to str, optional
        Identities of sources by name, such as the hash of a calibration or the number of a certificate. Sources with
        equal identities are one draw in several datasets; those without identity are not shared.
    reference_sources : sequence of str, optional
        Names of the sources that are the uncertainty of the reference state.
    reference_interval : tuple of float, optional
        First and last time of the reference state, s on the ``time`` of the dataset; equal for one instant.
    reference_position : float, optional
        Position whose errors are zero by definition, m or rad, for errors over ``position``.
    start : str, optional
        Instant of time 0: ISO 8601 with an offset from UTC.
    notes : sequence of str, optional
        Notes for the reader, one sentence each; empty ones are left out.
    doubts : sequence of str, optional
        Further notes: why an uncertainty may be too small. No decision on a tolerance relies on it then.
    measured : mapping, optional
        Attributes of the raw dataset. Those of `schemas.CARRIED` that are texts are copied to the errors. Errors that
        were measured are compared with those of machine tools (`errormotion.datasets.plausibility`).
    lever_axes : str, optional
        Axes whose travel is a lever of the rotations, such as ``Z``, if the errors are not those of one rigid
        motion.

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
        name: (dims, E[..., k].copy(), {"units": unit})
        for k, (name, unit) in enumerate(zip(DOF, ERROR_UNITS, strict=True))
    }
    variables |= {f"{dim}{INDEX}": ((dim,), np.arange(size)) for dim, size in zip(dims, E.shape, strict=False)}
    variables["covariance"] = ((*dims, "dof", "dof_"), C, {"long_name": "total covariance; m^2, m rad, rad^2"})
    own_coords: dict[str, Any] = dict(_labels())
    if influence is not None:
        variables["influence"], source_coords = _influence(influence, unseen, dims, sources, source_groups)
        own_coords |= source_coords | _identities(list(sources or ()), source_ids or {}, reference_sources)
    own_coords |= {name: _coordinate(name, value) for name, value in coords.items()}
    attrs: dict[str, Any] = {
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
    if component_description:
        attrs["component_description"] = component_description
    if reference_interval is not None:
        attrs["reference_interval"] = np.array(reference_interval, dtype=float)
    if reference_position is not None:
        attrs["reference_position"] = float(reference_position)
    if start:
        attrs["start"] = start
    doubts = [note for note in doubts if note]
    attrs["notes"] = [note for note in (*notes, *doubts, *provenance.get("interruptions", ())) if note] or [""]
    if doubts:
        attrs["doubts_uncertainty"] = doubts
    attrs |= {name: text for name in CARRIED if isinstance(text := (measured or {}).get(name), str) and text.strip()}
    if lever_axes:
        attrs["lever_axes"] = lever_axes
    try:
        more = dict(extras or {})
        clash = sorted(set(more) & {*variables, *own_coords})
        if clash:
            raise DatasetError(
                f"extras: expected names that are not used by the schema; found {', '.join(clash)}",
                code="errors.extras.name_used",
            )
        # Arrays without coordinates need no alignment, which would take most of the time.
        bare = {name: each.variable for name, each in more.items() if not len(each.coords)}
        aligned = len(bare) < len(more)
        ds = xr.Dataset(variables if aligned else variables | bare, coords=own_coords, attrs=attrs)
        if aligned:
            ds = ds.assign(more | bare)
    except ValueError as error:
        raise DatasetError(
            f"Values, coordinates and extra results do not fit together: {error}", code="errors.arrays.shape"
        ) from error
    messages = error_violations(ds)
    if messages:
        raise DatasetError(
            f"The result of method '{method}' breaks the schema {SCHEMA}:", messages, code="schema.violated"
        )
    return ds if measured is None else with_doubts(ds, of_result(ds))


@cache
def _labels() -> dict[str, xr.Variable]:
    """Return the labels of the freedoms with their indexes, the same in all error datasets."""
    return {name: xr.Variable(name, list(DOF)).to_index_variable() for name in ("dof", "dof_")}


def build_deviations(
    deviation: ArrayLike,
    variance: ArrayLike,
    sensitivity: ArrayLike,
    *,
    dims: Sequence[str],
    coords: Mapping[str, Any],
    influence: ArrayLike | None = None,
    sources: Sequence[str] | None = None,
    source_groups: Sequence[str] | None = None,
    extras: Mapping[str, xr.DataArray] | None = None,
    **attributes: Any,
) -> xr.Dataset:
    """Return an error dataset of a method that measures the errors along one known direction only.

    The six freedoms are NaN, since none of them is determined.

    Parameters
    ----------
    deviation, variance : array_like, (...)
        m and m^2, including influences; NaN where unknown.
    sensitivity : array_like, (..., 6) or (6,)
        Effect of one unit of each freedom at the functional point on the deviation: a unit vector, and m/rad.
    dims, coords, sources, source_groups, extras
        As for `build_errors`.
    influence : array_like, (source, ...), optional
        Effect of one standard uncertainty of each source on the deviation, m.
    **attributes
        ``component``, ``machine``, ``frame`` and all others of `build_errors`.

    Raises
    ------
    DatasetError
        Shapes that do not fit, or any violation of the schema; all of them at once.
    """
    dims, value = tuple(dims), np.asarray(deviation, dtype=float)
    h = np.asarray(sensitivity, dtype=float)
    variables: dict[str, Any] = {
        "deviation": (dims, value, {"units": "m"}),
        "deviation_variance": (dims, np.where(np.isnan(value), np.nan, variance), {"units": "m^2"}),
        "sensitivity": ((*(dims if h.ndim > 1 else ()), "dof"), h, {"long_name": "of the deviation to each freedom"}),
    }
    coords = dict(coords)
    if influence is not None:
        names = list(sources or ())
        coords |= {"source": names, "source_group": ("source", list(source_groups or ()))}
        coords |= _identities(names, attributes.pop("source_ids", {}), attributes.pop("reference_sources", ()))
        unknown = np.broadcast_to(np.isnan(value), np.shape(influence))
        variables["deviation_influence"] = (("source", *dims), np.where(unknown, np.nan, influence), {"units": "m"})
    try:
        arrays = {
            name: xr.DataArray(array, dims=names, attrs=attrs) for name, (names, array, attrs) in variables.items()
        }
    except ValueError as error:
        raise DatasetError(
            f"Deviation, variance, sensitivity and influence do not fit together: {error}", code="errors.arrays.shape"
        ) from error
    unseen = np.full((*value.shape, 6), np.nan)
    return build_errors(
        unseen,
        np.full((*unseen.shape, 6), np.nan),
        dims=dims,
        coords=coords,
        extras={**arrays, **(extras or {})},
        **attributes,
    )


def _check_shapes(E: Array, C: Array, dims: tuple[str, ...]) -> None:
    messages = []
    if E.ndim != len(dims) + 1 or E.shape[-1] != 6:
        messages.append(f"values: expected shape ({', '.join([*dims, '6'])}); found {E.shape}")
    elif (*E.shape, 6) != C.shape:
        messages.append(f"covariance: expected shape {(*E.shape, 6)}; found {C.shape}")
    if messages:
        raise DatasetError("Arrays do not fit together:", messages, code="errors.arrays.shape")


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
        raise DatasetError(
            f"influence: expected shape {expected} for {len(names)} named sources; found {F.shape}",
            code="errors.influence.shape",
        )
    if groups is None or len(groups) != len(names):
        raise DatasetError(
            f"source_groups: expected {len(names)}, one for each source; found {len(groups or ())}",
            code="errors.groups.count",
        )
    variable = (("source", *dims, "dof"), np.where(unseen, np.nan, F), {"long_name": "of one standard uncertainty"})
    return variable, {"source": names, "source_group": ("source", list(groups))}


def _identities(names: list[str], ids: Mapping[str, str], references: Sequence[str]) -> dict[str, Any]:
    """Return the coordinates with the identities of the sources, and with those of the reference state."""
    if stray := sorted({*ids, *references} - set(names)):
        raise DatasetError(
            f"source_ids, reference_sources: expected names among {names}; found {', '.join(stray)}",
            code="errors.sources.unknown",
        )
    return {
        "source_id": ("source", [ids.get(name, "") for name in names]),
        "source_reference": ("source", np.array([name in references for name in names], dtype=np.int8)),
    }


def _coordinate(name: str, value: Any) -> Any:
    if not isinstance(value, tuple):
        value = (name, value)
    names, array, attrs = (*value, {})[:3]
    row = _ROWS.get(name)
    if row is not None and row.unit:
        attrs = {"units": row.unit, "long_name": row.meaning, **attrs}
    return (names, array, attrs)
