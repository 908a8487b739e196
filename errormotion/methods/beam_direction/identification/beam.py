"""A beam from readings on planes: what was observed, what follows from the solution, and what is worth a note."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy.special import chdtrc

from errormotion.arrays import Array
from errormotion.datasets.calibrations.inclination import tilt_text
from errormotion.datasets.certificates import certified
from errormotion.errors import MethodError
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.sources import Errors, Source
from errormotion.estimation.variance import Verdict, expansion
from errormotion.kinematics.beams import beam_errors, error_jacobian, inclination_rotation
from errormotion.measurement.identification import of_readings
from errormotion.measurement.observed import Observed, Solved
from errormotion.methods.beam_direction.identification.direction import Direction, solve
from errormotion.methods.beam_direction.identification.model import SCALE, Beam, State
from errormotion.methods.beam_direction.identification.planes import Planes, correlation_root, fit_planes
from errormotion.methods.beam_direction.identification.reading import Readings, read
from errormotion.methods.beam_direction.identification.receiver import check_receiver
from errormotion.methods.beam_direction.identification.sensor import Sensor

if TYPE_CHECKING:
    from errormotion.methods.beam_direction.settings import BeamDirectionSettings

FALSE_ALARM = 1e-3
"""Probability that correct known points of planes are reported as contradictory."""
MIN_SINGULAR_VALUE = 0.02
"""Of the normals, divided by the root of their number, for which they determine a point."""
_NOTED_CURVATURE = 0.05
_MAX_SLOPE = 0.2
_PARAMETERS = ["px", "py", "pz", "ux", "uy", "uz"]
_LABELS = {"direction": list("xyz"), "direction_": list("xyz"), "p": _PARAMETERS, "p_": _PARAMETERS}


def observe(raw: xr.Dataset, settings: BeamDirectionSettings, sensor: Sensor | None) -> Observed:
    """Return readings on planes as a model of the beam; see `errormotion.methods.beam_direction.identification.model`.

    Parameters
    ----------
    raw : Dataset
    settings : BeamDirectionSettings
    sensor : Sensor or None
        For the compensation.

    Raises
    ------
    MethodError
        Data that do not determine the beam; the message names the plane.
    """
    notes: list[str] = []
    data = read(raw, settings, notes)
    planes = fit_planes(data, settings, notes)
    exact = Beam(
        planes,
        data.nominal_direction,
        np.full(data.points.shape, np.nan),
        mid_range=float(raw["mid_range"]) if "mid_range" in raw else 0.0,
        scale_uncertainty=settings.layout.scale_uncertainty,
        stage_uncertainty=settings.layout.stage_uncertainty,
        scale_identity=certified(raw.attrs, {SCALE: ("sensor", "gain")}).get(SCALE, ""),
    )
    plain = solve(exact, data.nominal_direction)
    detected = plain
    if sensor is None:
        notes.append("No inclination compensation: the readings are not corrected for the inclination error.")
    else:
        notes += sensor.notes
        detected = solve(replace(exact, sensor=sensor, mid_range=sensor.mid_range), data.nominal_direction, plain.roots)
        _check_slopes(detected.state, data)
    beam = detected.adjusted()
    closed = fit(beam.problem())
    beam = beam.started(closed.unknowns)
    if sensor is not None:
        check_receiver(detected, closed, notes)
    beam = _with_points(beam, closed, data, notes)
    _note_roots(detected, data, notes)
    p0 = data.nominal_origin
    result = _Result(raw, settings, data, beam, plain.state.direction)
    return Observed(
        problem=beam.problem(),
        places=beam.places(),
        dims=("beam",),
        coords={"beam": [settings.beam], **_LABELS},
        component="beam",
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=np.where(np.isfinite(p0), p0, 0.0).tolist(),
        reference="nominal beam; its errors are stated at its nominal zero point (nominal_origin)",
        what="the planes",
        robust=False,
        resolution=0.0,
        record=lambda raw, y, generator: recorded(raw, data, planes, y, generator),
        finish=result.of,
        notes=notes,
        doubts=planes.doubts,
    )


def recorded(raw: xr.Dataset, data: Readings, planes: Planes, y: Array, generator: np.random.Generator) -> xr.Dataset:
    """Return raw data with readings of gradients and offsets y (k, 4), and with noise and speckle as stated."""
    distance = np.full(data.distance.shape, np.nan)
    for k, (stage, centre) in enumerate(zip(data.stage, planes.centre, strict=True)):
        its = np.isfinite(data.distance[k]) & np.isfinite(stage).all(axis=1)
        root = correlation_root(stage[its], data.noise, data.speckle, data.speckle_length)
        exact = (stage[its] - centre) @ y[k, :3] + y[k, 3]
        distance[k, its] = exact + root @ generator.standard_normal(int(its.sum()))
    return raw.assign(distance=(("plane", "reading"), distance, raw["distance"].attrs))


def _check_slopes(state: State, data: Readings) -> None:
    for name, k in zip(data.names, state.slope, strict=True):
        if abs(k) > _MAX_SLOPE:
            raise MethodError(
                f"{name}: the inclination error of the calibration is {k:.0%} of the depth; expected a few per cent at "
                "most. Check that the calibration belongs to this sensor and covers this inclination.",
                code="beam.inclination.too_large",
            )


def _with_points(beam: Beam, closed: Fit, data: Readings, notes: list[str]) -> Beam:
    """Return the beam with the known points of its planes, if they determine the zero point.

    Points that contradict one another have the uncertainty that they show: ``sum (e / s)^2`` over their degrees of
    freedom, with Student's distribution.
    """
    known = np.asarray(np.isfinite(data.points).all(axis=1))
    gradient = beam.state(closed.unknowns, closed.constants).gradient[known]
    normals = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    count = int(known.sum())
    if count < 3 or np.linalg.svd(normals, compute_uv=False)[2] < MIN_SINGULAR_VALUE * np.sqrt(count):
        notes.append(
            "The zero point is unknown: expected three or more planes with a known point (plane_point) and independent "
            f"normals; found {count} with a known point."
        )
        return beam
    if not data.point_uncertainty > 0:
        notes.append("No plane_point_uncertainty in the data: the known points of the planes are assumed to be exact.")
    if not np.isfinite(data.nominal_origin).all():
        notes.append("No nominal_origin in the data: the zero point is stated as beam_origin, its error is unknown.")
    placed = replace(
        beam, points=np.where(known[:, None], data.points, np.nan), point_uncertainty=data.point_uncertainty
    ).started(closed.unknowns)
    freedom = count - 3
    if not freedom:
        return placed
    joint = fit(placed.problem())
    chi2 = joint.chi2 - closed.chi2
    if chdtrc(freedom, max(chi2, 0.0)) >= FALSE_ALARM:
        return placed.started(joint.unknowns)
    free = fit(replace(placed, point_uncertainty=_LOOSE).problem())
    misfit = free.unknowns.point[:, 0]
    worst = int(np.argmax(np.abs(misfit)))
    shown = float(np.sqrt(np.sum(misfit**2) / freedom) * expansion(freedom))
    notes.append(
        f"The known points of the planes contradict one another: chi-square {chi2:.4g} with {freedom} "
        f"degrees of freedom; {data.names[worst].lower()} is {misfit[worst] * 1e6:.3g} um "
        f"from its point. Their uncertainty is increased to {shown * 1e6:.3g} um."
    )
    return replace(placed, point_uncertainty=max(shown, data.point_uncertainty))


_LOOSE = 1e-3
"""Standard deviation of points with which the planes alone determine the direction, m."""


def _note_roots(detected: Direction, data: Readings, notes: list[str]) -> None:
    u = detected.state.direction
    if detected.other_root is not None:
        other, u0 = detected.other_root, data.nominal_direction
        angles = [float(np.degrees(np.arccos(np.clip(v @ u0, -1, 1)))) for v in (u, other)]
        notes.append(
            f"Two directions fit the planes; the one closer to nominal, at {angles[0]:.3g} deg, is used. The other one "
            "is ({:.5f}, {:.5f}, {:.5f}), at ".format(*other)
            + f"{angles[1]:.3g} deg."
        )
    if detected.curvature > _NOTED_CURVATURE:
        notes.append(
            "The beam is near the plane of the normals of the planes: its uncertainty is large compared with the "
            "distance of the two possible directions, and intervals are approximate. Measure a plane tilted about "
            "another axis."
        )


@dataclass(frozen=True, eq=False)
class _Result:
    """What follows from a solution."""

    raw: xr.Dataset
    settings: BeamDirectionSettings
    data: Readings
    beam: Beam
    uncompensated: Array

    def of(self, solved: Solved) -> Solved:
        """Return the solution with errors relative to the nominal beam, notes and variables."""
        errors = solved.relative.errors
        data, value, total = self.data, errors.value, errors.covariance
        p0, u0 = data.nominal_origin[None], data.nominal_direction[None]
        twist, covariance = beam_errors(p0, u0, value[:, :3], value[:, 3:], total)
        if not solved.propagated:
            return replace(solved, relative=replace(solved.relative, errors=Errors(twist, covariance, [])))
        chart = error_jacobian(u0, value[:, 3:])[0]
        sources = [
            Source(one.name, one.group, np.nan_to_num(one.effect) @ chart.T, one.identity) for one in errors.sources
        ]
        by_sources = sum((one.effect[:, :, None] * one.effect[:, None, :] for one in sources), np.zeros((1, 6, 6)))
        mapped = Errors(twist, covariance - by_sources, sources)
        state = self.beam.state(solved.fit.unknowns, solved.fit.constants)
        closure, u_closure = closures(self.beam, solved, state)
        notes = [*solved.observed.notes, self._contradiction(solved, closure, u_closure)]
        extras = self._extras(state, value, total, notes) | {
            "closure": _array(closure, ("plane",), "1", "g.u + 1"),
            "closure_uncertainty": _array(u_closure, ("plane",), "1", "0 for two planes, which always close"),
        }
        return replace(
            solved,
            observed=replace(solved.observed, notes=notes, extras=extras),
            scatter=replace(solved.scatter, note=""),
            relative=replace(solved.relative, errors=mapped),
        )

    def _contradiction(self, solved: Solved, closure: Array, u: Array) -> str:
        """Return the note on planes that contradict one another, with the largest closure."""
        scatter, names = solved.scatter, self.data.names
        if scatter.verdict is not Verdict.MORE:
            return ""
        z = np.where(u > 0, np.abs(closure) / np.where(u > 0, u, 1.0), 0.0)
        k = int(np.argmax(z))
        # Three planes have one contradiction, the same for each.
        largest = (
            f"all by {z[k]:.1f} standard uncertainties, because three planes do not show which of them is wrong"
            if len(z) == 3
            else f"most {names[k].lower()}, by {closure[k]:.2g}, {z[k]:.1f} standard uncertainties"
        )
        cause = (
            "an invalid calibration, triangulation_normal or receiver"
            if self.beam.sensor is not None
            else "the uncompensated inclination error of the sensor"
        )
        freedom = solved.fit.freedom
        factor = np.sqrt(scatter.factor) * float(expansion(scatter.freedom))
        return (
            f"The planes contradict one another: chi-square {scatter.ratio**2 * freedom:.4g} with {freedom} degrees of "
            f"freedom; {largest}. Possible causes: {cause}, or a plane that moved. The uncertainties are increased by "
            f"the factor {factor:.3g}."
        )

    def _extras(self, state: State, value: Array, total: Array, notes: list[str]) -> dict[str, xr.DataArray]:
        data, planes = self.data, self.beam.planes
        vector, by_plane, by_reading = ("beam", "direction"), ("plane", "direction"), ("plane", "reading")
        gradients = planes.gradients / state.factor[:, None]
        normals = gradients / np.linalg.norm(gradients, axis=1, keepdims=True)
        if state.tilt is not None:
            alpha, beta = inclination_rotation(state.tilt)
        else:
            alpha = np.arccos(np.clip(-(normals @ state.direction), -1, 1))
            beta = np.full(len(normals), np.nan)
        readings = of_readings(planes.solved, self.raw) if planes.solved is not None else {}
        if readings:
            out = np.isfinite(data.raw) & np.isnan(data.distance)
            left = readings["left_out"]
            readings["left_out"] = left.copy(data=left.values + 2 * out.astype(np.int8)).assign_attrs(
                long_name="1: outlier; 2: out of the sensor's range"
            )
            compensated, correction = self._compensated(state, left.values == 1, notes)
            readings["compensation"] = _array(correction, by_reading, "m", "subtracted from the reading")
            readings["distance_compensated"] = _array(compensated, by_reading, "m")
        return readings | {
            "beam_origin": _array(value[:, :3], vector, "m"),
            "beam_direction": _array(value[:, 3:], vector, "1"),
            "nominal_origin": _array(data.nominal_origin[None], vector, "m"),
            "nominal_direction": _array(data.nominal_direction[None], vector, "1"),
            "beam_covariance": _array(total, ("beam", "p", "p_"), "", "SI: m for p, 1 for u"),
            "gradient": _array(gradients, by_plane, "1", "of the reading with the stage position"),
            "gradient_covariance": _array(
                planes.covariance[:, :3, :3] / np.square(state.factor)[:, None, None], (*by_plane, "direction_"), "1"
            ),
            "normal": _array(normals, by_plane, "1", "towards the sensor"),
            "inclination": _array(alpha, ("plane",), "rad"),
            "rotation": _array(beta, ("plane",), "rad"),
            "distance_raw": _array(data.raw, by_reading, "m"),
            "stage": _array(data.stage, (*by_reading, "direction"), "m", "of the sensor relative to the target"),
            "uncompensated_direction": _array(self.uncompensated[None], vector, "1"),
            "noise": _array([planes.noise], ("beam",), "m", "stated, or of the residuals where it is larger"),
        }

    def _compensated(self, state: State, left_out: Any, notes: list[str]) -> tuple[Array, Array]:
        """Return readings compensated by the calibration, and the correction, m; refuse or note what it does not cover.

        Outliers, which are not used, have none. What the planes improve of the calibration is not in these readings.
        """
        data, sensor = self.data, self.beam.sensor
        if sensor is None or state.tilt is None:
            return data.raw, np.full(data.raw.shape, np.nan)
        used, values = np.where(left_out, np.nan, data.distance), []
        for name, reading, tilt in zip(data.names, used, state.tilt, strict=True):
            try:
                value = sensor.calibration.compensate(reading, tilt, sensor.mid_range).value
            except MethodError as error:
                if not self.settings.extrapolate:
                    raise MethodError(f"{name}: {error}", code=error.code) from error
                value = sensor.calibration.compensate(reading, tilt, sensor.mid_range, extrapolate=True).value
                notes.append(
                    f"{name}: extrapolated. Calibration '{sensor.calibration.name}' does not cover {tilt_text(tilt)}, "
                    "or not all of the readings there."
                )
            values.append(value)
        return np.array(values), data.raw - values


def closures(beam: Beam, solved: Solved, state: State) -> tuple[Array, Array]:
    """Return ``g . u + 1`` (k,) of the measured gradients of a solution, and its standard uncertainty by their noise.

    The covariance of a residual is ``W^-1 (1 - H) W^-T`` with the whitener W and the hat matrix H. Two planes always
    close.
    """
    k = len(beam.planes.names)
    if k < 3:
        return np.zeros(k), np.zeros(k)
    closed, u = solved.fit, state.direction
    closure = beam.planes.gradients @ u / state.factor + 1
    root = np.linalg.inv(closed.linear.whitener)
    left = root @ (np.eye(4) - closed.hat) @ np.swapaxes(root, 1, 2)
    variance = np.einsum("i,kij,j->k", u, left[:, :3, :3], u) / np.square(state.factor)
    estimated = solved.scatter.factor if solved.fit_factor == 1.0 else 1.0
    return closure, np.sqrt(np.maximum(variance, 0.0) / estimated)


def _array(values: Any, dims: tuple[str, ...], unit: str, meaning: str = "") -> xr.DataArray:
    attrs = ({"units": unit} if unit else {}) | ({"long_name": meaning} if meaning else {})
    return xr.DataArray(values, dims=dims, attrs=attrs)
