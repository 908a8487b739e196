"""Errors of one axis and of the volume on common ground, by the kinematic chain of the machine."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.compare.chain.curve import Curve, measured, reference_weights
from errormotion.compare.chain.straightness import TABLE, TOOL, at_reference, from_line, levers
from errormotion.compare.chain.volume import SAME, predict
from errormotion.compare.point_errors import PointErrors, Stored
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.timing import between, later
from errormotion.errors import DatasetError
from errormotion.kinematics.chains import parse_chain
from errormotion.kinematics.iso import LINEAR_AXES, ROTARY_AXES

__all__ = ["at_reference", "axis_of", "from_line", "in_machine", "levers", "on_axis", "predict"]


def axis_of(datasets: Mapping[str, xr.Dataset]) -> str:
    """Return the axis of some datasets if the others are of the volume; otherwise an empty text."""
    axes = {str(ds.attrs["component"]) for ds in datasets.values()} - {"tool"}
    mixed = len(axes) == 1 and any(ds.attrs["component"] == "tool" for ds in datasets.values())
    axis = axes.pop() if mixed else ""
    return axis if axis in (*LINEAR_AXES, *ROTARY_AXES) else ""


def on_axis(
    datasets: Mapping[str, xr.Dataset], *, at: ArrayLike | None = None, same_start: bool = False, notes: list[str]
) -> tuple[dict[str, xr.Dataset], dict[str, Stored]]:
    """Return all datasets as errors of one axis, at common positions, relative to the same positions.

    The second mapping relates those of the axis to the errors that they state.

    Parameters
    ----------
    datasets : mapping of str to Dataset
        Errors of one axis (over ``position``, optionally ``time``) and of the tool (over ``target``).
    at : array_like, (3,), optional
        Functional point in machine coordinates with all axes at zero, m. Default: that of the first volume.
    same_start : bool
        Use the last time of an axis over time if a start is not stated.
    notes : list of str
        Notes on the procedure are appended.

    Raises
    ------
    DatasetError
        Missing or contradictory: chain, frame, coordinates, kind of reference, start in UTC, or common positions.
    """
    axis = axis_of(datasets)
    volumes = {name: ds for name, ds in datasets.items() if ds.attrs["component"] == "tool"}
    first_name, first = next(iter(volumes.items()))
    for name, ds in volumes.items():
        _check_volume(name, ds, axis)
    point = np.array(first.attrs["functional_point"] if at is None else at, dtype=float)
    axes, shifts = {}, {}
    for name, ds in datasets.items():
        if name in volumes:
            continue
        _check_reference(name, ds, first_name, first)
        axes[name] = _at_instant(name, ds, first_name, first, same_start, notes).em.at(point)
        shifts[name] = point - np.asarray(ds.attrs["functional_point"], dtype=float)
    # The errors of an axis are stated at a point of the body that moves.
    place = TOOL if parse_chain(str(first.attrs["chain"]))[axis] else TABLE
    axes, _, _ = at_reference(axes, place, notes)
    letter = axis.lower()
    positions = _common_positions(axes, volumes, letter)
    curves: dict[str, Curve] = {}
    for name in datasets:
        if name in axes:
            curves[name] = measured(axes[name], letter, positions)
        else:
            curves[name] = predict(volumes[name], axis, positions, point, notes=notes, name=name)
    weights = reference_weights([each.value for each in curves.values()], positions, axis)
    notes.append(
        f"Errors of {axis} from the volume ({', '.join(volumes)}) by the chain {first.attrs['chain']}, at "
        f"{positions.size} positions. Positioning and rotations are relative to the first, straightness to the line "
        "through the first and the last: squareness, datum and constant parts are not compared."
    )

    def relative(errors: PointErrors) -> PointErrors:
        return _placed(_curve(errors).relative(weights))

    stored = {
        name: Stored(
            _placed(curves[name]),
            shift,
            finish=relative,
            levers=levers(place, positions, axis) if axis in LINEAR_AXES else {},
        )
        for name, shift in shifts.items()
    }
    placed = {
        name: _dataset(datasets[name], curve.relative(weights), axis, positions, point, first)
        for name, curve in curves.items()
    }
    return placed, stored


def _placed(curve: Curve) -> PointErrors:
    return PointErrors(curve.value, curve.own, curve.influence, curve.source, curve.identity)


def _curve(errors: PointErrors) -> Curve:
    return Curve(errors.value, errors.own, errors.influence, errors.source, [""] * len(errors.source), errors.identity)


def _check_volume(name: str, ds: xr.Dataset, axis: str) -> None:
    dims = ", ".join(map(str, ds["EX"].dims)) or "nothing"
    if ds["EX"].dims != ("target",):
        raise DatasetError(
            f"'{name}': the errors of {axis} can be derived only from errors of the tool at targets in the volume; "
            f"these errors depend on {dims}",
            code="compare.axis.not_derivable",
        )
    if "chain" not in ds.attrs:
        raise DatasetError(
            f"'{name}': no attribute 'chain' (such as workpiece-X-Y-bed-Z-spindle-tool), so that the errors of {axis} "
            "cannot be derived from those of the volume. State it (--chain)",
            code="compare.chain.missing",
        )
    axes = parse_chain(str(ds.attrs["chain"]))
    if axis not in axes:
        raise DatasetError(f"'{name}': its chain {ds.attrs['chain']} has no axis {axis}", code="compare.chain.no_axis")
    missing = [each for each in axes if each not in "XYZ" or each.lower() not in ds.variables]
    if missing:
        raise DatasetError(
            f"'{name}': its targets state no commanded position of {', '.join(missing)}",
            code="compare.targets.no_position",
        )


def in_machine(ds: xr.Dataset) -> xr.Dataset:
    """Return the dataset in machine coordinates, if it states the origin of its frame in machine coordinates."""
    if "frame_origin" not in ds.attrs:
        return ds
    origin = np.asarray(ds.attrs["frame_origin"], dtype=float)
    moved = ds.assign_attrs(frame="machine", functional_point=np.asarray(ds.attrs["functional_point"]) + origin)
    del moved.attrs["frame_origin"]
    return moved


def _check_reference(name: str, ds: xr.Dataset, volume_name: str, volume: xr.Dataset) -> None:
    changes = ["reference_interval" in each.attrs for each in (ds, volume)]
    if changes[0] == changes[1]:
        return
    one, other = ((name, ds), (volume_name, volume)) if changes[0] else ((volume_name, volume), (name, ds))
    raise DatasetError(
        f"'{one[0]}' states changes since a reference state ({one[1].attrs['reference']}), '{other[0]}' errors against "
        f"the commanded positions ({other[1].attrs['reference']}): measure '{other[0]}' in the reference state as well "
        "and subtract it (ds.em.change_from(before), --change NAME=AFTER,BEFORE)",
        code="compare.reference.differs",
    )


def _at_instant(
    name: str, ds: xr.Dataset, volume_name: str, volume: xr.Dataset, same_start: bool, notes: list[str]
) -> xr.Dataset:
    """Return the errors of an axis over time at the time of the volume."""
    if ds["EX"].dims not in (("time", "position"), ("position", "time"), ("position",)):
        dims = ", ".join(map(str, ds["EX"].dims)) or "nothing"
        raise DatasetError(
            f"'{name}': expected errors over position, optionally also over time; they depend on {dims}",
            code="compare.dims.not_positions",
        )
    if "time" not in ds["EX"].dims:
        return ds
    t = np.asarray(ds["time"].values, dtype=float)
    silent = [n for n, each in ((name, ds), (volume_name, volume)) if not each.attrs.get("start")]
    if silent and not same_start:
        raise DatasetError(
            f"{', '.join(map(repr, silent))}: no attribute 'start' (UTC of time 0), so that the time of '{name}' "
            f"that corresponds to '{volume_name}' is unknown. State it, or use the last time (same_start, "
            "--same-start)",
            code="compare.start.missing",
        )
    wanted = t[-1] if silent else between(str(ds.attrs["start"]), str(volume.attrs["start"]))
    k = int(np.abs(t - wanted).argmin())
    step = np.abs(np.diff(t)).max(initial=0.0)
    if not t[0] - step <= wanted <= t[-1] + step:
        raise DatasetError(
            f"'{volume_name}' starts {wanted:.0f} s after the start of '{name}', which covers {t[0]:.0f} s to "
            f"{t[-1]:.0f} s: they do not overlap in time",
            code="compare.times.no_overlap",
        )
    notes.append(f"'{name}' at {t[k]:.0f} s, {abs(t[k] - wanted):.0f} s from the start of '{volume_name}'.")
    one = ds.isel(time=k).drop_vars(["time", "time_index"], errors="ignore")
    return one.assign_attrs(start=later(str(ds.attrs["start"]), t[k])) if ds.attrs.get("start") else one


def _common_positions(axes: Mapping[str, xr.Dataset], volumes: Mapping[str, xr.Dataset], letter: str) -> Array:
    """Return the positions that all datasets of the axis have in common and that are within all volumes."""
    for name, ds in axes.items():
        if letter not in ds.variables or ds[letter].dims != ("position",):
            raise DatasetError(
                f"'{name}': no coordinate {letter} along the dimension position", code="compare.coordinate.missing"
            )
    grid = np.sort(np.asarray(next(iter(axes.values()))[letter].values, dtype=float))
    for ds in axes.values():
        grid = np.array([q for q in grid if (np.abs(ds[letter].values - q) <= SAME).any()])
    for ds in volumes.values():
        inside = np.asarray(ds[letter].values, dtype=float)[np.isfinite(ds["EX"].values)]
        if inside.size:
            grid = grid[(grid >= inside.min() - SAME) & (grid <= inside.max() + SAME)]
    if grid.size < 2:
        raise DatasetError(
            f"{', '.join(map(repr, axes))}: {grid.size} positions of {letter} in common within the volume; expected "
            "at least two, since errors are not extrapolated",
            code="compare.positions.few_common",
        )
    return grid


def _dataset(ds: xr.Dataset, curve: Curve, axis: str, positions: Array, point: Array, volume: xr.Dataset) -> xr.Dataset:
    F = np.nan_to_num(curve.influence)
    return build_errors(
        curve.value,
        curve.own + np.einsum("sni,snj->nij", F, F),
        dims=("position",),
        coords={axis.lower(): ("position", positions)},
        component=axis,
        machine=str(ds.attrs["machine"]),
        frame=str(volume.attrs["frame"]),
        functional_point=point,
        reference="the first position; for straightness the line through the first and the last one",
        method=str(ds.attrs["method"]),
        method_version=str(ds.attrs["method_version"]),
        provenance=provenance.of(ds),
        influence=curve.influence if len(F) else None,
        sources=curve.source,
        source_groups=curve.group,
        source_ids={name: key for name, key in zip(curve.source, curve.identity, strict=True) if key},
        start=str(ds.attrs.get("start", "")),
        measured=volume.attrs,
    )
