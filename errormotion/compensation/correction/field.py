"""The errors of one source as a function of position and time, at the functional point of a tool."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array, products
from errormotion.compensation.correction.nodes import Constant, Line, Nodes, Weights, of_targets
from errormotion.datasets.results.reduction import influence_of
from errormotion.datasets.schemas import DOF, SCHEMA
from errormotion.errors import DatasetError
from errormotion.kinematics.chains import parse_chain
from errormotion.kinematics.twists import rigid_motions

_AXES = "XYZ"


@dataclass(frozen=True)
class Field:
    """Errors at nodes, and their effect at a position.

    Attributes
    ----------
    name : str
        For messages.
    instants : Line or None
        Times of the errors, s; None if they do not depend on time.
    nodes : Nodes
        Positions of the errors; they vary faster than the times.
    columns : tuple of int
        Indices of the commanded X, Y, Z that are coordinates of the nodes.
    values, own, influence : (node, 6), (node, 6, 6), (source, node, 6)
        Errors, covariance that is independent between nodes, effects of the sources; 0 for unknown freedoms.
    identity : tuple of str
        Sources of equal identity are fully correlated between fields; empty: independent.
    known : (6,) of bool
        Which freedoms are known.
    trained : (node,) of bool
        False where a prediction lies outside the training range of its model.
    point : (3,)
        Functional point of the values, m.
    lever : (3,)
        From there to the functional point of the tool with all axes at zero, m.
    travel : (3,)
        1 for axes whose travel adds to the lever, else 0.
    """

    name: str
    instants: Line | None
    nodes: Nodes
    columns: tuple[int, ...]
    values: Array
    own: Array
    influence: Array
    identity: tuple[str, ...]
    known: NDArray[np.bool_]
    trained: NDArray[np.bool_]
    point: Array
    lever: Array
    travel: Array

    def for_tool(self, point: Array) -> Field:
        """Return the field at another functional point."""
        return replace(self, lever=self.lever + point - self.point, point=point)

    def weights(self, positions: Array, time: Array | None) -> Weights:
        """Return the weights of the nodes for the errors at commanded positions (n, 3) and times (n,)."""
        found = self.nodes.weights(positions[:, self.columns])
        if self.instants is None:
            return found
        if time is None:
            raise DatasetError(
                f"{self.name}: the errors depend on time; state the time of each point (s)",
                code="correction.time.missing",
            )
        return self.instants.weights(time[:, None]).times(found, self.nodes.size)

    def displacement(self, positions: Array, weights: Weights) -> Array:
        """Return the displacement of the tool at commanded positions, (n, 3), m, from their weights."""
        found = weights.of(self._moved)
        if self.travel.any():
            found += np.cross(weights.of(self.values[:, 3:]), self.travel * positions)
        return found

    @cached_property
    def _moved(self) -> Array:
        """Displacement at the nodes, moved by the constant part of the lever, (node, 3)."""
        return np.asarray(self.values[:, :3] + np.cross(self.values[:, 3:], self.lever))

    def needed(self) -> list[str]:
        """Return the freedoms that act on the displacement of this tool, known or not."""
        rotations = [k for k in range(3) if any((self.lever[j] != 0 or self.travel[j]) for j in range(3) if j != k)]
        return [*DOF[:3], *(DOF[3 + k] for k in rotations)]

    def spread(self, positions: Array, weights: Weights, time: Array | None) -> tuple[Array, Array]:
        """Return the covariance of the displacement, (n, 3, 3), and the effects of the sources, (source, n, 3).

        The covariance is that without the sources, including that of the interpolation.
        """
        n = len(positions)
        own = weights.squared(self.own)
        own[:, range(6), range(6)] += np.where(self.known, self._added(positions, time), 0.0)
        L = rigid_motions(self.lever + self.travel * positions, np.zeros(3))
        effects = [weights.of(each) for each in self.influence]
        moved = np.array([np.einsum("nij,nj->ni", L, each) for each in effects]).reshape(-1, n, 3)
        return L @ own @ np.swapaxes(L, 1, 2), moved

    def _added(self, positions: Array, time: Array | None) -> Array:
        """Return the variance of the interpolation in space and in time, (n, 6)."""
        T = 1 if self.instants is None else self.instants.size
        E = self.values.reshape(T, -1, 6)
        C = self.own.reshape(T, -1, 6, 6)
        points = positions[:, self.columns]
        if self.instants is None or time is None:
            return self.nodes.added(points, E[0], C[0])
        found = self.nodes.added(points, E.mean(axis=0), C.mean(axis=0) / T)
        return np.asarray(found + self.instants.added_in_time(time[:, None], E, C))


def field_of(ds: xr.Dataset, name: str, chain: str) -> tuple[Field, list[str]]:
    """Return the field of an error dataset at its own functional point, and notes.

    Parameters
    ----------
    ds : Dataset
        Errors over time, position, target, or time and one of them.
    name : str
        For messages.
    chain : str
        Of the machine; that of the dataset where empty.

    Raises
    ------
    DatasetError
        Errors along one direction only, of beams, over other dimensions, not in the frame of the machine; no known
        errors; coordinates that do not increase.
    """
    _check(ds, name)
    dims = tuple(str(dim) for dim in ds["EX"].dims)
    place = next((dim for dim in dims if dim != "time"), "")
    order = [dim for dim in ("time", place) if dim in dims]
    arranged = ds.transpose(..., *order, "dof", "dof_", missing_dims="ignore")
    shape = (ds.sizes["time"] if "time" in dims else 1, ds.sizes[place] if place else 1)
    E = np.stack([arranged[each].values for each in DOF], axis=-1).reshape(*shape, 6)
    total = arranged["covariance"].transpose(*order, "dof", "dof_").values.reshape(*shape, 6, 6)
    F = influence_of(arranged.transpose("source", ..., missing_dims="ignore")).reshape(-1, *shape, 6)
    known = np.isfinite(E).any(axis=(0, 1))
    if not known.any():
        raise DatasetError(f"{name}: all errors are unknown; nothing can be corrected", code="correction.no_errors")
    lost = ~np.isfinite(E[..., known]).all(axis=-1)
    times = ~lost.all(axis=1)
    kept = ~lost[times].any(axis=0)
    if not kept.any():
        raise DatasetError(
            f"{name}: no position has known errors at all times; select one time (--select time=NUMBER)",
            code="correction.positions.unknown",
        )
    notes = []
    if gaps := int((~times).sum()):
        notes.append(f"{name}: {gaps} of {shape[0]} times have no known errors; interpolated from their neighbours.")
    if gaps := int((~kept).sum()):
        notes.append(
            f"{name}: {gaps} of {shape[1]} positions have no known errors; interpolated from their neighbours."
        )
    instants = _line(ds, "time", times, name) if "time" in dims else None
    nodes, columns, rows = _nodes(ds, place, np.flatnonzero(kept), name)
    E, total, F = (
        each[np.ix_(times, rows)] for each in (E, total, np.moveaxis(F, 0, 2))
    )  # F: (time, position, source, 6)
    size = E.shape[0] * E.shape[1]
    E, total, F = (np.nan_to_num(each.reshape(size, *each.shape[2:])) for each in (E, total, F))
    F = np.moveaxis(F, 1, 0)
    outside = np.zeros(shape[0]) if "outside" not in ds.variables else np.asarray(ds["outside"].values)
    trained = np.repeat(np.broadcast_to(outside, shape[0])[times] == 0, len(rows))
    point = np.asarray(ds.attrs["functional_point"], dtype=float) + np.asarray(
        ds.attrs.get("frame_origin", np.zeros(3))
    )
    lever, travel, note = _lever(ds, point, chain or str(ds.attrs.get("chain", "")), place, name)
    identity = ds["source_id"].values.tolist() if "source_id" in ds.coords else [""] * len(F)
    field = Field(
        name, instants, nodes, columns, E, total - products(F), F, tuple(map(str, identity)), known, trained, point,
        lever, travel,
    )  # fmt: skip
    return field, [*notes, *note]


def _check(ds: xr.Dataset, name: str) -> None:
    if ds.attrs.get("schema") != SCHEMA:
        raise DatasetError(
            f"{name}: expected schema {SCHEMA}; found {ds.attrs.get('schema', 'none')}", code="schema.other"
        )
    if "deviation" in ds.variables:
        raise DatasetError(
            f"{name}: the errors are known along one direction only and cannot be corrected",
            code="correction.freedoms.one_direction",
        )
    if ds.attrs["component"] == "beam":
        raise DatasetError(
            f"{name}: the errors are those of beams, not of the machine", code="correction.errors.of_beams"
        )
    dims = [str(dim) for dim in ds["EX"].dims]
    if not set(dims) <= {"time", "position", "target"} or {"position", "target"} <= set(dims):
        raise DatasetError(
            f"{name}: expected errors over time, position, target, or time and one of these; found "
            f"({', '.join(dims)}). Select one value of the others (--select DIM=NUMBER)",
            code="correction.dims.other",
        )
    if ds.attrs["frame"] != "machine" and "frame_origin" not in ds.attrs:
        raise DatasetError(
            f"{name}: expected errors in machine coordinates; found the frame '{ds.attrs['frame']}'. Transform them "
            "(ds.em.in_frame), or state its origin (attribute frame_origin) if its directions are those of the machine",
            code="correction.frame.other",
        )


def _line(ds: xr.Dataset, coordinate: str, kept: NDArray[np.bool_], name: str) -> Line:
    values = np.asarray(ds[coordinate].values, dtype=float)[kept]
    if not np.isfinite(values).all() or (np.diff(values) <= 0).any():
        raise DatasetError(
            f"{name}: {coordinate}: expected finite values that increase", code="errors.coordinate.not_increasing"
        )
    return Line(values)


def _nodes(
    ds: xr.Dataset, dim: str, rows: NDArray[np.intp], name: str
) -> tuple[Nodes, tuple[int, ...], NDArray[np.intp]]:
    """Return the nodes of the errors, which of X, Y, Z are their coordinates, and the rows of the dataset in order."""
    if not dim:
        return Constant(), (), rows
    found = [k for k, axis in enumerate("xyz") if axis in ds.variables and ds[axis].dims == (dim,)]
    if dim == "position":
        own = _AXES.find(str(ds.attrs["component"]))
        if own >= 0:
            found = [k for k in found if k == own]
        if len(found) != 1:
            raise DatasetError(
                f"{name}: expected one coordinate x, y or z along 'position', that of the component "
                f"{ds.attrs['component']}; found {', '.join('xyz'[k] for k in found) or 'none'}",
                code="correction.coordinate.ambiguous",
            )
        position = np.asarray(ds["xyz"[found[0]]].values, dtype=float)
        rows = rows[np.argsort(position[rows], kind="stable")]
        kept = position[rows]
        if not np.isfinite(kept).all() or (np.diff(kept) <= 0).any():
            raise DatasetError(f"{name}: expected finite positions that differ", code="correction.positions.not_finite")
        return Line(kept), (found[0],), rows
    if len(found) != 3:
        raise DatasetError(
            f"{name}: expected x, y and z of the targets; found {', '.join('xyz'[k] for k in found)}",
            code="correction.coordinate.missing",
        )
    targets = np.stack([np.asarray(ds[axis].values, dtype=float) for axis in "xyz"], axis=1)[rows]
    if not np.isfinite(targets).all():
        raise DatasetError(f"{name}: expected finite x, y and z of the targets", code="correction.positions.not_finite")
    nodes, order = of_targets(targets)
    return nodes, (0, 1, 2), rows[order]


def _lever(ds: xr.Dataset, point: Array, chain: str, place: str, name: str) -> tuple[Array, Array, list[str]]:
    """Return the lever of the rotations with all axes at zero, (3,), and which travels add to it, (3,)."""
    component = str(ds.attrs["component"])
    if component == "tool" and not place:  # one motion of the frame of the axes: e(p) = E + R x M (p - f)
        levers = str(ds.attrs.get("lever_axes", _AXES))
        travel = np.array([float(axis in levers) for axis in _AXES])
        return -travel * point, travel, []
    if place != "position" or component not in _AXES:
        note = f"{name}: the errors of the {component} are treated as equal at all positions." if not place else ""
        return np.zeros(3), np.zeros(3), [note] if note else []
    if not chain:
        return np.zeros(3), np.zeros(3), [
            f"{name}: the chain of the machine is unknown: the travel of the other axes is no lever of its rotations. "
            "State it (--chain workpiece-X-Y-bed-Z-spindle-tool)."
        ]  # fmt: skip
    try:
        carries_tool = parse_chain(chain)
    except ValueError as error:
        raise DatasetError(f"{name}: {error}", code="correction.chain.form") from error
    if component not in carries_tool:
        raise DatasetError(f"{name}: the chain {chain} has no axis {component}", code="correction.chain.no_axis")
    behind = list(carries_tool)[list(carries_tool).index(component) + 1 :]
    # The point of such an axis is fixed to the body on the workpiece side: its own travel changes the lever.
    if not carries_tool[component]:
        behind.append(component)
    return np.zeros(3), np.array([float(axis in behind) for axis in _AXES]), []
