"""Pose of the profiler in the tool frame, from scans of a level plate with a circular pocket of known position.

A point (x, 0, z) of a line is at H (x, 0, z) + s in the tool frame at its position over the pocket, with s the
displacement of the carriage from there and H = T(dx, dy, dz) R_X(a) R_Y(b) R_Z(g). The rim satisfies

    (X - X0)^2 + (Y - Y0)^2 = r^2,   Z = Z0,

and the plate provides the tilt dz/dx. The feed s is along Y of the machine, not of the profiler. This determines g: the
circle is sheared in (x, s), not rotated. With s in the profiler's frame, as in eq. (7) of Zhao et al., it would be a
rotated circle, from which g cannot be separated from the position of the centre. For the same reason, a is determined
only when the plate is scanned at two heights.

The line of sight is tilted to the axis of the pocket: from the rim to the floor, at depth d, it moves by
t = -d (H_xz, H_yz) / H_zz. Where it moves outwards, along the normal n of the rim, it ends on the wall, which is then
between plate and floor in the picture, w = t.n wide. The edge that `edges` finds lies on the wall, at the share k of
its width: at the radius r - k w. k depends on what the sensor makes of a wall: 1/2 if it sees all or nothing of it. It
is a parameter of the fit, with a uniform distribution from 0 to 1 as its prior. Without it, the picture of the rim
would be deformed on one side only, which is in part a shear like that by g.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion.arrays import Array
from errormotion.datasets import validate
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_zero
from errormotion.methods.crossbeam_scan.identification.profiler_pose import edges
from errormotion.methods.crossbeam_scan.identification.profiler_pose.edges import Tilt

#: a, b, g (rad), dx, dy, dz (m)
PARAMETERS = ("a", "b", "g", "dx", "dy", "dz")
_MIN_LINES = 10
#: Smallest accepted |cos| of the angle of an edge point, seen from the centre: other lines cross the rim too obliquely.
OBLIQUE = 0.35
#: Half differences and half sums of the edges' radii beyond this many standard deviations are excluded. The scatter of
#: edges has long tails, because single points at the rim may be lost; a tighter limit makes the covariance too small.
CLIP = 10.0
#: Standard uncertainty beyond which a parameter is not determined: rad, m.
WORST_ANGLE, WORST_POSITION = 0.05, 2e-3

#: Standard uncertainty of the position of edges that oblique lines across a spot leave, common to all of them, m.
EDGE_UNCERTAINTY = 10e-9
#: Expected share of the wall between rim and edge, and its standard uncertainty.
WALL_SHARE, WALL_UNCERTAINTY = 0.5, 12**-0.5

_STEP = 1e-5
"""Change of the line of sight for numerical derivatives."""
_UNIT = np.array([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5, 1e-5, 1e-1])


def pose(a: ArrayLike, b: ArrayLike, g: ArrayLike, dx: ArrayLike, dy: ArrayLike, dz: ArrayLike) -> RigidTransform:
    """Return H = T(dx, dy, dz) R_X(a) R_Y(b) R_Z(g), profiler to tool frame (eq. 5 of Zhao et al.); rad, m."""
    shift, angles = np.stack([dx, dy, dz], axis=-1), np.stack([a, b, g], axis=-1)
    return RigidTransform.from_components(shift, Rotation.from_euler("XYZ", angles))


def parameters(H: RigidTransform) -> Array:
    """Return (a, b, g, dx, dy, dz) of a pose, rad and m; the inverse of `pose`."""
    return np.concatenate([H.rotation.as_euler("XYZ"), H.translation])


@dataclass(frozen=True)
class Pocket:
    """A circular pocket whose position in the tool frame is known, because the machine itself has cut it.

    Attributes
    ----------
    radius, radius_uncertainty : float
        m; the radius is a parameter of the fit with this prior.
    centre : ndarray, (3,)
        (X0, Y0, Z0) of the rim, in the tool frame at its position over the pocket, m.
    centre_uncertainty : ndarray, (3,)
        Standard uncertainty, m.
    """

    radius: float
    radius_uncertainty: float = 1e-6
    centre: ArrayLike = (0.0, 0.0, 0.0)
    centre_uncertainty: ArrayLike = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ProfilerPose:
    """Pose of the profiler in the tool frame.

    Attributes
    ----------
    values : ndarray, (6,)
        (a, b, g, dx, dy, dz), rad and m.
    covariance : ndarray, (6, 6)
        Of ``values``.
    radius : float
        Fitted radius of the pocket, m.
    residual_x, residual_y : float
        Scatter of one edge along the profile, and of one line along the feed, m.
    lines : int
        Number of lines used.
    """

    values: Array
    covariance: Array
    radius: float
    residual_x: float
    residual_y: float
    lines: int

    @property
    def transform(self) -> RigidTransform:
        """The pose, profiler to tool frame."""
        a, b, g, dx, dy, dz = self.values
        return pose(a, b, g, dx, dy, dz)

    @property
    def matrix(self) -> Array:
        """The pose as a homogeneous matrix, (4, 4)."""
        return np.asarray(self.transform.as_matrix())


def calibrate(
    x: ArrayLike, height: ArrayLike, stage: ArrayLike, pocket: Pocket, *, angle_prior: float | None = None
) -> ProfilerPose:
    """Return the pose of the profiler from scans of a pocket.

    Parameters
    ----------
    x : (point,)
        Positions along the profile, m.
    height : (scan, line, point)
        m; NaN = no reading. One scan does not determine ``a`` without a prior; two scans at different heights do.
    stage : (scan, line, 3)
        Displacement of the tool frame at each line from its position over the pocket, m, in machine directions; one
        height per scan.
    pocket : Pocket
    angle_prior : float, optional
        Standard uncertainty of the angles a, b, g about 0 when the profiler was set up, rad.

    Raises
    ------
    MethodError
        Shapes that do not match, no pocket in the scans, or parameters that the scans do not determine.
    """
    points, z, s = (np.asarray(value, dtype=float) for value in (x, height, stage))
    if z.ndim != 3 or points.shape != z.shape[2:] or s.shape != (*z.shape[:2], 3):
        raise MethodError(
            "Expected x (point), height (scan, line, point) and stage (scan, line, 3); found "
            f"{points.shape}, {z.shape} and {s.shape}.",
            code="scan.pocket.shape",
        )
    if np.ptp(s[..., 2], axis=1).max() > 1e-6:
        raise MethodError(
            "Expected one height of the spindle for each scan of the pocket; Z of the stage changes within a scan.",
            code="scan.pocket.heights",
        )
    fit = _Fit([_scan(points, *pair) for pair in zip(z, s, strict=True)], pocket, angle_prior)
    return fit.solve()


def calibrate_dataset(raw: xr.Dataset, *, angle_prior: float | None = None) -> ProfilerPose:
    """Return the pose of the profiler from a raw dataset, variant "profiler pose" of the crossbeam scan.

    Parameters
    ----------
    raw : Dataset
        Schema ``errormotion.raw.crossbeam_scan/1`` with ``pocket_radius``.
    angle_prior : float, optional
        As in `calibrate`, rad.

    Raises
    ------
    DatasetError
        The dataset breaks its schema.
    MethodError
        It contains no scans of a pocket, or as in `calibrate`.
    """
    validate(raw)
    if "pocket_radius" not in raw:
        raise MethodError(
            "Expected scans of a pocket (a raw dataset of crossbeam_scan with pocket_radius); found "
            f"{raw.attrs['schema']} with {', '.join(map(str, raw.data_vars))}.",
            code="scan.pocket.missing",
        )
    names = ("radius", "radius_uncertainty", "centre", "centre_uncertainty")
    known: dict[str, Any] = {name: raw[f"pocket_{name}"].values for name in names if f"pocket_{name}" in raw}
    line = ("scan", "profile")
    height, stage = raw.height.transpose(*line, "point"), raw.stage.transpose(*line, "direction")
    return calibrate(raw.x.values, height.values, stage.values, Pocket(**known), angle_prior=angle_prior)


@dataclass(frozen=True)
class _Scan:
    """Input of the fit from one scan: edges (n, 2, 3) in the profiler's frame, and the plate."""

    edges: Array
    stage: Array  # (n, 3) of the lines of the edges
    level: float  # z of the plate at x = 0, and its standard uncertainty
    level_u: float
    lift: float
    tilt: Tilt
    depth: float  # of the pocket, m


def _scan(x: Array, height: Array, stage: Array) -> _Scan:
    plate, rim = edges.pocket(x, height)
    heights = plate.height[np.isfinite(plate.height)]
    # The carriage moves straight and the plate is level: the height of the rim is the mean over all lines.
    z = heights.mean() + plate.slope * rim.x
    positions = np.stack([rim.x, np.zeros_like(z), z], axis=-1)
    level, level_u = float(heights.mean()), float(heights.std(ddof=1) / np.sqrt(heights.size))
    return _Scan(positions, stage[rim.line], level, level_u, float(stage[0, 2]), plate, rim.depth)


def _sight(p: Array) -> Array:
    """Return the motion (2,) of the line of sight across the axis of the pocket, for each metre of depth."""
    R = pose(*p[:6]).rotation.as_matrix()
    return np.asarray(-R[:2, 2] / R[2, 2])


class _Fit:
    """Least squares over half sums and half differences of the radii of both edges of a line, the plate and the priors.

    Jitter of a line along the feed moves both its edges equally: it affects the half sum only.
    """

    def __init__(self, scans: Sequence[_Scan], pocket: Pocket, angle_prior: float | None) -> None:
        self.scans, self.pocket, self.angle_prior = scans, pocket, angle_prior
        self.edges = np.concatenate([scan.edges for scan in scans])
        self.centre = np.array(pocket.centre, dtype=float)
        self.shift = np.concatenate([scan.stage for scan in scans])[:, None] - self.centre
        self.depth = np.concatenate([np.full((len(scan.edges), 1), scan.depth) for scan in scans])
        self.size_x = self.size_y = 2e-6
        self.sight = np.zeros(2)  # motion of the line of sight across, for each metre of depth

    def solve(self) -> ProfilerPose:
        """Return the fit, its weights from its own residuals."""
        from scipy.optimize import least_squares  # takes time to import

        p = self._start()
        used = self._rim(p, pose(*p[:6]))[2] > OBLIQUE
        fitted = used
        for _ in range(4):
            if (lines := int(used.sum())) < _MIN_LINES:
                raise MethodError(
                    f"Ten lines across the pocket must fit one circle; {lines} do.", code="scan.pocket.not_round"
                )
            self.sight = _sight(p)
            solution = least_squares(self._residuals, p / _UNIT, jac=self._jacobian, args=(used,), method="lm")
            p, fitted = solution.x * _UNIT, used
            used = self._weigh(p, used)
        lines = int(fitted.sum())
        fun, jac = np.array(solution.fun), np.array(solution.jac)
        covariance = self._covariance(jac, fun, 2 * lines, self._through_sight(solution.x, fitted, fun, jac))
        covariance += np.diag([0.0, 0.0, EDGE_UNCERTAINTY / p[6], EDGE_UNCERTAINTY, EDGE_UNCERTAINTY, 0.0]) ** 2
        return ProfilerPose(p[:6], covariance, float(p[6]), self.size_x, self.size_y, lines)

    def _start(self) -> Array:
        middle = (self.edges.mean(axis=1) + self.shift[:, 0]).mean(axis=0)
        b = np.mean([-np.arctan(scan.tilt.slope) for scan in self.scans])
        return np.array([0.0, b, 0.0, *-middle, self.pocket.radius, WALL_SHARE])

    def _rim(self, p: Array, H: RigidTransform) -> tuple[Array, Array, Array, Array]:
        """Return half sum and half difference of the radii less r, m, and |cos|, |sin| of the edges, (..., n) each."""
        x, z, rows = self.edges[..., 0], self.edges[..., 2], H.as_matrix()[..., None, None]
        X, Y = (
            rows[..., k, 0, :, :] * x + rows[..., k, 2, :, :] * z + rows[..., k, 3, :, :] + self.shift[..., k]
            for k in (0, 1)
        )
        radius = np.hypot(X, Y)
        outwards = (self.sight[0] * X + self.sight[1] * Y) / radius
        of_rim = radius + p[..., 7, None, None] * np.maximum(self.depth * outwards, 0.0)
        (left, right), (cos, other_cos), (sin, other_sin) = (
            np.moveaxis(values, -1, 0) for values in (of_rim, np.abs(X / radius), Y / radius)
        )
        half_sum = (left + right) / 2 - p[..., 6, None]
        return half_sum, (right - left) / 2, np.minimum(cos, other_cos), np.abs((sin + other_sin) / 2)

    def _residuals(self, scaled: Array, used: NDArray[np.bool_]) -> Array:
        """Return all residuals (..., n) divided by their standard deviations, for scaled parameters (..., 8)."""
        p = scaled * _UNIT
        H = pose(*np.moveaxis(p[..., :6], -1, 0))
        half_sum, half_difference, cos, sin = self._rim(p, H)
        size = cos * self.size_x / np.sqrt(2)
        rows = [(half_sum / np.hypot(size, sin * self.size_y))[..., used], (half_difference / size)[..., used]]
        misses = [
            (p[..., 6] - self.pocket.radius) / max(self.pocket.radius_uncertainty, 1e-9),
            (p[..., 7] - WALL_SHARE) / WALL_UNCERTAINTY,
        ]
        R = H.rotation.as_matrix()
        for scan in self.scans:
            Z = R[..., 2, 2] * scan.level + p[..., 5] + scan.lift - self.centre[2]  # at x = 0
            slope = -R[..., 2, 0] / R[..., 2, 2]
            misses += [Z / max(scan.level_u, 1e-9), (scan.tilt.slope - slope) / max(scan.tilt.uncertainty, 1e-9)]
        rows.append(np.stack(misses, axis=-1))
        if self.angle_prior is not None:
            rows.append(p[..., :3] / self.angle_prior)
        return np.concatenate(rows, axis=-1)

    def _jacobian(self, scaled: Array, used: NDArray[np.bool_]) -> Array:
        """Return the derivatives (n, 8) of the residuals: differences for all parameters at once."""
        step = np.copysign(np.sqrt(np.finfo(float).eps) * np.maximum(np.abs(scaled), 1.0), scaled)
        ends = scaled + np.diag(step)
        here, *there = self._residuals(np.stack([scaled, *ends]), used)
        return np.asarray((np.stack(there) - here).T / (np.diag(ends) - scaled))

    def _through_sight(self, scaled: Array, used: NDArray[np.bool_], fun: Array, J: Array) -> Array:
        """Return the change (8, 8) of the scaled parameters with that of a fit at a given line of sight.

        The wall determines no angle: a sensor may see it otherwise. An error of the angles, however, changes the width
        of the wall, and thereby the other parameters and the angles again.
        """
        by_sight = np.empty((len(fun), 2))
        kept = self.sight
        for k, step in enumerate(_STEP * np.eye(2)):
            self.sight = kept + step
            by_sight[:, k] = (self._residuals(scaled, used) - fun) / _STEP
        self.sight = kept
        by_angle = np.zeros((2, len(scaled)))
        by_angle[0, 1], by_angle[1, 0] = -_UNIT[1], _UNIT[0]  # of the sight, small angles
        fed_back = -np.linalg.lstsq(J, by_sight, rcond=None)[0] @ by_angle
        return np.asarray(np.linalg.inv(np.eye(len(scaled)) - fed_back))

    def _weigh(self, p: Array, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Estimate both scatters from the residuals; return the lines within `CLIP`."""
        half_sum, half_difference, cos, sin = self._rim(p, pose(*p[:6]))
        right = np.sqrt(2) * half_difference / cos
        rough = max(scale_about_zero(right[used]), 1e-9)
        fits = (cos > OBLIQUE) & (np.abs(right) < CLIP * rough)
        self.size_x = max(float(np.sqrt(np.mean(right[fits] ** 2))), 1e-9)
        size = np.hypot(cos * self.size_x / np.sqrt(2), sin * self.size_y)
        rough = max(scale_about_zero(half_sum[fits] / size[fits]), 1e-3)
        fits &= np.abs(half_sum) < CLIP * rough * size
        along = (half_sum**2 - (cos * self.size_x) ** 2 / 2) * sin**2
        self.size_y = float(np.sqrt(max(along[fits].sum() / np.sum(sin[fits] ** 4), 1e-18)))
        return np.asarray(fits)

    def _covariance(self, J: Array, misses: Array, edges_end: int, through_sight: Array) -> Array:
        """Return the covariance (6, 6) of the pose; raise MethodError where it is not determined.

        The first ``edges_end`` residuals are those of the edges. Their scatter depends on how obliquely a line crosses
        the rim; their squares are used instead of a common variance (White 1980). The others have variance 1.
        """
        _, s, V = np.linalg.svd(J, full_matrices=False)
        inverse = V.T / np.maximum(s, 1e-12 * s[0])
        squares = np.ones(misses.size)
        squares[:edges_end] = misses[:edges_end] ** 2 * edges_end / (edges_end - _UNIT.size)
        gain = through_sight @ (inverse @ inverse.T) @ J.T
        covariance = np.asarray((gain * squares) @ gain.T * np.outer(_UNIT, _UNIT))[:6, :6]
        size = np.sqrt(np.diag(covariance))
        worst = np.repeat([WORST_ANGLE, WORST_POSITION], 3)
        unknown = [name for name, too_much in zip(PARAMETERS, size > worst, strict=True) if too_much]
        if unknown:
            raise MethodError(
                f"The scans of the pocket do not determine {', '.join(unknown)} of the profiler's pose. The angle a "
                "needs scans at two heights of the spindle, some millimetres apart, or an angle_prior, such as "
                "0.005 rad.",
                code="scan.pocket.undetermined",
            )
        covariance[3:, 3:] += np.diag(np.asarray(self.pocket.centre_uncertainty, dtype=float) ** 2)
        return covariance
