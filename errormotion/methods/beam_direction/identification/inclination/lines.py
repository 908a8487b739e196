"""Lines of the errors over depth, one for each setting of the surface, from readings against an interferometer.

The error of a reading is e = r - d = (d - m) k + b: k the slope of the setting, b the zero of its series, because an
interferometer measures displacements only. Readings that do not fit the line of their setting are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_zero

Indices = NDArray[np.int64]

SAME = 1e-5
"""Angle within which groups belong to one setting, rad."""
MIN_FREEDOM = 30
"""Degrees of freedom from which on the noise is estimated from the scatter about the lines."""
RECEIVER_TOLERANCE = 1e-3
"""Largest deviation of the receiver's rotation from 0 or 180 deg, rad."""
_ENOUGH = 4
"""Median number of readings per setting from which on each setting has its own zero."""
_OUTLIER = 5.0
"""Standard deviations from which on a reading does not fit its line."""
_MIN_NOISE = 1e-10
"""Rounding of readings without noise, m."""
_MAX_ITERATIONS = 20


@dataclass(frozen=True)
class Readings:
    """Valid readings by group.

    Attributes
    ----------
    error : ndarray (group,)
        r - d, m.
    depth : ndarray (group,)
        d - m, m.
    reading : ndarray (group,)
        r, m.
    setting : ndarray (group,)
        Index of the setting of each group.
    inclination, rotation : ndarray (setting,)
        rad.
    noise : float
        Stated standard deviation, m; NaN if not stated.
    mid_range : float
        m.
    missing : int
        Groups without a reading.
    turned : float
        Angle that was added to the stated rotations, so that the receiver is at 180 deg, rad.
    """

    error: Array
    depth: Array
    reading: Array
    setting: Indices
    inclination: Array
    rotation: Array
    noise: float
    mid_range: float
    missing: int
    turned: float


@dataclass(frozen=True)
class Lines:
    """The lines of all settings.

    Attributes
    ----------
    slope, offset : ndarray (setting,)
        k, and the error at mid-range, m; the offset is 0 if it was not free.
    slope_variance : ndarray (setting,)
        From the noise.
    residual : ndarray (group,)
        m, including groups that were left out.
    left_out : ndarray of bool (group,)
    noise : float
        Standard deviation of one reading, m.
    free_offsets : bool
    """

    slope: Array
    offset: Array
    slope_variance: Array
    residual: Array
    left_out: NDArray[np.bool_]
    noise: float
    free_offsets: bool


def read(raw: xr.Dataset, receiver_rotation: float | None = None) -> Readings:
    """Return the readings of a raw dataset; implausible readings are refused.

    Parameters
    ----------
    raw : Dataset
    receiver_rotation : float, optional
        Rotation at which a surface's normal leans towards the receiver, rad; default: that of the dataset.

    Raises
    ------
    MethodError
        No rotation of the receiver, readings or references that do not change, have opposite signs or different
        units, depths on one side of mid-range only, or no inclination.
    """
    r, d, alpha, beta = (
        np.asarray(raw[name].values, dtype=float) for name in ("reading", "reference", "inclination", "rotation")
    )
    known = np.isfinite(r) & np.isfinite(d)
    if not known.any():
        raise MethodError(
            "Every reading is missing (NaN); expected readings of the sensor against the interferometer.",
            code="inclination.no_readings",
        )
    r, d, alpha, beta = r[known], d[known], alpha[known], beta[known]
    m = float(raw["mid_range"]) if "mid_range" in raw.variables else 0.0
    _check(r, d, m)
    if np.abs(alpha).max() < SAME:
        raise MethodError("Every inclination is 0; expected several inclinations.", code="inclination.all_zero")
    turn = _turn(raw, receiver_rotation)
    if turn:
        beta = np.mod(beta + turn + np.pi, 2 * np.pi) - np.pi
    written = np.round(np.stack([alpha, beta]) / SAME)
    _, first, setting = np.unique(written, axis=1, return_index=True, return_inverse=True)
    return Readings(
        error=r - d,
        depth=d - m,
        reading=r,
        setting=setting.ravel(),
        inclination=alpha[first],
        rotation=beta[first],
        noise=float(raw["reading_noise"]) if "reading_noise" in raw.variables else float("nan"),
        mid_range=m,
        missing=int((~known).sum()),
        turned=turn,
    )


def _turn(raw: xr.Dataset, receiver_rotation: float | None) -> float:
    """Return the angle to be added to the rotations, so that the receiver is at 180 deg, rad; 0 if it is there."""
    if receiver_rotation is None and "receiver_rotation" in raw.variables:
        receiver_rotation = float(raw["receiver_rotation"])
    if receiver_rotation is None or not np.isfinite(receiver_rotation):
        raise MethodError(
            "receiver_rotation: expected the rotation at which the normal of the surface leans towards the receiver of "
            "the sensor, 0 or 180 deg; found none. Add it to the readings ('# receiver_rotation = 180 deg' in a text "
            "file), or state it: --set receiver_rotation=180deg. To find out, tilt the surface by 65 deg or more in "
            "the plane of laser and receiver: turned away from the receiver, it is dark for the sensor first.",
            code="inclination.receiver.missing",
        )
    turn = float(np.mod(np.pi - receiver_rotation + np.pi, 2 * np.pi) - np.pi)
    if min(abs(turn), np.pi - abs(turn)) > RECEIVER_TOLERANCE:
        raise MethodError(
            f"receiver_rotation: expected 0 or 180 deg, because rotations are measured from the plane of laser and "
            f"receiver; found {np.degrees(receiver_rotation):.4g} deg. Measure the rotations from that plane.",
            code="inclination.receiver.form",
        )
    return 0.0 if abs(turn) <= RECEIVER_TOLERANCE else np.pi


def _check(r: Array, d: Array, m: float) -> None:
    """Refuse implausible readings and references."""
    if np.ptp(d) < 1e-6:
        raise MethodError(
            f"The reference is constant, {1e3 * d[0]:.4f} mm; expected depths over the range of the sensor.",
            code="inclination.reference.constant",
        )
    ratio = float(np.cov(r, d)[0, 1] / d.var(ddof=1)) if len(d) > 1 else 1.0
    if abs(ratio) < 1e-4:
        raise MethodError(
            f"The readings stay near {1e3 * np.median(r):.4f} mm while the reference moves by {1e3 * np.ptp(d):.3f} "
            "mm; expected the same displacement. Check the column of the readings.",
            code="inclination.readings.constant",
        )
    if ratio < 0:
        raise MethodError(
            "The readings decrease where the reference increases. Change the sign of the reference, so that both "
            "increase with the depth.",
            code="inclination.readings.opposite",
        )
    if not 0.8 < ratio < 1.25:
        units = {
            1e3: "whether the reference is in mm, stated as m",
            1e-3: "whether the readings are in mm, stated as m",
        }
        check = next((text for factor, text in units.items() if 0.8 < ratio * factor < 1.25), "the units")
        raise MethodError(
            f"The readings change {ratio:.4g} times as much as the reference; expected a ratio of about 1. Check "
            f"{check}.",
            code="inclination.readings.scale",
        )
    low, high = float(d.min() - m), float(d.max() - m)
    if min(-low, high) < 0.05 * (high - low):
        raise MethodError(
            f"The depths are from {1e3 * low:.3f} to {1e3 * high:.3f} mm relative to mid-range ({1e3 * m:.3f} mm), on "
            "one side; expected both sides, because the error changes its sign there. Check `mid_range` and the sign "
            "of the reference.",
            code="inclination.depths.one_side",
        )


def fit(readings: Readings, offsets: str = "auto") -> Lines:
    """Fit the lines of all settings.

    Parameters
    ----------
    readings : Readings
    offsets : str
        ``"each"``: every setting has its own zero of the interferometer; ``"none"``: the interferometer has the zero of
        the sensor; ``"auto"``: ``"each"`` if the settings have enough readings, else ``"none"``.

    Raises
    ------
    MethodError
        A setting has too few readings for its own zero, or the noise is unknown.
    """
    count = np.bincount(readings.setting)
    free = offsets == "each" or (offsets == "auto" and float(np.median(count)) >= _ENOUGH and count.min() > 1)
    if offsets == "each" and count.min() < 2:
        k = int(np.argmin(count))
        raise MethodError(
            f"{_name(readings, k)} has only one reading, which does not determine its zero; expected two readings or "
            "more, or the setting offsets = 'none'.",
            code="inclination.setting.one_reading",
        )
    slope, offset = _start(readings, free)
    kept = np.ones(len(readings.error), dtype=bool)
    for _ in range(_MAX_ITERATIONS):
        residual = readings.error - slope[readings.setting] * readings.depth - offset[readings.setting]
        before, kept = kept, _inliers(residual, kept, readings, free)
        slope, offset, variance = _solve(readings, kept, free)
        if (before == kept).all():
            break
    residual = readings.error - slope[readings.setting] * readings.depth - offset[readings.setting]
    noise = _noise(residual[kept], int(kept.sum()) - len(count) * (2 if free else 1), readings.noise)
    return Lines(slope, offset, noise**2 * variance, residual, ~kept, noise, free)


def _start(readings: Readings, free: bool) -> tuple[Array, Array]:
    """Return robust slopes and offsets: medians over pairs of readings."""
    n = int(readings.setting.max()) + 1
    slope, offset = np.zeros(n), np.zeros(n)
    order = np.argsort(readings.setting, kind="stable")
    for k, positions in enumerate(np.split(order, np.cumsum(np.bincount(readings.setting))[:-1])):
        depth, error = readings.depth[positions], readings.error[positions]
        if free:
            i, j = np.triu_indices(len(positions), 1)
            step = depth[j] - depth[i]
            far = np.abs(step) > 0.2 * np.ptp(depth)
            slope[k] = np.median((error[j] - error[i])[far] / step[far]) if far.any() else 0.0
            offset[k] = np.median(error - slope[k] * depth)
        else:
            weight = np.abs(depth)
            far = weight >= 0.2 * weight.max()
            slope[k] = np.median(error[far] / depth[far]) if weight.max() > 0 else 0.0
    return slope, offset


def _inliers(residual: Array, kept: NDArray[np.bool_], readings: Readings, free: bool) -> NDArray[np.bool_]:
    """Return which readings fit the line of their setting; settings with few readings keep all of them."""
    count = np.bincount(readings.setting)
    # The residuals of a fitted line are smaller than the errors, by the degrees of freedom of the line.
    share = min(len(count) * (2 if free else 1) / kept.sum(), 0.75)
    scale = max(scale_about_zero(residual[kept]) / np.sqrt(1 - share), _MIN_NOISE)
    few = count[readings.setting] < (_ENOUGH if free else 2)
    return np.asarray((np.abs(residual) <= _OUTLIER * scale) | few)


def _solve(readings: Readings, kept: NDArray[np.bool_], free: bool) -> tuple[Array, Array, Array]:
    """Return slopes, offsets, and the variances of the slopes for noise 1."""
    n = int(readings.setting.max()) + 1

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(readings.setting, values * kept, n), dtype=float)

    N, D, DD = total(np.ones(len(kept))), total(readings.depth), total(readings.depth**2)
    E, DE = total(readings.error), total(readings.depth * readings.error)
    if not free:
        _require_depth(readings, DD > 0)
        return DE / DD, np.zeros(n), 1 / DD
    det = N * DD - D**2
    _require_depth(readings, det > 1e-9 * np.maximum(N * DD, 1e-30))
    slope, offset = (N * DE - D * E) / det, (DD * E - D * DE) / det
    return slope, offset, N / det


def _require_depth(readings: Readings, enough: NDArray[np.bool_]) -> None:
    if not enough.all():
        raise MethodError(
            f"{_name(readings, int(np.argmin(enough)))} has readings at only one depth; expected several depths, which "
            "determine the slope of the error. Remove the setting or repeat its measurement.",
            code="inclination.setting.one_depth",
        )


def _noise(residual: Array, freedom: int, stated: float) -> float:
    """Return the standard deviation of one reading, by the lines, or the stated one if there are too few readings."""
    if freedom >= MIN_FREEDOM:
        return max(float(np.sqrt((residual**2).sum() / freedom)), _MIN_NOISE)
    if not np.isfinite(stated):
        raise MethodError(
            f"Expected at least {MIN_FREEDOM} readings more than unknowns to estimate the noise, or `reading_noise` in "
            f"the data; found {freedom}.",
            code="readings.too_few",
        )
    return max(stated, _MIN_NOISE)


def _name(readings: Readings, setting: int) -> str:
    alpha, beta = np.degrees(readings.inclination[setting]), np.degrees(readings.rotation[setting])
    return f"The setting of inclination {alpha:g} deg at rotation {beta:g} deg"


@dataclass(frozen=True)
class MidRange:
    """Common point of the lines of all settings: the reading at which the error does not depend on the inclination.

    Attributes
    ----------
    reading, uncertainty : float
        m; NaN if the lines do not determine it.
    """

    reading: float
    uncertainty: float


def mid_range(readings: Readings, lines: Lines) -> MidRange:
    """Return the common point of the lines.

    The error at the stated mid-range is b = b0 - k (m_found - m): a line over k.
    """
    known = len(lines.slope) - 2
    if not lines.free_offsets or known < 3 or np.ptp(lines.slope) < 5 * np.sqrt(np.median(lines.slope_variance)):
        return MidRange(float("nan"), float("nan"))
    A = np.stack([np.ones(len(lines.slope)), -lines.slope], axis=1)
    good = np.ones(len(lines.slope), dtype=bool)
    for _ in range(3):  # without outliers of the zeros
        (_, shift), *_ = np.linalg.lstsq(A[good], lines.offset[good])
        rest = lines.offset - A @ np.array([np.median(lines.offset + lines.slope * shift), shift])
        good = np.abs(rest) <= _OUTLIER * max(scale_about_zero(rest), _MIN_NOISE)
    scatter = float(np.sqrt((rest[good] ** 2).sum() / max(int(good.sum()) - 2, 1)))
    C = np.linalg.inv(A[good].T @ A[good]) * scatter**2
    return MidRange(readings.mid_range + float(shift), float(np.sqrt(C[1, 1])))
