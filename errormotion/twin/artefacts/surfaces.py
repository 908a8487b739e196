"""The compiled loops of the line profiler: surfaces, rays on them, and the disturbances of a real sensor.

A surface consists of a number for its shape, a vector of parameters and a table, so that one loop without calls into
Python evaluates all shapes. All lengths are in metres, in the frame of the artefact: z up, 0 in the middle of its top.
"""

from __future__ import annotations

import math
from typing import cast

import numba
import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.twin.kernels import Function, compiled, mixed, normal

#: Shapes.
FREEFORM, PLANE, SPHERE, POCKET = 0, 1, 2, 3
#: Number of parameters: half size in x and y; then for the free form x0, y0 (of the first coefficient) and knots per
#: metre, for the sphere its radius, for the pocket radius, depth and spot.
PARAMETERS = 5
#: Newton's iteration on a ray: largest last step, m, and largest number of steps.
STEP, STEPS = 1e-13, 20

_ROOT_2, _ROOT_2_PI = math.sqrt(2.0), math.sqrt(2.0 * math.pi)
_NO_WALL = 1e-6
"""Width of a wall in the picture, relative to the spot, below which it is not seen."""
_GOLDEN, _S11 = np.uint64(0x9E3779B97F4A7C15), np.uint64(11)


def inlined(function: Function) -> Function:
    """Make a function a part of the compiled functions that call it; a call would take as long as the function."""
    return cast(Function, numba.njit(inline="always")(function))


@inlined
def weights(f: float) -> tuple[float, float, float, float, float, float, float, float]:
    """Return the four cubic B-splines at a position 0 <= f < 1 between two knots, and their derivatives."""
    g = 1.0 - f
    return (
        g * g * g / 6.0,
        (4.0 - 3.0 * f * f * (2.0 - f)) / 6.0,
        (4.0 - 3.0 * g * g * (2.0 - g)) / 6.0,
        f * f * f / 6.0,
        -0.5 * g * g,
        0.5 * f * (3.0 * f - 4.0),
        -0.5 * g * (3.0 * g - 4.0),
        0.5 * f * f,
    )


@inlined
def freeform(p: Array, table: Array, x: float, y: float) -> tuple[float, float, float]:
    """Return height and both slopes of a bicubic spline; the outermost cell is continued beyond the table."""
    u = (x - p[2]) * p[4]
    v = (y - p[3]) * p[4]
    i = min(max(math.floor(u), 1), table.shape[0] - 3)
    j = min(max(math.floor(v), 1), table.shape[1] - 3)
    a = weights(u - i)
    b = weights(v - j)
    z = zx = zy = 0.0
    for k in range(4):
        row = slope = 0.0
        for m in range(4):
            c = table[i - 1 + k, j - 1 + m]
            row += b[m] * c
            slope += b[4 + m] * c
        z += a[k] * row
        zx += a[4 + k] * row
        zy += a[k] * slope
    return z, zx * p[4], zy * p[4]


@inlined
def surface(shape: int, p: Array, table: Array, x: float, y: float) -> tuple[float, float, float]:
    """Return height and both slopes of a smooth surface; NaN off the surface."""
    if shape == FREEFORM:
        return freeform(p, table, x, y)
    if shape == SPHERE:
        below = p[2] * p[2] - x * x - y * y
        if below <= 0.0:
            return math.nan, math.nan, math.nan
        root = math.sqrt(below)
        return root - p[2], -x / root, -y / root
    return 0.0, 0.0, 0.0


@compiled
def edge_distance(shape: int, p: Array, x: float, y: float) -> float:
    """Return the distance of a position from the nearest edge, m, negative off the artefact."""
    inside = min(p[0] - abs(x), p[1] - abs(y))
    if shape == SPHERE:
        inside = min(inside, p[2] - math.hypot(x, y))
    if shape == POCKET and inside > 0.0:
        inside = min(inside, abs(p[2] - math.hypot(x, y)))
    return float(inside)


@compiled
def _positive_part(mean: float, spread: float) -> float:
    """Return the mean of max(0, X) of a normal X."""
    u = mean / spread
    return mean * 0.5 * (1.0 + math.erf(u / _ROOT_2)) + spread * math.exp(-0.5 * u * u) / _ROOT_2_PI


@compiled
def _pocket(p: Array, pose: Array, x: float, steepest: float) -> tuple[float, float, float]:
    """Return the point of a ray on a pocket: z in the profiler's frame, and x, y at the rim in the artefact's frame.

    A ray that is tilted to the outside on its way down ends on the wall, where it meets it above the floor; on the
    other side of the pocket the plate hides the wall. At the edges, the reading is the mean over the spot. z is NaN
    in the middle of the wall, if it is steeper than ``steepest`` in the profiler's frame.
    """
    z = -(pose[2, 3] + pose[2, 0] * x) / pose[2, 2]
    qx = pose[0, 0] * x + pose[0, 2] * z + pose[0, 3]
    qy = pose[1, 0] * x + pose[1, 2] * z + pose[1, 3]
    radius = math.hypot(qx, qy)
    inside = p[2] - radius
    outwards = -(pose[0, 2] * qx + pose[1, 2] * qy) / (pose[2, 2] * max(radius, p[4]))  # per depth of the ray
    wall = outwards * p[3]
    if wall <= _NO_WALL * p[4]:
        depth = p[3] * 0.5 * (1.0 + math.erf(inside / (p[4] * _ROOT_2)))
        return z - depth / pose[2, 2], qx, qy
    if 0.0 < inside < wall and outwards * steepest < 1.0:
        return math.nan, qx, qy
    depth = (_positive_part(inside, p[4]) - _positive_part(inside - wall, p[4])) / outwards
    return z - depth / pose[2, 2], qx, qy


@compiled
def profile(
    shape: int, p: Array, table: Array, pose: Array, x: Array, out: Array, edge: NDArray[np.float32], steepest: float
) -> None:
    """Fill one line of heights: intersections of the rays x, 0, z of the profiler's frame with the surface.

    Parameters
    ----------
    pose : ndarray, (4, 4)
        From the profiler's frame to the artefact's.
    x : ndarray, (point,)
        m, along the line.
    out : ndarray, (point,)
        z in the profiler's frame, m; NaN off the artefact, and where the surface is steeper than ``steepest``.
    edge : ndarray, (point,)
        Distance to the nearest edge, m.
    """
    z = -pose[2, 3] / pose[2, 2]
    for i in range(x.size):
        out[i] = math.nan
        edge[i] = -1.0
        if shape == POCKET:
            height, qx, qy = _pocket(p, pose, x[i], steepest)
            edge[i] = edge_distance(shape, p, qx, qy)
            if edge[i] >= 0.0:
                out[i] = height
            continue
        s = sx = sy = 0.0
        for _ in range(STEPS):
            qx = pose[0, 0] * x[i] + pose[0, 2] * z + pose[0, 3]
            qy = pose[1, 0] * x[i] + pose[1, 2] * z + pose[1, 3]
            s, sx, sy = surface(shape, p, table, qx, qy)
            miss = pose[2, 0] * x[i] + pose[2, 2] * z + pose[2, 3] - s
            dz = miss / (pose[2, 2] - sx * pose[0, 2] - sy * pose[1, 2])
            z -= dz
            if not abs(dz) > STEP:
                break
        if math.isnan(z) or abs(dz) > STEP:
            z = -pose[2, 3] / pose[2, 2]
            continue
        edge[i] = edge_distance(shape, p, qx, qy)
        # slope in the profiler's frame: the normal (-sx, -sy, 1), rotated back
        nx = -sx * pose[0, 0] - sy * pose[1, 0] + pose[2, 0]
        ny = -sx * pose[0, 1] - sy * pose[1, 1] + pose[2, 1]
        nz = -sx * pose[0, 2] - sy * pose[1, 2] + pose[2, 2]
        if edge[i] >= 0.0 and nx * nx + ny * ny <= (steepest * nz) ** 2:
            out[i] = z


@compiled
def uniform(key: np.uint64, index: int) -> float:
    """Return the number ``index`` of the stream ``key``, uniform from 0 to 1."""
    return np.float64(mixed(key + np.uint64(index) * _GOLDEN) >> _S11) * 2.0**-53


@compiled
def scan(
    shape: int,
    p: Array,
    table: Array,
    poses: Array,
    x: Array,
    out: Array,
    sizes: Array,
    low: float,
    high: float,
    keys: NDArray[np.uint64],
) -> None:
    """Fill a scan, line by line: rays on the surface, then the sensor's own errors.

    Parameters
    ----------
    poses : ndarray, (line, 4, 4)
        Profiler to artefact, m.
    x : ndarray, (point,)
        m.
    out : ndarray, (line, point)
        Heights, m; NaN = none.
    sizes : ndarray, (11,)
        Noise, jitter of a line in z, speckle (m), correlation of the speckle of neighbouring points, largest slope,
        lift at an edge and its range (m), share of points lost at an edge, share of outliers and their spread
        (m), share of points lost elsewhere.
    low, high : float
        Measuring range, m.
    keys : ndarray of uint64, (6,)
        Streams: noise, jitter, speckle, edges, outliers, losses.
    """
    noise, jitter, speckle, keep, steepest, lift, reach, lost_at_edge, outliers, spread, lost = sizes
    fresh = math.sqrt(1.0 - keep * keep)
    edge = np.empty(x.size, dtype=np.float32)
    for k in range(poses.shape[0]):
        profile(shape, p, table, poses[k], x, out[k], edge, steepest)
        of_line = jitter * normal(keys[1], k) if jitter > 0.0 else 0.0
        grain = normal(keys[2], k * (x.size + 1) + x.size) if speckle > 0.0 else 0.0
        for i in range(x.size):
            n = k * (x.size + 1) + i
            if speckle > 0.0:
                grain = keep * grain + fresh * normal(keys[2], n)
            z = out[k, i]
            if math.isnan(z):
                continue
            z += of_line + speckle * grain
            if noise > 0.0:
                z += noise * normal(keys[0], n)
            if edge[i] < reach:
                z += lift * math.exp(-3.0 * edge[i] / reach) * (1.0 + 0.5 * normal(keys[3], n))
                if 3.0 * edge[i] < reach and uniform(keys[3], -1 - n) < lost_at_edge:
                    z = math.nan
            if outliers > 0.0 and uniform(keys[4], n) < outliers:
                z += spread * normal(keys[4], -1 - n)
            if lost > 0.0 and uniform(keys[5], n) < lost:
                z = math.nan
            out[k, i] = z if low <= z <= high else math.nan


@compiled
def heights(shape: int, p: Array, table: Array, x: Array, y: Array, out: Array) -> None:
    """Fill ``out`` (n,) with the heights of an artefact at positions x, y (n,), m; NaN off it."""
    for i in range(x.size):
        out[i] = math.nan
        if edge_distance(shape, p, x[i], y[i]) >= 0.0:
            out[i] = surface(shape, p, table, x[i], y[i])[0]
            if shape == POCKET:
                out[i] = -p[3] * 0.5 * (1.0 + math.erf((p[2] - math.hypot(x[i], y[i])) / (p[4] * _ROOT_2)))
