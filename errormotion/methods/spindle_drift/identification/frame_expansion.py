"""Correction of the readings for the thermal expansion of the measuring frame, and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.methods.spindle_drift.identification.record import Record, sensors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.identification.uncertainty import State
    from errormotion.methods.spindle_drift.settings import Settings


_MOST_KNOTS = 32
"""Largest number of knots of the unknown temperature."""


@dataclass(frozen=True)
class FrameWarming:
    """Temperature of the frame, and its effect on the beams.

    Attributes
    ----------
    temperature : ndarray (instant,)
        Smoothed temperature of the frame, degC.
    uncertainty : ndarray (instant,)
        Standard uncertainty from resolution and noise, K.
    per_kelvin : ndarray (5, 3)
        Shift of each beam's origin, m/K.
    """

    temperature: Array
    uncertainty: Array
    per_kelvin: Array


def frame_warming(raw: xr.Dataset, record: Record, settings: Settings, notes: list[str]) -> FrameWarming | None:
    """Return the warming of the frame, None where its expansion is not or cannot be compensated."""
    if not settings.compensate_frame:
        return None
    if "frame_expansion" not in raw:
        notes.append(
            "The raw dataset states no frame_expansion: the expansion of the measuring frame is neither corrected nor "
            "part of "
            "the uncertainty (about 2 um/K for a frame of steel)."
        )
        return None
    if record.temperature is None or settings.frame_temperature not in sensors(raw):
        notes.append(
            "The expansion of the frame is stated but not its temperature (no sensor "
            f"'{settings.frame_temperature}'): the "
            "errors are not corrected for it."
        )
        return None
    measured = record.temperature[sensors(raw).index(settings.frame_temperature)]
    if np.isnan(measured).any():
        notes.append(
            f"The temperature of the frame is unknown in {int(np.isnan(measured).sum())} means; the errors there are "
            "NaN."
        )
    smooth, uncertainty = local_line(measured, record.averages.time, settings.frame_smoothing)
    per_kelvin = np.asarray(raw["frame_expansion"].transpose("channel", "direction").values, np.float64)
    return FrameWarming(smooth, uncertainty, per_kelvin)


def local_line(values: Array, time: Array, length: float) -> tuple[Array, Array]:
    """Fit a straight line within half of ``length`` on both sides of each instant; return its value and uncertainty.

    A line keeps a steady rise unbiased where one side is missing; a mean would not. The noise is the scatter about the
    lines; repeated values of a slow logger are taken into account through their autocorrelation. NaN where the value
    is NaN.
    """
    known = np.isfinite(values)
    if known.sum() < 3:
        return values, np.zeros_like(values)
    level, zero = values[known].mean(), time.mean()
    x, y = np.where(known, time - zero, 0.0), np.where(known, values - level, 0.0)
    sums = [np.concatenate([[0.0], np.cumsum(part)]) for part in (known.astype(float), x, y, x * x, x * y)]
    i = np.searchsorted(time, time - 0.5 * length - 1e-9)
    j = np.searchsorted(time, time + 0.5 * length + 1e-9, side="right")
    n, sx, sy, sxx, sxy = (total[j] - total[i] for total in sums)
    n = np.maximum(n, 1.0)
    at = time - zero - sx / n
    spread = sxx - sx * sx / n
    steep = np.where(spread > 1e-9 * np.maximum(sxx, 1e-30), (sxy - sx * sy / n) / np.maximum(spread, 1e-30), 0.0)
    smooth = level + sy / n + steep * at
    residual = (values - smooth)[known]
    lags = [float(residual[k:] @ residual[: residual.size - k]) for k in range(min(50, residual.size))]
    repeats = 1.0
    if lags[0] > 0:
        for lag in lags[1:]:
            if lag < 0.1 * lags[0]:
                break
            repeats += 2.0 * lag / lags[0]
    variance = float(np.mean(residual**2)) * repeats
    if np.median(np.diff(time[known])) <= length:
        # In a window with few values, second differences give the noise; at longer intervals they would include the
        # warming.
        variance = max(variance, float(np.mean(np.diff(values[known], 2) ** 2)) / 6.0)
    weight = 1.0 / n + np.where(spread > 0, at * at / np.maximum(spread, 1e-30), 0.0)
    uncertainty = np.sqrt(variance * np.minimum(weight, 1.0))
    return np.where(known, smooth, np.nan), np.where(known, uncertainty, np.nan)


def smoothing_sources(warming: FrameWarming, time: Array, length: float, reference: NDArray[np.int64]) -> list[Array]:
    """Return the uncertainty of the smoothed temperature as shared sources, each a change over time (instant,), K.

    Instants within the length of the smoothing share the error of their temperature, more distant ones do not. It is
    modelled by knots at this distance (at most ``_MOST_KNOTS``), each one draw, with weights whose squares add up to
    one. The changes are relative to the reference state.
    """
    effects = temperature_knots(warming, time, length)
    return list(effects - effects[:, reference].mean(axis=1, keepdims=True))


def temperature_knots(warming: FrameWarming, time: Array, length: float) -> Array:
    """Return the uncertainty (knot, instant) of the smoothed temperature, K: each knot is one draw."""
    knots = int(np.clip(np.ceil(np.ptp(time) / max(length, 1e-9)), 1, _MOST_KNOTS)) + 1
    return np.asarray(hats(time, knots) * np.nan_to_num(warming.uncertainty))


def hats(time: Array, knots: int) -> Array:
    """Return weights (knot, instant) about evenly spaced knots over a record; their squares add up to one."""
    position = (time - time[0]) / max(float(np.ptp(time)), 1e-9) * (knots - 1)
    return np.asarray(np.sqrt(np.maximum(1.0 - np.abs(position - np.arange(knots)[:, None]), 0.0)))


def readings_per_kelvin(warming: FrameWarming, state: State, origin: Array, direction: Array, levels: Array) -> Array:
    """Return the correction of the readings per kelvin of the frame, (5, instant), m/K.

    A displacement s of the origin of a beam changes its reading by -n . s / (n . u), n the surface normal.
    """
    A = np.column_stack([state.q[:, :2], np.full(len(state.q), levels[0])])
    S = origin[:, None] + direction[:, None] * state.distance[:, :, None]
    w = S - A
    n = w - np.einsum("cti,ti->ct", w, state.a)[..., None] * state.a
    n[4] = state.a
    along = np.einsum("cti,ci->ct", n, direction)
    return np.asarray(np.einsum("cti,ci->ct", n, warming.per_kelvin) / along)
