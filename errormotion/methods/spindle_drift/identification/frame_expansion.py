"""The measuring frame's own expansion: taken out of the readings by its temperature, with what that is worth."""

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


@dataclass(frozen=True)
class FrameWarming:
    """How the frame's temperature moves the beams.

    Attributes
    ----------
    temperature : ndarray (instant,)
        Smoothed temperature of the frame, degC.
    uncertainty : ndarray (instant,)
        What its resolution and noise leave unknown of it, K.
    per_kelvin : ndarray (5, 3)
        Shift of each beam's origin, m/K.
    """

    temperature: Array
    uncertainty: Array
    per_kelvin: Array


def frame_warming(raw: xr.Dataset, record: Record, settings: Settings, notes: list[str]) -> FrameWarming | None:
    """Return how the frame warmed, or None where its expansion is not to be or cannot be compensated."""
    if not settings.compensate_frame:
        return None
    if "frame_expansion" not in raw:
        notes.append(
            "The raw dataset states no frame_expansion: the measuring frame's own warming is neither taken out nor in "
            "the uncertainty (about 2 um a kelvin for a frame of steel)."
        )
        return None
    if record.temperature is None or settings.frame_temperature not in sensors(raw):
        notes.append(
            f"The frame's expansion is known but not its temperature (no sensor '{settings.frame_temperature}'): the "
            "errors are not corrected for it."
        )
        return None
    measured = record.temperature[sensors(raw).index(settings.frame_temperature)]
    if np.isnan(measured).any():
        notes.append(
            f"The frame's temperature is unknown in {int(np.isnan(measured).sum())} means; the errors there are NaN."
        )
    smooth, uncertainty = local_line(measured, record.averages.time, settings.frame_smoothing)
    per_kelvin = np.asarray(raw["frame_expansion"].transpose("channel", "direction").values, np.float64)
    return FrameWarming(smooth, uncertainty, per_kelvin)


def local_line(values: Array, time: Array, length: float) -> tuple[Array, Array]:
    """Fit a straight line within half of ``length`` on both sides of each instant; return its value and uncertainty.

    A line and not a mean, so that a steady rise is not bent where one side is missing. The scatter about the lines
    gives the noise; values that repeat one another (a slow logger) count as one through their autocorrelation.
    NaN where the value itself is.
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
        # Where a window holds too few values to scatter, second differences tell the noise; further apart than that
        # they would tell the warming itself.
        variance = max(variance, float(np.mean(np.diff(values[known], 2) ** 2)) / 6.0)
    weight = 1.0 / n + np.where(spread > 0, at * at / np.maximum(spread, 1e-30), 0.0)
    uncertainty = np.sqrt(variance * np.minimum(weight, 1.0))
    return np.where(known, smooth, np.nan), np.where(known, uncertainty, np.nan)


def smoothing_sources(warming: FrameWarming, time: Array, length: float, reference: NDArray[np.int64]) -> list[Array]:
    """Return what is unknown of the smoothed temperature as shared sources, each a change over time (instant,), K.

    Instants closer than the smoothing's length share what is unknown of their temperature, those further apart do
    not: knots at that distance (at most ``_MOST_KNOTS`` of them), each one draw, with weights whose squares add up to
    one between them. All is relative to the reference state.
    """
    knots = int(np.clip(np.ceil(np.ptp(time) / max(length, 1e-9)), 1, _MOST_KNOTS)) + 1
    effects = hats(time, knots) * np.nan_to_num(warming.uncertainty)
    return list(effects - effects[:, reference].mean(axis=1, keepdims=True))


def hats(time: Array, knots: int) -> Array:
    """Return weights (knot, instant) about evenly spaced knots over a record; their squares add up to one."""
    place = (time - time[0]) / max(float(np.ptp(time)), 1e-9) * (knots - 1)
    return np.asarray(np.sqrt(np.maximum(1.0 - np.abs(place - np.arange(knots)[:, None]), 0.0)))


def readings_per_kelvin(warming: FrameWarming, state: State, origin: Array, direction: Array, levels: Array) -> Array:
    """Return what a kelvin of the frame does to the readings of an unmoved bar, (5, instant), m/K, as a correction.

    A beam's origin that goes by s makes its reading wrong by n . s / (n . u), n the surface normal it meets.
    """
    A = np.column_stack([state.q[:, :2], np.full(len(state.q), levels[0])])
    S = origin[:, None] + direction[:, None] * state.distance[:, :, None]
    w = S - A
    n = w - np.einsum("cti,ti->ct", w, state.a)[..., None] * state.a
    n[4] = state.a
    along = np.einsum("cti,ci->ct", n, direction)
    return np.asarray(np.einsum("cti,ci->ct", n, warming.per_kelvin) / along)
