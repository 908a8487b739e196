"""Draws of the sources of readings on planes for the Monte Carlo method."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from errormotion.errors import MethodError
from errormotion.methods.beam_direction.identification.compensation import CALIBRATION, SCALE, TRIANGULATION
from errormotion.methods.beam_direction.identification.planes import determine
from errormotion.methods.beam_direction.identification.slopes import MAX_CORRELATED, correlation_factor
from errormotion.methods.beam_direction.settings import Settings
from errormotion.plugins import Redraw, Redrawing, replaced

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.arrays import Array
    from errormotion.datasets.calibrations.inclination import InclinationCalibration
    from errormotion.methods.beam_direction.identification.compensation import Sensor
    from errormotion.methods.beam_direction.identification.planes import Determined


class TrialSettings(Settings):
    """Settings of one trial, with a calibration whose coefficients are drawn."""

    calibration: Any = Field(default=None, exclude=True, repr=False)


def redrawing(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings without outliers, and the draws of their sources: noise, known points, calibration or scale.

    Raises
    ------
    MethodError
        A check bar without planes, which does not determine the errors of a beam.
    """
    if "distance" not in raw:
        raise MethodError(
            "The Monte Carlo method evaluates the errors of a beam: expected readings on planes; found a check bar "
            "only."
        )
    beam = determine(raw, settings, [])
    distance = np.asarray(raw["distance"].transpose("plane", "reading").values, dtype=float)
    used = errors["left_out"].transpose("plane", "reading").values == 0
    bar = [name for name in raw.variables if str(name).startswith("bar_")]
    clean = (("plane", "reading"), np.where(used, distance, np.nan), raw["distance"].attrs)
    reduced = raw.drop_vars(bar).load().assign(distance=clean)
    trial = TrialSettings(**{name: getattr(settings, name) for name in type(settings).model_fields})
    trial = trial.model_copy(update={"robust": False, "noise": "stated", "extrapolate": True})
    sources = {"readings": _readings(beam)}
    if beam.origin is not None and beam.data.point_uncertainty > 0:
        reduced["plane_point"] = raw["plane_point"].transpose("plane", "direction").load()
        sources["known points of the planes"] = _points(beam)
    if beam.sensor is not None:
        trial = trial.model_copy(update={"calibration": beam.sensor.calibration})
        sources[CALIBRATION] = _calibration(beam.sensor.calibration)
        if beam.sensor.normal_uncertainty > 0:
            sources[TRIANGULATION] = _triangulation(beam.sensor, beam.converged.direction.direction)
    elif settings.layout.scale_uncertainty > 0:
        sources[SCALE] = _scale(settings.layout.scale_uncertainty, beam.converged.mid_range)
    return Redrawing(reduced, trial, sources)


def _readings(beam: Determined) -> Redraw:
    """Return the draw of noise and speckle, increased if readings scatter more or planes contradict one another."""
    data, size = beam.data, beam.noise_factor * beam.closure_factor
    factors = []
    for distance, stage in zip(data.distance, data.stage, strict=True):
        known = np.flatnonzero(np.isfinite(distance) & np.isfinite(stage).all(axis=1))
        correlated = data.speckle > 0 and data.speckle_length > 0 and known.size <= MAX_CORRELATED
        L = correlation_factor(stage[known], data.noise, data.speckle, data.speckle_length) if correlated else None
        factors.append((known, L))
    white = size * float(np.hypot(data.noise, data.speckle))

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        changed = np.array(raw.variables["distance"].values, dtype=float)
        for row, (known, L) in zip(changed, factors, strict=True):
            z = generator.normal(size=known.size)
            row[known] += white * z if L is None else size * (L @ z)
        return replaced(raw, {"distance": changed}), settings

    return Redraw(draw, own=True)


def _points(beam: Determined) -> Redraw:
    """Return the draw of the known points of the planes, along the normals, independent by plane."""
    size = beam.data.point_uncertainty * beam.closure_factor
    normals = beam.converged.planes.normals

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        shift = size * generator.normal(size=len(normals))[:, None] * normals
        return replaced(raw, {"plane_point": raw.variables["plane_point"].values + shift}), settings

    return Redraw(draw, own=True)


def _calibration(calibration: InclinationCalibration) -> Redraw:
    """Return the draw of the coefficients of the inclination calibration."""
    values, vectors = np.linalg.eigh(calibration.coefficient_covariance)
    factor = vectors * np.sqrt(np.maximum(values, 0.0))

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        drawn = copy(calibration)
        drawn.coefficients = calibration.coefficients + factor @ generator.normal(size=len(values))
        return raw, settings.model_copy(update={"calibration": drawn})

    return Redraw(draw, groups=(CALIBRATION,))


def _triangulation(sensor: Sensor, beam: Array) -> Redraw:
    """Return the draw of the angle of the triangulation plane about the beam."""

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        turn = Rotation.from_rotvec(beam * sensor.normal_uncertainty * generator.normal())
        return replaced(raw, {"triangulation_normal": turn.apply(raw["triangulation_normal"].values)}), settings

    return Redraw(draw, groups=(TRIANGULATION,))


def _scale(relative: float, mid_range: float) -> Redraw:
    """Return the draw of the scale of the sensor about its mid-range."""

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        distance = raw.variables["distance"].values
        scaled = mid_range + (distance - mid_range) * (1.0 + relative * generator.normal())
        return replaced(raw, {"distance": scaled}), settings

    return Redraw(draw, groups=(SCALE,))
