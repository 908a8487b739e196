"""A drift record averaged to means: their noise, the reference state, and the run-out.

The run-out vanishes in the mean over whole turns. While the speed changes, a mean holds parts of turns and is unknown.
While the spindle is at rest, a mean is off by up to the run-out: one unknown shift for the whole rest, as large as the
scatter of the readings at steady speed beyond their noise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.files.hashing import DatasetHasher, cores
from errormotion.datasets.timing import SWITCHING
from errormotion.errors import MethodError
from errormotion.estimation.checks import resolution
from errormotion.estimation.checks.aliases import aliases
from errormotion.estimation.checks.resolution import step_of
from errormotion.estimation.checks.series import spikes
from errormotion.estimation.checks.slow_noise import SlowNoise, sentence, slow_noise
from errormotion.methods.spindle_drift.identification.averaging import (
    Averager,
    Averages,
    Windows,
    join,
    missing_places,
    slices,
    window_sums,
)
from errormotion.methods.spindle_drift.identification.times import Times, first_and_last, increases, values_of
from errormotion.methods.spindle_drift.schema import CHANNELS, PLANNED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


_CHANCE = 3.3
"""Standard deviations by which the observed noise must exceed the stated one (about one record in a thousand)."""
_EDGE = 0.01
"""Share of a mean by which its edges may be off, because the interval of the samples does not divide its length."""
_FIRST = 20_000
"""Readings of a channel that show the step of its scale."""
_SHOWN = 6
"""Times in a note."""
_ENOUGH = 30
"""Smallest number of values for a standard deviation."""
_SAME_SPEED = 0.02
"""Share of the highest speed within which two speeds are equal: a measured speed varies."""


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
    weight : ndarray (5, window)
        Standard deviation of the noise of a mean relative to that of its valid samples: larger than 1 where samples are
        missing on one side, so that the mean is carried to the time of the window.
    scatter : ndarray (5,) or None
        Standard deviation of single readings within one mean at steady speed, m; None where the record consists of
        means, or has no spindle speed.
    step : ndarray (5,)
        Of the scale that the readings are rounded to, m; 0 for none.
    hash : str
        Of the raw data, from the same pass.
    """

    averages: Averages
    temperature: Array | None
    spindle_speed: Array | None
    scatter: Array | None
    weight: Array
    step: Array
    hash: str


def average_record(raw: xr.Dataset, settings: SpindleDriftSettings) -> Record:
    """Average and hash a record in one pass and constant memory."""
    slow = [name for name in ("temperature", "spindle_speed") if name in raw and "time" in raw[name].dims]
    # The order is changed after reading: a lazy selection would read the store sample by sample.
    order = [list(raw["channel"].values).index(name) for name in CHANNELS]
    averager = Averager(len(CHANNELS), settings.average, settings.min_valid)
    slow_averagers = {name: Averager(raw[name].sizes.get("sensor", 1), settings.average, minimum=0.0) for name in slow}
    parts: list[Averages] = []
    slow_parts: dict[str, list[Averages]] = {name: [] for name in slow}
    scatter: Array | None = None
    step: Array | None = None
    with DatasetHasher(raw) as hasher:
        for piece in _pieces(raw, {"distance": averager, **slow_averagers}, order, hasher):
            parts.append(piece.added_to(averager, "distance"))
            if step is None and raw.attrs.get("machine") != PLANNED:  # expected readings have no noise
                step = np.array([step_of(row[:_FIRST]) for row in piece.values["distance"]])
            for name in slow:
                slow_parts[name].append(piece.added_to(slow_averagers[name], name))
            if "spindle_speed" in slow and scatter is None:
                turning = piece.values["spindle_speed"][0].astype(np.float64)
                scatter = _scatter(values_of(piece.time), piece.values["distance"], turning, settings)
        known_hash = hasher.value()
    parts.append(averager.finish())
    means = {name: join([*complete, slow_averagers[name].finish()]).mean for name, complete in slow_parts.items()}
    speed = means.get("spindle_speed")
    averages = join(parts)
    ones = np.ones(averages.mean.shape)
    record = Record(
        averages=averages,
        temperature=means.get("temperature"),
        spindle_speed=None if speed is None else speed[0],
        scatter=scatter,
        weight=ones,
        step=np.zeros(len(CHANNELS)) if step is None else step,
        hash=known_hash,
    )
    return _at_common_times(record, settings)


def without_spikes(record: Record, settings: SpindleDriftSettings, notes: list[str]) -> Record:
    """Return a record without the means that stand out from those beside them, which are noted.

    As many readings as unknowns check nothing: a wrong reading is found by its neighbours in time only. What changes
    at once by a command (speed, compensation) is no spike, however short.
    """
    time = record.averages.time
    near = settling(record, settings.spin_up)
    for event in settings.schedule:
        near |= np.abs(time - event.at - SWITCHING / 2) < settings.average + SWITCHING / 2
    near = near | np.append(near[1:], False) | np.append(False, near[:-1])
    mean = record.averages.mean.copy()
    for channel, row in zip(CHANNELS, mean, strict=True):
        wrong = spikes(np.where(near, np.nan, row))
        if wrong.any():
            at = ", ".join(f"{time:.1f} s" for time in record.averages.time[wrong][:_SHOWN])
            notes.append(
                f"{channel}: {int(wrong.sum())} means stand out from those beside them and are not used ({at})."
            )
            row[wrong] = np.nan
    return replace(record, averages=replace(record.averages, mean=mean))


def _at_common_times(record: Record, settings: SpindleDriftSettings) -> Record:
    """Return a record whose means are those at the times of their windows, although samples are missing.

    The mean of a window without its first third is that at a later time. Each is carried back along the slope of the
    means beside it, but not across a change of speed or of a compensation.
    """
    averages = record.averages
    if not averages.lag.any():
        return record
    time = averages.time
    steady = ~settling(record, settings.spin_up)
    together = steady[1:] & steady[:-1]
    first, last = time - settings.average / 2, time + settings.average / 2
    for event in settings.schedule:
        together &= (last[1:] <= event.at) | (first[:-1] >= event.at + SWITCHING)
    mean, weight = averages.mean.copy(), record.weight.copy()
    for i, lag in enumerate(averages.lag):
        step = np.diff(time + lag)
        slope = np.where(together, np.diff(averages.mean[i]) / step, np.nan)
        pairs = np.flatnonzero(np.isfinite(slope))
        if not (lag.any() and pairs.size):
            continue
        nearest = pairs[np.minimum(np.searchsorted(pairs, np.arange(time.size) - 1), pairs.size - 1)]
        x = lag / step[nearest]
        gradient, weight[i] = _gradient(slope, slope[nearest], x)
        mean[i] -= lag * gradient
    return replace(record, averages=replace(averages, mean=mean), weight=weight)


def _gradient(slope: Array, nearest: Array, x: Array) -> tuple[Array, Array]:
    """Return the slope of a curve at its points, and the noise of ``y - x step gradient`` relative to that of y.

    ``slope`` (n - 1,) is that between neighbours, NaN where it is not to be used. It is the mean of both sides, of
    second order on one side, or ``nearest`` (n,).
    """
    padded = np.pad(slope, 2, constant_values=np.nan)
    further_left, left, right, further_right = (padded[k : k + x.size] for k in range(4))
    sides = [
        ((left + right) / 2, np.hypot(1.0, x / np.sqrt(2.0))),
        (1.5 * right - 0.5 * further_right, np.sqrt((1 + 1.5 * x) ** 2 + 4.25 * x**2)),
        (1.5 * left - 0.5 * further_left, np.sqrt((1 - 1.5 * x) ** 2 + 4.25 * x**2)),
        (right, np.hypot(1 + x, x)),
        (left, np.hypot(1 - x, x)),
        (nearest, np.hypot(1.0, np.sqrt(2.0) * x)),
    ]
    known = [np.isfinite(gradient) for gradient, _ in sides]
    return tuple(np.select(known, list(each)) for each in zip(*sides, strict=True))


@dataclass(frozen=True)
class _Piece:
    """A slice of a record: its times, values (row, sample), and arguments of `Averager.add` unless each is a window."""

    time: Times
    windows: Windows | None
    values: dict[str, NDArray[Any]]
    sums: dict[str, tuple[Array, NDArray[np.int64], NDArray[np.int64]]]

    def added_to(self, averager: Averager, name: str) -> Averages:
        """Return the windows that are complete with this slice."""
        if self.windows is None:
            return averager.update(self.time, self.values[name])
        return averager.add(self.time, self.windows, *self.sums[name])


def _pieces(
    raw: xr.Dataset, averagers: Mapping[str, Averager], order: list[int], hasher: DatasetHasher
) -> Iterator[_Piece]:
    """Yield a record slice by slice. Each is read, hashed and added up by one thread while it is in its cache."""

    def work(time: Times, part: xr.Dataset, done: int, windows: Windows | None) -> _Piece:
        values, sums = {}, {}
        for name in averagers:
            read = np.asarray(part[name].values)
            hasher.update(name, read, time=slice(done, done + time.size))
            # The axis is moved after reading: a lazy transposition reads sample by sample.
            rows = np.moveaxis(read, raw[name].get_axis_num("time"), -1).reshape(-1, time.size)
            if name == "distance" and order != [0, 1, 2, 3, 4]:
                rows = rows[order]
            values[name] = rows
            if windows is not None:
                total, counts = window_sums(rows, windows.edges)
                sums[name] = total, counts, missing_places(rows, windows.edges, counts)
        return _Piece(time, windows, values, sums)

    last, done = -np.inf, 0
    with ThreadPoolExecutor(cores(), thread_name_prefix="slice") as pool:
        running: deque[Future[_Piece]] = deque()
        for time, part in slices(raw):
            first, end = first_and_last(time)
            if not (last < first and increases(time) and np.isfinite([first, end]).all()):
                raise MethodError(
                    "The time of the record does not increase everywhere: expected increasing seconds.",
                    code="raw.time.not_increasing",
                )
            _, *_, windows = (None, *(each.windows(time) for each in averagers.values()))  # the same for all
            running.append(pool.submit(work, time, part, done, windows))
            last, done = end, done + time.size
            while len(running) > (cores() if windows is not None else 0):
                yield running.popleft().result()
        while running:
            yield running.popleft().result()


def _scatter(
    time: Array, readings: NDArray[np.floating[Any]], speed: Array, settings: SpindleDriftSettings
) -> Array | None:
    """Return the standard deviation (5,) of the readings of one mean at steady speed, or None if there is none here."""
    turning = is_rotating(speed)
    start = int(np.argmax(turning))
    first, end = np.searchsorted(time, time[start] + settings.spin_up + np.array([0.0, settings.average]))
    if not turning[start] or end - first < _ENOUGH or end >= time.size or not turning[first:end].all():
        return None
    part = readings[:, first:end].astype(np.float64)
    if np.isnan(part).all(axis=1).any():
        return None
    return np.asarray(np.nanstd(part, axis=1, ddof=1))


def count_unknown(averages: Averages, notes: list[str]) -> None:
    """Note every channel with unknown means; MethodError for a channel without any known mean."""
    for channel, row, counts in zip(CHANNELS, averages.mean, averages.count, strict=True):
        unknown = np.isnan(row)
        if unknown.all():
            raise MethodError(
                f"Channel {channel} has no valid reading in the record. Check the sensor and its cable.",
                code="drift.channel.no_readings",
            )
        if unknown.any():
            first, last = averages.time[unknown][[0, -1]]
            notes.append(
                f"{channel}: {unknown.sum()} of {row.size} means are unknown, between {first:.1f} s and {last:.1f} s "
                f"({averages.expected.sum() - counts.sum()} samples are missing in total); the errors there are NaN."
            )


def reference_windows(
    averages: Averages, settings: SpindleDriftSettings, coming_up: NDArray[np.bool_], notes: list[str]
) -> NDArray[np.int64]:
    """Return the windows of the reference state; MethodError where there is none with all five readings."""
    mean = averages.mean
    start = averages.time[0] + (settings.reference_time or 0.0)
    if settings.reference_time is None and coming_up[0]:
        start = averages.time[int(np.argmin(coming_up))]
    length = settings.reference_average or 0.0
    last = start + max(length - length_of_means(averages, settings), 0.0) + _EDGE * settings.average
    inside = (averages.time >= start - 1e-6) & (averages.time < last)
    if not inside.any():
        later = np.flatnonzero(averages.time >= start - 1e-6)
        if later.size == 0:
            raise MethodError(
                f"The record ends at {averages.time[-1]:.1f} s, before the start of the reference state at "
                f"{start:g} s (reference_time).",
                code="drift.reference.outside",
            )
        inside[later[0]] = True
    steady = np.flatnonzero(inside & ~coming_up)
    if steady.size:  # means after the next change of speed belong to another state
        changes = np.flatnonzero(coming_up[steady[0] :])
        inside[:] = False
        inside[steady if not changes.size else steady[steady < steady[0] + changes[0]]] = True
    elif settings.reference_time is not None and coming_up[inside].any():
        notes.append("The reference state is within spin_up of a change of speed: its run-out is part of all errors.")
    known = inside & np.isfinite(mean).all(axis=0)
    if not known.any():
        lost = [c for c, row in zip(CHANNELS, mean[:, inside], strict=True) if np.isnan(row).all()]
        raise MethodError(
            f"The reference state at {start:.1f} s has no valid reading of {', '.join(lost) or 'all channels together'}"
            ". Choose another reference state with reference_time and reference_average.",
            code="drift.reference.no_readings",
        )
    return np.flatnonzero(known)


def length_of_means(averages: Averages, settings: SpindleDriftSettings) -> float:
    """Return the time that each mean covers, s; 0 where each is a single reading at its time."""
    return settings.average if averages.expected.max() > 1 else 0.0


def noise(raw: xr.Dataset, record: Record, settings: SpindleDriftSettings, notes: list[str]) -> Array:
    """Return the standard uncertainty (5, instant) of the means, m: as stated, or as observed where that is larger."""
    stated = float(raw["distance_noise"])
    averages = record.averages
    sigma = stated / np.sqrt(np.maximum(averages.count, 1))
    if settings.noise == "stated":
        return _rounded(np.asarray(sigma * record.weight), record, notes)
    for i, channel in enumerate(CHANNELS):
        # Second differences remove the drift, the median removes steps.
        root = np.sqrt(np.maximum(averages.count[i], 1))
        second = np.diff(averages.mean[i] * root, 2) / np.sqrt(6.0)
        second = second[np.isfinite(second)]
        if second.size < _ENOUGH:
            continue
        seen = float(np.median(np.abs(second)) / 0.674490)
        # Standard deviation of this estimate from overlapping second differences, by simulation: 1.7 / sqrt(2 n).
        chance = _CHANCE * 1.7 / np.sqrt(2 * second.size)
        said = (
            f"{channel}: the noise observed in the means is {seen * 1e6:.3g} um per sample, the stated noise is "
            f"{stated * 1e6:.3g} um; the uncertainty follows from the"
        )
        if seen > stated * (1.0 + chance):
            notes.append(f"{said} observed noise.")
            sigma[i] = seen / root
        elif seen < stated * (1.0 - chance) and record.step[i] < stated and raw.attrs.get("machine") != PLANNED:
            notes.append(f"{said} stated noise.")
    return _rounded(np.asarray(sigma * record.weight), record, notes)


def slow(
    record: Record, sigma: Array, settings: SpindleDriftSettings, notes: list[str], doubts: list[str]
) -> SlowNoise:
    """Return the noise of the means (5,) beyond ``sigma`` (5, instant), m, if there is any.

    It is alike from mean to mean, or the readings are too few for their second differences.
    """
    averages, none = record.averages, SlowNoise(np.zeros(len(CHANNELS)), 0.0)
    if settings.noise == "stated":
        return none
    values = np.where(settling(record, settings.spin_up), np.nan, averages.mean)
    noise_part = slow_noise(averages.time, values, sigma, _abrupt(record, settings))
    if noise_part is None:
        return none
    sizes = ", ".join(f"{name} {sd * 1e6:.2g} um" for name, sd in zip(CHANNELS, noise_part.sd, strict=True) if sd > 0)
    (doubts if noise_part.duration > 0 else notes).append(sentence(noise_part, sizes))
    if noise_part.duration > 0:
        notes.append("The uncertainties of the values of ISO 230-3 contain that these readings are alike.")
    return noise_part


def run_out_left(
    record: Record, stated: float, settings: SpindleDriftSettings, notes: list[str], doubts: list[str]
) -> Array:
    """Return the standard deviation (5,) of the run-out that a mean contains while the spindle turns, m.

    A mean over many turns contains none of it, unless samples are taken at nearly the same angles of each turn, or the
    mean is over few turns. Where the wave of the samples is shorter than a mean, its size is that of their scatter.
    Where it is longer, it is hidden in the means, and unknown.
    """
    averages, speed = record.averages, record.spindle_speed
    count = int(np.median(averages.expected))
    run_out = np.zeros(len(CHANNELS))
    if speed is None or count <= 1:
        return run_out
    rate, turning, said = count / settings.average, is_rotating(speed), set[int]()
    for part in np.split(np.arange(speed.size), _changes(speed)):
        usual = float(np.median(np.abs(held(speed)[part]))) if part.size else 0.0
        if not part.size or not turning[part].any() or round(usual) in said:
            continue
        said.add(round(usual))
        for alias in aliases(usual / 60.0, rate, count):
            what = (
                f"At {usual:.0f} 1/min and {rate:.4g} samples per second, a mean over {settings.average:g} s contains"
            )
            order = f"the run-out (harmonic {alias.order})"
            if alias.frequency * settings.average < 1.0:
                period = (
                    f"a wave with a period of about {1 / alias.frequency:.2g} s" if alias.frequency else "an offset"
                )
                doubts.append(
                    f"{what} {100 * alias.share:.0f} % of {order} as {period}, which the uncertainty does not contain. "
                    "Choose another spindle speed, sample rate or average."
                )
            elif record.scatter is not None:
                size = alias.share * np.sqrt(np.maximum(record.scatter**2 - stated**2, 0.0))
                if (size > stated / np.sqrt(count)).any():
                    notes.append(f"{what} {100 * alias.share:.0f} % of {order}; the uncertainty contains it.")
                    run_out = np.maximum(run_out, size)
    return run_out


def _abrupt(record: Record, settings: SpindleDriftSettings) -> list[float]:
    """Return the times at which the readings may change abruptly: changes of the speed, and switched compensations.

    The last single reading before a change is the start of the curve that follows. A mean at rest contains the run-out.
    """
    time = record.averages.time
    times = [event.at for event in settings.schedule if event.compensation]
    if record.spindle_speed is not None:
        single = record.averages.expected[0] <= 1
        times += [float(time[max(k - 1, 0) if single else k]) for k in _changes(record.spindle_speed)]
    return times


def _rounded(sigma: Array, record: Record, notes: list[str]) -> Array:
    """Return the uncertainties of means with that of rounding, which all readings of a mean may have in common."""
    rounded = sigma.copy()
    for i, (channel, step) in enumerate(zip(CHANNELS, record.step, strict=True)):
        added = resolution.rounding_of_means(sigma[i], record.averages.count[i], float(step))
        if added is not None:
            notes.append(resolution.sentence(f"the readings of {channel}", added))
            rounded[i] = np.hypot(sigma[i], added.sd)
    return rounded


def sensors(raw: xr.Dataset) -> list[str]:
    """Return the names of the temperature sensors."""
    return (
        [str(name) for name in raw["sensor"].values]
        if "sensor" in raw.coords
        else [f"T{k + 1}" for k in range(raw.sizes.get("sensor", 0))]
    )


def is_rotating(speed: Array) -> NDArray[np.bool_]:
    """Return where a spindle turns, in either direction; an unknown speed (NaN) is taken from the value before it."""
    known = np.isfinite(speed)
    if not known.any():
        return np.zeros(speed.shape, bool)
    size = np.abs(held(speed))
    return np.asarray((size > _SAME_SPEED * size.max()) & (size > 0))


def held(speed: Array) -> Array:
    """Return speeds with unknown values replaced by the last known one, at the start by the first known one."""
    known = np.isfinite(speed)
    if not known.any():
        return np.zeros(speed.shape)
    index = np.maximum.accumulate(np.where(known, np.arange(speed.size), -1))
    return np.asarray(speed[np.where(index < 0, int(np.argmax(known)), index)])


def settling(record: Record, spin_up: float) -> NDArray[np.bool_]:
    """Return the means that include a change of speed, or follow one within ``spin_up`` seconds.

    A record that starts with a turning spindle is assumed to start together with the spindle. A record of means (one
    sample each) has no such means.
    """
    time, speed = record.averages.time, record.spindle_speed
    is_settling = np.zeros(time.size, bool)
    if speed is None or time.size < 2 or record.averages.expected[0] <= 1 or spin_up == 0 or np.ptp(time) <= spin_up:
        return is_settling
    length = float(np.median(np.diff(time)))
    for k in _changes(speed):
        is_settling |= (time > time[k] - 0.6 * length) & (time < time[k] + spin_up - 1e-6)
    return is_settling


def _changes(speed: Array) -> NDArray[np.intp]:
    """Return the means with which another speed starts; the spindle is at rest before the record."""
    steady = held(speed)
    return np.flatnonzero(np.abs(np.diff(steady, prepend=0.0)) > _SAME_SPEED * np.abs(steady).max())


def run_out_at_rest(
    record: Record, reference: NDArray[np.int64], noise: float
) -> tuple[Array, NDArray[np.intp], list[int]]:
    """Return the run-out of each channel at rest, (5,), m, and during which rest each mean was.

    Each rest is one draw. The rests are numbered; the means (n,), and last the reference state, state the position of
    their rest in this list, or its length while the spindle turns. There are none where the spindle always turns,
    always rests, or its speed is unknown.
    """
    n = record.averages.time.size
    if record.scatter is None or record.spindle_speed is None:
        return np.zeros(len(CHANNELS)), np.zeros(n + 1, np.intp), []
    still = ~is_rotating(record.spindle_speed)
    edges = np.flatnonzero(np.diff(still, prepend=False, append=False)).reshape(-1, 2)
    if still.all():
        edges = edges[:0]
    rest = np.full(n + 1, len(edges), np.intp)
    for k, (first, end) in enumerate(edges):
        rest[first:end] = k
    rest[-1] = rest[reference[0]]
    return np.sqrt(np.maximum(record.scatter**2 - noise**2, 0.0)), rest, list(range(1, len(edges) + 1))
