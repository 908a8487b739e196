"""The angle of the spindle at every sample: from index pulses, from an encoder, or from the eccentricity.

Angles are known at knots and interpolated by cubic polynomials between them, whose slopes are those of the neighbours:
a speed that changes evenly causes no error. Chunks of a record of any length are read one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.indexes import RangeIndex

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.spindle_error_motion.averaging import interpolated
from errormotion.methods.spindle_error_motion.layout import Layout

TAU = 2 * np.pi
FEWEST_TURNS = 4
_CHUNK_BYTES = 16 << 20
_TURNS_OF_A_BLOCK = 4
"""Turns over which the phase of the eccentricity is determined."""
_CLEAR = 10.0
"""Smallest ratio of the eccentricity to the scatter of the readings about it, where it states the angle."""


@dataclass(frozen=True, eq=False)
class Turning:
    """The angle of the spindle over a record.

    Attributes
    ----------
    knots, angles : ndarray, (knot,)
        Times, s, and angles from the first whole turn on, rad; empty where ``by_encoder``.
    turns : int
        Whole turns from angle 0; samples before and after them are not used.
    sense : int
        +1 or -1, that of the spindle: the angle of the axis is ``sense`` times this angle.
    by_encoder : bool
        The angle is the variable ``angle`` of the raw data, from ``start``, rad.
    start : float
        rad.
    source : str
        In words.
    """

    knots: Array
    angles: Array
    turns: int
    sense: int
    source: str
    by_encoder: bool = False
    start: float = 0.0

    def at(self, time: Array) -> Array:
        """Return the angles at increasing times, rad, from the start of the first whole turn; NaN outside the knots."""
        slope = np.gradient(self.angles, self.knots)  # second order, also for uneven knots
        angle = np.empty(time.size)
        interpolated(time, self.knots, self.angles, slope, angle)
        return angle


@dataclass(frozen=True, eq=False)
class Chunk:
    """Samples of a record: times (n,), s, readings (sensor, n), m, and the encoder's angles, (n,) or none, rad."""

    time: Array
    reading: Array
    encoder: Array


def chunks(raw: xr.Dataset) -> Iterator[Chunk]:
    """Yield a record along ``time``, in whole chunks of its storage; readings have the order of the sensors.

    Raises
    ------
    MethodError
        The record has no time.
    """
    reading = raw["displacement"]
    step = max(1, _CHUNK_BYTES // (reading.sizes["sensor"] * 8))
    stored = reading.encoding.get("preferred_chunks", {}).get("time", 1)
    if stored > 1:
        step = max(1, step // stored) * stored
    for first in range(0, reading.sizes["time"], step):
        part = slice(first, first + step)
        read = reading.isel(time=part).load()  # before it is turned: a lazy array that is turned is read value by value
        values = np.asfortranarray(read.transpose("sensor", "time").values, dtype=np.float64)  # sample by sample
        encoder = np.asarray(raw["angle"][part].values, float) if "angle" in raw else np.zeros(0)
        yield Chunk(_times(raw, first, values.shape[1]), values, encoder)


def _times(raw: xr.Dataset, first: int, count: int) -> Array:
    clock = raw.xindexes.get("time")
    if isinstance(clock, RangeIndex):
        return np.asarray(float(clock.start) + (first + np.arange(count)) * float(clock.step))
    if "time" in raw.variables:
        return np.asarray(raw["time"][first : first + count].values, float)
    if "sample_rate" in raw.attrs:
        start = float(raw.attrs.get("time_start", 0.0))
        return np.asarray(start + (first + np.arange(count)) / float(raw.attrs["sample_rate"]))
    raise MethodError(
        "The raw dataset has no time: expected a coordinate 'time' (s) or the attribute 'sample_rate' (Hz).",
        code="raw.time.missing",
    )


def turning_of(raw: xr.Dataset, layout: Layout, notes: list[str]) -> Turning:
    """Return the angle over the record: by the encoder, else by the index pulses, else by the eccentricity.

    Raises
    ------
    MethodError
        Speed, pulses or angles contradict one another, or there are too few turns.
    """
    speed = float(raw["spindle_speed"])
    if not abs(speed) > 0:
        raise MethodError(
            "spindle_speed: expected the nominal speed of a turning spindle, with its sense; found 0",
            code="spindle.speed.zero",
        )
    if "angle" in raw:
        turning = _by_encoder(raw, speed)
    elif "index_time" in raw:
        turning = _by_index(np.asarray(raw["index_time"].values, float), speed, notes)
    else:
        turning = _by_eccentricity(raw, layout, speed, notes)
    if turning.turns < FEWEST_TURNS:
        raise MethodError(
            f"The record has {turning.turns} whole turns; expected at least {FEWEST_TURNS}, and 20 or more for the "
            "asynchronous error motion.",
            code="spindle.turns.too_few",
        )
    return turning


def _by_encoder(raw: xr.Dataset, speed: float) -> Turning:
    first, last, before = np.nan, 0.0, np.nan
    sense = 1 if speed > 0 else -1
    for chunk in chunks(raw):
        angle = unwrapped(chunk.encoder, before)
        known = angle[np.isfinite(angle)]
        if not known.size:
            continue
        first = float(known[0]) if np.isnan(first) else first
        if (np.diff(known) * sense < -0.2).any():
            raise MethodError(
                f"angle: expected the spindle to turn in the sense of spindle_speed ({speed:g} /min); found angles "
                "against it. Check the sense, or omit the part where the spindle stops.",
                code="spindle.angle.sense",
            )
        last = before = float(known[-1])
    start = sense * np.ceil(sense * first / TAU - 1e-9) * TAU
    turns = max(int(np.floor((last - start) * sense / TAU + 1e-9)), 0) if np.isfinite(first) else 0
    none = np.zeros(0)
    return Turning(none, none, turns, sense, "encoder", by_encoder=True, start=float(start))


def unwrapped(angle: Array, before: float) -> Array:
    """Return the angles of an encoder without jumps of whole turns, continued from an angle before them."""
    turns = np.full(angle.shape, np.nan)
    known = np.isfinite(angle)
    each = angle[known] if np.isnan(before) else np.append(before, angle[known])
    whole = np.unwrap(each)
    turns[known] = whole if np.isnan(before) else whole[1:]
    return turns


def _by_index(pulse: Array, speed: float, notes: list[str]) -> Turning:
    """Return the angle by pulses; where one is missing the turns are counted by the speed, a second one is dropped."""
    pulse = np.unique(pulse[np.isfinite(pulse)])
    if pulse.size < 2:
        raise MethodError(
            "index_time: expected the pulses of several turns; found fewer than two", code="spindle.index.missing"
        )
    usual = float(np.median(np.diff(pulse)))
    nominal = 60.0 / abs(speed)
    if not 0.5 < usual / nominal < 1.5:
        raise MethodError(
            f"index_time: expected pulses about {nominal:.4g} s apart, by spindle_speed; found {usual:.4g} s",
            code="spindle.index.implausible",
        )
    kept = [0]
    for k in range(1, pulse.size):
        if pulse[k] - pulse[kept[-1]] > 0.5 * usual:
            kept.append(k)
    if extra := pulse.size - len(kept):
        notes.append(f"{extra} index pulses follow another one within half a turn and are not used.")
    pulse = pulse[kept]
    turns = np.rint(np.diff(pulse) / usual).astype(int)
    if missing := int((turns - 1).sum()):
        notes.append(f"{missing} index pulses are missing; the angle is interpolated over their turns.")
    change = float(np.ptp(np.diff(pulse) / turns) / usual)
    if change > 0.02:
        notes.append(f"The time of one turn varies by {100 * change:.2g} %; the angle within a turn is interpolated.")
    angles = TAU * np.concatenate([[0], np.cumsum(turns)])
    return Turning(pulse, angles, int(turns.sum()), 1 if speed > 0 else -1, "index pulse")


def _by_eccentricity(raw: xr.Dataset, layout: Layout, speed: float, notes: list[str]) -> Turning:
    """Return the angle by the phase of the largest radial reading that occurs once a turn, block by block."""
    radial = np.flatnonzero(layout.radial)
    if not radial.size:
        raise MethodError(
            "Without index_time and angle, the angle follows from a radial sensor; there is none.",
            code="spindle.angle.unknown",
        )
    frequency = _frequency(raw, radial, abs(speed) / 60)
    time, phasor, rest = _phasors(raw, radial, frequency)
    known = np.isfinite(phasor).all(axis=1)
    if known.sum() < 2:
        raise MethodError(
            "The record is too short to follow the eccentricity: expected a time of 20 turns.",
            code="spindle.record.too_short",
        )
    time, phasor = time[known], phasor[known]
    use = int(np.argmax(np.abs(phasor).mean(axis=0)))
    size, scatter = float(np.abs(phasor[:, use]).mean()), float(np.sqrt(np.mean(rest[known, use])))
    if size < _CLEAR * scatter:
        raise MethodError(
            f"Without index_time and angle, the angle follows from the eccentricity, {1e6 * size:.3g} um, which the "
            f"other motion, {1e6 * scatter:.3g} um, hides: expected {_CLEAR:g} times as much. Record an index pulse.",
            code="spindle.eccentricity.hidden",
        )
    sense = 1 if speed > 0 else -1
    sensor = radial[use]
    # An eccentricity at azimuth sense * angle gives side * cos(sense * angle - azimuth)
    zero = sense * layout.azimuth[sensor] + (np.pi if layout.side[sensor] < 0 else 0.0)
    base = TAU * frequency * time
    angle = base + np.unwrap(np.angle(phasor[:, use]) - base) + zero
    half = (time[1] - time[0]) / 2
    rate = np.gradient(angle, time)[[0, -1]]
    time = np.concatenate([[time[0] - half], time, [time[-1] + half]])
    angle = np.concatenate([[angle[0] - half * rate[0]], angle, [angle[-1] + half * rate[1]]])
    angle = angle - TAU * np.ceil(angle[0] / TAU)
    notes.append(
        "The angle follows from the eccentricity, whose direction is the angle 0: a speed that changes within "
        f"{_TURNS_OF_A_BLOCK} turns is not followed."
    )
    return Turning(time, angle, int(np.floor(angle[-1] / TAU)), sense, "eccentricity")


def _frequency(raw: xr.Dataset, radial: NDArray[np.intp], nominal: float) -> float:
    """Return the frequency of the turns at the start of the record, near the nominal one, Hz."""
    first = next(iter(chunks(raw)))
    n = min(first.time.size, 1 << 17)
    y = np.nan_to_num(first.reading[radial, :n])
    y = (y - y.mean(axis=1, keepdims=True)) * np.hanning(n)
    step = (first.time[n - 1] - first.time[0]) / max(n - 1, 1)
    size = 4 * n
    power = np.square(np.abs(np.fft.rfft(y, size, axis=1))).sum(axis=0)
    f = np.fft.rfftfreq(size, step)
    near = np.flatnonzero((f > 0.8 * nominal) & (f < 1.2 * nominal))
    if not near.size:
        raise MethodError(
            f"spindle_speed: no frequency of the readings is near the {nominal:.4g} turns in a second",
            code="spindle.speed.implausible",
        )
    return float(f[near[np.argmax(power[near])]])


def _phasors(raw: xr.Dataset, radial: NDArray[np.intp], frequency: float) -> tuple[Array, Array, Array]:
    """Return times (block,), complex amplitudes (block, sensor), and mean squares of the rest (block, sensor)."""
    times, phasors, rest = [], [], []
    kept_time, kept = np.zeros(0), np.zeros((radial.size, 0))
    for chunk in chunks(raw):
        time, y = np.append(kept_time, chunk.time), np.concatenate([kept, chunk.reading[radial]], axis=1)
        n = max(int(_TURNS_OF_A_BLOCK / frequency / np.median(np.diff(time[:1000]))), 8)
        for first in range(0, time.size - n + 1, n):
            t, readings = time[first : first + n], y[:, first : first + n]
            its = np.isfinite(readings).all(axis=0)
            middle = float(t.mean())
            times.append(middle)
            if its.sum() < 8:
                phasors.append(np.full(radial.size, np.nan + 0j))
                rest.append(np.full(radial.size, np.nan))
                continue
            phase = TAU * frequency * (t[its] - middle)
            design = np.stack([np.ones(phase.size), phase, np.cos(phase), np.sin(phase)], axis=1)
            a, *_ = np.linalg.lstsq(design, readings[:, its].T, rcond=None)
            # cos(phase + p) = cos p cos phase - sin p sin phase
            phasors.append(a[2] - 1j * a[3])
            rest.append(np.mean(np.square(readings[:, its].T - design @ a), axis=0))
        done = time.size // n * n
        kept_time, kept = time[done:], y[:, done:]
    return np.array(times), np.array(phasors).reshape(-1, radial.size), np.array(rest).reshape(-1, radial.size)


def angles_of(chunk: Chunk, turning: Turning, before: float) -> tuple[Array, float]:
    """Return the angles of the samples of a chunk, and that to continue from: of the encoder before the next chunk."""
    if not turning.by_encoder:
        return turning.at(chunk.time), before
    angle = unwrapped(chunk.encoder, before)
    known = angle[np.isfinite(angle)]
    return turning.sense * (angle - turning.start), float(known[-1]) if known.size else before
