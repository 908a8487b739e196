"""ISO 230-3 values of a spindle drift, with their uncertainties.

Seven quantities: the axis displacement at the two levels (X1, Y1 at L1, X2, Y2 at L2), Z, and the tilts A and B. For
each, the range over an interval and the difference between its end and its start; the name states which, because the
two differ for a curve that is not monotonic. Ranges are taken over means of half a minute and the value at the end of
the interval, that of a line through the last half minute. A range of noisy values is too large; its mean excess is
stated as bias, and is contained in its uncertainty (`errormotion.estimation.extremes`). No mean reaches beyond
the end of an interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.timing import SWITCHING
from errormotion.errors import MethodError
from errormotion.estimation.extremes import expanded, range_from_reference
from errormotion.methods.spindle_drift.identification.record import is_rotating

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Index = NDArray[np.int64]

QUANTITIES = ("X1", "X2", "Y1", "Y2", "Z", "A", "B")
MEASURES = (
    "range_60min",
    "difference_60min",
    "range_running",
    "difference_running",
    "range_total",
    "difference_total",
    "time_constant",
    "end_slope",
    "per_kelvin",
)
LABELS = {"level": ["L1", "L2"], "lateral": ["x", "y"], "quantity": list(QUANTITIES), "measure": list(MEASURES)}
HOUR = 3600.0
_SLOPE_SPAN = 600.0
"""Interval before the end of running over which the end slope is taken, s."""
_BLOCK = 256
"""Instants whose correlations are in memory at a time."""
_MIN_CHANGE = 0.2
"""Smallest change of temperature for a value per kelvin, K."""


@dataclass(frozen=True)
class Series:
    """Seven quantities over time.

    Attributes
    ----------
    value : ndarray, (7, t)
    influence : ndarray, (source, 7, t)
    variance : ndarray, (7, t)
        Of what is no source, at one instant.
    alike : Alike, optional
        The part of it that neighbouring instants have in common; the rest is independent.
    """

    value: Array
    influence: Array
    variance: Array
    alike: Alike | None = None

    def weighted(self, k: int, index: Index, weights: Array) -> tuple[float, float, Array]:
        """Return value, standard uncertainty and influence (source,) of a weighted sum of quantity k over instants."""
        shared = self.influence[:, k, index] @ weights
        own = self.own(k, index, weights)
        return float(self.value[k, index] @ weights), float(np.sqrt(shared @ shared + own)), shared

    def own(self, k: int, index: Index, weights: Array) -> float:
        """Return the variance of a weighted sum of quantity k over instants, without that by the sources."""
        found = float(self.variance[k, index] @ weights**2)
        # not less than for independent instants: the correlation is estimated
        return found + (max(self.alike.common(k, index, weights), 0.0) if self.alike is not None else 0.0)


@dataclass(frozen=True)
class Alike:
    """Noise of the readings that is alike at neighbouring instants, with the correlation ``exp(-d / duration)``.

    Attributes
    ----------
    effect : ndarray, (channel, 7, t)
        Of one standard deviation of it, which is independent between channels.
    time : ndarray, (t,)
        s.
    duration : float
        s.
    """

    effect: Array
    time: Array
    duration: float

    def common(self, k: int, index: Index, weights: Array) -> float:
        """Return what the correlation adds to the variance of a weighted sum of quantity k over instants."""
        order = np.argsort(self.time[index], kind="stable")
        time, effect = self.time[index][order], (self.effect[:, k, index] * weights)[:, order]
        total, before, last = 0.0, np.zeros(len(effect)), time[0]
        for first in range(0, time.size, _BLOCK):
            t, x = time[first : first + _BLOCK], effect[:, first : first + _BLOCK]
            # sum over i < j of x_i exp(-(t_j - t_i) / duration) x_j: within the block, and with all before it
            R = np.tril(np.exp(-np.abs(np.subtract.outer(t, t)) / self.duration), -1)
            since = np.exp(-(t - last) / self.duration)
            total += float(np.einsum("cj,ji,ci->", x, R, x, optimize=True)) + float(before @ x @ since)
            before, last = before * since[-1] + x @ np.exp(-(t[-1] - t) / self.duration), t[-1]
        return 2.0 * total


def quantities(
    errors: Array,
    independent: Array,
    influence: Array,
    heights: Array,
    arm: Array,
    alike: tuple[Array, Array, float] | None = None,
) -> Series:
    """Return the seven quantities of error twists (t, 6), all on the spindle's axis.

    ``heights`` (2,) are those of L1 and L2 above the functional point, ``arm`` (3,) is the vector from it to the end of
    the bar on its axis, m. The unknown rotation about the axis has no effect on the axis; its source is not in
    ``influence``. ``alike`` are the effects (channel, t, 5) of noise that is alike at neighbouring instants, the times
    (t,) and the duration of `Alike`.
    """
    G = np.zeros((7, 5))
    for level, z in enumerate(heights):
        G[level, [0, 4]] = 1.0, z  # X: EX + EB z
        G[2 + level, [1, 3]] = 1.0, -z  # Y: EY - EA z
    G[4, [2, 3, 4]] = 1.0, arm[1], -arm[0]  # Z: EZ + EA y - EB x
    G[5, 3] = G[6, 4] = 1.0
    return Series(
        G @ errors[:, :5].T,
        np.einsum("ki,sti->skt", G, influence[..., :5]),
        np.einsum("ki,tij,kj->kt", G, independent[:, :5, :5], G),
        None if alike is None else Alike(np.einsum("ki,cti->ckt", G, alike[0]), *alike[1:]),
    )


@dataclass(frozen=True)
class Results:
    """ISO 230-3 values and their standard uncertainties, (quantity, measure), SI; NaN where not determined.

    ``bias`` is the mean excess of a range by noise, for which its value is not corrected. Half of it is contained in
    ``uncertainty``, so that the expanded uncertainty contains all of it. ``influence`` (source, quantity, measure) is
    the effect of one standard uncertainty of each source.
    """

    test: str
    value: Array
    bias: Array
    uncertainty: Array
    influence: Array
    sensor: str
    series: Series

    def as_extras(self, on_axis: NDArray[np.bool_]) -> dict[str, xr.DataArray]:
        """Return the values as further variables of an error dataset, ``on_axis``: which of its sources affect them.

        Their coordinates are `LABELS`.
        """
        table = ("quantity", "measure")
        units = {"units": "SI: m or rad; s for time_constant; per s for end_slope; per K for per_kelvin"}
        shared = np.einsum("skt,skt->kt", self.series.influence, self.series.influence)
        u = np.sqrt(shared + self.series.variance)
        F = np.zeros((len(on_axis), *self.value.shape))
        F[on_axis] = self.influence

        def by_level(values: Array) -> xr.DataArray:
            by_place = values[[0, 2, 1, 3]].reshape(2, 2, -1)  # X1 Y1 at L1, X2 Y2 at L2
            return xr.DataArray(by_place, dims=("level", "lateral", "time"), attrs={"units": "m"})

        return {
            "iso_value": xr.DataArray(self.value, dims=table, attrs=units),
            "iso_bias": xr.DataArray(self.bias, dims=table, attrs=units),
            "iso_uncertainty": xr.DataArray(self.uncertainty, dims=table, attrs=units),
            "iso_influence": xr.DataArray(F, dims=("source", *table), attrs=units),
            "displacement": by_level(self.series.value[:4]),
            "displacement_u": by_level(u[:4]),
        }


def evaluate(
    series: Series,
    time: Array,
    *,
    temperature: Array | None,
    sensors: Sequence[str],
    spindle_speed: Array | None,
    running_end: float | None,
    sensor: str | None,
    average: float,
    reference: Index,
    mean: float = 0.0,
    changes: Sequence[float] = (),
) -> Results:
    """Return the ISO 230-3 values of a record; ``time`` (t,) in s since the reference state.

    ``average`` (s) is the averaging time for ranges and end values. The reference state (the instants ``reference``) is
    one further mean, whose value is zero. ``mean`` (s) is the time that the value of each instant covers, 0 for a
    single reading. No mean of a range contains one of the times ``changes`` (s) at which the curve may have a step.
    """
    value = np.full((len(QUANTITIES), len(MEASURES)), np.nan)
    bias, uncertainty = np.zeros_like(value), np.full_like(value, np.nan)
    influence = np.zeros((len(series.influence), *value.shape))
    step = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    turning = spindle_speed is not None and bool(is_rotating(spindle_speed).any())
    still = spindle_speed is not None and not turning
    end = running_end if running_end is not None else _end_of_running(time, spindle_speed, turning) + mean / 2
    until_then = time + mean / 2 <= end + 1e-6
    hottest, change = _thermometer(temperature, sensors, sensor, until_then)
    known = np.isfinite(series.value) & (time >= -1e-9)
    whole = np.ones(time.size, bool)
    for each in changes:
        whole &= (time + mean / 2 <= each + 1e-6) | (time - mean / 2 >= each + SWITCHING - 1e-6)
    divided: dict[tuple[int, bytes], list[Weighted]] = {}  # most quantities are known at the same instants
    for k in range(len(QUANTITIES)):
        for column, until in ((0, HOUR), (2, end), (4, time[-1] + mean / 2)):
            place = (column, known[k].tobytes())
            if place not in divided:
                inside = np.flatnonzero(known[k] & whole & (time + mean / 2 <= until + 1e-6))
                complete = inside.size >= 2 and time[-1] >= until - 1.5 * step
                later = np.flatnonzero(known[k] & (time > until)) if column == 0 else inside[:0]
                divided[place] = _divided(inside, later, time, average, until, 1.5 * step, changes) if complete else []
            parts = divided[place]
            if not parts:
                continue
            of_range, influence[:, k, column] = _range(series, k, parts, reference)
            value[k, column], bias[k, column], uncertainty[k, column] = of_range
            if time[parts[-1].index].max() >= until - max(1.5 * step, average):
                # The errors are zero in the reference state: the value at the end is the difference.
                last = series.weighted(k, parts[-1].index, parts[-1].weights)
                value[k, column + 1], uncertainty[k, column + 1], influence[:, k, column + 1] = last
        running = np.flatnonzero(known[k] & until_then)
        value[k, 6] = _time_constant(time[running], series.value[k, running])
        tail = running[time[running] >= end - _SLOPE_SPAN]
        if tail.size > 10 and np.ptp(time[tail]) > 0.9 * _SLOPE_SPAN:
            weighted = series.weighted(k, tail, _slope_weights(time[tail]))
            value[k, 7], uncertainty[k, 7], influence[:, k, 7] = weighted
        if change is not None:
            warm = running[np.isfinite(change[running])]
            if warm.size > 10 and np.ptp(change[warm]) > _MIN_CHANGE:
                weighted = series.weighted(k, warm, _slope_weights(change[warm]))
                value[k, 8], uncertainty[k, 8], influence[:, k, 8] = weighted
    bias[np.isnan(value)] = np.nan
    test = "ETVE (spindle still)" if still else "rotating spindle" if turning else "spindle speed not recorded"
    return Results(test, value, bias, uncertainty, influence, hottest, series)


@dataclass(frozen=True)
class Weighted:
    """A weighted mean of instants, whose weights have the sum 1."""

    index: Index
    weights: Array


def _divided(
    inside: Index, later: Index, time: Array, average: float, until: float, gap: float, changes: Sequence[float]
) -> list[Weighted]:
    """Return means of ``average`` seconds over the instants of an interval, and as the last one its value at the end.

    It is that of a line through the last mean, or between the last instant and the first of the ``later`` ones if the
    mean has fewer than three instants, if both are within ``gap`` of the end.
    """
    between = np.split(inside, np.searchsorted(time[inside], np.sort(np.asarray(changes, float)), side="right"))
    blocks = [block for part in between if part.size for block in _blocks(part, time, average)]
    parts = [Weighted(block, np.full(block.size, 1.0 / block.size)) for block in blocks]
    last = parts[-1].index
    if last.size >= 3:
        t = time[last] - time[last].mean()
        ahead = min(until, time[last[-1]] + gap) - time[last].mean()
        return [*parts[:-1], Weighted(last, 1.0 / last.size + t * ahead / (t @ t))]
    if later.size and time[later[0]] - until <= gap and until - time[last[-1]] <= gap:
        pair = np.array([last[-1], later[0]])
        share = (until - time[pair[0]]) / (time[pair[1]] - time[pair[0]])
        return [*parts, Weighted(pair, np.array([1.0 - share, share]))]
    return parts


def _range(series: Series, k: int, parts: list[Weighted], reference: Index) -> tuple[tuple[float, float, float], Array]:
    """Return range, bias and standard uncertainty of quantity k over some means and the reference, and influence."""
    value, variance = np.empty(len(parts)), np.empty(len(parts))
    shared = np.empty((len(series.influence), len(parts)))
    for i, part in enumerate(parts):
        value[i] = series.value[k, part.index] @ part.weights
        variance[i] = series.own(k, part.index, part.weights)
        shared[:, i] = series.influence[:, k, part.index] @ part.weights
    extremes = range_from_reference(value, variance, shared)
    every = [Weighted(reference, np.full(reference.size, 1.0 / reference.size)), *parts]
    levels = np.concatenate([[series.value[k, reference].mean()], value])
    top, bottom = every[int(levels.argmax())], every[int(levels.argmin())]
    _, u, effects = series.weighted(
        k, np.concatenate([top.index, bottom.index]), np.concatenate([top.weights, -bottom.weights])
    )
    size, bias = float(extremes.value), float(extremes.bias)
    return (size, bias, max(float(expanded(bias, extremes.u)) / 2.0, u)), effects


def _blocks(index: Index, time: Array, length: float) -> list[Index]:
    """Divide instants into blocks of ``length`` seconds, counted back from the last one, which is complete."""
    age = np.floor((time[index[-1]] - time[index]) / length + 1e-9)
    blocks = list(np.split(index, np.flatnonzero(np.diff(age)) + 1))
    if len(blocks) > 1 and np.ptp(time[blocks[0]]) < 0.5 * length < np.ptp(time[blocks[1]]):
        blocks[:2] = [np.concatenate(blocks[:2])]  # a short remainder at the start would be a mean of few values
    return blocks


def _end_of_running(time: Array, speed: Array | None, turning: bool) -> float:
    if speed is None or not turning:
        return float(time[-1])
    return float(time[np.flatnonzero(is_rotating(speed))[-1]])


def _thermometer(
    temperature: Array | None, sensors: Sequence[str], given: str | None, running: NDArray[np.bool_]
) -> tuple[str, Array | None]:
    """Return name and temperature (t,) of the given sensor, or of the one with the largest change while running."""
    if given is not None and given not in sensors:
        raise MethodError(
            f"iso_temperature = '{given}': expected one of the sensors {', '.join(sensors) or 'none'}.",
            code="drift.temperature.unknown",
        )
    if temperature is None or not running.any():
        return "", None
    part = temperature[:, running]
    seen = np.isfinite(part)
    spread = np.where(seen, part, -np.inf).max(axis=1) - np.where(seen, part, np.inf).min(axis=1)
    index = list(sensors).index(given) if given is not None else int(np.argmax(spread))
    return sensors[index], temperature[index]


def _slope_weights(x: Array) -> Array:
    """Weights whose sum with y is the least-squares slope of y over x."""
    centred = x - x.mean()
    return np.asarray(centred / (centred @ centred))


def _time_constant(time: Array, y: Array) -> float:
    """Return tau of y0 + c (1 - exp(-t / tau)), s; NaN where the curve has another shape.

    For each tau, y0 and c follow by linear least squares. The best tau must be between a fiftieth of the length of the
    record and its length, and the curve must explain nine tenths of the variance.
    """
    if time.size < 20 or np.ptp(time) <= 0:
        return np.nan
    pick = np.unique(np.linspace(0, time.size - 1, min(time.size, 500)).astype(int))
    t, v = time[pick] - time[pick][0], y[pick]
    centred = v - v.mean()
    total = float(np.sum(centred**2))

    def rest(log_tau: float) -> float:
        rows = np.column_stack([np.ones(t.size), -np.expm1(-t / np.exp(log_tau))])
        return float(np.sum((v - rows @ np.linalg.lstsq(rows, v)[0]) ** 2))

    low, high = np.log(t[-1] / 50), np.log(t[-1])
    grid = np.linspace(low, high, 25)
    X = -np.expm1(-t / np.exp(grid)[:, None])
    X -= X.mean(axis=1, keepdims=True)
    share = X @ centred / np.sum(X**2, axis=1)
    best = int(np.argmin(np.sum((centred - share[:, None] * X) ** 2, axis=1)))
    if best in (0, grid.size - 1) or total == 0:
        return np.nan
    from scipy.optimize import minimize_scalar

    minimum = minimize_scalar(rest, bounds=(grid[best - 1], grid[best + 1]), method="bounded")
    return float(np.exp(minimum.x)) if minimum.fun < 0.1 * total else np.nan
