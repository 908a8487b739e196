"""Contents of a result of `beam_direction` as arrays over its planes, with NaN for missing data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.report.fields import field

STROKES = "XYZ"
_OUT_OF_RANGE = 2
"""Code in `left_out`."""


@dataclass(frozen=True)
class Planes:
    """The planes that determine a beam; NaN for unknown values.

    Attributes
    ----------
    names : list of str
        Labels of the planes, by default their numbers from 1.
    inclination, rotation, closure, closure_u : (plane,)
        rad; closure is g.u + 1.
    gradient : (plane, 3)
    gradient_covariance : (plane, 3, 3)
    residual, compensation, raw, compensated : (plane, reading)
        m.
    left_out, given : (plane, reading) of bool
        Readings that the fit did not use, and readings that are not missing.
    beyond : (plane, reading) of bool
        Readings left out because they are out of the sensor's range.
    stage : (plane, reading, 3)
        m.
    """

    names: list[str]
    inclination: Array
    rotation: Array
    closure: Array
    closure_u: Array
    gradient: Array
    gradient_covariance: Array
    residual: Array
    compensation: Array
    raw: Array
    compensated: Array
    left_out: NDArray[np.bool_]
    given: NDArray[np.bool_]
    beyond: NDArray[np.bool_]
    stage: Array

    def __len__(self) -> int:
        return len(self.names)

    @property
    def strokes(self) -> NDArray[np.str_]:
        """Moving axis at each reading, (plane, reading): ``X``, ``Y``, ``Z`` or ``path``.

        Empty if the stage positions are unknown, or if the stage did not move.
        """
        result = np.full(self.given.shape, "", dtype="U4")
        for plane, (positions, given) in enumerate(zip(self.stage, self.given, strict=True)):
            known = np.flatnonzero(given & np.isfinite(positions).all(axis=1))
            if known.size < 2:
                continue
            steps = np.diff(positions[known], axis=0)
            names = np.array([_axis_of(step) for step in steps])
            # A reading belongs to the step before it, or after a move to the next stroke to the step after it.
            before, after = np.concatenate([names[:1], names]), np.concatenate([names, names[-1:]])
            result[plane, known] = np.where(np.isin(before, list(STROKES)), before, after)
        return result


def _axis_of(step: Array) -> str:
    size = np.abs(step)
    if not size.max() > 0:
        return ""
    return STROKES[int(size.argmax())] if np.sort(size)[1] < 0.02 * size.max() else "path"


@dataclass(frozen=True)
class BeamView:
    """One beam: nominal and measured position and direction, and their uncertainty. NaN for unknown values.

    Attributes
    ----------
    direction, nominal, uncompensated : (3,)
        Unit vectors; ``uncompensated`` is the direction without compensation of the readings.
    origin, nominal_origin : (3,)
        m.
    covariance : (6, 6)
        Over origin (m) and direction.
    """

    name: str
    direction: Array
    nominal: Array
    uncompensated: Array
    origin: Array
    nominal_origin: Array
    covariance: Array
    planes: Planes

    @property
    def known(self) -> bool:
        """Whether the direction is known."""
        return bool(np.isfinite(self.direction).all())

    @property
    def compensated(self) -> bool:
        """Whether the readings were corrected."""
        return bool(np.nan_to_num(self.planes.compensation).any()) and bool(np.isfinite(self.uncompensated).all())


def is_direction(errors: xr.Dataset) -> bool:
    """Return whether a dataset is the result of `beam_direction`."""
    measured = "beam_direction" in errors or "residual" in errors  # a plan has neither
    return measured and "beam" in errors.dims and errors.attrs.get("method") == "beam_direction"


def beam_view(errors: xr.Dataset, raw: xr.Dataset | None = None) -> BeamView:
    """Return the view of a result, with the stage positions of ``raw`` if the result does not contain them."""
    name = str(errors["beam"].values[0]) if "beam" in errors.coords else "beam"
    direction, nominal = (_of_beam(errors, f"{kind}_direction") for kind in ("beam", "nominal"))
    covariance = np.full((6, 6), np.nan)
    if "beam_covariance" in errors and errors["beam_covariance"].shape[1:] == (6, 6):
        covariance = np.asarray(errors["beam_covariance"].values[0], float)
    return BeamView(
        name,
        _unit(direction),
        _unit(nominal),
        _unit(_of_beam(errors, "uncompensated_direction")),
        _of_beam(errors, "beam_origin"),
        _of_beam(errors, "nominal_origin"),
        covariance,
        _planes(errors, raw),
    )


def _planes(errors: xr.Dataset, raw: xr.Dataset | None) -> Planes:
    n, m = (errors.sizes.get(dim, 0) for dim in ("plane", "reading"))

    def get(name: str, *dims: str, source: xr.Dataset | None = errors) -> Array:
        shape = tuple({"plane": n, "reading": m}.get(dim, 3) for dim in dims)
        if source is None or name not in source or set(source[name].dims) != set(dims):
            return np.full(shape, np.nan)
        values = field(source, name, *dims)
        return values if values.shape == shape else np.full(shape, np.nan)

    stage = get("stage", "plane", "reading", "direction")
    if not np.isfinite(stage).any():
        stage = get("stage", "plane", "reading", "direction", source=raw)
    reading = get("distance_raw", "plane", "reading")
    compensated = get("distance_compensated", "plane", "reading")
    residual = get("residual", "plane", "reading")
    code = np.nan_to_num(get("left_out", "plane", "reading"))
    given = np.isfinite(reading) | np.isfinite(compensated) | np.isfinite(residual)
    names = [str(i + 1) for i in range(n)]
    if "plane" in errors.coords and errors["plane"].dtype.kind in "US":
        names = [str(label) for label in errors["plane"].values]
    return Planes(
        names,
        get("inclination", "plane"),
        get("rotation", "plane"),
        get("closure", "plane"),
        get("closure_uncertainty", "plane"),
        get("gradient", "plane", "direction"),
        get("gradient_covariance", "plane", "direction", "direction_"),
        residual,
        get("compensation", "plane", "reading"),
        reading,
        compensated,
        (code > 0) & given,
        given,
        (code >= _OUT_OF_RANGE) & given,
        stage,
    )


def _of_beam(errors: xr.Dataset, name: str) -> Array:
    if name not in errors or set(errors[name].dims) != {"beam", "direction"}:
        return np.full(3, np.nan)
    return np.asarray(errors[name].transpose("beam", "direction").values[0], float)


def _unit(vector: Array) -> Array:
    size = np.linalg.norm(vector)
    return vector / size if size > 0 else np.full(3, np.nan)


def across(direction: Array) -> tuple[Array, tuple[str, str]]:
    """Return two unit vectors (2, 3) across a direction, nearest to two machine axes, and the names of these axes."""
    along = int(np.argmax(np.abs(direction)))
    first, second = (i for i in range(3) if i != along)
    a = np.eye(3)[first] - direction[first] * direction
    a /= np.linalg.norm(a)
    b = np.eye(3)[second] - direction[second] * direction
    b -= (b @ a) * a
    return np.stack([a, b / np.linalg.norm(b)]), ("XYZ"[first], "XYZ"[second])
