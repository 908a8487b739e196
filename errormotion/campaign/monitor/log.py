"""The log of a monitor, read in blocks and reduced to the resolution of a page, for logs of any length."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.plugins import FigureOfMerit

BINS = 600
"""Number of intervals of the reduced log: the resolution of a page."""
BLOCK = 65536
"""Number of rows that are read at a time."""
MISSED = 2.5
"""Time between two rows, in intervals, above which rows are missing."""

AXES = ("X", "Y", "Z")
NUMBERS = (
    ("spindle_speed", "Spindle speed", "1/min", 1.0),
    ("spindle_load", "Spindle load", "%", 100.0),
    ("feed", "Feed", "m/min", 60.0),
)
"""Working parameters: name in the log, title, unit on the page, and factor from the SI unit to it."""


@dataclass(frozen=True)
class Channel:
    """One column of the log.

    Attributes
    ----------
    name : str
    first, low, high, last, mean : float
        Of the known values, in the unit of the log; NaN if there are none.
    known : int
        Rows with a value.
    values : (m,)
        On the reduced time axis: lowest and highest value of each interval; NaN if unknown.
    """

    name: str
    first: float
    low: float
    high: float
    last: float
    mean: float
    known: int
    values: Array


@dataclass(frozen=True)
class Gap:
    """An interval without readings; ``end`` is the first row after it, s, or the last row if none follows."""

    start: float
    end: float
    rows: int


@dataclass(frozen=True)
class Log:
    """A monitor's log.

    Attributes
    ----------
    rows : int
    interval : float
        Stated interval of the rows, s; the median interval if not stated.
    duration : float
        First to last row, s.
    time : (m,)
        Reduced, s.
    temperatures : list of Channel
    place : (sensor, 3)
        m; NaN = unknown.
    why : list of dict
        For each sensor: number of rows by reason of the unknown temperature.
    numbers : dict of str to Channel
        Working parameters and positions ``X Y Z`` in the log.
    gaps : dict of str to list of Gap
        By instrument.
    silent : dict of str to (m,)
        1 where an instrument did not answer in any row, on the reduced axis.
    missing : list of Gap
        Intervals in which no row was written.
    """

    rows: int
    interval: float
    duration: float
    time: Array
    temperatures: list[Channel]
    place: Array
    why: list[dict[str, int]]
    numbers: dict[str, Channel]
    gaps: dict[str, list[Gap]]
    silent: dict[str, Array]
    missing: list[Gap]


class _Thinner:
    """Lowest and highest value of every interval, and statistics of whole columns (n, c), updated block by block."""

    def __init__(self, count: int, bins: int) -> None:
        self.low, self.high = np.full((bins, count), np.inf), np.full((bins, count), -np.inf)
        self.first, self.last = np.full(count, np.nan), np.full(count, np.nan)
        self.sum, self.known = np.zeros(count), np.zeros(count, dtype=np.int64)

    def put(self, index: NDArray[np.intp], values: Array) -> None:
        known = np.isfinite(values)
        np.minimum.at(self.low, index, np.where(known, values, np.inf))
        np.maximum.at(self.high, index, np.where(known, values, -np.inf))
        self.sum += np.where(known, values, 0.0).sum(axis=0)
        self.known += known.sum(axis=0)
        for column in np.flatnonzero(known.any(axis=0)):
            own = np.flatnonzero(known[:, column])
            self.last[column] = values[own[-1], column]
            if np.isnan(self.first[column]):
                self.first[column] = values[own[0], column]

    def channels(self, names: Sequence[str], doubled: bool) -> list[Channel]:
        low = np.where(np.isfinite(self.low), self.low, np.nan)
        high = np.where(np.isfinite(self.high), self.high, np.nan)
        found = []
        for k, name in enumerate(names):
            thinned = np.stack([low[:, k], high[:, k]], axis=1).ravel() if doubled else low[:, k]
            some = self.known[k] > 0
            found.append(
                Channel(
                    name,
                    float(self.first[k]),
                    float(self.low[:, k].min()) if some else math.nan,
                    float(self.high[:, k].max()) if some else math.nan,
                    float(self.last[k]),
                    float(self.sum[k] / self.known[k]) if some else math.nan,
                    int(self.known[k]),
                    thinned,
                )
            )
        return found


def read_log(dataset: xr.Dataset) -> Log:
    """Return the reduced log."""
    time = np.asarray(dataset["time"].values, float)
    n = time.size
    sensors = _names(dataset, "sensor") if "temperature" in dataset else []
    sources = _names(dataset, "source")
    numbers = [name for name, *_ in NUMBERS if name in dataset and dataset[name].dims == ("time",)]
    columns = [*numbers, *(AXES if "position" in dataset else ())]
    # A short log is shown row by row; a long one by the lowest and highest value of each interval.
    whole = n <= 2 * BINS
    edges = _edges(time, whole)
    bins = len(edges) if n else 0
    warmth, states, silent = (_Thinner(len(names), bins) for names in (sensors, columns, sources))
    meanings = _meanings(dataset)
    why = np.zeros((len(sensors), len(meanings)), dtype=np.int64)
    runs: dict[str, list[Gap]] = {name: [] for name in sources}
    for start in range(0, n, BLOCK):
        part = dataset.isel(time=slice(start, start + BLOCK))
        own = time[start : start + BLOCK]
        index = np.searchsorted(edges, own, side="right") - 1
        if sensors:
            warmth.put(index, np.asarray(part["temperature"].transpose("time", "sensor").values, float))
            if "temperature_flag" in part:
                flags = np.asarray(part["temperature_flag"].transpose("time", "sensor").values).astype(int)
                for code in range(1, len(meanings)):
                    why[:, code] += (flags == code).sum(axis=0)
        if columns:
            data = [np.asarray(part[name].values, float)[:, None] for name in numbers]
            if "position" in part:
                data.append(np.asarray(part["position"].transpose("time", "direction").values, float))
            states.put(index, np.concatenate(data, axis=1))
        gap = np.asarray(part["gap"].transpose("time", "source").values).astype(float)
        silent.put(index, gap)
        for k, name in enumerate(sources):
            _extend(runs[name], gap[:, k] > 0, own, time, start)
    return Log(
        n,
        _interval(dataset, time),
        float(time[-1] - time[0]) if n else 0.0,
        _thinned_time(time, edges, whole),
        warmth.channels(sensors, not whole),
        _places(dataset, len(sensors)),
        [{meanings[c]: int(row[c]) for c in range(1, len(meanings)) if row[c]} for row in why],
        {channel.name: channel for channel in states.channels(columns, not whole)},
        runs,
        {name: np.nan_to_num(_highest(silent.high[:, k], not whole)) for k, name in enumerate(sources)},
        _missing(time, _interval(dataset, time)),
    )


def figures(dataset: xr.Dataset) -> list[FigureOfMerit]:
    """Return the duration of a log, its largest temperature change and highest temperature, and its gaps.

    The uncertainty of the temperatures is not part of a log: U is NaN.
    """
    log = read_log(dataset)
    merits = [FigureOfMerit("duration", log.duration, math.nan, "s")]
    known = [channel for channel in log.temperatures if channel.known]
    if known:
        most = max(known, key=lambda channel: abs(channel.last - channel.first))
        highest = max(known, key=lambda channel: channel.high)
        merits.append(FigureOfMerit(f"temperature change of {most.name}", most.last - most.first, math.nan, "K"))
        merits.append(FigureOfMerit(f"highest temperature of {highest.name}", highest.high, math.nan, "degC"))
    gaps = {name: sum(gap.rows for gap in gaps) for name, gaps in log.gaps.items()}
    merits += [FigureOfMerit(f"rows without a reading of {name}", float(rows), 0.0, "1") for name, rows in gaps.items()]
    return merits


def _edges(time: Array, whole: bool) -> Array:
    """Return the start of each interval; in a short log the rows themselves, and one in each gap."""
    if not time.size:
        return np.empty(0)
    if not whole:
        return np.linspace(time[0], time[-1], BINS + 1)[:-1]
    step = np.diff(time)
    holes = np.flatnonzero(step > MISSED * float(np.median(step))) if step.size else np.empty(0, dtype=int)
    return np.sort(np.concatenate([time, time[holes] + step[holes] / 2]))


def _thinned_time(time: Array, edges: Array, whole: bool) -> Array:
    if whole:
        return edges
    width = (time[-1] - time[0]) / BINS
    doubled = np.stack([edges + width / 4, edges + 3 * width / 4], axis=1).ravel()
    doubled[0], doubled[-1] = time[0], time[-1]
    return doubled


def _highest(high: Array, doubled: bool) -> Array:
    known = np.where(np.isfinite(high), high, 0.0)
    return np.repeat(known, 2) if doubled else known


def _names(dataset: xr.Dataset, dim: str) -> list[str]:
    if dim in dataset.coords:
        return [str(name) for name in dataset[dim].values]
    return [f"{dim} {i + 1}" for i in range(dataset.sizes.get(dim, 0))]


def _meanings(dataset: xr.Dataset) -> list[str]:
    """Return the meanings of the numbers of ``temperature_flag``."""
    try:
        meanings = json.loads(str(dataset.attrs.get("flag_meanings", "[]")))
    except (ValueError, RecursionError):
        meanings = []
    return [str(word) for word in meanings] if isinstance(meanings, list) and meanings else ["known", "unknown"]


def _interval(dataset: xr.Dataset, time: Array) -> float:
    stated = dataset.attrs.get("interval")
    if isinstance(stated, int | float | np.number):
        return float(stated)
    return float(np.median(np.diff(time))) if time.size > 1 else math.nan


def _places(dataset: xr.Dataset, count: int) -> Array:
    if "sensor_place" in dataset and set(dataset["sensor_place"].dims) == {"sensor", "direction"}:
        return np.asarray(dataset["sensor_place"].transpose("sensor", "direction").values, float)
    return np.full((count, 3), np.nan)


def _extend(runs: list[Gap], where: NDArray[np.bool_], own: Array, time: Array, start: int) -> None:
    """Add the gaps of one block, joined to a gap at the end of the previous block."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        end = float(time[min(start + stop, time.size - 1)])
        joined = first == 0 and start > 0 and runs and runs[-1].end == own[0]
        if joined:
            runs[-1] = Gap(runs[-1].start, end, runs[-1].rows + int(stop - first))
        else:
            runs.append(Gap(float(own[first]), end, int(stop - first)))


def _missing(time: Array, interval: float) -> list[Gap]:
    step = np.diff(time)
    if not step.size or not math.isfinite(interval):
        return []
    return [
        Gap(float(time[k]), float(time[k + 1]), max(round(float(step[k]) / interval) - 1, 1))
        for k in np.flatnonzero(step > MISSED * interval)
    ]
