"""Result of a registration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification.registration.extra import Extra


@dataclass(frozen=True)
class Registration:
    """Pose of the warm scan's frame in the cold scan's frame, with its covariance.

    Attributes
    ----------
    backend : str
        The backend that was used.
    pose : RigidTransform
        M: takes a point from the warm frame to the cold one. Extra parameters come after it and leave ``point``
        where it is: p of the warm frame is at ``point`` + (1 + sum e G) (M p - ``point``) of the cold one.
    point : ndarray (3,)
        Functional point of twist and covariance, in profiler coordinates, m.
    covariance : ndarray (6, 6)
        Of the twist at ``point``, m^2, m rad, rad^2; NaN for freedoms that the artefact does not determine, and all
        NaN where a backend gives none.
    residual : ndarray (block row, block column)
        Distance of the warm blocks from the cold surface along z, m; NaN where there is none. Empty for clouds.
    x, y : ndarray
        Centres of the blocks in the warm frame, m.
    rms : float
        Root mean square of the residuals of the backend, m. It gives no information about the accuracy of the pose.
    points : int
        Points used of the warm scan.
    noise : tuple of float
        Standard deviation of a point about the surface, cold and warm, m.
    line_jitter : tuple of float
        Standard deviation, both scans together, of a profile's shift along z and along y, m; 0 where none shows.
    condition : float
        Of the information, rotations scaled by the artefact's radius.
    loose : tuple of str
        Freedoms that the artefact does not determine.
    iterations : int
        Steps taken.
    extra_names : tuple of str
        Further parameters that were estimated.
    extra : ndarray (k,)
        Their values: each displaces a point P of the cold frame by its matrix times (P - ``point``).
    joint_covariance : ndarray (6 + k, 6 + k)
        Of the twist at ``point`` and the further parameters; ``covariance`` is its first block.
    cold_share : float
        Share of the covariance that comes from the noise of the cold scan, which all warm scans registered onto it have
        in common.
    """

    backend: str
    pose: RigidTransform
    point: Array
    covariance: Array
    residual: Array
    x: Array
    y: Array
    rms: float
    points: int
    noise: tuple[float, float]
    line_jitter: tuple[float, float]
    condition: float
    loose: tuple[str, ...]
    iterations: int
    extra_names: tuple[str, ...]
    extra: Array
    joint_covariance: Array
    cold_share: float
    variance_factor: float = 1.0

    @property
    def twist(self) -> Array:
        """How the profiler moved: (EX, EY, EZ, EA, EB, EC) at ``point``, m and rad."""
        return poses.displacement(self.pose, self.point)

    @property
    def sigma(self) -> Array:
        """Standard uncertainties of the twist, (6,), m and rad."""
        return np.sqrt(np.diag(self.covariance))

    def at(self, point: Array) -> tuple[Array, Array]:
        """Return twist (6,) and covariance (6, 6) at another point (3,) of the profiler's frame, m."""
        twist, _, covariance = self.joint_at(point)
        return twist, covariance[:6, :6]

    def joint_at(self, point: Array) -> tuple[Array, Array, Array]:
        """Return twist (6,), extra parameters (k,) and their covariance (6 + k, 6 + k) about another point (3,), m."""
        terms = Extra.of(dict.fromkeys(self.extra_names, np.inf))
        shift = np.asarray(point, dtype=float) - self.point
        pose = terms.pose_about(self.pose, self.extra, shift)
        return poses.displacement(pose, point), self.extra, terms.moved(self.joint_covariance, shift)
