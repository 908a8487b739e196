"""Two general point clouds, which are no height maps: registered along the normals of both, with covariance.

Point-to-plane ICP of Open3D is the start. A pair of a warm point p and its nearest cold point q with the normals m and
n has the residual r = (M m + n) / 2 . (M p - q), and for a small further twist at c the row
J = ((M m + n) / 2, (M p - c) x (M m + n) / 2). With the normal of one cloud only, a curved surface between two points
is a residual of one sign, which moves the pose; with both normals it cancels (Rusinkiewicz 2019, A symmetric objective
function for ICP). The noise of a cold point is in all pairs that share it: with equal noise in both clouds and s^2 the
variance of r,

    C = H^-1 (s^2 / 2) (H + sum over q of j_q j_q^T) H^-1,   H = sum J^T J,   j_q the sum of q's rows.

The normals are noisy, so that H is never 0. A freedom counts as determined if H is many times what the noise of the
normals alone makes of it, from the points that were found around each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.datasets import DOF
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_zero
from errormotion.kinematics.poses import displaced
from errormotion.kinematics.twists import cross_matrix
from errormotion.methods.crossbeam_scan.identification.registration import clouds
from errormotion.methods.crossbeam_scan.identification.registration.clouds import Normals
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import freedoms, refuse, scales
from errormotion.methods.crossbeam_scan.identification.registration.register import Registration
from errormotion.methods.crossbeam_scan.identification.registration.solver import inverse

NOISY = 10.0
"""Information counts beyond this many times what the noise of the normals makes of nothing."""
GATE = 5.0
"""Pairs further apart along the normal than this many robust standard deviations do not count."""
ALIKE = 0.9
"""Smallest cosine between the normals of a pair."""
MIN_PAIRS = 60
"""Smallest number of pairs: ten for each freedom."""
SETTLED = 0.03
"""Largest step, in standard deviations, at which the pose has settled."""
_STEPS = 30


def register_clouds(cold: ArrayLike, warm: ArrayLike, *, point: ArrayLike | None = None) -> Registration:
    """Find how the sensor's frame has moved between two clouds of one artefact.

    Parameters
    ----------
    cold, warm : array_like (n, 3), (m, 3)
        Points, m; rows with NaN are left out. Start: no motion beyond 0.3 mm anywhere.
    point : array_like (3,), optional
        Functional point of the result, m; default: the middle of the cold cloud.

    Returns
    -------
    Registration
        Backend "open3d_plane"; its maps are empty.

    Raises
    ------
    MethodError
        Open3D is not installed, no clouds, too few points in common, or freedoms that the
        artefact leaves undetermined.
    """
    pose, _, _ = clouds.plane_icp(cold, warm)
    old, new = (each[np.isfinite(each).all(axis=1)] for each in (np.asarray(c, dtype=float) for c in (cold, warm)))
    middle = old.mean(axis=0)
    surfaces = [clouds.normals(each) for each in (old, new)]
    radius = float(np.sqrt(np.mean(np.sum((old - middle) ** 2, axis=1))))
    steps = 0
    while steps < _STEPS:
        steps += 1
        pairs = _pairs(old, new, surfaces, pose, middle)
        H = pairs.J.T @ pairs.J
        free = freedoms(H, len(pairs.J), NOISY * pairs.of_noise, radius)
        unit = scales(radius, 0)
        inverted = inverse(H * np.outer(unit, unit), free.motions) * np.outer(unit, unit)
        covariance = pairs.covariance(H, inverted)
        step = -inverted @ (pairs.J.T @ pairs.residual)
        pose = displaced(step, middle) * pose
        if float(step @ H @ step) <= SETTLED**2 * pairs.variance * 6:
            break
    refuse(free, "a cloud")
    sigma = float(np.sqrt(0.5 * pairs.variance))
    covariance = covariance + np.outer(step, step)
    own = Registration(
        backend="open3d_plane", pose=pose, point=middle, covariance=covariance, residual=np.empty((0, 0)),
        x=np.empty(0), y=np.empty(0), rms=pairs.rms, points=len(pairs.J), noise=(sigma, sigma), line_jitter=(0.0, 0.0),
        condition=free.condition, loose=free.loose, iterations=steps, extra_names=(), extra=np.empty(0),
        joint_covariance=covariance, cold_share=0.5,
    )  # fmt: skip
    if point is None:
        return own
    at = np.asarray(point, dtype=float)
    elsewhere = own.at(at)[1]
    return replace(own, point=at, covariance=elsewhere, joint_covariance=elsewhere)


@dataclass(frozen=True)
class _Pairs:
    """Pairs of nearest points at a pose.

    Attributes
    ----------
    residual : ndarray (n,)
        Distance along the mean normal, m.
    J : ndarray (n, 6)
    of_noise : ndarray (6, 6)
        Expected part of J^T J that the noise of the normals makes.
    shared : ndarray of int (n,)
        Number of the cold point of each pair.
    rms : float
        Root mean square distance of the pairs, m.
    """

    residual: Array
    J: Array
    of_noise: Array
    shared: NDArray[np.int64]
    rms: float

    @property
    def variance(self) -> float:
        """Variance of the residuals, m^2."""
        return float(np.sum(self.residual**2) / max(len(self.residual) - 6, 1))

    def covariance(self, H: Array, inverted: Array) -> Array:
        of_point = np.column_stack([np.bincount(self.shared, weights=column) for column in self.J.T])
        C: Array = 0.5 * self.variance * inverted @ (H + of_point.T @ of_point) @ inverted
        return C


def _pairs(old: Array, new: Array, surfaces: list[Normals], pose: RigidTransform, middle: Array) -> _Pairs:
    """Return the pairs at a pose; raise MethodError for too few of them."""
    cold, warm = surfaces
    moved = np.asarray(pose.apply(new))
    apart, nearest = (np.asarray(each) for each in cKDTree(old).query(moved, distance_upper_bound=clouds.NEAREST))
    near = np.isfinite(apart)
    q = nearest[near]
    p, ahead, n = moved[near], pose.rotation.apply(warm.vectors[near]), cold.vectors[q]
    cosine = np.sum(ahead * n, axis=1)
    normal = 0.5 * (n + np.sign(cosine)[:, None] * ahead)
    residual = np.sum(normal * (p - old[q]), axis=1)
    alike = np.abs(cosine) >= ALIKE
    scale = scale_about_zero(residual[alike]) if alike.any() else 0.0
    used = alike & (np.abs(residual) <= GATE * scale)
    if used.sum() < MIN_PAIRS:
        raise MethodError(
            f"expected {MIN_PAIRS} pairs of points or more on the common surface of both clouds, found "
            f"{int(used.sum())}, which leaves {', '.join(DOF)} undetermined; check that both show the same piece, and "
            "measure more points",
            code="registration.pairs.too_few",
        )
    J = np.hstack([normal, np.cross(p - middle, normal)])[used]
    tilt = (0.25 * (cold.tilt[q] + warm.tilt[near]))[used]
    _, shared = np.unique(q[used], return_inverse=True)
    rms = float(np.sqrt(np.mean(apart[near][used] ** 2)))
    return _Pairs(residual[used], J, _of_tilted_normals(p[used] - middle, tilt), shared, rms)


def _of_tilted_normals(arm: Array, variance: Array) -> Array:
    """Return what normals with a variance (n,) about every direction add to the information of points at ``arm``."""
    moved = np.concatenate([np.tile(np.eye(3), (len(arm), 1, 1)), cross_matrix(arm)], axis=1)
    return np.asarray(np.einsum("n,nik,njk->ij", variance, moved, moved))
