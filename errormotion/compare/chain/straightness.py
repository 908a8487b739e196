"""The point at which the straightness of a linear axis is read: it is fixed to the table or to the tool.

A positive command moves the tool relative to the table along the axis. In table coordinates a point that is fixed to
the tool is therefore displaced by the position q along the direction d from the point of the table that it meets at
zero. Both readings are displacements of one rigid motion of the tool relative to the table, at these two points:
``E_tool(q) = E_table(q) + R(q) x (q d)``. This is independent of which of the two bodies moves.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from errormotion.arrays import Array, filled
from errormotion.compare.chain.curve import Curve, reference_weights
from errormotion.compare.point_errors import PointErrors
from errormotion.datasets.schemas import STRAIGHTNESS_REFERENCES
from errormotion.kinematics import twists
from errormotion.kinematics.iso import DOF, LINEAR_AXES, direction_of, is_straightness

ATTRIBUTE = "straightness_reference"
TABLE, TOOL = STRAIGHTNESS_REFERENCES
OTHER = {TABLE: TOOL, TOOL: TABLE}


def at_reference(
    datasets: Mapping[str, xr.Dataset], wanted: str, notes: list[str]
) -> tuple[dict[str, xr.Dataset], str, bool]:
    """Return datasets of one linear axis with the straightness at one point, where it is, and whether one was changed.

    Parameters
    ----------
    datasets : mapping of str to Dataset
        Errors of an axis with the coordinate of its position.
    wanted : str
        ``table`` or ``tool``: where the straightness is wanted; empty: where the first dataset that states it was read.
    notes : list of str
        Transformations and unknown references are appended.
    """
    stated = {name: str(ds.attrs.get(ATTRIBUTE, "")) for name, ds in datasets.items()}
    place = wanted or next(filter(None, stated.values()), "")
    moved, changed = {}, False
    for name, ds in datasets.items():
        moved[name] = ds
        q = _position(ds)
        if q is None or not _straight(ds):
            continue
        if not stated[name]:
            notes.append(_unknown(name, ds, q, place))
        elif stated[name] != place:
            moved[name], changed = _moved(ds, q, stated[name]), True
            lost = [each for each in _straight(ds) if np.isnan(moved[name][each]).sum() > np.isnan(ds[each]).sum()]
            unknown = f" Unknown after it, since the rotations are not all known: {', '.join(lost)}." if lost else ""
            notes.append(
                f"'{name}': straightness read at a point of the {stated[name]}, transformed to a point of the {place}."
                + unknown
            )
    return moved, place, changed


def levers(place: str, q: Array, axis: str) -> dict[str, Array]:
    """Return where else a straightness may have been read, with the shift (n, 3) from there.

    An unknown ``place`` (empty) is that of the other dataset, so that either difference is possible.
    """
    wanted = (place,) if place else (TABLE, TOOL)
    return {OTHER[each]: lever_to(each, q, axis) for each in wanted}


def lever_to(place: str, q: Array, axis: str) -> Array:
    """Return the shift (n, 3) from the other point of reading to that of ``place``, at positions (n,) of an axis."""
    sign = 1.0 if place == TOOL else -1.0
    shift: Array = sign * np.multiply.outer(q, np.eye(3)[direction_of(axis)])
    return shift


def from_line(placed: PointErrors, positions: Array, axis: str) -> PointErrors:
    """Return the errors with straightness relative to the line through the first and the last known position."""
    weights = np.nan_to_num(reference_weights([placed.value], positions, axis))
    weights[:, :, [k for k in range(6) if not is_straightness(k, axis)]] = 0.0
    own, F = filled(placed.own), placed.influence
    curve = Curve(placed.value, own, F, placed.source, [""] * len(placed.source), placed.identity).relative(weights)
    return PointErrors(curve.value, curve.own, curve.influence, curve.source, curve.identity)


def _straight(ds: xr.Dataset) -> list[str]:
    """Return the known straightness of the dataset of a linear axis."""
    axis = str(ds.attrs["component"])
    return [name for k, name in enumerate(DOF) if is_straightness(k, axis) and np.isfinite(ds[name].values).any()]


def _position(ds: xr.Dataset) -> xr.DataArray | None:
    """Return the position of a linear axis, for each value or one for all; None for other components."""
    axis = str(ds.attrs["component"])
    letter = "xyz"[direction_of(axis)] if axis in LINEAR_AXES else ""
    return ds[letter] if letter in ds.variables and set(ds[letter].dims) <= set(ds["EX"].dims) else None


def _moved(ds: xr.Dataset, q: xr.DataArray, read_at: str) -> xr.Dataset:
    """Return the dataset with the straightness at the other point."""
    dims = ds["EX"].dims
    where = q.broadcast_like(ds["EX"]).transpose(*dims).values
    A = twists.adjoint(shift=lever_to(OTHER[read_at], where, str(ds.attrs["component"])))
    E = twists.transform(ds.em.twist().values, A)
    new = {name: E[..., k] for k, name in enumerate(DOF)}
    new["covariance"] = twists.transform_covariance(ds["covariance"].transpose(*dims, "dof", "dof_").values, A)
    if "influence" in ds.variables:
        new["influence"] = twists.transform(ds["influence"].transpose("source", *dims, "dof").values, A)
    moved = ds.copy()
    for name, values in new.items():
        order = {"covariance": (*dims, "dof", "dof_"), "influence": ("source", *dims, "dof")}.get(name, dims)
        moved[name] = (order, values, ds[name].attrs)
    return moved.assign_attrs({ATTRIBUTE: OTHER[read_at]})


def _unknown(name: str, ds: xr.Dataset, q: xr.DataArray, place: str) -> str:
    """Return the note on a dataset that does not state where its straightness was read."""
    text = (
        f"'{name}': where its straightness was read is unknown (attribute {ATTRIBUTE}: table or tool). It is compared "
    )
    text += f"as read at a point of the {place}" if place else "as read like that of the others"
    E = ds.em.twist().values
    shift = np.abs(np.asarray(q.broadcast_like(ds["EX"]).transpose(*ds["EX"].dims).values, dtype=float))
    axis = direction_of(str(ds.attrs["component"]))
    rotations = np.delete(E[..., 3:], axis, axis=-1)
    effect = np.abs(shift[..., None] * (rotations - _reference(rotations)))
    if not np.isfinite(effect).any():
        return text + "; how much the other point would change it is unknown without rotations."
    return text + f"; at the other point it differs by up to {1e6 * np.nanmax(effect):.2g} um."


def _reference(rotations: Array) -> Array:
    """Return the rotation at the first place; a constant rotation adds a line, which is no straightness."""
    first: Array = rotations.reshape(-1, rotations.shape[-1])[:1]
    return np.nan_to_num(first)
