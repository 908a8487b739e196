"""ISO 230-3 values of a spindle drift, with their uncertainties.

Seven quantities: the axis displacement at the two levels (X1, Y1 at L1, X2, Y2 at L2), Z, and the tilts A and B. For
each, the range over an interval and the difference between its end and its start; the name states which, because the
two differ for a curve that is not monotonic. The range of thousands of noisy values is biased. Ranges are therefore
taken over means of half a minute, and the uncertainty of a range is that of the difference of the two extreme means.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.identification.record import turns

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
_MIN_CHANGE = 0.2
"""Smallest change of temperature for a value per kelvin, K."""


@dataclass(frozen=True)
class Series:
    """Seven quantities over time: value (7, t), influence (source, 7, t) and independent variance (7, t)."""

    value: Array
    influence: Array
    variance: Array

    def difference(self, k: int, later: Index, earlier: Index) -> tuple[float, float, Array]:
        """Return what `weighted` does of quantity k's mean over some instants minus that over others."""
        index = np.concatenate([later, earlier])
        weights = np.concatenate([np.full(later.size, 1.0 / later.size), np.full(earlier.size, -1.0 / earlier.size)])
        return self.weighted(k, index, weights)

    def weighted(self, k: int, index: Index, weights: Array) -> tuple[float, float, Array]:
        """Return value, standard uncertainty and influence (source,) of a weighted sum of quantity k over instants."""
        shared = self.influence[:, k, index] @ weights
        own = self.variance[k, index] @ weights**2
        return float(self.value[k, index] @ weights), float(np.sqrt(shared @ shared + own)), shared


def quantities(errors: Array, independent: Array, influence: Array, heights: Array, arm: Array) -> Series:
    """Return the seven quantities of error twists (t, 6), all on the spindle's axis.

    ``heights`` (2,) are those of L1 and L2 above the functional point, ``arm`` (3,) is the vector from it to the end of
    the bar on its axis, m. The unknown rotation about the axis has no effect on the axis; its source is not in
    ``influence``.
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
    )


@dataclass(frozen=True)
class Results:
    """ISO 230-3 values and their standard uncertainties, (quantity, measure), SI; NaN where not determined.

    ``influence`` (source, quantity, measure) is the effect of one standard uncertainty of each source.
    """

    test: str
    value: Array
    uncertainty: Array
    influence: Array
    sensor: str
    series: Series

    def as_extras(self, sources: int) -> dict[str, xr.DataArray]:
        """Return the values as further variables of an error dataset with ``sources``; the last ones have no effect.

        Their coordinates are `LABELS`.
        """
        table = ("quantity", "measure")
        units = {"units": "SI: m or rad; s for time_constant; per s for end_slope; per K for per_kelvin"}
        shared = np.einsum("skt,skt->kt", self.series.influence, self.series.influence)
        u = np.sqrt(shared + self.series.variance)
        F = np.zeros((sources, *self.value.shape))
        F[: len(self.influence)] = self.influence

        def by_level(values: Array) -> xr.DataArray:
            by_place = values[[0, 2, 1, 3]].reshape(2, 2, -1)  # X1 Y1 at L1, X2 Y2 at L2
            return xr.DataArray(by_place, dims=("level", "lateral", "time"), attrs={"units": "m"})

        return {
            "iso_value": xr.DataArray(self.value, dims=table, attrs=units),
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
) -> Results:
    """Return the ISO 230-3 values of a record; ``time`` (t,) in s since the reference state.

    ``average`` (s) is the averaging time for ranges and end values. The reference state (the instants ``reference``) is
    one further mean, whose value is zero.
    """
    value = np.full((len(QUANTITIES), len(MEASURES)), np.nan)
    uncertainty = np.full_like(value, np.nan)
    influence = np.zeros((len(series.influence), *value.shape))
    step = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    turning = spindle_speed is not None and bool(turns(spindle_speed).any())
    still = spindle_speed is not None and not turning
    end = running_end if running_end is not None else _end_of_running(time, spindle_speed, turning)
    hottest, change = _thermometer(temperature, sensors, sensor, time <= end)
    known = np.isfinite(series.value) & (time >= -1e-9)
    divided: dict[tuple[int, bytes], list[Index]] = {}  # most quantities are known at the same instants
    for k in range(len(QUANTITIES)):
        for column, until in ((0, HOUR), (2, end), (4, time[-1])):
            place = (column, known[k].tobytes())
            if place not in divided:
                inside = np.flatnonzero(known[k] & (time <= until + 1e-6))
                complete = inside.size >= 2 and time[-1] >= until - 1.5 * step
                divided[place] = [reference, *_blocks(inside, time, average)] if complete else []
            blocks = divided[place]
            if not blocks:
                continue
            means = np.array([series.value[k, block].mean() for block in blocks])
            top, bottom = blocks[means.argmax()], blocks[means.argmin()]
            value[k, column], uncertainty[k, column], influence[:, k, column] = (
                series.difference(k, top, bottom) if top is not bottom else (0.0, 0.0, 0.0)
            )
            if time[blocks[-1][-1]] >= until - max(1.5 * step, average):
                # The errors are zero in the reference state: the value at the end is the difference.
                weights = np.full(blocks[-1].size, 1.0 / blocks[-1].size)
                found = series.weighted(k, blocks[-1], weights)
                value[k, column + 1], uncertainty[k, column + 1], influence[:, k, column + 1] = found
        running = np.flatnonzero(known[k] & (time <= end))
        value[k, 6] = _time_constant(time[running], series.value[k, running])
        tail = running[time[running] >= end - _SLOPE_SPAN]
        if tail.size > 10 and np.ptp(time[tail]) > 0.9 * _SLOPE_SPAN:
            found = series.weighted(k, tail, _slope_weights(time[tail]))
            value[k, 7], uncertainty[k, 7], influence[:, k, 7] = found
        if change is not None:
            warm = running[np.isfinite(change[running])]
            if warm.size > 10 and np.ptp(change[warm]) > _MIN_CHANGE:
                found = series.weighted(k, warm, _slope_weights(change[warm]))
                value[k, 8], uncertainty[k, 8], influence[:, k, 8] = found
    test = "ETVE (spindle still)" if still else "rotating spindle" if turning else "spindle speed not recorded"
    return Results(test, value, uncertainty, influence, hottest, series)


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
    return float(time[np.flatnonzero(turns(speed))[-1]])


def _thermometer(
    temperature: Array | None, sensors: Sequence[str], given: str | None, running: NDArray[np.bool_]
) -> tuple[str, Array | None]:
    """Return name and temperature (t,) of the given sensor, or of the one with the largest change while running."""
    if given is not None and given not in sensors:
        raise MethodError(f"iso_temperature = '{given}': expected one of the sensors {', '.join(sensors) or 'none'}.")
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

    found = minimize_scalar(rest, bounds=(grid[best - 1], grid[best + 1]), method="bounded")
    return float(np.exp(found.x)) if found.fun < 0.1 * total else np.nan
