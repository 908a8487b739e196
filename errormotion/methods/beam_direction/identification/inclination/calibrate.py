"""Calibration of the inclination error of a point sensor from readings against an interferometer.

``lines`` fits the slope of every setting, ``surface`` a smooth surface to the slopes; this module combines them in a
calibration dataset, with the prediction error at settings that are left out of the fit (cross-validation).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from errormotion.arrays import Array
from errormotion.datasets import provenance, validate
from errormotion.datasets.calibrations import owner
from errormotion.datasets.calibrations.inclination import (
    AWAY,
    ROTATION_ZERO,
    InclinationCalibration,
    build,
    half_tilt,
    hole_texts,
    terms,
)
from errormotion.datasets.units import Angle
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_zero
from errormotion.kinematics.beams import tilt_vector
from errormotion.methods.beam_direction.identification.inclination import lines as inclination_lines
from errormotion.methods.beam_direction.identification.inclination import surface as inclination_surface
from errormotion.methods.beam_direction.identification.inclination.lines import Lines, MidRange, Readings
from errormotion.methods.beam_direction.identification.inclination.surface import Surface
from errormotion.methods.beam_direction.schema import INCLINATION_SCHEMA

GAP = 0.6
"""Diameter of the largest empty circle between calibrated tilts that is covered, relative to the steepest tilt: half
the period of a k that changes its sign five times in half a turn about the beam."""
MARGIN = 0.05
"""Largest distance of a covered tilt from the calibrated tilts, relative to the steepest tilt."""

_CONTRADICTION = 6.0
"""Standard deviations from which on a setting contradicts the others."""
_MAX_CONTRADICTING = 0.1
"""Largest share of such settings."""
_MIN_TILTS = 4
"""Different tilts: one more than the number of coefficients of a plane."""
_FEW_TILTS = 50
"""Different tilts below which the intervals are approximate."""
_MAX_LISTED = 6
_LARGE_HOLE = 3.5
"""Size of a hole, in steps of inclination, from which on the coverage of intervals next to it is only 70 to 90 %."""
_FULL_TURN = np.radians(359.0)
_DRAWS = 1000
_SIGNIFICANT = 3.0
"""Standard uncertainties from which on a deviation of the mid-range from the stated one is reported."""


class InclinationCalibrationSettings(BaseModel):
    """Settings of a calibration."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    order: int | None = Field(
        default=None,
        ge=0,
        le=inclination_surface.MAX_ORDER,
        description="order of the polynomial; default: chosen from the data",
    )
    mirror: bool | None = Field(
        default=None,
        description="whether the error is symmetric about the triangulation plane; default: chosen from the data",
    )
    offsets: Literal["auto", "each", "none"] = Field(
        default="auto", description="whether each setting has its own zero of the interferometer"
    )
    receiver_rotation: Angle | None = Field(
        default=None,
        description="rotation at which the normal of the surface leans towards the receiver, 0 or 180 deg; default: "
        "that of the readings",
    )
    serial_number: str = Field(default="", description="serial number of the sensor; default: that of the readings")


def calibrate(raw: xr.Dataset, settings: InclinationCalibrationSettings | None = None) -> InclinationCalibration:
    """Return the calibration from readings.

    Parameters
    ----------
    raw : Dataset
        Of the schema ``errormotion.raw.inclination/1``.
    settings : InclinationCalibrationSettings, optional

    Returns
    -------
    InclinationCalibration
        Its attribute ``notes`` (text, one note per line) contains remarks on its use.

    Raises
    ------
    DatasetError
        The raw dataset violates its schema.
    MethodError
        Implausible readings, no direction of rotation 0, or too few settings.
    """
    settings = settings or InclinationCalibrationSettings()
    if raw.attrs.get("schema") != INCLINATION_SCHEMA:
        raise MethodError(
            f"Expected readings of the schema {INCLINATION_SCHEMA}; found {raw.attrs.get('schema', 'none')}.",
            code="schema.other",
        )
    validate(raw)
    raw = raw.load()
    readings = inclination_lines.read(raw, settings.receiver_rotation)
    lines = inclination_lines.fit(readings, settings.offsets)
    q = tilt_vector(readings.inclination, readings.rotation)
    kept, surface = _surface(q, lines, settings)
    pivot = inclination_lines.mid_range(readings, lines)
    variables = _variables(readings, lines, surface, kept, q, pivot)
    attrs = {
        "order": surface.order,
        "mirror": int(surface.mirror),
        "free_offsets": int(lines.free_offsets),
        ROTATION_ZERO: AWAY,
        "provenance": json.dumps(provenance.make(settings, raw, None)),
        **_serial_number(raw, settings),
        **{name: str(raw.attrs[name]) for name in ("machine", "sensor", "source", "title") if name in raw.attrs},
    }
    calibration = InclinationCalibration(build(variables, attrs))
    notes = _notes(calibration, readings, lines, kept, pivot)
    return InclinationCalibration(calibration.dataset.assign_attrs(notes="\n".join(notes)))


def _serial_number(raw: xr.Dataset, settings: InclinationCalibrationSettings) -> dict[str, str]:
    """Return the attribute with the serial number of the calibrated sensor; empty if it is unknown."""
    serial = settings.serial_number or owner.serial_number(raw.attrs, "point_lds")
    return {owner.ATTRIBUTE: serial} if serial else {}


def _surface(q: Array, lines: Lines, settings: InclinationCalibrationSettings) -> tuple[NDArray[np.bool_], Surface]:
    """Return which settings were used, without those that contradict the others, and the surface fitted to them."""
    different = len(np.unique(np.round(q, 6), axis=0))
    fits = [
        order
        for order in range(inclination_surface.MAX_ORDER + 1)
        if len(inclination_surface.degrees_to(order, bool(settings.mirror))) < different
    ]
    if different < _MIN_TILTS:
        raise MethodError(
            f"Expected at least {_MIN_TILTS} different tilts of the surface, for the cross-validation; found "
            f"{different}. Measure more inclinations and rotations.",
            code="inclination.tilts.too_few",
        )
    if settings.order is not None and settings.order not in fits:
        count = len(inclination_surface.degrees_to(settings.order, bool(settings.mirror)))
        raise MethodError(
            f"order: expected fewer coefficients than different tilts, {different}; found {count} at order "
            f"{settings.order}. Use order {fits[-1]} or less, or measure more settings.",
            code="inclination.order.too_high",
        )
    x = half_tilt(q)
    kept = np.ones(len(q), dtype=bool)
    while True:
        surface = inclination_surface.fit_surface(
            x[kept] / _scale(x[kept]),
            lines.slope[kept],
            lines.slope_variance[kept],
            highest=fits[-1],
            order=settings.order,
            mirror=settings.mirror,
        )
        z = np.abs(surface.prediction.z)
        z = z / max(scale_about_zero(z), 1e-3)
        # only the largest deviations, because they also affect their neighbours
        wrong = z > max(_CONTRADICTION, 0.5 * z.max())
        if not wrong.any() or (~kept).sum() + wrong.sum() > _MAX_CONTRADICTING * len(q):
            return kept, surface
        kept[np.flatnonzero(kept)[wrong]] = False


def _scale(x: Array) -> float:
    return float(np.hypot(*x.T).max())


def _variables(
    readings: Readings, lines: Lines, surface: Surface, kept: NDArray[np.bool_], q: Array, pivot: MidRange
) -> dict[str, Any]:
    """Return the variables of the calibration dataset."""
    x = half_tilt(q)
    scale = _scale(x[kept])
    J = terms(x / scale, surface.degrees)
    predicted = J @ surface.coefficients
    variance = ((J @ surface.covariance) * J).sum(axis=1)
    predicted[kept], variance[kept] = surface.prediction.slope, surface.prediction.variance
    prediction_error = (lines.slope - predicted)[kept]
    steepest = float(np.hypot(*q[kept].T).max())
    return {
        "coefficient": surface.coefficients,
        "coefficient_covariance": surface.covariance,
        "degree": surface.degrees,
        "tilt_scale": scale,
        "mid_range": readings.mid_range,
        "mid_range_found": pivot.reading,
        "mid_range_uncertainty": pivot.uncertainty,
        "reading_low": readings.reading[~lines.left_out].min(),
        "reading_high": readings.reading[~lines.left_out].max(),
        "support_gap": GAP * steepest,
        "support_margin": MARGIN * steepest,
        "inclination": readings.inclination,
        "rotation": readings.rotation,
        "slope": lines.slope,
        "slope_uncertainty": np.sqrt(lines.slope_variance),
        "offset": lines.offset,
        "slope_predicted": predicted,
        "slope_predicted_uncertainty": np.sqrt(variance),
        "setting_left_out": (~kept).astype(np.int8),
        "noise": lines.noise,
        "scatter": surface.scatter,
        "group_setting": readings.setting,
        "group_depth": readings.depth,
        "group_residual": lines.residual,
        "group_left_out": lines.left_out.astype(np.int8),
        "remaining_error": np.sqrt(np.mean(prediction_error**2)),
        "remaining_error_interval": _interval(prediction_error),
    }


def _interval(error: Array) -> Array:
    """Return the 95 % interval (2,) of a root mean square, by bootstrap over the settings."""
    rng = np.random.default_rng(0)
    draws = rng.integers(0, len(error), size=(_DRAWS, len(error)), dtype=np.int32)
    return np.asarray(np.quantile(np.sqrt((error**2)[draws].mean(axis=1)), [0.025, 0.975]))


def _notes(
    calibration: InclinationCalibration,
    readings: Readings,
    lines: Lines,
    kept: NDArray[np.bool_],
    pivot: MidRange,
) -> Iterator[str]:
    """Yield the notes of the calibration."""
    settings = [
        f"inclination {a:g} deg at rotation {b:g} deg"
        for a, b in zip(np.degrees(readings.inclination), np.degrees(readings.rotation), strict=True)
    ]
    if readings.turned:
        yield (
            "Rotations are counted from the direction away from the receiver: those of the readings "
            f"{np.degrees(readings.turned):+.4g} deg."
        )
    if readings.missing:
        yield f"{counted(readings.missing, 'group')} without a reading {_were(readings.missing)} ignored."
    outliers = np.flatnonzero(lines.left_out)
    if outliers.size:
        listed = [
            f"{settings[readings.setting[k]]}, depth {1e3 * readings.depth[k]:.3f} mm "
            f"({1e6 * lines.residual[k]:+.1f} um)"
            for k in outliers[np.argsort(-np.abs(lines.residual[outliers]), kind="stable")][:_MAX_LISTED]
        ]
        count = outliers.size
        yield f"{count} of {lines.left_out.size} readings {_were(count)} left out: {_list(listed, count)}."
    wrong = np.flatnonzero(~kept)
    if wrong.size:
        contradict = "contradicts" if wrong.size == 1 else "contradict"
        yield (
            f"{counted(wrong.size, 'setting')} {contradict} the others and {_were(wrong.size)} left out: "
            f"{_list([settings[k] for k in wrong[:_MAX_LISTED]], wrong.size)}."
        )
    if np.isfinite(readings.noise) and not 0.5 <= lines.noise / max(readings.noise, 1e-12) <= 2.0:
        yield (
            f"The scatter of the readings about their lines is {1e6 * lines.noise:.3g} um; the stated noise is "
            f"{1e6 * readings.noise:.3g} um. The scatter is used."
        )
    shift = pivot.reading - readings.mid_range
    if abs(shift) > _SIGNIFICANT * pivot.uncertainty and abs(shift) * np.ptp(lines.slope) > lines.noise:
        yield (
            f"The lines of the settings meet at a reading of {1e3 * pivot.reading:.4f} mm "
            f"(u = {1e3 * pivot.uncertainty:.4f} mm), not at the stated mid-range, {1e3 * readings.mid_range:.4f} mm."
        )
    different = len(np.unique(np.round(calibration.settings, 6), axis=0))
    if different < _FEW_TILTS:
        yield f"{different} different tilts: with fewer than {_FEW_TILTS} the calibration between them is uncertain."
    if not calibration.serial_number:
        yield "The serial number of the sensor is unknown: use with another sensor will not be detected."
    yield from _holes(calibration)


def _holes(calibration: InclinationCalibration) -> Iterator[str]:
    holes, step = calibration.support.holes(), calibration.support.step
    if not holes:
        return
    texts = hole_texts(holes)
    yield (
        f"Holes between the settings, whose typical step is {np.degrees(step):.3g} deg of inclination; tilts in them "
        f"are refused: {_list(texts[:_MAX_LISTED], len(texts))}."
    )
    widest = max((np.ptp(hole.inclination) for hole in holes if np.ptp(hole.rotation) > _FULL_TURN), default=0.0)
    if widest > _LARGE_HOLE * step:
        yield (
            f"A hole of {np.degrees(widest):.0f} deg at every rotation also affects its surroundings: the coverage of "
            "intervals there is smaller than stated. Measure settings in it."
        )


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is 1."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _were(count: int) -> str:
    return "was" if count == 1 else "were"


def _list(items: list[str], count: int) -> str:
    return "; ".join(items) + (f"; and {count - len(items)} more" if count > len(items) else "")
