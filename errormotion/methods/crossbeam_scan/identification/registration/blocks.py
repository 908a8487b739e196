"""A height map reduced to blocks of 4 profiles by 16 points: height, slopes and noise of each, in one pass.

The mean of a block of width h is the height at its centre plus z'' h^2 / 24, for points at a pitch p plus
z'' (h^2 - p^2) / 24. Second differences of the means take this out. A block in which points are missing or wrong is
fitted again by medians and a plane through what lies near it; the same correction follows from the points that are
left. A block with too few points, or that no plane explains, is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.robust import NORMAL_MAD
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import Moments
from errormotion.methods.crossbeam_scan.identification.registration.kernels.planes import COLUMNS, FEWEST, POINTS, ROWS
from errormotion.methods.crossbeam_scan.identification.registration.reduction import (
    blocks_of,
    reduce_blocks,
    robust_planes,
)
from errormotion.methods.crossbeam_scan.identification.registration.surface import Surface, repaired

LARGEST = 1.0
"""Largest size of an artefact, m; larger numbers are taken for millimetres."""
COMPILED_FROM = 60_000_000
"""Points of a campaign from which loops are compiled: less than these take less time than to compile them."""
MIN_BLOCKS = 8
BESIDE_HOLE = 3.0
"""Factor on the variance of blocks next to a hole, because the filled heights are not measured."""
THIN = 4
_SAMPLED = 64
_FEW = 2500


@dataclass(frozen=True)
class BlockMap:
    """A scan as `prepare` leaves it.

    Attributes
    ----------
    x, y : ndarray
        Centres of the block columns and block rows in the profiler's frame, m, evenly spaced.
    height : ndarray (block row, block column)
        Height of the surface at the centres, m; filled in from around where ``variance`` is infinite.
    slope_x, slope_y : ndarray (block row, block column)
        Slopes of the blocks.
    variance : ndarray (block row, block column)
        Variance of the height from the scatter of the points, m^2; infinite where the block was dropped.
    points : ndarray (block row, block column)
        Points used.
    noise : float
        Standard deviation of a point about the surface, m; line jitter shows in it in part.
    slope_noise : float
        Standard deviation of the blocks' slopes, the larger of both directions.
    scan : tuple of ndarray
        The height map, its x and its y, as given.
    compiled : bool
        Whether compiled loops work on it and on what is registered onto it.
    """

    x: Array
    y: Array
    height: Array
    slope_x: Array
    slope_y: Array
    variance: Array
    points: NDArray[np.int64]
    noise: float
    slope_noise: float
    scan: tuple[NDArray[np.float32], Array, Array] = field(repr=False)
    compiled: bool = False

    @property
    def pitch(self) -> tuple[float, float]:
        """Distance of the block centres along x and y, m."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which blocks are known, (block row, block column)."""
        return np.isfinite(self.variance)

    @cached_property
    def centre(self) -> Array:
        """Middle of the known surface, (3,), m."""
        known = self.known
        columns, rows = known.sum(axis=0), known.sum(axis=1)
        total = np.array([columns @ self.x, rows @ self.y, self.height[known].sum()])
        return np.asarray(total / rows.sum())

    @cached_property
    def surface(self) -> Surface:
        """The surface between the blocks, as a spline."""
        return Surface.through(self.height, self.x, self.y)

    @property
    def bending(self) -> float:
        """Standard deviation of a block's points about its plane because the surface is curved, m.

        Beyond 1.5 times the noise the blocks are too large for the surface: what lies between them is not known to the
        covariance that a registration states.
        """
        along_x, along_y = np.diff(self.height, 2, axis=1), np.diff(self.height, 2, axis=0)
        # x^2 / 2 over a width h has the variance h^4 / 720.
        return float(np.sqrt((np.mean(along_x**2) + np.mean(along_y**2)) / 720.0))

    @cached_property
    def usual_variance(self) -> float:
        """Median variance of a block's height, m^2."""
        return sampled_median(self.variance)

    @cached_property
    def moments(self) -> Moments:
        """Information of the slopes of every fourth block along both directions about motions."""
        some = slice(THIN // 2, None, THIN)
        known = self.known[some, some]
        x, y = np.meshgrid(self.x[some] - self.centre[0], self.y[some] - self.centre[1])
        p = np.stack([np.ones_like(x), x, y, self.height[some, some] - self.centre[2]])[:, known]
        q = np.concatenate([-self.slope_x[some, some][known] * p, -self.slope_y[some, some][known] * p, p])
        return Moments(q @ q.T, q[8:] @ q[8:].T, q.shape[1])


def prepare(height: ArrayLike, x: ArrayLike, y: ArrayLike, scans: int = 1) -> BlockMap:
    """Reduce a scan to blocks.

    Parameters
    ----------
    height : array_like (row, column)
        Heights z in the profiler's frame, m; NaN where the sensor gave no value. float32 is read as it is.
    x : array_like (column,)
        Positions of the points along the profile, m, evenly spaced and rising.
    y : array_like (row,)
        Positions of the profiles along the feed, m, rising; uneven by less than their pitch.
    scans : int
        How many scans the campaign has: loops are compiled for large campaigns only. The result is the same but for
        rounding.

    Returns
    -------
    BlockMap

    Raises
    ------
    MethodError
        Shapes do not fit, positions do not rise or are not even, numbers that are not in metres, or too few points.
    """
    z = np.ascontiguousarray(height, dtype=np.float32)
    x, y = np.ascontiguousarray(x, dtype=float), np.ascontiguousarray(y, dtype=float)
    if z.ndim != 2 or z.shape != (y.size, x.size):
        raise MethodError(
            f"expected heights of shape (rows, columns) = ({y.size}, {x.size}) by y and x, found {z.shape}; "
            "give z[row, column] with one y for every profile and one x for every point of a profile",
            code="registration.heights.shape",
        )
    rows, columns = z.shape[0] // ROWS, z.shape[1] // COLUMNS
    if min(rows, columns) < MIN_BLOCKS:
        raise MethodError(
            f"expected at least {MIN_BLOCKS * ROWS} profiles of {MIN_BLOCKS * COLUMNS} points, found "
            f"{z.shape[0]} of {z.shape[1]}; scan a longer piece of the artefact",
            code="registration.scan.too_small",
        )
    xc, dx = _centres("x", x, columns, COLUMNS, 0.01)
    yc, dy = _centres("y", y, rows, ROWS, 1.0)
    scales = _block_scales(z, dx[0], dy, max(1, rows * columns // _SAMPLED))
    if scales.size < MIN_BLOCKS:
        raise MethodError(
            f"expected a surface, found heights in {np.isfinite(z).mean():.1%} of the points and nowhere "
            f"{FEWEST} of {POINTS} neighbours together; check the sensor's range and exposure",
            code="registration.heights.missing",
        )
    # A scan without any noise still has the last bit of its numbers; some of them give its size.
    least = float(np.spacing(np.nanmax(np.abs(z[:: 4 * ROWS - 1, :: COLUMNS - 1]))))
    compiled = scans * z.size >= COMPILED_FROM
    out = reduce_blocks(z, dx[0], dy, max(float(np.median(scales)), least), compiled)
    return _deblurred(out, xc, yc, dx[0], dy[0], least, (z, x, y), compiled)


def _centres(name: str, positions: Array, blocks: int, size: int, tolerance: float) -> tuple[Array, Array]:
    """Return evenly spaced centres of the blocks and the positions of the points about them, (block, point)."""
    step = np.diff(positions)
    if not np.isfinite(positions).all() or not (step > 0).all():
        wrong = int(np.argmax(~(step > 0)))
        raise MethodError(
            f"expected {name} to rise from point to point, found {positions[wrong]:.9g} m followed by "
            f"{positions[wrong + 1]:.9g} m at index {wrong + 1}; check the encoder's count (overflow, reversal) and "
            "sort or cut the scan",
            code="registration.positions.order",
        )
    if positions[-1] - positions[0] > LARGEST:
        raise MethodError(
            f"expected {name} in metres over less than {LARGEST:g} m, found {positions[-1] - positions[0]:.6g} m; "
            "if these are millimetres, divide by 1000",
            code="registration.positions.unit",
        )
    used = positions[: blocks * size]
    pitch = (used[-1] - used[0]) / (used.size - 1)
    even = used[0] + pitch * np.arange(used.size)
    even += np.median(used - even)
    uneven = float(np.max(np.abs(used - even)))
    if uneven > tolerance * pitch:
        raise MethodError(
            f"expected {name} evenly spaced within {tolerance:g} of the pitch {pitch * 1e6:.3f} um, found "
            f"{uneven * 1e6:.3f} um; check the trigger for lost pulses, or resample the scan",
            code="registration.positions.uneven",
        )
    centres = even[0] + pitch * (np.arange(blocks) * size + (size - 1) / 2)
    return centres, used.reshape(blocks, size) - centres[:, None]


def _deblurred(
    out: Array, x: Array, y: Array, dx: Array, dy: Array, least: float, scan: tuple[NDArray[np.float32], Array, Array],
    compiled: bool,
) -> BlockMap:  # fmt: skip
    """Return the block map of the kernel's columns: filled, sharpened, its noise estimated."""
    mean, sx, sy, gain = out[0], out[1], out[2], out[5]
    pitch_x, pitch_y = x[1] - x[0], y[1] - y[0]
    known = np.isfinite(mean)
    if np.count_nonzero(known) < MIN_BLOCKS:
        raise MethodError(
            "expected a smooth surface, found none: no plane explains the blocks of 16 x 4 points; "
            "check that heights are in metres and that the scan is of the artefact",
            code="registration.surface.rough",
        )
    if not known.all():
        out[0], out[1], out[2] = repaired(mean, sx, sy, pitch_x, pitch_y)
    # A curved block scatters about its plane without any noise.
    share = POINTS / (POINTS - 3)
    bends = share * np.array([np.var(0.5 * dx**2), np.var(0.5 * dy**2), np.var(dx) * np.var(dy)])
    height, rest = _sharpened(out, pitch_x, pitch_y, bends)
    noise = np.sqrt(max(sampled_median(rest), least**2))
    variance = gain * noise**2
    if not known.all():
        variance = np.where(known, np.where(_beside(~known), BESIDE_HOLE, 1.0) * variance, np.inf)
    slope_noise = max(_slope_noise(out[1], height, pitch_x, 1), _slope_noise(out[2], height, pitch_y, 0))
    points = out[4].astype(np.int64)
    return BlockMap(x, y, height, out[1], out[2], variance, points, float(noise), slope_noise, scan, compiled)


def _beside(lost: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which blocks have a lost one among their eight neighbours."""
    wide = np.pad(lost, 1)
    along = wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:]
    beside: NDArray[np.bool_] = along[:-2] | along[1:-1] | along[2:]
    return beside


def _slope_noise(slope: Array, height: Array, pitch: float, axis: int) -> float:
    """Return by how much slopes within blocks differ from those between blocks, robustly."""
    if axis == 0:
        slope, height = slope.T, height.T
    step = max(1, slope.size // _FEW)
    slope, height = slope[::step], height[::step]
    inner = np.abs(slope[:, 1:-1] - (height[:, 2:] - height[:, :-2]) / (2 * pitch))
    return NORMAL_MAD * sampled_median(inner)


def sampled_median(values: Array) -> float:
    """Return the median of the finite out of some thousand evenly chosen values: a robust scale needs no more."""
    median = upper_median(some_of(values))
    return median if median == median else float(np.median(values[np.isfinite(values)]))


def some_of(values: Array, few: int = _FEW) -> Array:
    """Return the finite out of about so many values, evenly chosen."""
    flat = values.reshape(-1)
    chosen = flat[:: flat.size // few | 1]  # odd: not the same columns of every row
    return np.asarray(chosen[np.isfinite(chosen)])


def upper_median(values: Array) -> float:
    """Return the value in the middle, of two the larger; NaN where there is none."""
    return float(np.partition(values, values.size // 2)[values.size // 2]) if values.size else np.nan


def _block_scales(z: NDArray[np.float32], dx: Array, dy: Array, step: int) -> Array:
    """Return the robust scatter (m) of every ``step``-th block about its plane, without those of too few points."""
    blocks = blocks_of(z, len(dy))
    row, column = np.divmod(np.arange(0, len(dy) * blocks.shape[2], step), blocks.shape[2])
    scales = robust_planes(blocks[row, :, column], dx, dy[row])[3]
    return np.asarray(scales[np.isfinite(scales)])


def _sharpened(maps: Array, pitch_x: float, pitch_y: float, bends: Array) -> tuple[Array, Array]:
    """Return heights without what curvature adds to the blocks' means, m, and variances without what it adds, m^2.

    Parameters
    ----------
    maps : ndarray (9, block row, block column)
        Columns of `kernels.reduce_blocks`, holes in means and slopes filled; no points where a block was dropped.
    pitch_x, pitch_y : float
        Distance of the blocks, m.
    bends : ndarray (3,)
        Variance about its plane of a block with z = dx^2 / 2, dy^2 / 2, dx dy.
    """
    zxx, zyy = _second(maps[0].T).T / pitch_x**2, _second(maps[0]) / pitch_y**2
    zxy = np.gradient(maps[1], pitch_y, axis=0)
    added = maps[6] * zxx + maps[7] * zyy + maps[8] * zxy
    height = maps[0] - np.where(maps[4] > 0, added, 0.0)
    return height, maps[3] - (zxx**2 * bends[0] + zyy**2 * bends[1] + zxy**2 * bends[2])


def _second(z: Array) -> Array:
    """Return second differences along the first axis, extended as straight lines at both ends."""
    inner = z[:-2] - 2.0 * z[1:-1] + z[2:]
    return np.concatenate([2.0 * inner[:1] - inner[1:2], inner, 2.0 * inner[-1:] - inner[-2:-1]])
