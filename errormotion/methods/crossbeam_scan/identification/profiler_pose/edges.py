"""Tilt and height of each line of a scan of a level plate with a circular pocket, and the edges of the pocket.

An edge is determined to a fraction of the point pitch from the area under the step: with the height g normalised to 0
(floor) and 1 (plate), the distance of a falling edge from the start of a window is the sum of g times the pitch. This
is true for any symmetrical spot at any sampling phase. Where the line of sight is tilted, the wall of the pocket is in
the picture on one side, as a slope between plate and floor or without readings: the edge is then somewhere on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_zero

Mask = NDArray[np.bool_]

#: Width beside an edge that stray light may disturb, and width of the floor that is used next to it, m.
TRIM, FLOOR = 250e-6, 1.5e-3
#: Points farther from their line than this many standard deviations are excluded.
CLIP = 4.5
#: Largest accepted share of missing points in the window of an edge.
GAPS = 0.4


@dataclass(frozen=True)
class Tilt:
    """The common slope of the lines on a plane.

    Attributes
    ----------
    slope, uncertainty : float
        dz/dx and its standard uncertainty, from the scatter of the lines: effects correlated along a line are included.
    height : ndarray, (line,)
        z of each line at x = 0 under the common slope, m; NaN without points.
    """

    slope: float
    uncertainty: float
    height: Array


@dataclass(frozen=True)
class Edges:
    """Both edges of a pocket on the lines that cross it.

    Attributes
    ----------
    line : ndarray of int, (n,)
        Index of the line.
    x : ndarray, (n, 2)
        Left and right edge, m.
    z : ndarray, (n, 2)
        Height of the plate there, m.
    depth : float
        Of the floor below the plate, m.
    """

    line: NDArray[np.int64]
    x: Array
    z: Array
    depth: float


def tilt(x: Array, height: Array) -> Tilt:
    """Return the slope of a plane along the profiles, and the height of each of them.

    Parameters
    ----------
    x : (point,)
        m.
    height : (line, point)
        m; NaN = no reading, or not on the plane.

    Raises
    ------
    MethodError
        Fewer than three lines with a hundred points each.
    """
    used = np.isfinite(height)
    for _ in range(3):
        n = used.sum(axis=1)
        full = n >= 100
        if full.sum() < 3:
            raise MethodError(
                f"The tilt needs three lines with 100 points on the plane; found {int(full.sum())} of {len(height)} "
                "lines. Check the unit of the heights and that the plane lies in the measuring range.",
                code="scan.pocket.plane_missing",
            )
        z = np.where(used, height, 0.0)
        mean_x, mean_z = (used @ x) / np.maximum(n, 1), z.sum(axis=1) / np.maximum(n, 1)
        spread = used @ x**2 - n * mean_x**2
        slopes = (z @ x - n * mean_x * mean_z)[full] / spread[full]
        weights = spread[full] / spread[full].sum()
        slope = float(weights @ slopes)
        residual = height - np.where(n > 0, mean_z - slope * mean_x, np.nan)[:, None] - slope * x
        size = scale_about_zero(residual[used])
        used &= np.abs(np.where(np.isfinite(residual), residual, np.inf)) <= CLIP * max(size, 1e-12)
    count = slopes.size
    # variance of a weighted mean, from the scatter about it
    variance = float(weights**2 @ (slopes - slope) ** 2) * count / (count - 1)
    return Tilt(slope, float(np.sqrt(variance)), np.where(full, mean_z - slope * mean_x, np.nan))


def pocket(x: Array, height: Array) -> tuple[Tilt, Edges]:
    """Return the plate around a pocket and the edges of the pocket.

    Parameters
    ----------
    x : (point,)
        Evenly spaced, increasing, m.
    height : (line, point)
        m; NaN = no reading.

    Raises
    ------
    MethodError
        There are no two levels, or fewer than ten lines with both edges.
    """
    pitch = float(x[1] - x[0])
    low, high = np.nanpercentile(height, [2, 98]) if np.isfinite(height).any() else (np.nan, np.nan)
    deep = height < (low + high) / 2
    inside = _spans(deep)
    if high - low < 0.2e-3 or inside.sum() < 10:
        raise MethodError(
            f"Expected a circular pocket at least 0.2 mm deep, with ten lines across it; found levels {low * 1e3:.4g} "
            f"and {high * 1e3:.4g} mm, and {int(inside.sum())} lines. Check the unit and that the pocket was scanned.",
            code="scan.pocket.not_round",
        )
    trim = max(round(TRIM / pitch), 3)
    first, last = np.argmax(deep, axis=1), x.size - 1 - np.argmax(deep[:, ::-1], axis=1)
    index = np.arange(x.size)
    beside = ~np.any(deep, axis=1, keepdims=True) | (index < first[:, None] - trim) | (index > last[:, None] + trim)
    seen = np.isfinite(height)
    start, end = np.argmax(seen, axis=1), x.size - 1 - np.argmax(seen[:, ::-1], axis=1)
    within = (index >= start[:, None] + trim) & (index <= end[:, None] - trim)
    plate = tilt(x, np.where(beside & within, height, np.nan))
    lines = np.flatnonzero(inside & np.isfinite(plate.height))
    step = height[lines] - (plate.height[lines, None] + plate.slope * x)
    ends = [_edges(x, step, index[lines], trim, side) for index, side in ((first, 1), (last, -1))]
    positions = np.stack(ends, axis=-1)
    valid = np.isfinite(positions).all(axis=1)
    line, at = lines[valid], positions[valid]
    if line.size < 10:
        raise MethodError(
            f"Expected ten lines with both edges of the pocket; found {line.size}. Too many readings are missing at "
            "the edges, or the pocket is not completely in the scan.",
            code="scan.pocket.edges_missing",
        )
    floor = (index > first[lines, None] + trim) & (index < last[lines, None] - trim)
    depth = -float(np.nanmedian(np.where(floor, step, np.nan)))
    return plate, Edges(line, at, plate.height[line, None] + plate.slope * at, depth)


def _spans(deep: Mask) -> Mask:
    """Return the lines that cross the pocket: deep over some of their points, but not at their ends."""
    many = deep.sum(axis=1) >= max(0.02 * deep.shape[1], 8)
    return np.asarray(many & ~deep[:, :4].any(axis=1) & ~deep[:, -4:].any(axis=1))


def _edges(x: Array, step: Array, index: NDArray[np.int64], trim: int, side: int) -> Array:
    """Return the position of the edge near a point of each line, m; NaN without one.

    Parameters
    ----------
    x : (point,)
        m.
    step : (line, point)
        Height above the plate, m.
    index : (line,)
        The point.
    trim : int
        Number of points beside an edge that stray light may disturb.
    side : {1, -1}
        1 where the floor is at the right.
    """
    pitch = float(x[1] - x[0])
    width = round(FLOOR / pitch)
    window = np.arange(-trim, trim + 1)
    beyond = trim + np.arange(width) if side > 0 else np.arange(-trim - width, -trim)
    at = np.full(index.size, np.nan)
    first, end = min(window[0], beyond[0]), max(window[-1], beyond[-1] + 1)
    rows = np.flatnonzero((index + first >= 0) & (index + end < x.size))
    floor = np.sort(step[rows[:, None], index[rows, None] + beyond], axis=1)  # NaN last
    count = np.isfinite(floor).sum(axis=1)
    seen = count >= trim
    rows, floor, count = rows[seen], floor[seen], count[seen]
    row = np.arange(rows.size)
    level = (floor[row, (count - 1) // 2] + floor[row, count // 2]) / 2
    g = 1 - step[rows[:, None], index[rows, None] + window] / level[:, None]
    known = np.isfinite(g)
    usable = ~(np.mean(~known, axis=1) > GAPS) & known[:, 0] & known[:, -1]
    rows, g, known = rows[usable], np.clip(g[usable], 0.0, 1.0), known[usable]
    for k in np.flatnonzero(~known.all(axis=1)):
        g[k] = np.interp(window, window[known[k]], g[k, known[k]])
    share = g.sum(axis=1) * pitch
    at[rows] = x[index[rows] - side * trim] - side * pitch / 2 + side * share
    return at
