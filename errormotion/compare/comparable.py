"""Common ground: the same errors, functional point, frame, reference state and grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.compare import chain
from errormotion.compare.point_errors import PointErrors, Stored
from errormotion.compare.stack import Estimate
from errormotion.datasets import validate
from errormotion.datasets.results.interpolation import bracket
from errormotion.datasets.timing import between
from errormotion.errors import DatasetError
from errormotion.kinematics.iso import DOF, LINEAR_AXES, ROTARY_AXES, direction_of

SAME_POINT = 1e-6
"""Distance below which two commanded positions are regarded as equal, m."""
SAME_MOTION = {"spindle": "tool", "tool": "tool"}
"""Components with the same motion, that of the tool relative to the workpiece, as measured on a bar in the spindle."""
UNKNOWN = ("", "unknown")
"""Values of an unknown machine or frame."""
COORDINATES = {"position": ("x", "y", "z"), "target": ("x", "y", "z")}


@dataclass(frozen=True)
class ComparableErrors:
    """Estimates of the same errors on one grid.

    Attributes
    ----------
    estimates : list of Estimate
        An estimate for each dataset, (n, d): points of the grid, and ``freedoms``.
    dim : str
        ``time``, ``position``, ``target``, a declared dimension, or empty for a single place.
    coords : dict
        Coordinates along ``dim``.
    freedoms : tuple of str
    component, machine, frame : str
    point : ndarray, (3,)
        Functional point, m.
    since : float or None
        Time of the common reference state on ``time``, s; None if the errors have no common reference in time.
    notes : list of str
    records : dict of str to Dataset
        Complete datasets over time, at the functional point and on the common time axis.
    labels : dict of str to str
        Names of sources by identity.
    stored : dict of str to Stored
        The errors of each dataset as a function of the errors that it states.
    """

    estimates: list[Estimate]
    dim: str
    coords: dict[str, xr.DataArray]
    freedoms: tuple[str, ...]
    component: str
    machine: str
    frame: str
    point: Array
    since: float | None
    start: str = ""
    notes: list[str] = field(default_factory=list)
    records: dict[str, xr.Dataset] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    stored: dict[str, Stored] = field(default_factory=dict)


def comparable_errors(
    datasets: Mapping[str, xr.Dataset],
    *,
    at: ArrayLike | None = None,
    freedoms: Sequence[str] = (),
    since: float | None = None,
    same_start: bool = False,
) -> ComparableErrors:
    """Transform error datasets to common ground.

    Parameters
    ----------
    datasets : mapping of str to Dataset
        Name to error dataset; at least two.
    at : array_like, (3,), optional
        Functional point in the common frame, m. Default: that of the first dataset.
    freedoms : sequence of str, optional
        Freedoms to compare. Default: all that are known in every dataset.
    since : float, optional
        Time of the common reference state, s after the start of the first dataset. Default: the first common time.
    same_start : bool
        Treat time 0 of all datasets as the same instant if they do not state their start.

    Raises
    ------
    DatasetError
        There are fewer than two datasets, a dataset is given twice, machines, components, frames or dimensions differ,
        a start is missing, or datasets have no common time, position or freedom.
    """
    names = list(datasets)
    if len(names) < 2:
        raise DatasetError(
            f"Expected at least two datasets to compare; found {len(names)}", code="compare.datasets.too_few"
        )
    for name, ds in datasets.items():
        _check(name, ds)
    _once(datasets)
    notes: list[str] = []
    datasets = {name: chain.in_machine(ds) for name, ds in datasets.items()}
    stored: dict[str, Stored] = {}
    place, straightened = "", False
    if chain.axis_of(datasets):
        _same(datasets, "machine")
        _same(datasets, "frame")
        datasets, stored = chain.on_axis(datasets, at=at, same_start=same_start, notes=notes)
    else:
        datasets, place, straightened = chain.at_reference(datasets, "", notes)
    for name, ds in datasets.items():
        _check_dimensions(name, ds)
    first = datasets[names[0]]
    component = _same(datasets, "component", SAME_MOTION)
    machine, frame = _same(datasets, "machine"), _same(datasets, "frame")
    if frame in UNKNOWN:
        raise DatasetError(
            f"{', '.join(map(repr, names))}: their frame is unknown (attribute 'frame': '{frame}'), so that their axes "
            "may have different directions. State the frame",
            code="compare.frame.unknown",
        )
    if machine in UNKNOWN:
        notes.append(f"No dataset states its machine ('{machine}'); they are treated as datasets of one machine.")
    dim = _dimension(datasets)
    point = np.array(first.attrs["functional_point"] if at is None else at, dtype=float)
    moved = {
        name: ds if component == "beam" or np.array_equal(point, ds.attrs["functional_point"]) else _at(name, ds, point)
        for name, ds in datasets.items()
    }
    reference: float | None = None
    records: dict[str, xr.Dataset] = {}
    if dim == "time":
        records = _on_one_axis(moved, same_start, notes)
        errors, grid = _in_time(records, since, notes)
        reference = float(grid[0])
        coords = {"time": xr.DataArray(grid, dims=("time",), attrs=first["time"].attrs)}
    else:
        found = _in_place(moved, dim, notes) if dim else moved
        errors = {name: PointErrors.of(ds) for name, ds in found.items()}
        coords = _coordinates(next(iter(found.values())), dim)
    if stored:
        stored |= {name: Stored(each, np.zeros(3)) for name, each in errors.items() if name not in stored}
    else:
        stored = _stored(errors, datasets, point, component, coords, place)
        if straightened:
            errors = {name: each.line(each.errors) for name, each in stored.items()}
            stored = {name: replace(each, finish=each.line) for name, each in stored.items()}
            notes.append("Straightness is compared relative to the line through the first and the last position.")
    seen = [each.seen for each in errors.values()]
    chosen = tuple(name for name in (freedoms or DOF) if all(name in each for each in seen))
    for name in freedoms:
        for dataset, each in zip(errors, seen, strict=True):
            if name not in each:
                raise DatasetError(
                    f"'{dataset}' does not state {name}; it states {', '.join(each) or 'nothing'}",
                    code="compare.attribute.missing",
                )
    if not chosen:
        states = "; ".join(f"'{name}': {', '.join(each) or 'none'}" for name, each in zip(errors, seen, strict=True))
        raise DatasetError(f"The datasets have no freedom in common: {states}", code="compare.freedoms.none_common")
    _check_rotations(moved, chosen)
    return ComparableErrors(
        estimates=[each.estimate(name, chosen) for name, each in errors.items()],
        dim=dim,
        coords=coords,
        freedoms=chosen,
        component=component,
        machine=machine,
        frame=frame,
        point=point,
        since=reference,
        start=str(first.attrs.get("start", "")),
        notes=notes,
        stored=stored,
        records=records,
        labels={
            identity: source
            for each in errors.values()
            for identity, source in zip(each.identity, each.source, strict=True)
            if identity
        },
    )


def _stored(
    errors: Mapping[str, PointErrors],
    datasets: Mapping[str, xr.Dataset],
    point: Array,
    component: str,
    coords: Mapping[str, xr.DataArray],
    place: str,
) -> dict[str, Stored]:
    """Return the errors of each dataset as a function of the errors that it states."""
    coordinates = {}
    for name, each in errors.items():
        own = np.array(datasets[name].attrs["functional_point"], dtype=float)
        coordinates[name] = Stored(each, np.zeros(3) if component == "beam" else point - own)
    if component in LINEAR_AXES and (letter := "xyz"[direction_of(component)]) in coords:
        q = np.asarray(coords[letter].values, dtype=float)
        line = partial(chain.from_line, positions=q, axis=component)
        coordinates = {
            name: replace(each, levers=chain.levers(place, q, component), line=line)
            for name, each in coordinates.items()
        }
    return coordinates


def parts_compared(component: str) -> set[str]:
    """Return the parts of the machine with which errors of a component can be compared.

    An axis is compared with the same axis, and with the tool by the kinematic chain.
    """
    part = SAME_MOTION.get(component, component)
    return {part, "tool"} if part in (*LINEAR_AXES, *ROTARY_AXES) else {part}


def _check(name: str, ds: xr.Dataset) -> None:
    try:
        validate(ds)
        ds.em.names  # noqa: B018 - raises if it is not an error dataset
    except DatasetError as error:
        raise DatasetError(f"'{name}': {error}", code=error.code) from None
    if ds.em.names != DOF:
        raise DatasetError(
            f"'{name}': errors along one direction only (deviation) cannot be compared",
            code="compare.freedoms.one_direction",
        )
    variance = np.diagonal(ds["covariance"].values, axis1=-2, axis2=-1)
    known = np.isfinite(variance)
    if known.any() and not (variance[known] > 0).any():
        raise DatasetError(
            f"'{name}': its covariance is 0 everywhere; expected the uncertainty of its errors. State a small "
            "uncertainty for exact values, such as true errors",
            code="compare.covariance.zero",
        )


def _check_dimensions(name: str, ds: xr.Dataset) -> None:
    if len(ds["EX"].dims) > 1:
        raise DatasetError(
            f"'{name}': its errors depend on {', '.join(map(str, ds['EX'].dims))}; select one value of all but one, as "
            "in ds.isel(position=3) or --over time --select position=3",
            code="compare.dims.too_many",
        )


def _once(datasets: Mapping[str, xr.Dataset]) -> None:
    """Raise DatasetError for one dataset under two names."""
    seen: dict[bytes, list[str]] = {}
    for name, ds in datasets.items():
        alike = seen.setdefault(b"".join(ds[freedom].values.tobytes() for freedom in DOF), [])
        for other in alike:
            if datasets[name].identical(datasets[other]):
                raise DatasetError(
                    f"'{other}' and '{name}' are the same dataset; a comparison needs two measurements",
                    code="compare.dataset.same",
                )
        alike.append(name)


def _same(datasets: Mapping[str, xr.Dataset], attribute: str, alike: Mapping[str, str] | None = None) -> str:
    found = {name: str(ds.attrs[attribute]) for name, ds in datasets.items()}
    values = {(alike or {}).get(value, value) for value in found.values()}
    if len(values) > 1:
        stated = "; ".join(f"'{name}': {value}" for name, value in found.items())
        hint = {
            "frame": ". Transform one to the frame of the other by ds.em.in_frame(pose, name), or state the origin of "
            "its frame in machine coordinates (attribute frame_origin, --origin NAME=x,y,z)",
            "component": ". Compare those of one part of the machine; a comparison of the errors of an axis and of the "
            "tool needs the kinematic chain",
        }.get(attribute, "")
        raise DatasetError(
            f"The datasets have different attributes '{attribute}' ({stated}){hint}", code="compare.attribute.differs"
        )
    return values.pop()


def _at(name: str, ds: xr.Dataset, point: Array) -> xr.Dataset:
    try:
        moved: xr.Dataset = ds.em.at(point)
    except DatasetError as error:
        own = ",".join(f"{1e3 * each:g}" for each in ds.attrs["functional_point"])
        raise DatasetError(f"'{name}': {error}, or compare at its own point (--at {own})", code=error.code) from None
    return moved


def _check_rotations(datasets: Mapping[str, xr.Dataset], freedoms: Sequence[str]) -> None:
    """Raise DatasetError for rotations of different bodies: of the tool, and of the frame of the axes."""
    angles = [name for name in freedoms if name in DOF[3:]]
    levers = {name: str(ds.attrs.get("lever_axes", "XYZ")) for name, ds in datasets.items()}
    if angles and len(set(levers.values())) > 1:
        stated = "; ".join(f"'{name}': {axes}" for name, axes in levers.items())
        raise DatasetError(
            f"The rotations ({', '.join(angles)}) are those of different bodies (attribute lever_axes: {stated}): XYZ "
            "means a rigid motion of the tool, fewer axes mean the frame of the axes that carry the tool. Compare the "
            f"displacements: {_displacements(freedoms)}",
            code="compare.bodies.differ",
        )


def _displacements(freedoms: Sequence[str]) -> str:
    left = [name for name in freedoms if name in DOF[:3]]
    return f"--freedoms {','.join(left)}" if left else "these datasets have no common displacements"


def _dimension(datasets: Mapping[str, xr.Dataset]) -> str:
    dims = {name: ds["EX"].dims for name, ds in datasets.items()}
    if len(set(dims.values())) > 1:
        stated = "; ".join(f"'{name}': {', '.join(map(str, each)) or 'none'}" for name, each in dims.items())
        raise DatasetError(
            f"The errors of the datasets depend on different dimensions ({stated})", code="compare.dims.differ"
        )
    dim = next(iter(dims.values()))
    return str(dim[0]) if dim else ""


def _on_one_axis(datasets: Mapping[str, xr.Dataset], same_start: bool, notes: list[str]) -> dict[str, xr.Dataset]:
    """Return the datasets with their times counted from the start of the first one."""
    names = list(datasets)
    starts = {name: str(ds.attrs.get("start", "")) for name, ds in datasets.items()}
    missing = [name for name, start in starts.items() if not start]
    if missing and not same_start:
        raise DatasetError(
            f"{', '.join(repr(name) for name in missing)}: no attribute 'start' (UTC of time 0), so that its times "
            "cannot be related to those of the others. State it, or state that all start at the same instant "
            "(same_start, --same-start)",
            code="compare.start.missing",
        )
    if missing:
        notes.append(f"Time 0 of all datasets is treated as the same instant: {', '.join(missing)} without start.")
    offset = {name: 0.0 if missing else between(starts[names[0]], start) for name, start in starts.items()}
    return {
        name: ds.assign_coords(time=("time", ds["time"].values + offset[name], ds["time"].attrs))
        for name, ds in datasets.items()
    }


def _in_time(
    shifted: Mapping[str, xr.Dataset], since: float | None, notes: list[str]
) -> tuple[dict[str, PointErrors], Array]:
    """Return the datasets at the times of the sparsest one, as changes since a common time, and these times."""
    names = list(shifted)
    known = {name: ds["time"].values[_known(ds)] for name, ds in shifted.items()}
    first = max((times[0] if times.size else np.inf) for times in known.values())
    last = min((times[-1] if times.size else -np.inf) for times in known.values())
    if first > last:
        spans = "; ".join(
            f"'{name}': {times[0]:g} s to {times[-1]:g} s" if times.size else f"'{name}': no known values"
            for name, times in known.items()
        )
        raise DatasetError(
            f"The datasets do not overlap in time (s after the start of '{names[0]}'): {spans}",
            code="compare.times.no_overlap",
        )
    inside = {name: times[(times >= first) & (times <= last)] for name, times in known.items()}
    sparse = min(inside, key=lambda name: inside[name].size)
    grid = inside[sparse]
    if since is not None:
        grid = grid[grid > since]
        grid = np.concatenate([[since], grid])
        if not first <= since <= last:
            raise DatasetError(
                f"since: expected a time from {first:g} s to {last:g} s; found {since:g} s",
                code="compare.since.outside",
            )
    others = [name for name in names if name != sparse]
    kept = _apart(grid, [shifted[name]["time"].values for name in others])
    if (~kept).any():
        notes.append(
            f"{int((~kept).sum())} of {grid.size} times are left out, so that no two interpolated values depend on the "
            "same measured value."
        )
        grid = grid[kept]
    if grid.size < 2:
        raise DatasetError(
            "The datasets have fewer than two common times; a change needs a reference and a value",
            code="compare.times.too_few",
        )
    notes.append(f"Grid: the {grid.size} times of '{sparse}'; interpolated: {', '.join(others)}.")
    errors = {name: PointErrors.of(ds).at_times(ds["time"].values, grid) for name, ds in shifted.items()}
    for name, each in errors.items():
        if not np.isfinite(each.value[0])[np.isfinite(each.value).any(axis=0)].all():
            raise DatasetError(
                f"'{name}': not all of its errors are known at {grid[0]:g} s, the common reference state",
                code="compare.reference.unknown",
            )
    return {name: each.since_first() for name, each in errors.items()}, grid


def _apart(grid: Array, times: Sequence[Array]) -> NDArray[np.bool_]:
    """Return which times of a grid are kept, so that each value of a dataset is used for at most one of them."""
    used = np.array([bracket(t, grid) for t in times])  # (dataset, before and after, time)
    kept = np.ones(grid.size, dtype=bool)
    if (used[:, 0, 1:] > used[:, 1, :-1]).all():
        return kept
    last = np.full(len(times), -1)
    for i in range(grid.size):
        kept[i] = bool((used[:, 0, i] > last).all())
        last = used[:, 1, i] if kept[i] else last
    return kept


def _in_place(datasets: Mapping[str, xr.Dataset], dim: str, notes: list[str]) -> dict[str, xr.Dataset]:
    """Return the datasets at their common points."""
    names = list(datasets)
    points = {name: _points(name, ds, dim) for name, ds in datasets.items()}
    first = points[names[0]]
    rows: dict[str, list[int]] = {name: [] for name in names}
    for i, point in enumerate(first):
        matches = {name: _match(point, points[name]) for name in names[1:]}
        if all(match is not None for match in matches.values()):
            rows[names[0]].append(i)
            for name, match in matches.items():
                rows[name].append(int(match or 0))
    if not rows[names[0]]:
        raise DatasetError(
            f"The datasets {', '.join(map(repr, names))} have no {dim} in common (within {SAME_POINT * 1e6:g} um)",
            code="compare.points.none_common",
        )
    left = {name: ds.sizes[dim] - len(rows[name]) for name, ds in datasets.items()}
    if any(left.values()):
        notes.append(
            f"{len(rows[names[0]])} common points; left out: "
            + ", ".join(f"{count} of '{name}'" for name, count in left.items() if count)
        )
    return {name: ds.isel({dim: rows[name]}) for name, ds in datasets.items()}


def _points(name: str, ds: xr.Dataset, dim: str) -> list[Any]:
    """Return the identification of the points of a dimension: coordinates, or labels."""
    axes = [axis for axis in COORDINATES.get(dim, ()) if axis in ds.variables and ds[axis].dims == (dim,)]
    if axes:
        return list(np.stack([ds[axis].values for axis in axes], axis=-1))
    if dim in ds.coords:
        return list(ds[dim].values.tolist())
    raise DatasetError(
        f"'{name}': its {dim} has no coordinate; its values cannot be matched with those of the others",
        code="compare.coordinate.missing",
    )


def _match(point: Any, points: list[Any]) -> int | None:
    if isinstance(point, np.ndarray):
        if not points or np.shape(points[0]) != point.shape:
            return None
        distance = np.linalg.norm(np.array(points, dtype=float) - point, axis=1)
        nearest = int(distance.argmin())
        return nearest if distance[nearest] <= SAME_POINT else None
    return points.index(point) if point in points else None


def _known(ds: xr.Dataset) -> NDArray[np.bool_]:
    known: NDArray[np.bool_] = np.isfinite(np.stack([ds[name].values for name in DOF])).any(axis=0)
    return known


def _coordinates(ds: xr.Dataset, dim: str) -> dict[str, xr.DataArray]:
    coords = {str(name): ds[name] for name in ds.coords if dim and ds[name].dims == (dim,) and name != "source"}
    return {name: value.drop_vars(set(value.coords) - {name}) for name, value in coords.items()}
