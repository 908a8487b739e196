"""Point clouds registered by Open3D: point-to-plane ICP, and the published chain, for comparison.

Both match every point with its nearest neighbour. They serve clouds that are no height map, and show what the height
map gains. The published chain trims 20 points (250 um) off the edges, removes statistical outliers, and runs the normal
distributions transform before point-to-point ICP (Zhao et al., section 3.2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.errors import MethodError

Scan = tuple[NDArray[np.float32], Array, Array]
Found = tuple[RigidTransform, float, int]

EDGE = 20
"""Points trimmed off both ends of every profile."""
NEAREST = 0.3e-3
"""Points further apart than this, m, are no pair."""
CELL = 1e-3
"""Edge of the cells of the normal distributions transform, m."""
_NORMAL_RADIUS = 0.25e-3
_NEIGHBOURS = 30
MIN_NEIGHBOURS = 12
"""Smallest number of points of a plane, those beyond 0.25 mm included."""
_AT_ONCE = 20_000
"""Points whose neighbours are in memory at once."""
_ICP_STEPS = 60


def open3d() -> Any:
    """Return the module; raise MethodError with the command that installs it.

    Raises
    ------
    MethodError
        Open3D is not installed.
    """
    import numba

    numba.get_num_threads()  # its threads start before Open3D loads a TBB of its own, which numba would warn of
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        raise MethodError(
            f"expected Open3D for this registration, found none ({error}); install the extra with "
            '"pip install \'errormotion[open3d]\'" (Python below 3.13), or choose registration = "height_map"',
            code="package.missing",
        ) from error
    return module


def points_of(scan: Scan, edge: int = 0) -> Array:
    """Return the points (n, 3) of a height map that have a value, without ``edge`` columns at both ends."""
    z, x, y = scan
    kept = slice(edge, z.shape[1] - edge)
    height = z[:, kept].astype(float)
    X, Y = np.meshgrid(x[kept], y)
    known = np.isfinite(height)
    return np.column_stack([X[known], Y[known], height[known]])


def plane_icp(cold: ArrayLike, warm: ArrayLike) -> Found:
    """Register two clouds (n, 3), m, by point-to-plane ICP; normals from neighbours within 0.25 mm.

    Returns
    -------
    pose : RigidTransform
        Takes the warm cloud onto the cold one.
    rms : float
        Root mean square distance of the pairs, m.
    iterations : int
        The largest possible number: Open3D does not report it.
    """
    o3d = open3d()
    target, source = _cloud(o3d, cold), _cloud(o3d, warm)
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(_NORMAL_RADIUS, _NEIGHBOURS))
    method = o3d.pipelines.registration.TransformationEstimationPointToPlane()
    return _icp(o3d, source, target, np.eye(4), method)


@dataclass(frozen=True)
class Normals:
    """Normals of a cloud's points, from the points around them.

    Attributes
    ----------
    vectors : ndarray (n, 3)
        Unit normals, of either sign.
    tilt : ndarray (n,)
        Variance of a normal's tilt about one direction, rad^2.
    """

    vectors: Array
    tilt: Array


def normals(points: Array) -> Normals:
    """Return the normals of a cloud (n, 3), m, from planes through the points around: within 0.25 mm, and 12 at least.

    The tilt of a plane through m points is that of their scatter about it over their spread and m - 3. Curvature counts
    as scatter, and it does tilt the plane where the points around are unevenly spread.
    """
    tree = cKDTree(points)
    vectors, tilt = np.empty(points.shape), np.empty(len(points))
    for first in range(0, len(points), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        distance, near = tree.query(points[part], _NEIGHBOURS)
        there = (distance <= _NORMAL_RADIUS) | (np.arange(_NEIGHBOURS) < MIN_NEIGHBOURS)
        m = there.sum(axis=1)
        around = np.where(there[..., None], points[near] - points[part, None], 0.0)
        middle = around.sum(axis=1) / m[:, None]
        spread = np.einsum("nki,nkj->nij", around, around) / m[:, None, None] - middle[:, :, None] * middle[:, None]
        values, axes = np.linalg.eigh(spread)
        vectors[part] = axes[:, :, 0]
        tilt[part] = np.maximum(values[:, 0], 0.0) / np.maximum(values[:, 1], np.finfo(float).tiny) / (m - 3)
    return Normals(vectors, tilt)


def published_chain(cold: ArrayLike, warm: ArrayLike) -> Found:
    """Register two clouds (n, 3), m: statistical outlier removal, NDT, point-to-point ICP; returns as `plane_icp`."""
    o3d = open3d()
    target, source = (_cloud(o3d, cloud).remove_statistical_outlier(20, 2.0)[0] for cloud in (cold, warm))
    fine = o3d.pipelines.registration
    start = np.eye(4)
    if hasattr(fine, "registration_ndt"):
        start = fine.registration_ndt(source, target, ndt_option(o3d), start).transformation
    return _icp(o3d, source, target, start, fine.TransformationEstimationPointToPoint())


def ndt_option(o3d: Any) -> Any:
    """Return the options of the normal distributions transform: tolerances far below a micrometre."""
    return o3d.pipelines.registration.NormalDistributionsTransformOption(
        voxel_size=CELL, transformation_epsilon=1e-9, relative_objective=1e-9, max_iteration=60
    )


def _cloud(o3d: Any, points: ArrayLike) -> Any:
    values = np.asarray(points, dtype=float)
    if values.ndim != 2 or values.shape[1] != 3 or len(values) < 100:
        raise MethodError(
            f"expected a cloud of shape (n, 3) with at least 100 points, found {values.shape}",
            code="registration.cloud.shape",
        )
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(values[np.isfinite(values).all(axis=1)]))


def _icp(o3d: Any, source: Any, target: Any, start: Array, method: Any) -> Found:
    """Run ICP with tolerances below the noise of the pose."""
    fine = o3d.pipelines.registration
    criteria = fine.ICPConvergenceCriteria(1e-10, 1e-12, _ICP_STEPS)
    registered = fine.registration_icp(source, target, NEAREST, start, method, criteria)
    if registered.fitness == 0:
        raise MethodError(
            f"expected clouds that lie within {NEAREST * 1e3:g} mm of one another, found none of the points to do so; "
            "check units and the order of the scans",
            code="registration.clouds.apart",
        )
    return RigidTransform.from_matrix(np.array(registered.transformation)), float(registered.inlier_rmse), _ICP_STEPS


BACKENDS: dict[str, Callable[[Scan, Scan], Found]] = {
    "open3d_plane": lambda cold, warm: plane_icp(points_of(cold), points_of(warm)),
    "paper": lambda cold, warm: published_chain(points_of(cold, EDGE), points_of(warm, EDGE)),
}
