"""Calibration of the inclination error of a point sensor from readings against an interferometer.

``lines`` fits the slope of every setting, ``surface`` a smooth surface to the slopes; this module combines them to a
calibration dataset, with the prediction error at settings that were left out.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from errormotion.arrays import NORMAL_MAD, Array
from errormotion.datasets import provenance, validate
from errormotion.datasets.calibrations import owner
from errormotion.datasets.calibrations.inclination import InclinationCalibration, build, half_tilt, hole_texts, terms
from errormotion.errors import MethodError
from errormotion.kinematics.beams import tilt_vector
from errormotion.methods.beam_direction.identification.inclination import lines as inclination_lines
from errormotion.methods.beam_direction.identification.inclination import surface as inclination_surface
from errormotion.methods.beam_direction.identification.inclination.lines import Lines, MidRange, Readings
from errormotion.methods.beam_direction.identification.inclination.surface import Surface
from errormotion.methods.beam_direction.schema import INCLINATION_SCHEMA

GAP = 0.6
"""Diameter of the largest empty circle between calibrated tilts that is covered, relative to the steepest tilt: half a
wave of a k that changes its sign five times in half a turn about the beam."""
MARGIN = 0.05
"""Largest distance of a covered tilt from the calibrated tilts, relative to the steepest tilt."""

_CONTRADICTS = 6.0
"""Standard deviations from which on a setting contradicts all others."""
_MOST_CONTRADICTING = 0.1
"""Largest share of such settings."""
_FEWEST = 4
"""Fewest different tilts: one more than a plane has coefficients."""
_FEW = 50
"""Different tilts below which the intervals are rough."""
_NAMED = 6
_SPOILS = 3.5
"""Size of a hole, in steps of inclination, from which on the intervals next to it hold in only 70 to 90 % of cases."""
_ALL_AROUND = np.radians(359.0)
_DRAWS = 1000
_SEVERAL = 3.0
"""Standard uncertainties from which on a deviation of the mid-range from the stated one is reported."""


class Settings(BaseModel):
    """How a calibration is made."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    order: int | None = Field(
        default=None,
        ge=0,
        le=inclination_surface.HIGHEST_ORDER,
        description="order of the polynomial; default: chosen from the data",
    )
    mirror: bool | None = Field(
        default=None,
        description="whether the error is symmetric about the triangulation plane; default: chosen from the data",
    )
    offsets: Literal["auto", "each", "none"] = Field(
        default="auto", description="whether each setting has its own zero of the interferometer"
    )

    serial_number: str = Field(default="", description="serial number of the sensor; default: as the readings state it")


def calibrate(raw: xr.Dataset, settings: Settings | None = None) -> InclinationCalibration:
    """Return the calibration from readings.

    Parameters
    ----------
    raw : Dataset
        Of the schema ``errormotion.raw.inclination/1``.
    settings : Settings, optional

    Returns
    -------
    InclinationCalibration
        Its attribute ``notes`` (text, one note per line) states restrictions of its use.

    Raises
    ------
    DatasetError
        The raw dataset violates its schema.
    MethodError
        Implausible readings, or too few settings.
    """
    settings = settings or Settings()
    if raw.attrs.get("schema") != INCLINATION_SCHEMA:
        raise MethodError(
            f"Expected readings of the schema {INCLINATION_SCHEMA}; found {raw.attrs.get('schema', 'none')}."
        )
    validate(raw)
    raw = raw.load()
    readings = inclination_lines.read(raw)
    lines = inclination_lines.fit(readings, settings.offsets)
    q = tilt_vector(readings.inclination, readings.rotation)
    kept, surface = _surface(q, lines, settings)
    pivot = inclination_lines.mid_range(readings, lines)
    variables = _variables(readings, lines, surface, kept, q, pivot)
    attrs = {
        "order": surface.order,
        "mirror": int(surface.mirror),
        "free_offsets": int(lines.free_offsets),
        "provenance": json.dumps(provenance.make(settings, raw, None)),
        **_serial_number(raw, settings),
        **{name: str(raw.attrs[name]) for name in ("machine", "sensor", "source", "title") if name in raw.attrs},
    }
    calibration = InclinationCalibration(build(variables, attrs))
    notes = _notes(calibration, readings, lines, kept, pivot)
    return InclinationCalibration(calibration.dataset.assign_attrs(notes="\n".join(notes)))


def _serial_number(raw: xr.Dataset, settings: Settings) -> dict[str, str]:
    """Return the attribute that states the sensor to which the calibration belongs; empty where it is unknown."""
    serial = settings.serial_number or owner.serial_number(raw.attrs, "point_lds")
    return {owner.ATTRIBUTE: serial} if serial else {}


def _surface(q: Array, lines: Lines, settings: Settings) -> tuple[NDArray[np.bool_], Surface]:
    """Return which settings were used and the surface through them; those that contradict all others are not."""
    different = len(np.unique(np.round(q, 6), axis=0))
    fits = [
        order
        for order in range(inclination_surface.HIGHEST_ORDER + 1)
        if len(inclination_surface.degrees_to(order, bool(settings.mirror))) < different
    ]
    if different < _FEWEST:
        raise MethodError(
            f"{different} different tilts of the surface; expected at least {_FEWEST}, for the cross-"
            "validation. Measure more inclinations and rotations."
        )
    if settings.order is not None and settings.order not in fits:
        count = len(inclination_surface.degrees_to(settings.order, bool(settings.mirror)))
        raise MethodError(
            f"Order {settings.order} has {count} coefficients; expected more different tilts than that, found "
            f"{different}. Use order {fits[-1]} or less, or measure more settings."
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
        z = z / max(NORMAL_MAD * float(np.median(z)), 1e-3)
        # The worst one first, because it also affects its neighbours.
        wrong = z > max(_CONTRADICTS, 0.5 * z.max())
        if not wrong.any() or (~kept).sum() + wrong.sum() > _MOST_CONTRADICTING * len(q):
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
    missed = (lines.slope - predicted)[kept]
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
        "remaining_error": np.sqrt(np.mean(missed**2)),
        "remaining_error_interval": _interval(missed),
    }


def _interval(missed: Array) -> Array:
    """Return the 95 % interval (2,) of a root mean square, by bootstrap over the settings."""
    rng = np.random.default_rng(0)
    draws = rng.integers(0, len(missed), size=(_DRAWS, len(missed)), dtype=np.int32)
    return np.asarray(np.quantile(np.sqrt((missed**2)[draws].mean(axis=1)), [0.025, 0.975]))


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
    if readings.missing:
        yield f"{_of(readings.missing, 'group')} without a reading {_were(readings.missing)} ignored."
    wild = np.flatnonzero(lines.left_out)
    if wild.size:
        named = [
            f"{settings[readings.setting[k]]}, depth {1e3 * readings.depth[k]:.3f} mm "
            f"({1e6 * lines.residual[k]:+.1f} um)"
            for k in wild[np.argsort(-np.abs(lines.residual[wild]), kind="stable")][:_NAMED]
        ]
        yield f"{wild.size} of {lines.left_out.size} readings {_were(wild.size)} left out: {_list(named, wild.size)}."
    wrong = np.flatnonzero(~kept)
    if wrong.size:
        named = [settings[k] for k in wrong[:_NAMED]]
        contradict = "contradicts" if wrong.size == 1 else "contradict"
        yield (
            f"{_of(wrong.size, 'setting')} {contradict} all others and {_were(wrong.size)} left out: "
            f"{_list(named, wrong.size)}."
        )
    if np.isfinite(readings.noise) and not 0.5 <= lines.noise / max(readings.noise, 1e-12) <= 2.0:
        yield (
            f"The scatter of the readings about their lines is {1e6 * lines.noise:.3g} um; the stated noise is "
            f"{1e6 * readings.noise:.3g} um. The scatter is used."
        )
    shift = pivot.reading - readings.mid_range
    if abs(shift) > _SEVERAL * pivot.uncertainty and abs(shift) * np.ptp(lines.slope) > lines.noise:
        yield (
            f"The lines of the settings meet at a reading of {1e3 * pivot.reading:.4f} mm "
            f"(u = {1e3 * pivot.uncertainty:.4f} mm), not at the stated mid-range, {1e3 * readings.mid_range:.4f} mm."
        )
    different = len(np.unique(np.round(calibration.settings, 6), axis=0))
    if different < _FEW:
        yield f"{different} different tilts: with fewer than {_FEW} the calibration between them is uncertain."
    if not calibration.serial_number:
        yield "The serial number of the sensor is unknown: the calibration cannot be refused for another sensor."
    yield from _holes(calibration)


def _holes(calibration: InclinationCalibration) -> Iterator[str]:
    holes, step = calibration.support.holes(), calibration.support.step
    if not holes:
        return
    texts = hole_texts(holes)
    yield (
        f"Holes between the settings, whose usual step is {np.degrees(step):.3g} deg of inclination; tilts in them are "
        f"refused: {_list(texts[:_NAMED], len(texts))}."
    )
    widest = max((np.ptp(hole.inclination) for hole in holes if np.ptp(hole.rotation) > _ALL_AROUND), default=0.0)
    if widest > _SPOILS * step:
        yield (
            f"A hole of {np.degrees(widest):.0f} deg at every rotation also affects its surroundings: intervals there "
            "hold less often than stated. Measure settings in it."
        )


def _of(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _were(count: int) -> str:
    return "was" if count == 1 else "were"


def _list(named: list[str], count: int) -> str:
    return "; ".join(named) + (f"; and {count - len(named)} more" if count > len(named) else "")
