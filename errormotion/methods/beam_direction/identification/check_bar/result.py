"""The check bar in a result: with the planes of the beam, or alone with a known beam."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.timing import start_of
from errormotion.errors import FitError, MethodError
from errormotion.methods.beam_direction.identification.check_bar.measure import measure_bar

if TYPE_CHECKING:
    from errormotion.datasets.calibrations.inclination import InclinationCalibration
    from errormotion.methods.beam_direction.identification.sensor import Sensor
    from errormotion.methods.beam_direction.settings import BeamDirectionSettings


log = logging.getLogger(__name__)

_CONTRADICTION = (
    "The check bar contradicts the stated side of the receiver: its residuals are systematic with it and random with "
    "the opposite one. Check triangulation_normal and receiver on the sensor, and receiver_rotation of the readings "
    "from which the calibration was made."
)


def identify_bar(
    raw: xr.Dataset, sensor: Sensor | None, settings: BeamDirectionSettings, method: str, version: str
) -> xr.Dataset:
    """Return a result with a check bar only; the errors of the beam are NaN.

    The beam is that stated in the data, ``nominal_direction`` and ``nominal_origin`` (default: the stage's zero).

    Parameters
    ----------
    raw : Dataset
        Schema ``errormotion.raw.beam_direction/1``, the check bar alone.
    sensor : Sensor or None
        For the compensation of its readings.
    settings : BeamDirectionSettings
    method, version : str

    Raises
    ------
    MethodError, FitError
        See `errormotion.methods.beam_direction.identification.check_bar.measure.measure_bar`.
    """
    moves = raw.attrs.get("moves", settings.moves)
    if moves not in ("sensor", "target"):
        raise MethodError(f"attribute moves: expected 'sensor' or 'target'; found {moves!r}.", code="raw.moves.form")
    u0 = np.asarray(raw["nominal_direction"].values, np.float64)
    p0 = np.asarray(raw["nominal_origin"].values if "nominal_origin" in raw else np.full(3, np.nan), np.float64)
    notes = ["A check bar only: the stated beam is used, without uncertainty; its errors are unknown."]
    if not np.isfinite(p0).all():
        notes.append("No nominal_origin in the data: the centre of the bar is relative to the zero point of the beam.")
    if sensor is None:
        notes.append("No inclination compensation: the readings are not corrected for the inclination error.")
    else:
        notes += sensor.notes
    calibration = sensor.calibration if sensor is not None else None
    extras = bar_extras(raw, np.nan_to_num(p0), u0, None, calibration, moves, settings, notes)
    for note in notes:
        log.warning(note)
    vector = ("beam", "direction")
    extras |= {
        "nominal_origin": xr.DataArray(p0[None], dims=vector, attrs={"units": "m"}),
        "nominal_direction": xr.DataArray(u0[None], dims=vector, attrs={"units": "1"}),
        "beam_direction": xr.DataArray(np.full((1, 3), np.nan), dims=vector, attrs={"units": "1"}),
    }
    ds = build_errors(
        np.full((1, 6), np.nan),
        np.full((1, 6, 6), np.nan),
        dims=("beam",),
        coords={"beam": [settings.beam], "direction": ("direction", list("xyz"))},
        component="beam",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=np.nan_to_num(p0),
        reference="nominal beam; its errors are not determined by a check bar",
        method=method,
        method_version=version,
        measured=raw.attrs,
        start=start_of(raw),
        provenance=provenance.make(settings, raw, None, steps=["check bar"])
        | ({"calibration": calibration.reference()} if calibration is not None else {}),
        extras=extras,
    )
    return ds.assign_attrs(notes=notes)


def bar_extras(
    raw: xr.Dataset,
    origin: Array,
    direction: Array,
    covariance: Array | None,
    calibration: InclinationCalibration | None,
    moves: Literal["sensor", "target"],
    settings: BeamDirectionSettings,
    notes: list[str],
) -> dict[str, xr.DataArray]:
    """Return the check bar of a raw dataset, measured with a beam; remarks are appended to ``notes``."""
    measure = partial(
        measure_bar,
        origin=origin,
        direction=direction,
        covariance=covariance,
        calibration=calibration,
        moves=moves,
        robust=settings.robust,
        extrapolate=settings.extrapolate,
        receiver=settings.receiver,
        radius_uncertainty=float(raw["bar_radius_uncertainty"]) if "bar_radius_uncertainty" in raw else 0.0,
    )
    points, bar = measure(raw)
    if calibration is not None and bar.systematic:
        try:
            confirmed = measure(raw.assign(triangulation_normal=-raw["triangulation_normal"]))[1].systematic
        except (MethodError, FitError):  # no bar with the opposite side
            confirmed = True
        if not confirmed:
            raise MethodError(_CONTRADICTION, code="beam.bar.calibration_contradicts")
    notes.extend(f"Check bar: {note}" for note in (*points.notes, *bar.notes))
    left_out = np.zeros(len(bar.residuals), np.int8)
    left_out[list(bar.left_out)] = 1
    m = {"units": "m"}
    return {
        "bar_point": xr.DataArray(points.points, dims=("bar_reading", "direction"), attrs=m),
        "bar_residual": xr.DataArray(bar.residuals, dims="bar_reading", attrs=m),
        "bar_left_out": xr.DataArray(left_out, dims="bar_reading"),
        "bar_centre": xr.DataArray(bar.centre, dims="direction", attrs=m),
        "bar_centre_u": xr.DataArray(np.sqrt(np.diag(bar.centre_covariance)), dims="direction", attrs=m),
        "bar_axis": xr.DataArray(bar.axis, dims="direction", attrs={"units": "1"}),
        "bar_radius_fitted": xr.DataArray(bar.free_radius, attrs=m),
        "bar_radius_u": xr.DataArray(bar.free_radius_u, attrs=m),
    }
