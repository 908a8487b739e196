"""Passes over the samples of a record, in constant memory: sums by batch of turns and part of a turn, and extremes.

A sample is used if all sensors have a reading, within the whole turns, and if none of them is a spike: a value whose
two neighbours agree with each other and not with it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compiling import Compiler

compiled = Compiler("the loops for spindle error motions", seconds=6, error_model="numpy")
DRAWS = 3
"""Extremes with further noise, which state the bias by the noise."""


@compiled()
def interpolated(time: Array, knots: Array, values: Array, slope: Array, result: Array) -> None:
    """Write values at increasing times, between knots by cubic polynomials with these slopes; NaN outside of them."""
    j = max(np.searchsorted(knots, time[0], side="right") - 1, 0) if time.size else 0
    last = knots.size - 2
    for i in range(time.size):
        t = time[i]
        if t < knots[0] or t > knots[last + 1]:
            result[i] = np.nan
            continue
        while j < last and knots[j + 1] <= t:
            j += 1
        h = knots[j + 1] - knots[j]
        x = (t - knots[j]) / h
        d, m0, m1 = values[j + 1] - values[j], h * slope[j], h * slope[j + 1]
        # Hermite: a + x m0 + x^2 (3 d - 2 m0 - m1) + x^3 (m0 + m1 - 2 d)
        result[i] = values[j] + x * (m0 + x * (3 * d - 2 * m0 - m1 + x * (m0 + m1 - 2 * d)))


@compiled(inline="always")
def spike(before: float, value: float, after: float, limit: float) -> bool:
    """Return whether a value stands out from both neighbours, which agree; False where one of them is unknown."""
    off = abs(value - 0.5 * (before + after))
    return off > limit and abs(after - before) < 0.5 * off


@compiled()
def add_up(
    reading: Array,
    turn: Array,
    sense: int,
    turns: int,
    limit: Array,
    count: NDArray[np.int64],
    offset: Array,
    square: Array,
    total: Array,
) -> int:
    """Add the samples of a chunk to the sums; return the number of spikes.

    Parameters
    ----------
    reading : ndarray, (sensor, n)
    turn : ndarray, (n,)
        Angle from the first whole turn, in turns; NaN where it is unknown.
    limit : ndarray, (sensor,)
        Of spikes, m.
    count : ndarray, (batch, part)
        Number of samples.
    offset, square : ndarray, (batch, part)
        Sums of the angle from the middle of the part, and of its square, in parts.
    total : ndarray, (sensor, batch, part)
        Sums of readings, m.
    """
    sensors, n = reading.shape
    batches, parts = count.shape
    whole_turns = 0
    for j in range(n):
        u = turn[j]
        if not (u >= 0.0 and u < turns):
            continue
        good = True
        for i in range(sensors):
            y = reading[i, j]
            if np.isnan(y):
                good = False
            elif 0 < j < n - 1 and spike(reading[i, j - 1], y, reading[i, j + 1], limit[i]):
                good = False
                whole_turns += 1
        if not good:
            continue
        whole = int(u)
        at = u - whole if sense > 0 else 1.0 - (u - whole)
        place = at * parts
        p = int(place)
        if p >= parts:
            p, place = 0, 0.0
        b = whole * batches // turns
        d = place - p - 0.5
        count[b, p] += 1
        offset[b, p] += d
        square[b, p] += d * d
        for i in range(sensors):
            total[i, b, p] += reading[i, j]
    return whole_turns


@compiled()
def extremes(
    reading: Array,
    turn: Array,
    sense: int,
    turns: int,
    limit: Array,
    table: Array,
    drift: Array,
    weight: Array,
    noise: Array,
    normal: Array,
    seed: int,
    low: Array,
    high: Array,
    noisy_low: Array,
    noisy_high: Array,
    power: Array,
) -> int:
    """Update the extremes of the motion that is not synchronous with the samples of a chunk; return the next seed.

    Parameters
    ----------
    reading, turn, sense, turns, limit
        As in `add_up`; spikes are searched in what is not synchronous.
    table : ndarray, (t + 1, sensor)
        Synchronous part of the readings at t even angles of the axis, and the first again, m.
    drift : ndarray, (batch, sensor)
        Slow changes of the readings at the middle of each batch of turns, m.
    weight : ndarray, (sector, curve, sensor)
        Effect of readings on each curve.
    noise : ndarray, (curve,)
        Standard deviation of the noise of the sensors in each curve.
    normal : ndarray, (2^k,)
        Normal numbers.
    low, high : ndarray, (curve, sector)
        Extremes of each curve.
    noisy_low, noisy_high : ndarray, (draw, curve, sector)
        The same with further noise.
    power : ndarray, (curve + 1,)
        Sums of squares, and the number of samples.
    """
    sensors, n = reading.shape
    sectors, curves = weight.shape[0], weight.shape[1]
    draws = noisy_low.shape[0]
    steps = table.shape[0] - 1
    batches = drift.shape[0]
    mask = normal.size - 1
    state = np.uint64(seed)
    rest = np.empty((3, sensors))
    known = np.zeros(3, np.bool_)
    reached = np.abs(normal).max() * noise
    # Values between these are no extremes, with or without noise
    inner_low, inner_high = np.empty((curves, sectors)), np.empty((curves, sectors))
    for c in range(curves):
        for s in range(sectors):
            inner_low[c, s] = max(low[c, s], noisy_low[:, c, s].max() + reached[c])
            inner_high[c, s] = min(high[c, s], noisy_high[:, c, s].min() - reached[c])
    now, middle, last = 0, 1, 2
    for j in range(n + 1):  # sample j comes in, sample j - 1 is evaluated with its neighbours
        now, middle, last = last, now, middle
        known[now] = False
        if j < n and turn[j] >= 0.0 and turn[j] < turns:
            u = turn[j]
            at = u - int(u) if sense > 0 else 1.0 - (u - int(u))
            x = at * steps
            t = min(int(x), steps - 1)
            x -= t
            b = u * batches / turns - 0.5
            k = min(max(int(b), 0), max(batches - 2, 0))
            w = min(max(b - k, 0.0), 1.0)
            next_one = min(k + 1, batches - 1)
            known[now] = True
            for i in range(sensors):
                r = reading[i, j] - (1.0 - x) * table[t, i] - x * table[t + 1, i]
                r -= (1.0 - w) * drift[k, i] + w * drift[next_one, i]
                rest[now, i] = r
                if np.isnan(r):
                    known[now] = False
        if j == 0 or not known[middle]:
            continue
        if known[now] and known[last]:
            good = True
            for i in range(sensors):
                if spike(rest[last, i], rest[middle, i], rest[now, i], limit[i]):
                    good = False
            if not good:
                continue
        u = turn[j - 1]
        at = u - int(u) if sense > 0 else 1.0 - (u - int(u))
        s = min(int(at * sectors), sectors - 1)
        power[curves] += 1.0
        for c in range(curves):
            v = 0.0
            for i in range(sensors):
                v += weight[s, c, i] * rest[middle, i]
            power[c] += v * v
            if v > inner_low[c, s] and v < inner_high[c, s]:
                continue  # as most: no noise makes it an extreme
            low[c, s] = min(low[c, s], v)
            high[c, s] = max(high[c, s], v)
            for d in range(draws):
                state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
                noisy = v + noise[c] * normal[(state >> np.uint64(33)) & np.uint64(mask)]
                noisy_low[d, c, s] = min(noisy_low[d, c, s], noisy)
                noisy_high[d, c, s] = max(noisy_high[d, c, s], noisy)
            inner_low[c, s] = max(low[c, s], noisy_low[:, c, s].max() + reached[c])
            inner_high[c, s] = min(high[c, s], noisy_high[:, c, s].min() - reached[c])
    return int(state >> np.uint64(2))
