"""The compiled inner loops: counter-based noise, and the samples of the sensors.

Every random number is a pure function of (key, index), so that a sample has the same noise in any block of a stream.
The loops do not depend on the machine: their arguments are nodes, tables and coefficients.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array

Function = TypeVar("Function", bound=Callable[..., Any])

_MASK = (1 << 64) - 1
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S11, _S27, _S30, _S31 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31)

# Wichura (1988), algorithm AS 241: rational approximations in the middle and in the tails, highest power first.
_A = (
    *(2.5090809287301226727e3, 3.3430575583588128105e4, 6.7265770927008700853e4, 4.5921953931549871457e4),
    *(1.3731693765509461125e4, 1.9715909503065514427e3, 1.3314166789178437745e2, 3.3871328727963666080),
)
_B = (
    *(5.2264952788528545610e3, 2.8729085735721942674e4, 3.9307895800092710610e4, 2.1213794301586595867e4),
    *(5.3941960214247511077e3, 6.8718700749205790830e2, 4.2313330701600911252e1, 1.0),
)
_C = (
    *(7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1, 1.27045825245236838258),
    *(3.64784832476320460504, 5.76949722146069140550, 4.63033784615654529590, 1.42343711074968357734),
)
_D = (
    *(1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2, 1.48103976427480074590e-1),
    *(6.89767334985100004550e-1, 1.67638483018380384940, 2.05319162663775882187, 1.0),
)


def compiled(function: Function) -> Function:
    """Compile with numba: cached on disk, without the interpreter's lock."""
    return cast(Function, numba.njit(cache=True, nogil=True)(function))


@compiled
def mixed(x: np.uint64) -> np.uint64:
    """Return x with its 64 bits mixed (the finaliser of SplitMix64, Steele, Lea and Flood 2014)."""
    x = (x ^ (x >> _S30)) * _MIX_1
    x = (x ^ (x >> _S27)) * _MIX_2
    return x ^ (x >> _S31)


@compiled
def horner(coefficients: tuple[float, ...], x: float) -> float:
    """Return the polynomial with these coefficients, highest power first."""
    value = 0.0
    for coefficient in coefficients:
        value = value * x + coefficient
    return value


@compiled
def normal_quantile(p: float) -> float:
    """Return the standard normal quantile of p, to a relative 1e-15 for 1e-12 < p < 1 - 1e-12, else to 1e-6."""
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        return q * horner(_A, r) / horner(_B, r)
    r = math.sqrt(-math.log(min(p, 1.0 - p))) - 1.6
    return math.copysign(horner(_C, r) / horner(_D, r), q)


@compiled
def normal(key: np.uint64, index: int) -> float:
    """Return the standard normal number ``index`` of the stream ``key``."""
    bits = mixed(key + np.uint64(index) * _GOLDEN)
    return normal_quantile((np.float64(bits >> _S11) + 0.5) * 2.0**-53)


@compiled
def normals(key: np.uint64, first: int, n: int) -> Array:
    """Return the numbers first .. first + n - 1 of a stream, shape (n,)."""
    out = np.empty(n)
    for i in range(n):
        out[i] = normal(key, first + i)
    return out


@compiled
def first_sample(time: float, rate: float) -> int:
    """Return the counter of the first sample at or after a time (sample i is taken at i / rate)."""
    i = math.ceil(time * rate)
    while i / rate < time:
        i += 1
    while i > 0 and (i - 1) / rate >= time:
        i -= 1
    return i


@compiled
def rotating_bar(
    out: Array,
    first: int,
    rate: float,
    times: Array,
    slow: Array,
    revolutions: Array,
    table: Array,
    noise: Array,
    keys: NDArray[np.uint64],
    limit: float,
) -> None:
    """Fill the samples of ``out`` that lie between the first and the last of the node times.

    Parameters
    ----------
    out : ndarray, (channel, n)
        Readings of samples first .. first + n - 1, m; NaN where out of range 0 .. limit.
    times : ndarray, (node,)
        Node times, s.
    slow : ndarray, (channel, node)
        Distance at each node, m; linear between.
    revolutions : ndarray, (node, 3)
        Angle of the spindle after node k: revolutions[k] @ (1, dt, dt^2), in revolutions.
    table : ndarray, (channel, angle + 1)
        The pattern that repeats in every turn, m, over one turn; the last column repeats the first.
    noise : ndarray, (channel,)
        White noise of one sample, m.
    keys : ndarray of uint64, (channel,)
        Noise streams.
    """
    n = out.shape[1]
    angles = table.shape[1] - 1
    for k in range(times.size - 1):
        start = max(first_sample(times[k], rate), first) - first
        stop = min(first_sample(times[k + 1], rate), first + n) - first
        if start >= stop:
            continue
        t0 = times[k]
        length = times[k + 1] - t0
        for c in range(out.shape[0]):
            value = slow[c, k]
            slope = (slow[c, k + 1] - value) / length
            revolutions_0, revolutions_1, revolutions_2 = revolutions[k, 0], revolutions[k, 1], revolutions[k, 2]
            track = table[c]
            key = keys[c]
            sigma = noise[c]
            for i in range(start, stop):
                dt = (first + i) / rate - t0
                turn = revolutions_0 + dt * (revolutions_1 + dt * revolutions_2)
                place = (turn - math.floor(turn)) * angles
                cell = min(int(place), angles - 1)
                pattern = track[cell] + (place - cell) * (track[cell + 1] - track[cell])
                reading = value + slope * dt + pattern + sigma * normal(key, first + i)
                out[c, i] = reading if 0.0 <= reading <= limit else math.nan


@compiled
def stepped_sphere(
    out: Array,
    first: int,
    rate: float,
    begins: Array,
    ends: Array,
    places: Array,
    radius: float,
    origin: Array,
    direction: Array,
    offset: Array,
    noise: Array,
    keys: NDArray[np.uint64],
    limit: float,
) -> None:
    """Fill ``out`` with readings of a sphere that is moved in steps.

    Parameters
    ----------
    out : ndarray, (channel, n)
        Readings of samples first .. first + n - 1, m; NaN out of range, or where the beam misses the sphere.
    begins, ends : ndarray, (rest,)
        Start and end of each rest, s; between two rests the sphere moves in a straight line.
    places : ndarray, (rest, 3)
        Centre of the sphere at each rest, m.
    origin, direction : ndarray, (channel, 3)
        Beams, m.
    offset : ndarray, (channel, rest)
        Deviation of the reading at each rest (speckle), m.
    """
    rests = begins.size
    for c in range(out.shape[0]):
        k = 0
        for i in range(out.shape[1]):
            t = (first + i) / rate
            while k < rests - 1 and t >= begins[k + 1]:
                k += 1
            share = 0.0
            if k < rests - 1 and t > ends[k]:
                share = (t - ends[k]) / (begins[k + 1] - ends[k])
            after = min(k + 1, rests - 1)
            along = 0.0  # of the sphere's centre along the beam
            square = 0.0  # of its distance from the origin
            for x in range(3):
                centre = places[k, x] + share * (places[after, x] - places[k, x]) - origin[c, x]
                along += centre * direction[c, x]
                square += centre * centre
            inside = along * along - square + radius * radius
            if inside < 0.0:
                out[c, i] = math.nan
                continue
            extra = offset[c, k] + share * (offset[c, after] - offset[c, k])
            reading = along - math.sqrt(inside) + extra + noise[c] * normal(keys[c], first + i)
            out[c, i] = reading if 0.0 <= reading <= limit else math.nan


def stream_key(*labels: int) -> np.uint64:
    """Return the key of a random stream from integer labels (seed, purpose, channel, ...)."""
    key = 0
    for label in labels:
        key = _mixed_integer((key + (int(label) & _MASK) + int(_GOLDEN)) & _MASK)
    return np.uint64(key)


def _mixed_integer(x: int) -> int:
    x = ((x ^ (x >> 30)) * int(_MIX_1)) & _MASK
    x = ((x ^ (x >> 27)) * int(_MIX_2)) & _MASK
    return x ^ (x >> 31)
