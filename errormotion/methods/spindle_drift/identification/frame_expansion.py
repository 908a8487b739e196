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

    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


_MAX_PARTS = 48
"""Largest number of parts of a record in each of which the mean noise of the temperature is a source."""


@dataclass(frozen=True)
class FrameWarming:
    """Temperature of the frame, and its effect on the beams.

    Attributes
    ----------
    temperature : ndarray (instant,)
        Smoothed temperature of the frame, degC.
    noise : float
        Standard deviation of one measured temperature from resolution and noise, K.
    smoothing : LocalLine
        What the measured temperatures were smoothed with.
    per_kelvin : ndarray (5, 3)
        Shift of each beam's origin, m/K.
    """

    temperature: Array
    noise: float
    smoothing: LocalLine
    per_kelvin: Array


def frame_warming(
    raw: xr.Dataset, record: Record, settings: SpindleDriftSettings, notes: list[str]
) -> FrameWarming | None:
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
    smoothing = LocalLine(record.averages.time, np.isfinite(measured), settings.frame_smoothing)
    smooth = measured if smoothing.known.sum() < 3 else smoothing(measured)
    per_kelvin = np.asarray(raw["frame_expansion"].transpose("channel", "direction").values, np.float64)
    return FrameWarming(smooth, smoothing.noise(measured, smooth), smoothing, per_kelvin)


class LocalLine:
    """Straight lines through the known values within half of ``length`` on both sides of each instant.

    A line keeps a steady rise unbiased where one side is missing; a mean would not. The smoothed values are linear in
    the values: ``smooth = S values``.

    Attributes
    ----------
    length : float
        Of a window, s.
    known : ndarray, bool (instant,)
        Where there is a value; smoothed values are NaN elsewhere.
    gain : ndarray (instant,)
        Variance of a smoothed value for values of unit variance, the diagonal of ``S S'``.
    """

    def __init__(self, time: Array, known: NDArray[np.bool_], length: float) -> None:
        self.known = known
        self._time, self.length = time, length
        self._x = np.where(known, time - time.mean(), 0.0)
        self._first = np.searchsorted(time, time - 0.5 * length - 1e-9)
        self._end = np.searchsorted(time, time + 0.5 * length + 1e-9, side="right")
        n, sx, sxx = (self._sums(part) for part in (known.astype(float), self._x, self._x**2))
        self._n = np.maximum(n, 1.0)
        self._middle = sx / self._n
        spread = sxx - sx * self._middle
        sloped = spread > 1e-9 * np.maximum(sxx, 1e-30)
        self._slope = np.where(sloped, (time - time.mean() - self._middle) / np.where(sloped, spread, 1.0), 0.0)
        self.gain = np.where(known, 1.0 / self._n + self._slope**2 * np.where(sloped, spread, 0.0), np.nan)

    def _sums(self, values: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(total[self._end] - total[self._first])

    def __call__(self, values: Array) -> Array:
        """Return the smoothed values (instant,)."""
        level = values[self.known].mean()
        y = np.where(self.known, values - level, 0.0)
        sy = self._sums(y)
        smooth = level + sy / self._n + self._slope * (self._sums(self._x * y) - self._middle * sy)
        return np.where(self.known, smooth, np.nan)

    def weights(self, combination: Array) -> Array:
        """Return the weight (instant,) of each value in a linear combination of smoothed values, ``S' combination``."""
        combination = np.where(self.known, combination, 0.0)
        slope = combination * self._slope
        weights = []
        for part in (combination / self._n - slope * self._middle, slope):
            steps = np.zeros(part.size + 1)
            np.add.at(steps, self._first, part)
            np.subtract.at(steps, self._end, part)
            weights.append(np.cumsum(steps)[:-1])
        return np.where(self.known, weights[0] + weights[1] * self._x, 0.0)

    def noise(self, values: Array, smooth: Array) -> float:
        """Return the standard deviation of one value: white noise that gives the smoothed values their variance.

        The noise is the scatter about the lines; repeated values of a slow logger are taken into account through their
        autocorrelation.
        """
        if self.known.sum() < 3:
            return 0.0
        residual = (values - smooth)[self.known]
        lags = [float(residual[k:] @ residual[: residual.size - k]) for k in range(min(50, residual.size))]
        repeats = 1.0
        if lags[0] > 0:
            for lag in lags[1:]:
                if lag < 0.1 * lags[0]:
                    break
                repeats += 2.0 * lag / lags[0]
        variance = float(np.mean(residual**2)) * repeats
        # In a window with few values, second differences give the noise; at longer intervals they would include the
        # warming.
        close = np.diff(self._time[self.known]) <= self.length
        close = close[1:] & close[:-1]
        if close.any():
            variance = max(variance, float(np.mean(np.diff(values[self.known], 2)[close] ** 2)) / 6.0)
        return float(np.sqrt(variance))


def smoothing_sources(
    smoothing: LocalLine, noise: float, time: Array, reference: NDArray[np.int64]
) -> tuple[list[Array], Array]:
    """Return the uncertainty of the smoothed temperature relative to the reference state, K.

    White noise of the measured temperatures has the covariance ``noise^2 S S'`` after smoothing: instants within the
    length of the smoothing share it, more distant ones do not. The noise is split exactly into its means over parts of
    the record, half as long as the smoothing or longer (at most ``_MAX_PARTS``), each one draw, and the rest. Of the
    rest, what the reference state shares with every instant is one more draw. What remains at each instant is shared
    over less than a part or the length of the smoothing, and is stated as independent from instant to instant.

    Returns
    -------
    sources : list of ndarray (instant,)
        Each one draw, relative to the reference state; none without noise.
    own : ndarray (instant,)
        Standard uncertainty of each instant alone.
    """
    if not noise > 0:
        return [], np.zeros(time.size)
    parts = int(np.clip(np.ceil(np.ptp(time) / max(0.5 * smoothing.length, 1e-9)), 1, _MAX_PARTS))
    part = np.minimum(((time - time[0]) / max(float(np.ptp(time)), 1e-9) * parts).astype(int), parts - 1)
    rest = smoothing.weights(np.bincount(reference, minlength=time.size) / reference.size)
    rows = []
    for k in range(parts):
        inside = (part == k) & smoothing.known
        if inside.any():
            rows.append(smoothing(inside / np.sqrt(inside.sum())))
            rest[inside] -= rest[inside].mean()
    size = float(np.linalg.norm(rest))
    if size > 1e-9:
        rows.append(smoothing(rest / size))
    shared = noise * np.nan_to_num(np.array(rows))
    variance = noise**2 * np.nan_to_num(smoothing.gain) - np.sum(shared**2, axis=0)
    return list(shared - shared[:, reference].mean(axis=1, keepdims=True)), np.sqrt(np.maximum(variance, 0.0))


def hats(time: Array, knots: int) -> Array:
    """Return weights (knot, instant) about evenly spaced knots over a record; their squares add up to one."""
    position = (time - time[0]) / max(float(np.ptp(time)), 1e-9) * (knots - 1)
    return np.asarray(np.sqrt(np.maximum(1.0 - np.abs(position - np.arange(knots)[:, None]), 0.0)))
