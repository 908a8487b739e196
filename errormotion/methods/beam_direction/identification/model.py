"""The measurement model: which gradients and offsets of the reading a beam has on planes.

With the zero point of the sensor at p0 + s, where s is the stage position, the reading d along the unit vector u of the
beam ends at the plane N . (x - P) = 0: N . (p0 + s + u d - P) = 0. The gradient of the reading is therefore
``gamma = -N / (N . u)``, and each plane, with any normal, is one condition ``gamma . u = -1``; it has two unknowns,
``gamma = t - u`` with t across u. On a plane through P the reading at the stage position c is

    d = gamma . (p0 + c - P) + |gamma| e,

with the distance e of the plane from its known point; without one it is unknown. A sensor with the relative error a of
its scale and the inclination error k(q) reads ``r = m + (d - m) (1 + k) (1 + a)`` about its mid-range m, and a stage
whose axes have relative errors b of their scales is at ``c (1 + b)``, so that the measured gradient is
``gamma (1 + b) (1 + k) (1 + a)``. The tilt q of the plane to the beam, measured from the plane of triangulation, is
``q = (gamma . e1, gamma . e2)``, see `kinematics.beams`.

All of this is one fit: what the readings say about the calibration of the sensor is used as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np

from errormotion.arrays import Array
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.derivatives import STEP
from errormotion.estimation.problem import READINGS, Problem
from errormotion.estimation.sources import Places
from errormotion.kinematics.beams import across
from errormotion.methods.beam_direction.identification.sensor import CALIBRATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.estimation.fit import Fit
    from errormotion.methods.beam_direction.identification.planes import Planes
    from errormotion.methods.beam_direction.identification.sensor import Sensor

T = TypeVar("T")
SCALE, STAGE, TRIANGULATION = "scale of the sensor", "scales of the stage", "triangulation plane"
POINTS = "known points of the planes"


class Unknowns(NamedTuple, Generic[T]):
    """Tables of what is estimated.

    The beam's two angles; two components of t and the reading at the centre (used if no point is known) for each plane;
    the zero point; and the distance of each plane from its known point.
    """

    beam: T
    plane: T
    origin: T
    point: T


class Known(NamedTuple, Generic[T]):
    """Tables of what is known with an uncertainty: scales, components of the calibration, rotation of the sensor."""

    scale: T
    stage: T
    slope: T
    roll: T


@dataclass(frozen=True, eq=False)
class State:
    """A solution: beam, and what it means for each plane.

    Attributes
    ----------
    direction, origin : ndarray (3,)
    gradient : ndarray (k, 3)
        gamma.
    slope, factor : ndarray (k,)
        Inclination error k, and ``(1 + k) (1 + a)``.
    tilt : ndarray (k, 2) or None
        q; None without compensation.
    """

    direction: Array
    origin: Array
    gradient: Array
    slope: Array
    factor: Array
    tilt: Array | None


@dataclass(frozen=True, eq=False)
class Beam:
    """A beam on planes.

    Attributes
    ----------
    planes : Planes
        Measured gradients and offsets.
    about : ndarray (3,)
        Direction near the beam, where the iteration starts.
    points : ndarray (k, 3)
        Known points of the planes, m; NaN where unknown, and everywhere if the zero point is not wanted.
    point_uncertainty : float or ndarray (k,)
        Standard uncertainty of the points along the normals, m; 0 = exact.
    sensor : Sensor or None
        For the compensation of the inclination error.
    mid_range : float
        About which the scale acts, m.
    scale_uncertainty, stage_uncertainty : float
        Relative standard uncertainty of the scales of the sensor, and of each axis of the stage.
    components : ndarray (term, r) or None
        Changes of the coefficients of the calibration by one standard uncertainty; None = all constants are exact.
    scale_identity : str
    component_identities : tuple of str
    start : Unknowns or None
        Where the iteration starts; None = at the measured gradients and offsets.
    """

    planes: Planes
    about: Array
    points: Array
    point_uncertainty: float | Array = 0.0
    sensor: Sensor | None = None
    mid_range: float = 0.0
    scale_uncertainty: float = 0.0
    stage_uncertainty: float = 0.0
    components: Array | None = None
    scale_identity: str = ""
    component_identities: tuple[str, ...] = ()
    start: Unknowns[Array] | None = None

    @cached_property
    def basis(self) -> Array:
        """Two unit vectors (2, 3) across `about`."""
        return across(self.about)

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Planes (k,) with a known point."""
        return np.asarray(np.isfinite(self.points).all(axis=1))

    def problem(self) -> Problem:
        """Return the least squares of gradients and offsets; each plane is one reading of four numbers."""
        planes, known, k = self.planes, self.known, len(self.planes.names)
        first, each = np.zeros(k, dtype=np.intp), np.arange(k)
        start = self._measured() if self.start is None else self.start
        uncertainty = np.broadcast_to(self.point_uncertainty, (k,))[:, None]
        free = np.column_stack([np.ones((k, 2), bool), ~known])
        return Problem(
            equation=lambda y, x, c: y - self.predicted(x, c),
            readings=planes.value,
            unknowns=Unknowns(
                beam=Block(start=start.beam, index=first, scale=1.0),
                plane=Block(start=start.plane, index=each, scale=1.0, free=free),
                origin=Block(start=start.origin, index=first, scale=1.0, free=np.full(1, known.any())),
                point=Block(
                    start=np.zeros((k, 1)),
                    index=each,
                    scale=1.0,
                    free=known[:, None] & (uncertainty > 0),
                    prior=np.where(uncertainty > 0, uncertainty, 1.0),
                    group=POINTS,
                ),
            ),
            constants=self._constants(k),
            noise=Noise(root=np.asarray(np.linalg.cholesky(planes.covariance), dtype=float)),
            derivatives=self._derivatives,
        )

    def started(self, x: Unknowns[Array]) -> Beam:
        """Return the beam with a start at other unknowns; the points start where they are known to be."""
        origin = x.origin if x.origin.any() else self._measured().origin
        return replace(self, start=x._replace(origin=origin, point=np.zeros_like(x.point)))

    def _measured(self) -> Unknowns[Array]:
        """Return the start at the measured gradients and offsets."""
        g, offset, known = self.planes.gradients, self.planes.value[:, 3], self.known
        origin = np.zeros((1, 3))
        if known.any():
            behind = offset - np.sum(g * (self.planes.centre - np.nan_to_num(self.points)), axis=1)
            origin[0] = np.linalg.lstsq(g[known], behind[known])[0]
        plane = np.column_stack([g @ self.basis.T, offset])
        return Unknowns(np.zeros((1, 2)), plane, origin, np.zeros((len(g), 1)))

    def predicted(self, x: Unknowns[Array], c: Known[Array]) -> Array:
        """Return the gradient and the reading at the centre (n, 4) for rows of all planes, once or several times."""
        u = self.direction(x.beam)
        gradient = self.gradient(u, x.plane)
        factor = (1 + self._slope(u, gradient, c)[0]) * (1 + c.scale[:, 0])
        stage, m, times = 1 + c.stage, self.mid_range, len(u) // len(self.known)
        centre, points = np.tile(self.planes.centre, (times, 1)), np.tile(np.nan_to_num(self.points), (times, 1))
        place = x.origin + centre * stage - points
        through = np.sum(gradient * place, axis=1) + np.linalg.norm(gradient, axis=1) * x.point[:, 0]
        d = np.where(np.tile(self.known, times), through, x.plane[:, 2])
        return np.column_stack([factor[:, None] * gradient * stage, m + factor * (d - m)])

    def _derivatives(self, y: Array, x: Unknowns[Array], c: Known[Array]) -> dict[str, Array]:
        """Return central differences by all columns of all tables, from one evaluation of all changed rows."""
        k, tables = len(y), [*x, *c]
        width = [table.shape[1] for table in tables]
        whole = np.concatenate(tables, axis=1)
        steps = STEP * np.concatenate([np.eye(sum(width)), -np.eye(sum(width))])
        changed = (whole + steps[:, None]).reshape(-1, sum(width))
        parts = np.split(changed, np.cumsum(width)[:-1], axis=1)
        values = self.predicted(Unknowns(*parts[: len(x)]), Known(*parts[len(x) :])).reshape(2, -1, k, 4)
        J = np.moveaxis((values[1] - values[0]) / (2 * STEP), 0, 2)
        by_table = dict(zip([*x._fields, *c._fields], np.split(J, np.cumsum(width)[:-1], axis=2), strict=True))
        return {**by_table, READINGS: np.broadcast_to(np.eye(4), (k, 4, 4))}

    def direction(self, angles: Array) -> Array:
        """Return unit vectors (n, 3) at angles (n, 2) to `about`."""
        u = self.about + angles @ self.basis
        return np.asarray(u / np.linalg.norm(u, axis=-1, keepdims=True))

    def gradient(self, u: Array, plane: Array) -> Array:
        """Return the gradients (k, 3) that meet their condition."""
        t = plane[:, :2] @ self.basis
        return np.asarray(t - np.sum(t * u, axis=1, keepdims=True) * u - u)

    def places(self) -> Places:
        """Return zero point and direction (1, 6) as what is wanted; the former NaN if no point is known."""

        def parameters(x: Unknowns[Array], _: Known[Array]) -> Array:
            origin = x.origin if self.known.any() else np.full((1, 3), np.nan)
            return np.concatenate([origin, self.direction(x.beam)], axis=1)

        return Places(parameters, 1)

    def direction_covariance(self, solution: Fit) -> Array:
        """Return the covariance (3, 3) of the direction of a fit of this problem."""
        root = solution.normal.root[solution.linear.numbering.border[0].ravel()]
        v = self.about + solution.unknowns.beam[0] @ self.basis
        u = v / np.linalg.norm(v)
        by_angles = (self.basis - np.outer(self.basis @ u, u)) / np.linalg.norm(v)
        return np.asarray(by_angles.T @ root @ root.T @ by_angles)

    def state(self, x: Unknowns[Array], c: Known[Array]) -> State:
        """Return the solution of tables of unknowns and constants."""
        k = len(self.planes.names)
        rows = Known(*(np.repeat(table[:1], k, axis=0) for table in c))
        u = self.direction(np.repeat(x.beam, k, axis=0))
        gradient = self.gradient(u, x.plane)
        slope, tilt = self._slope(u, gradient, rows)
        origin = x.origin[0] if self.known.any() else np.full(3, np.nan)
        return State(u[0], origin, gradient, slope, (1 + slope) * (1 + rows.scale[:, 0]), tilt)

    def _slope(self, u: Array, gradient: Array, c: Known[Array]) -> tuple[Array, Array | None]:
        """Return the slope (k,) of the inclination error, and the tilts (k, 2)."""
        if self.sensor is None:
            return np.zeros(len(u)), None
        e1 = np.cross(self.sensor.triangulation_normal, u)
        e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
        q1, q2 = np.sum(gradient * e1, axis=1), np.sum(gradient * np.cross(u, e1), axis=1)
        # A rotation of the sensor about the beam rotates the axes of q, and q in the opposite sense.
        cos, sin = np.cos(c.roll[:, 0]), np.sin(c.roll[:, 0])
        q = np.column_stack([cos * q1 + sin * q2, cos * q2 - sin * q1])
        calibration = self.sensor.calibration
        coefficients = calibration.coefficients
        if self.components is not None:
            coefficients = coefficients + c.slope @ self.components.T
        return np.sum(calibration.jacobian(q) * coefficients, axis=1), q

    def _constants(self, k: int) -> Known[Any]:
        """Return the constants, which the readings may improve."""
        exact, sensor = self.components is None, self.sensor
        r = 0 if exact or self.components is None else self.components.shape[1]
        scale = 0.0 if exact or sensor is not None else self.scale_uncertainty
        roll = 0.0 if exact or sensor is None else sensor.normal_uncertainty
        stage = 0.0 if exact else self.stage_uncertainty

        def constant(sd: float, count: int, group: str, **more: Any) -> Constant:
            factor = sd * np.eye(max(count, 1))[None, :, : count if sd > 0 else 0]
            return Constant(
                value=np.zeros((1, max(count, 1))),
                factor=factor,
                index=np.zeros(k, dtype=np.intp),
                scale=1.0,
                group=group,
                adjust=True,
                **more,
            )

        return Known(
            scale=constant(scale, 1, SCALE, identity=(self.scale_identity,) if scale > 0 else ()),
            stage=constant(stage, 3, STAGE, names=tuple(f"scale of the stage {a}" for a in "XYZ") if stage > 0 else ()),
            slope=constant(
                1.0,
                r,
                CALIBRATION,
                names=tuple(f"{CALIBRATION} {i + 1}" for i in range(r)),
                identity=self.component_identities if r else (),
            ),
            roll=constant(roll, 1, TRIANGULATION),
        )
