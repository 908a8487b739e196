"""Error dataset of one beam from readings on planes."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy.special import ndtri

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.calibrations import owner
from errormotion.datasets.calibrations.inclination import InclinationCalibration, tilt_text
from errormotion.datasets.certificates import certified
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.kinematics.beams import beam_errors, error_jacobian, inclination_rotation
from errormotion.methods.beam_direction.identification.check_bar.result import bar_extras
from errormotion.methods.beam_direction.identification.compensation import (
    SCALE,
    Converged,
    Planes,
    Sensor,
    converge,
    identities,
    uncompensated,
)
from errormotion.methods.beam_direction.identification.origin import Origin, locate
from errormotion.methods.beam_direction.identification.propagation import (
    FALSE_ALARM,
    Propagated,
    chi2_quantile,
    closure_chi2,
    propagate,
)
from errormotion.methods.beam_direction.identification.reading import Readings, read, triangulation_normal
from errormotion.methods.beam_direction.identification.receiver import check_receiver
from errormotion.methods.beam_direction.identification.slopes import UNKNOWNS, PlaneFit, fit_plane_readings

if TYPE_CHECKING:
    from errormotion.methods.beam_direction.settings import Settings


log = logging.getLogger(__name__)

_NOTED_CURVATURE = 0.05
_PARAMETERS = ["px", "py", "pz", "ux", "uy", "uz"]
_LABELS = {"direction": list("xyz"), "direction_": list("xyz"), "p": _PARAMETERS, "p_": _PARAMETERS}


def identify_beam(raw: xr.Dataset, settings: Settings, method: str, version: str) -> xr.Dataset:
    """Return an error dataset of component ``beam``: the beam minus the nominal beam.

    Raises
    ------
    MethodError
        Data that do not determine the beam; the message names the plane.
    """
    notes: list[str] = []
    beam = determine(raw, settings, notes)
    data, sensor, converged, influence = beam.data, beam.sensor, beam.converged, beam.propagated.influence
    total = beam.propagated.covariance * beam.closure_factor**2 + influence.T @ influence
    p0, u0 = data.nominal_origin, data.nominal_direction
    p = beam.origin.origin if beam.origin is not None else np.full(3, np.nan)
    u = converged.direction.direction
    errors, covariance = beam_errors(p0[None], u0[None], p[None], u[None], total[None])
    chart = error_jacobian(u0[None], u[None])[0]
    by_source = np.nan_to_num(influence) @ chart.T
    steps = ["gradients by generalised least squares", "maximum likelihood of the direction"]
    steps += [f"inclination compensation, {converged.iterations} iterations"] if sensor is not None else []
    extras = _extras(beam, total, p)
    if "bar_distance" in raw:
        if not np.isfinite(p).all():
            notes.append(
                "Check bar: the centre is relative to the nominal zero point, because the actual one is unknown."
            )
        position = p if np.isfinite(p).all() else np.nan_to_num(p0)
        calibration = sensor.calibration if sensor is not None else None
        extras |= bar_extras(raw, position, u, np.nan_to_num(total), calibration, data.moves, settings, notes)
    for note in notes:
        log.warning(note)
    ds = build_errors(
        errors,
        covariance,
        dims=("beam",),
        coords={"beam": [settings.beam], **_LABELS},
        component="beam",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=np.where(np.isfinite(p0), p0, 0.0),
        reference="nominal beam; its errors are stated at its nominal zero point (nominal_origin)",
        method=method,
        method_version=version,
        measured=raw.attrs,
        start=start_of(raw),
        source_ids=identities(converged, sensor)
        | certified(raw.attrs, {SCALE: ("sensor", "gain")} if SCALE in converged.sources else {}),
        provenance=provenance.make(settings, raw, None, steps=steps)
        | ({"calibration": sensor.calibration.reference()} if sensor is not None else {}),
        influence=by_source[:, None, :] if converged.sources else None,
        sources=converged.sources or None,
        source_groups=converged.groups or None,
        extras=extras,
    )
    return ds.assign_attrs(notes=notes or [""])


@dataclass(frozen=True)
class Determined:
    """A beam determined from readings on planes, with the intermediate results.

    Attributes
    ----------
    data, fits : Readings, list of PlaneFit
    noise_factor : float
        Applied to the stated noise.
    sensor : Sensor or None
        None without compensation.
    converged, uncompensated : Converged
        With and without compensation.
    corrected : ndarray (plane, reading)
        Compensated readings, m.
    origin : Origin or None
    propagated : Propagated
    closure_factor : float
        Applied to the uncertainties; above 1 if planes contradict one another.
    """

    data: Readings
    fits: list[PlaneFit]
    noise_factor: float
    sensor: Sensor | None
    converged: Converged
    uncompensated: Converged
    corrected: Array
    origin: Origin | None
    propagated: Propagated
    closure_factor: float


def determine(raw: xr.Dataset, settings: Settings, notes: list[str]) -> Determined:
    """Return the beam; remarks are appended to ``notes``. Raises as `identify_beam`."""
    data = read(raw, settings, notes)
    fits = [
        fit_plane_readings(d, s, data.noise, data.speckle, data.speckle_length, settings.robust, name)
        for name, d, s in zip(data.names, data.distance, data.stage, strict=True)
    ]
    factor = _noise_factor(data, fits, settings, notes)
    planes = Planes(
        data.names,
        np.array([fit.gradient for fit in fits]),
        np.array([fit.offset for fit in fits]),
        np.array([fit.covariance for fit in fits]) * factor**2,
    )
    middle = float(raw["mid_range"]) if "mid_range" in raw else 0.0
    plain = uncompensated(planes, data.nominal_direction, settings.layout.scale_uncertainty, middle)
    sensor = sensor_of(raw, settings)
    if sensor is None:
        converged = plain
        notes.append("No inclination compensation: the readings are not corrected for the inclination error.")
    else:
        notes += sensor.notes
        converged = converge(planes, data.nominal_direction, sensor, settings.tolerance, settings.max_iterations)
    corrected = _corrected(data, fits, converged, sensor, settings, notes)
    compensated = converged.planes
    origin = locate(
        converged.direction, compensated.offsets, compensated.covariances, data.points, data.point_uncertainty
    )
    propagated = propagate(converged, origin, data.point_uncertainty)
    if sensor is not None:
        check_receiver(planes, sensor, converged, propagated, settings, notes)
    closure_factor = _closure_factor(data, converged, propagated, notes)
    _note_roots(converged, data, notes)
    _note_origin(data, origin, notes)
    return Determined(data, fits, factor, sensor, converged, plain, corrected, origin, propagated, closure_factor)


def sensor_of(raw: xr.Dataset, settings: Settings) -> Sensor | None:
    """Return the sensor for the compensation; None without compensation.

    Raises
    ------
    MethodError
        The data do not state the orientation of the sensor, or the side of its receiver.
    DatasetError
        The calibration is not found, or belongs to another sensor.
    """
    if settings.compensation is None:
        return None
    drawn = getattr(settings, "calibration", None)  # of a Monte Carlo trial
    calibration = InclinationCalibration.find(settings.compensation) if drawn is None else drawn
    normal = triangulation_normal(raw, settings.receiver)
    name = "triangulation_normal_uncertainty"
    mid_range = float(raw["mid_range"]) if "mid_range" in raw else calibration.mid_range
    serial, allowed = owner.serial_number(raw.attrs, "point_lds"), settings.allow_other_sensor
    notes = calibration.require_sensor(serial, mid_range, allow_other_sensor=allowed)
    return Sensor(
        calibration,
        normal,
        float(raw[name]) if name in raw else settings.triangulation_normal_uncertainty,
        mid_range,
        tuple(notes),
    )


def _noise_factor(data: Readings, fits: list[PlaneFit], settings: Settings, notes: list[str]) -> float:
    """Return the factor for the stated noise; note outliers, deviating scatter, and correlation."""
    for name, fit in zip(data.names, fits, strict=True):
        if fit.left_out.any():
            numbers = ", ".join(str(i + 1) for i in np.flatnonzero(fit.left_out)[:8])
            notes.append(
                f"{name}: {int(fit.left_out.sum())} readings are outliers and were ignored: reading {numbers}."
            )
    used: list[Array] = [fit.whitened[np.isfinite(fit.whitened)] for fit in fits]
    freedom = sum(len(w) - UNKNOWNS for w in used)
    if freedom < 1:
        return 1.0
    chi2 = float(sum(w @ w for w in used))
    factor = 1.0
    low, high = (chi2_quantile(p, freedom) for p in (FALSE_ALARM, 1 - FALSE_ALARM))
    ratio = float(np.sqrt(chi2 / freedom))
    if chi2 > high:
        increased = settings.noise == "auto"
        factor = ratio if increased else 1.0
        action = (
            "the uncertainties are increased accordingly" if increased else "the stated noise is used (noise = stated)"
        )
        notes.append(f"The scatter of the readings about their planes is {ratio:.3g} times the stated noise; {action}.")
    elif chi2 < low:
        notes.append(
            f"The scatter of the readings is only {ratio:.3g} times the stated noise; the stated noise is used."
        )
    pairs = sum(float(w[1:] @ w[:-1]) for w in used) / (chi2 / sum(len(w) for w in used) or 1.0)
    count = sum(len(w) - 1 for w in used)
    if pairs / np.sqrt(count) > ndtri(1 - FALSE_ALARM):
        notes.append(
            f"Residuals of neighbouring readings are correlated (correlation {pairs / count:.2f}), so that the "
            "uncertainties are too small. Possible causes: speckle that is not stated (speckle, speckle_length), a "
            "plane that is not flat, or a stage that is not straight."
        )
    return factor


def _closure_factor(data: Readings, converged: Converged, propagated: Propagated, notes: list[str]) -> float:
    """Return the factor for the uncertainties of planes that do not close; note the plane with the largest closure."""
    freedom = len(data.names) - 2
    if freedom < 1:
        return 1.0
    chi2 = closure_chi2(propagated)
    if chi2 <= chi2_quantile(1 - FALSE_ALARM, freedom):
        return 1.0
    factor = float(np.sqrt(chi2 / freedom))
    cause = (
        "an invalid calibration, triangulation_normal or receiver"
        if converged.iterations
        else "the uncompensated inclination error of the sensor"
    )
    notes.append(
        f"The planes contradict one another: chi-square {chi2:.4g} with {freedom} degrees of freedom; "
        f"{_largest_closure(data, propagated)}. Possible causes: {cause}, or a plane that moved. "
        f"The uncertainties are increased by the factor {factor:.3g}."
    )
    return factor


def _largest_closure(data: Readings, propagated: Propagated) -> str:
    """Return the plane with the largest closure as text. Three planes have one contradiction, the same for each."""
    z = np.abs(propagated.closure) / np.sqrt(np.diag(propagated.closure_covariance))
    k = int(np.argmax(z))
    if len(z) == 3:
        return f"all by {z[k]:.1f} standard uncertainties, because three planes do not show which of them is wrong"
    return f"most {data.names[k].lower()}, by {propagated.closure[k]:.2g}, {z[k]:.1f} standard uncertainties"


def _note_roots(converged: Converged, data: Readings, notes: list[str]) -> None:
    direction = converged.direction
    if direction.other_root is not None:
        other, u0 = direction.other_root, data.nominal_direction
        angles = [float(np.degrees(np.arccos(np.clip(v @ u0, -1, 1)))) for v in (direction.direction, other)]
        notes.append(
            f"Two directions fit the planes; the one closer to nominal, at {angles[0]:.3g} deg, is used. The other one "
            "is ({:.5f}, {:.5f}, {:.5f}), at ".format(*other)
            + f"{angles[1]:.3g} deg."
        )
    if direction.curvature > _NOTED_CURVATURE:
        notes.append(
            "The beam is near the plane of the normals of the planes: its uncertainty is large compared with the "
            "distance of the two possible directions, and intervals are approximate. Measure a plane tilted about "
            "another axis."
        )


def _note_origin(data: Readings, origin: Origin | None, notes: list[str]) -> None:
    known = int(np.isfinite(data.points).all(axis=1).sum())
    if origin is None:
        notes.append(
            "The zero point is unknown: expected three or more planes with a known point (plane_point) and independent "
            f"normals; found {known} with a known point."
        )
        return
    if not data.point_uncertainty > 0:
        notes.append("No plane_point_uncertainty in the data: the known points of the planes are assumed to be exact.")
    if not np.isfinite(data.nominal_origin).all():
        notes.append("No nominal_origin in the data: the zero point is stated as beam_origin, its error is unknown.")
    if known > 3 and origin.chi2 > chi2_quantile(1 - FALSE_ALARM, known - 3):
        worst = int(np.nanargmax(np.abs(origin.misfit)))
        notes.append(
            f"The known points of the planes contradict one another: chi-square {origin.chi2:.4g} with {known - 3} "
            f"degrees of freedom; {data.names[worst].lower()} is {origin.misfit[worst] * 1e6:.3g} um from its point."
        )


def _corrected(
    data: Readings,
    fits: list[PlaneFit],
    converged: Converged,
    sensor: Sensor | None,
    settings: Settings,
    notes: list[str],
) -> Array:
    """Return the compensated readings (plane, reading), m; tilts that are not calibrated are refused, or noted.

    Outliers, which are not used, have none.
    """
    if sensor is None or converged.tilt is None:
        return data.raw
    values = []
    for name, distance, fit, tilt in zip(data.names, data.distance, fits, converged.tilt, strict=True):
        reading = np.where(fit.left_out, np.nan, distance)
        try:
            value = sensor.calibration.compensate(reading, tilt, sensor.mid_range).value
        except MethodError as error:
            if not settings.extrapolate:
                raise MethodError(f"{name}: {error}") from error
            value = sensor.calibration.compensate(reading, tilt, sensor.mid_range, extrapolate=True).value
            notes.append(
                f"{name}: extrapolated. Calibration '{sensor.calibration.name}' does not cover {tilt_text(tilt)}, or "
                "not all of the readings there."
            )
        values.append(value)
    return np.array(values)


def _extras(beam: Determined, covariance: Array, origin: Array) -> dict[str, xr.DataArray]:
    data, fits, converged, corrected = beam.data, beam.fits, beam.converged, beam.corrected
    direction, planes = converged.direction, converged.planes

    def array(values: Any, dims: tuple[str, ...], unit: str, meaning: str = "") -> xr.DataArray:
        attrs = ({"units": unit} if unit else {}) | ({"long_name": meaning} if meaning else {})
        return xr.DataArray(values, dims=dims, attrs=attrs)

    vector, by_plane, by_reading = ("beam", "direction"), ("plane", "direction"), ("plane", "reading")
    if converged.tilt is not None:
        alpha, beta = inclination_rotation(converged.tilt)
    else:
        alpha, beta = np.arccos(np.clip(-(planes.normals @ direction.direction), -1, 1)), np.full(len(fits), np.nan)
    out_of_range = np.isfinite(data.raw) & np.isnan(data.distance)
    left_out = np.array([fit.left_out for fit in fits]).astype(np.int8) + 2 * out_of_range.astype(np.int8)
    residual = np.array([fit.residual for fit in fits]) / (1 + converged.slope)[:, None]
    correction = data.raw - corrected if converged.iterations else np.full(data.raw.shape, np.nan)
    return {
        "beam_origin": array(origin[None], vector, "m"),
        "beam_direction": array(direction.direction[None], vector, "1"),
        "nominal_origin": array(data.nominal_origin[None], vector, "m"),
        "nominal_direction": array(data.nominal_direction[None], vector, "1"),
        "beam_covariance": array(covariance[None], ("beam", "p", "p_"), "", "SI: m for p, 1 for u"),
        "gradient": array(planes.gradients, by_plane, "1", "of the reading with the stage position"),
        "gradient_covariance": array(planes.covariances[:, :3, :3], (*by_plane, "direction_"), "1"),
        "normal": array(planes.normals, by_plane, "1", "towards the sensor"),
        "inclination": array(alpha, ("plane",), "rad"),
        "rotation": array(beta, ("plane",), "rad"),
        "closure": array(beam.propagated.closure, ("plane",), "1", "g.u + 1"),
        "closure_uncertainty": array(
            np.sqrt(np.maximum(np.diag(beam.propagated.closure_covariance), 0.0)),
            ("plane",),
            "1",
            "0 for two planes, which always close",
        ),
        "residual": array(residual, by_reading, "m"),
        "left_out": array(left_out, by_reading, "", "1: outlier; 2: out of the sensor's range"),
        "compensation": array(correction, by_reading, "m", "correction that was subtracted from the reading"),
        "distance_raw": array(data.raw, by_reading, "m"),
        "distance_compensated": array(corrected, by_reading, "m"),
        "stage": array(data.stage, (*by_reading, "direction"), "m", "of the sensor relative to the target"),
        "uncompensated_direction": array(beam.uncompensated.direction.direction[None], vector, "1"),
        "iterations": array([converged.iterations], ("beam",), ""),
        "noise": array(
            [data.noise * beam.noise_factor], ("beam",), "m", "stated, or of the residuals where it is larger"
        ),
    }
