"""Correction of the inclination error of the sensor, which depends on the direction of the beam.

A reading r of a plane with the tilt q is r = d + (d - m) k(q). On one plane q is the same for all readings, so that the
compensated gradient is g / (1 + k) and the compensated offset m + (offset - m) / (1 + k): no second
fit is needed. The normal is N = g / |g| for any k. The tilt depends on the beam and the beam on the gradients: both are
determined alternately until the direction converges. Source: Lu et al., section 3.3, where the readings are iterated.

Uncertainties are propagated through the iteration. With du = M dk the effect of the slopes on the direction and
H = dk/du that of the direction on the slopes, any other change is multiplied by (1 - M H)^-1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.provenance import identity
from errormotion.errors import MethodError
from errormotion.kinematics.beams import across, tilt, turned
from errormotion.methods.beam_direction.identification.direction import Direction, solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from errormotion.datasets.calibrations.inclination import InclinationCalibration


CALIBRATION, TRIANGULATION, SCALE = "inclination calibration", "triangulation plane", "scale of the sensor"
"""Sources common to all planes: the first two with compensation of the inclination error, the last one without."""
_STEP = 1e-5
"""Change of the direction for numerical derivatives, rad."""
_MAX_SLOPE = 0.2
_NEGLIGIBLE = 1e-12
SAME_TILT = 0.01
"""Difference of tilts up to which a component of the calibration has the same effect in two datasets, rad."""


@dataclass(frozen=True)
class Planes:
    """Fitted planes, as read or compensated.

    Attributes
    ----------
    names : tuple of str
        For messages.
    gradients : ndarray (k, 3)
    offsets : ndarray (k,)
        Reading at the stage position 0, m.
    covariances : ndarray (k, 4, 4)
        Of (gradient, offset), SI.
    """

    names: tuple[str, ...]
    gradients: Array
    offsets: Array
    covariances: Array

    @property
    def normals(self) -> Array:
        """Unit normals (k, 3) of the planes, towards the sensor."""
        return np.asarray(self.gradients / np.linalg.norm(self.gradients, axis=1, keepdims=True))

    def compensated(self, slope: Array, mid_range: float) -> Planes:
        """Return the planes corrected for an inclination error of slopes (k,)."""
        scale = 1 / (1 + slope)
        return replace(
            self,
            gradients=self.gradients * scale[:, None],
            offsets=mid_range + (self.offsets - mid_range) * scale,
            covariances=self.covariances * (scale**2)[:, None, None],
        )

    def direction(self, nominal: Array) -> Direction:
        """Return the direction of the beam, see `direction.solve`."""
        return solve(self.gradients, self.covariances[:, :3, :3], nominal, self.names)


@dataclass(frozen=True)
class Sensor:
    """Properties of the sensor for the compensation.

    Attributes
    ----------
    calibration : InclinationCalibration
    triangulation_normal : ndarray (3,)
        Unit normal of the plane of emitted and received beam.
    normal_uncertainty : float
        Standard uncertainty of that normal's angle about the beam, rad.
    mid_range : float
        Reading at which the inclination error vanishes, m.
    notes : tuple of str
        Notes on the use of the calibration.
    """

    calibration: InclinationCalibration
    triangulation_normal: Array
    normal_uncertainty: float
    mid_range: float
    notes: tuple[str, ...] = ()

    def slopes(self, beam: Array, normals: Array) -> Array:
        """Return the slopes (k,) of the inclination error on planes with normals (k, 3)."""
        return self.calibration.slope(tilt(beam, self.triangulation_normal, normals))[0]


@dataclass(frozen=True)
class Converged:
    """A direction and its compensation.

    Attributes
    ----------
    direction : Direction
        Its covariance is that of the noise, without the iteration; see `propagation`.
    planes : Planes
        Compensated.
    tilt : ndarray (k, 2) or None
        Of each plane to the beam; None without compensation.
    slope : ndarray (k,)
        Of the inclination error on each plane.
    slope_by_direction : ndarray (k, 3)
        Its derivative by the direction.
    sources, groups : tuple of str
        Sources common to the slopes, and their groups in the budget.
    slope_by_source : ndarray (source, k)
        Change of the slopes with one standard uncertainty of each source, at this direction.
    mid_range : float
        m.
    iterations : int
        0 without compensation.
    """

    direction: Direction
    planes: Planes
    tilt: Array | None
    slope: Array
    slope_by_direction: Array
    sources: tuple[str, ...]
    groups: tuple[str, ...]
    slope_by_source: Array
    mid_range: float
    iterations: int


def uncompensated(planes: Planes, nominal: Array, scale_uncertainty: float = 0.0, mid_range: float = 0.0) -> Converged:
    """Return the direction without compensation of the readings.

    Parameters
    ----------
    planes : Planes
    nominal : ndarray (3,)
        Approximate direction.
    scale_uncertainty : float
        Relative standard uncertainty of the readings' scale about ``mid_range`` (m), common to all planes.
    """
    k, known = len(planes.offsets), scale_uncertainty == 0
    direction = planes.direction(nominal)
    return Converged(
        direction,
        planes,
        tilt=None,
        slope=np.zeros(k),
        slope_by_direction=np.zeros((k, 3)),
        sources=() if known else (SCALE,),
        groups=() if known else (SCALE,),
        slope_by_source=np.full((0 if known else 1, k), scale_uncertainty),
        mid_range=mid_range,
        iterations=0,
    )


def converge(planes: Planes, nominal: Array, sensor: Sensor, tolerance: float, max_iterations: int) -> Converged:
    """Compensate and solve alternately until the direction converges.

    Parameters
    ----------
    planes : Planes
        As read.
    nominal : ndarray (3,)
        Approximate direction.
    sensor : Sensor
    tolerance : float
        Change of the direction at convergence, rad.
    max_iterations : int

    Raises
    ------
    MethodError
        No convergence within ``max_iterations``, a compensation that is not a small correction, or an error of
        `direction.solve`.
    """
    normals = planes.normals
    u = planes.direction(nominal).direction
    steps: list[Array] = []
    while True:
        slope = sensor.slopes(u, normals)
        _check_slopes(slope, planes.names)
        compensated = planes.compensated(slope, sensor.mid_range)
        direction = compensated.direction(nominal)
        steps.append(direction.direction - u)
        u = direction.direction
        if np.linalg.norm(steps[-1]) < tolerance:
            break
        if len(steps) >= max_iterations:
            raise MethodError(_not_converged(steps, tolerance))
    q = tilt(u, sensor.triangulation_normal, normals)
    sources, groups, by_source = _slope_sources(sensor, q)
    by_direction = np.zeros((len(slope), 3))
    for e in np.eye(2):
        ahead, behind = (sensor.slopes(turned(u, sign * _STEP * e), normals) for sign in (1, -1))
        by_direction += np.outer((ahead - behind) / (2 * _STEP), e @ across(u))
    return Converged(
        direction, compensated, q, slope, by_direction, sources, groups, by_source, sensor.mid_range, len(steps)
    )


def _slope_sources(sensor: Sensor, q: Array) -> tuple[tuple[str, ...], tuple[str, ...], Array]:
    """Return names and groups of the sources common to the slopes, and their change (source, k) at tilts q (k, 2)."""
    J = sensor.calibration.jacobian(q)
    # The coefficients change the slopes of k planes in at most k independent ways.
    variance, axes = np.linalg.eigh(J @ sensor.calibration.coefficient_covariance @ J.T)
    moved = variance > _NEGLIGIBLE * max(float(variance[-1]), 1e-300)
    by_source = (axes * np.sqrt(np.maximum(variance, 0.0)))[:, moved].T[::-1]
    sources = tuple(f"{CALIBRATION} {i + 1}" for i in range(len(by_source)))
    groups = (CALIBRATION,) * len(sources)
    if sensor.normal_uncertainty > 0:
        c, s = np.cos(sensor.normal_uncertainty), np.sin(sensor.normal_uncertainty)
        # A rotation of the sensor about the beam rotates the axes of q, and q in the opposite sense.
        ahead, behind = (sensor.calibration.slope(q @ np.array([[c, -sign * s], [sign * s, c]]))[0] for sign in (1, -1))
        by_source = np.concatenate([by_source, [(ahead - behind) / 2]])
        sources, groups = (*sources, TRIANGULATION), (*groups, TRIANGULATION)
    return sources, groups, by_source


def identities(converged: Converged, sensor: Sensor | None) -> dict[str, str]:
    """Return the identity of each source that is a component of the sensor's calibration, by its name.

    Component i is a combination of the calibrated coefficients that depends on the tilts of the planes. Its error is
    the same in two datasets with the same calibration and the same tilts, to `SAME_TILT`, if it has the same sign on
    the plane with the largest effect.
    """
    if sensor is None or converged.tilt is None:
        return {}
    tilts = np.round(converged.tilt / SAME_TILT) + 0.0
    reference = sensor.calibration.reference()["hash"]
    result = {}
    for i, (name, row) in enumerate(zip(converged.sources, converged.slope_by_source, strict=True)):
        if name.startswith(CALIBRATION):
            largest = int(np.argmax(np.abs(row)))
            along = (largest, np.sign(row[largest]))
            result[name] = identity(reference, tilts, part=f"part {i + 1}", along=along)
    return result


def _check_slopes(slope: Array, names: Sequence[str]) -> None:
    for name, k in zip(names, slope, strict=True):
        if np.isnan(k):
            raise MethodError(
                f"{name}: during the compensation, the beam met the back of the plane. Check the nominal direction, "
                "and that the calibration belongs to this sensor."
            )
        if abs(k) > _MAX_SLOPE:
            raise MethodError(
                f"{name}: the inclination error of the calibration is {k:.0%} of the depth; expected a few per cent at "
                "most. Check that the calibration belongs to this sensor and covers this inclination."
            )


def _not_converged(steps: list[Array], tolerance: float) -> str:
    size = np.linalg.norm(steps, axis=1)
    back = float(steps[-1] @ steps[-2]) / max(size[-1] * size[-2], 1e-300) if len(steps) > 1 else 0.0
    factor = size[-1] / size[-2] if len(steps) > 1 else np.nan
    trend = "alternate" if back < -0.5 else "increase" if factor >= 1 else "decrease"
    rate = f"; the steps {trend}, each {factor:.2g} times the previous one" if len(steps) > 1 else ""
    if 0 < factor < 0.9:
        more = int(np.ceil(np.log(tolerance / size[-1]) / np.log(factor)))
        action = f"At this rate {more} more iterations are needed: increase max_iterations."
    else:
        action = "The inclination error depends too strongly on the tilt: use planes with less inclination."
    count = f"{len(steps)} iteration{'s' if len(steps) > 1 else ''}"
    return (
        f"The compensation of the inclination error does not converge: in the last of {count} the direction changed by "
        f"{size[-1]:.2g} rad; expected less than {tolerance:.2g} rad{rate}. {action}"
    )
