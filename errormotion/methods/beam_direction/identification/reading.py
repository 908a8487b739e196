"""Readings of a raw dataset, checked beyond the schema: range of the sensor, order of the stage, noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from errormotion.methods.beam_direction.settings import BeamDirectionSettings


MAX_MISSING = 0.3
"""Largest share of missing readings of a plane."""
NORMAL_NEEDED = (
    "expected the normal of the plane of emitted and received beam, for the compensation of the inclination error."
)
RECEIVER_NEEDED = (
    "expected 'right' or 'left', for the compensation of the inclination error: the side of the receiving lens, seen "
    "from the laser's exit, when one looks along the beam with triangulation_normal upwards. Find both openings on the "
    "sensor's drawing, or cover one: the laser's light comes from the other. The wrong side reverses the correction."
)
"""What a statement on the sensor must contain, for messages."""
_REVERSAL_COSINE = 0.999
_MIN_STEP = 1e-3
"""Share of the longest step below which the stage is at rest."""


@dataclass(frozen=True)
class Readings:
    """Readings on planes, SI.

    Attributes
    ----------
    names : tuple of str
        Of the planes, counted from 1.
    raw, distance : ndarray (plane, reading)
        Recorded readings, and those within the range of the sensor.
    stage : ndarray (plane, reading, 3)
        Position of the sensor relative to the target.
    moves : {"sensor", "target"}
    nominal_direction : ndarray (3,)
    nominal_origin : ndarray (3,)
        NaN where unknown.
    points : ndarray (plane, 3)
        A known point of each plane; NaN where unknown.
    noise, speckle, speckle_length, point_uncertainty : float
    """

    names: tuple[str, ...]
    raw: Array
    distance: Array
    stage: Array
    moves: Literal["sensor", "target"]
    nominal_direction: Array
    nominal_origin: Array
    points: Array
    noise: float
    speckle: float
    speckle_length: float
    point_uncertainty: float

    @property
    def has_correlated_speckle(self) -> bool:
        """Whether the correlation of readings at neighbouring positions is stated."""
        return self.speckle > 0 and self.speckle_length > 0


def read(raw: xr.Dataset, settings: BeamDirectionSettings, notes: list[str]) -> Readings:
    """Return the readings of a raw dataset; remarks are appended to ``notes``.

    Raises
    ------
    MethodError
        A stroke out of the sensor's range, a stage that reverses along a stroke, a noise of 0, speckle without its
        length.
    """
    moves = raw.attrs.get("moves", settings.moves)
    if moves not in ("sensor", "target"):
        raise MethodError(f"attribute moves: expected 'sensor' or 'target'; found {moves!r}.", code="raw.moves.form")
    distance = np.array(raw["distance"].transpose("plane", "reading").values, np.float64)
    stage = np.asarray(raw["stage"].transpose("plane", "reading", "direction").values, np.float64)
    names = tuple(f"Plane {i + 1}" for i in range(len(distance)))
    noise, speckle, length = float(raw["distance_noise"]), _scalar(raw, "speckle"), _scalar(raw, "speckle_length")
    if not noise > 0:
        raise MethodError(
            "distance_noise: expected the standard deviation of one reading at rest, m; found 0.",
            code="raw.noise.not_positive",
        )
    if speckle > 0 and "speckle_length" not in raw:
        raise MethodError(
            "speckle_length: expected the correlation length of the speckle, m; found none.",
            code="beam.speckle.missing",
        )
    low, high = raw["reading_range"].values if "reading_range" in raw else (-np.inf, np.inf)
    within = distance.copy()
    for i, name in enumerate(names):
        within[i] = _in_range(name, distance[i], np.isfinite(stage[i]).all(axis=1), float(low), float(high), notes)
        if settings.ordered:
            _check_order(name, stage[i])
    u0 = np.asarray(raw["nominal_direction"].values, np.float64)
    unknown = np.full(3, np.nan)
    return Readings(
        names=names,
        raw=distance,
        distance=within,
        stage=stage if moves == "sensor" else -stage,
        moves=moves,
        nominal_direction=u0 / np.linalg.norm(u0),
        nominal_origin=np.asarray(raw["nominal_origin"].values if "nominal_origin" in raw else unknown, np.float64),
        points=np.asarray(
            raw["plane_point"].transpose("plane", "direction").values
            if "plane_point" in raw
            else np.tile(unknown, (len(names), 1)),
            np.float64,
        ),
        noise=noise,
        speckle=speckle,
        speckle_length=length,
        point_uncertainty=_scalar(raw, "plane_point_uncertainty"),
    )


def with_receiver_right(normal: ArrayLike, receiver: str | None) -> Array:
    """Return the unit normal (3,) of a triangulation plane on the side from which the receiver is on the right.

    Parameters
    ----------
    normal : array_like (3,)
        Normal of the plane of emitted and received beam, on either side.
    receiver : {"left", "right"}
        Side of the receiver, seen from the laser, for an observer who looks along the beam with the normal upwards.

    Raises
    ------
    MethodError
        The side is not stated.
    """
    if receiver not in ("left", "right"):
        raise MethodError(f"receiver: {RECEIVER_NEEDED} Found {receiver!r}.", code="beam.receiver.missing")
    t = np.asarray(normal, np.float64)
    return np.asarray((t if receiver == "right" else -t) / np.linalg.norm(t))


def triangulation_normal(raw: xr.Dataset, receiver: str | None = None) -> Array:
    """Return the normal of the sensor's triangulation plane with the receiver on the right, see `with_receiver_right`.

    ``receiver`` is used for a dataset without the attribute of this name.

    Raises
    ------
    MethodError
        The data do not state the plane, or neither they nor ``receiver`` the side of the receiver.
    """
    if "triangulation_normal" not in raw:
        raise MethodError(
            "Expected triangulation_normal(direction) in the raw dataset, for the inclination compensation: "
            f"{NORMAL_NEEDED} Add it, or identify without compensation.",
            code="beam.triangulation_normal.missing",
        )
    return with_receiver_right(raw["triangulation_normal"].values, raw.attrs.get("receiver", receiver))


def _scalar(raw: xr.Dataset, name: str) -> float:
    value = float(raw[name]) if name in raw else 0.0
    return value if np.isfinite(value) else 0.0


def _in_range(
    name: str, distance: Array, placed: NDArray[np.bool_], low: float, high: float, notes: list[str]
) -> Array:
    """Return the readings with NaN for those out of range; MethodError if too many are missing."""
    out = (distance < low) | (distance > high)
    missing = placed & (out | np.isnan(distance))
    if not missing.any():
        return distance
    first, empty = int(np.argmax(missing)) + 1, int((placed & np.isnan(distance)).sum())
    text = (
        f"{name}: {int(missing.sum())} of {int(placed.sum())} readings are missing ({empty} without value, "
        f"{int(out.sum())} out of the sensor's range), the first is reading {first}"
    )
    if missing.sum() > MAX_MISSING * placed.sum():
        limits = f" of {low * 1e3:g} to {high * 1e3:g} mm" if np.isfinite(low) else ""
        raise MethodError(
            f"{text}: the strokes leave the sensor's range{limits}. Shorten them, start closer to mid-range, or reduce "
            "the tilt of the plane.",
            code="beam.strokes.outside_range",
        )
    notes.append(f"{text}; the others are used.")
    return np.where(out, np.nan, distance)


def _check_order(name: str, stage: Array) -> None:
    """Raise MethodError for a reversed step along a straight stroke: rows in wrong order, lost counts, backlash."""
    rows = np.flatnonzero(np.isfinite(stage).all(axis=1))
    steps = np.diff(stage[rows], axis=0)
    size = np.linalg.norm(steps, axis=1)
    moving = np.flatnonzero(size > _MIN_STEP * size.max(initial=0.0))
    if len(moving) < 3:
        return
    d, size = steps[moving] / size[moving, None], size[moving]
    reverses = np.sum(d[1:] * d[:-1], axis=1) < -_REVERSAL_COSINE
    wrong = reverses[:-1] & reverses[1:] & (size[1:-1] < 0.9 * np.minimum(size[:-2], size[2:]))
    if wrong.any():
        at = int(np.argmax(wrong)) + 1
        raise MethodError(
            f"{name}: at reading {rows[moving[at]] + 2} the stage moves back by {size[at] * 1e6:.4g} um along a "
            "stroke; expected strokes in one direction. Check that positions and readings correspond, and check the "
            "stage for backlash. For positions in any order, set ordered = false.",
            code="beam.strokes.backwards",
        )
