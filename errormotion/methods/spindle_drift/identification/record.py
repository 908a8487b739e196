"""A drift record brought down to means, and what its means are worth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.identification.averaging import Averager, Averages, join, slices
from errormotion.methods.spindle_drift.schema import CHANNELS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.datasets.hashing import DatasetHasher
    from errormotion.methods.spindle_drift.settings import Settings


# Where the noise seen exceeds the stated one by more than chance allows (about one record in a thousand).
_CHANCE = 3.3
_ENOUGH = 30
_SAME_SPEED = 0.02
"""Share of the highest speed within which two speeds count as the same: a measured speed is never quite steady."""


@dataclass(frozen=True)
class Record:
    """Means on one clock.

    Attributes
    ----------
    averages : Averages
        Of the five channels.
    temperature : ndarray (sensor, window) or None
        degC.
    spindle_speed : ndarray (window,) or None
        1/min.
    scatter : ndarray (5,) or None
        Standard deviation of single readings within one mean while the spindle turns steadily, m; None where the
        record came as means, or does not say when the spindle turns.
    """

    averages: Averages
    temperature: Array | None
    spindle_speed: Array | None
    scatter: Array | None


def average_record(raw: xr.Dataset, settings: Settings, hasher: DatasetHasher) -> Record:
    """Average a record in one pass and constant memory; the hasher of ``raw`` takes part in it."""
    slow = [name for name in ("temperature", "spindle_speed") if name in raw and "time" in raw[name].dims]
    # Put in order after reading: a lazy selection would read the store sample by sample.
    order = [list(raw["channel"].values).index(name) for name in CHANNELS]
    # One thread: the hasher uses the other cores.
    averager = Averager(len(CHANNELS), settings.average, settings.min_valid, threads=1)
    slow_averagers = {name: Averager(raw[name].sizes.get("sensor", 1), settings.average, minimum=0.0) for name in slow}
    parts: list[Averages] = []
    slow_parts: dict[str, list[Averages]] = {name: [] for name in slow}
    scatter: Array | None = None
    last, done = -np.inf, 0
    for time, part in slices(raw):
        increasing = last < time[0] and (time[1:] > time[:-1]).all()
        if not (increasing and np.isfinite(time[[0, -1]]).all()):
            raise MethodError("The time of the record does not increase everywhere: expected increasing seconds.")
        last = float(time[-1])
        read: dict[str, NDArray[Any]] = {}
        for name in ("distance", *slow):
            values = np.asarray(part[name].values)
            hasher.update(name, values, time=slice(done, done + time.size))
            # The axis is moved after reading: a lazy transposition reads sample by sample.
            read[name] = np.moveaxis(values, part[name].get_axis_num("time"), -1)
        done += time.size
        readings = read["distance"] if order == [0, 1, 2, 3, 4] else read["distance"][order]
        parts.append(averager.update(time, readings))
        for name in slow:
            values = read[name].astype(np.float64)
            slow_parts[name].append(slow_averagers[name].update(time, values.reshape(-1, time.size)))
            if name == "spindle_speed" and scatter is None:
                scatter = _scatter(time, readings, values, settings)
    parts.append(averager.finish())
    means = {name: join([*complete, slow_averagers[name].finish()]).mean for name, complete in slow_parts.items()}
    speed = means.get("spindle_speed")
    return Record(join(parts), means.get("temperature"), None if speed is None else speed[0], scatter)


def _scatter(time: Array, readings: NDArray[np.floating[Any]], speed: Array, settings: Settings) -> Array | None:
    """Return the standard deviation (5,) of the readings of one mean at steady speed, or None if there is none here."""
    turning = turns(speed)
    start = int(np.argmax(turning))
    begin, end = np.searchsorted(time, time[start] + settings.spin_up + np.array([0.0, settings.average]))
    if not turning[start] or end - begin < _ENOUGH or end >= time.size or not turning[begin:end].all():
        return None
    part = readings[:, begin:end].astype(np.float64)
    if np.isnan(part).all(axis=1).any():
        return None
    return np.asarray(np.nanstd(part, axis=1, ddof=1))


def count_unknown(averages: Averages, notes: list[str]) -> None:
    """Note every channel that has unknown means; refuse one that has no other."""
    for channel, row, counts in zip(CHANNELS, averages.mean, averages.count, strict=True):
        unknown = np.isnan(row)
        if unknown.all():
            raise MethodError(
                f"Channel {channel} has no valid reading in the whole record: check the sensor and its cable."
            )
        if unknown.any():
            first, last = averages.time[unknown][[0, -1]]
            notes.append(
                f"{channel}: {unknown.sum()} of {row.size} means are unknown, between {first:.1f} s and {last:.1f} s "
                f"({averages.expected.sum() - counts.sum()} samples lost in all); the errors there are NaN."
            )


def reference_windows(
    averages: Averages, settings: Settings, coming_up: NDArray[np.bool_], notes: list[str]
) -> NDArray[np.int64]:
    """Return the windows of the reference state; MethodError where there is none with all five readings."""
    mean = averages.mean
    begin = averages.time[0] + (settings.reference_time or 0.0)
    if settings.reference_time is None and coming_up[0]:
        begin = averages.time[int(np.argmin(coming_up))]
    length = settings.reference_average or 0.0
    inside = (averages.time >= begin - 1e-6) & (averages.time < begin + max(length - 0.5 * settings.average, 1e-6))
    if not inside.any():
        later = np.flatnonzero(averages.time >= begin - 1e-6)
        if later.size == 0:
            raise MethodError(
                f"The record ends at {averages.time[-1]:.1f} s; the reference state was to begin at "
                f"{begin:g} s (reference_time)."
            )
        inside[later[0]] = True
    if settings.reference_time is not None and coming_up[inside].any():
        notes.append("The reference state lies within spin_up of a change of speed: its run-out is in all errors.")
    known = inside & np.isfinite(mean).all(axis=0)
    if not known.any():
        lost = [c for c, row in zip(CHANNELS, mean[:, inside], strict=True) if np.isnan(row).all()]
        raise MethodError(
            f"The reference state at {begin:.1f} s has no valid reading of {', '.join(lost) or 'all channels at once'}"
            ". Choose another one with reference_time and reference_average."
        )
    return np.flatnonzero(known)


def noise(raw: xr.Dataset, averages: Averages, settings: Settings, notes: list[str]) -> Array:
    """Return the standard uncertainty (5, instant) of the means, m: as stated, or as seen where that is more."""
    stated = float(raw["distance_noise"])
    sigma = stated / np.sqrt(np.maximum(averages.count, 1))
    if settings.noise == "stated":
        return np.asarray(sigma)
    for i, channel in enumerate(CHANNELS):
        # Second differences take out the drift itself; the median takes out steps.
        root = np.sqrt(np.maximum(averages.count[i], 1))
        second = np.diff(averages.mean[i] * root, 2) / np.sqrt(6.0)
        second = second[np.isfinite(second)]
        if second.size < _ENOUGH:
            continue
        seen = float(np.median(np.abs(second)) / 0.674490)
        # Spread of a median-based deviation of overlapping second differences, from simulation: 1.7 / sqrt(2 n).
        if seen > stated * (1.0 + _CHANCE * 1.7 / np.sqrt(2 * second.size)):
            notes.append(
                f"{channel}: the means scatter as from a noise of {seen * 1e6:.3g} um a sample, the stated noise is "
                f"{stated * 1e6:.3g} um; the uncertainty is raised to what is seen."
            )
            sigma[i] = seen / root
    return np.asarray(sigma)


def sensors(raw: xr.Dataset) -> list[str]:
    """Return the names of the temperature sensors."""
    return (
        [str(name) for name in raw["sensor"].values]
        if "sensor" in raw.coords
        else [f"T{k + 1}" for k in range(raw.sizes.get("sensor", 0))]
    )


def turns(speed: Array) -> NDArray[np.bool_]:
    """Return where a spindle turns, either way round; a speed that is not known (NaN) is the one before it."""
    known = np.isfinite(speed)
    if not known.any():
        return np.zeros(speed.shape, bool)
    size = np.abs(held(speed))
    return np.asarray((size > _SAME_SPEED * size.max()) & (size > 0))


def held(speed: Array) -> Array:
    """Return speeds with unknown ones replaced by the last known one, at the beginning by the first."""
    known = np.isfinite(speed)
    if not known.any():
        return np.zeros(speed.shape)
    place = np.maximum.accumulate(np.where(known, np.arange(speed.size), -1))
    return np.asarray(speed[np.where(place < 0, int(np.argmax(known)), place)])


def settling(record: Record, spin_up: float) -> NDArray[np.bool_]:
    """Return the means that hold a change of speed, or follow one within ``spin_up`` seconds.

    A record that begins with a turning spindle counts as begun by its start. Readings that came as means already
    (one sample each) are taken as they are.
    """
    time, speed = record.averages.time, record.spindle_speed
    found = np.zeros(time.size, bool)
    if speed is None or time.size < 2 or record.averages.expected[0] <= 1 or spin_up == 0 or np.ptp(time) <= spin_up:
        return found
    steady = held(speed)
    length = float(np.median(np.diff(time)))
    for k in np.flatnonzero(np.abs(np.diff(steady, prepend=0.0)) > _SAME_SPEED * np.abs(steady).max()):
        found |= (time > time[k] - 0.6 * length) & (time < time[k] + spin_up - 1e-6)
    return found


def run_out_at_rest(record: Record, reference: NDArray[np.int64], noise: float) -> list[tuple[str, str, Array]]:
    """Return, per channel and rest, what stopping anywhere in a turn may do to the errors, as readings (5, instant), m.

    Each rest is one draw. Where the reference state rests, its own draw is in everything outside of that rest. Empty
    where the spindle always turns, always rests, or its speed is not known.
    """
    if record.scatter is None or record.spindle_speed is None:
        return []
    rests = ~turns(record.spindle_speed)
    if rests.all() or not rests.any():
        return []
    spread = np.sqrt(np.maximum(record.scatter**2 - noise**2, 0.0))
    found = []
    edges = np.flatnonzero(np.diff(rests, prepend=False, append=False)).reshape(-1, 2)
    for number, (begin, end) in enumerate(edges, start=1):
        if begin <= reference[0] < end:
            effect = -np.ones(rests.size)
            effect[begin:end] = 0.0
        else:
            effect = np.zeros(rests.size)
            effect[begin:end] = 1.0
        for i in np.flatnonzero(spread > 0):
            change = np.zeros((len(CHANNELS), rests.size))
            change[i] = effect * spread[i]
            found.append((f"run-out {CHANNELS[i]}, rest {number}", "run-out at rest", change))
    return found
