"""Noise of values over time that stated standard deviations do not contain, where no redundant reading shows it.

As many readings as unknowns leave no residuals. What is measured is a smooth curve, and noise is not. Second
differences show noise of the size s that changes from value to value, but ``(6 - 8 phi + 2 phi^2) / 6`` of the variance
of one whose neighbours are correlated by phi: 0.15 of it at phi = 0.8. The values y of a channel are modelled as

    y = X b + f + e,    cov f = a K,    cov e = s^2 (I + rho R),    R_tu = phi^|t - u|,

with the cubic and the relaxations ``exp(-t / T)``, T of the order of an interval, in X, and a K of a process whose
fourth derivative is white (a smoothing spline of degree 7). b is eliminated by the restricted likelihood, a is the most
likely one for each noise. With the generalised eigenvalues l_j of (K, I + rho R) and the values w_j in this basis

    -2 log L = sum log(1 + a l_j) + sum w_j^2 / (1 + a l_j) + log det (I + rho R).

One noise of all channels is searched in their principal components, most of which hardly change, and one of a single
channel in its values. rho is the mean over a grid of rho and phi with the likelihood as weight, and there is such noise
if the mean of the likelihood exceeds that of the noise s alone. This is done for means over several lengths, of which
the shortest is one value, so that noise of any correlation is seen at one of them.

Noise as slow as the curve itself cannot be told from it, and a motion that is faster than the curve can follow looks
like noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from errormotion.arrays import Array
from errormotion.estimation.blocks import Index

__all__ = ["SlowNoise", "sentence", "slow_noise"]

FEWEST = 16
"""Values of a stretch without which nothing is tested."""
LONGEST = 3600.0
"""Length of the longest stretch of means, s; single values may be longer."""
ODDS = (-0.4, 2.2)
"""Logarithm of the mean likelihood relative to that without such noise, of all channels and of one alone, from which
there is some: by simulation, in 3 % and 1 % of records without it."""
_MOST = 64
"""Means of a stretch; the last ones are the quietest of a warm-up."""
_LENGTHS = 8
"""Ratio of one length of means to the next."""
_DEGREE = 4
_RELAXATIONS = (0.7, 1.5, 3.0)
"""In intervals: the fast part of a warm-up."""
_PHI = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95)
_RHO = np.geomspace(0.25, 256.0, 11)
_AMPLITUDES = np.concatenate([[0.0], np.geomspace(1e-2, 1e18, 101)])
_NODES = (np.arange(400) + 0.5) / 400


@dataclass(frozen=True)
class SlowNoise:
    """Noise of the values beyond their stated one.

    Attributes
    ----------
    sd : ndarray, (channel,)
        Its standard deviation in the unit of the values; 0 where there is none.
    duration : float
        Time over which it is alike, s; 0 for independent values.
    """

    sd: Array
    duration: float


def sentence(noise: SlowNoise, sizes: str, what: str = "the readings") -> str:
    """Return the sentences on further noise, with its ``sizes`` in words; they doubt uncertainties if it is alike."""
    subject = what[:1].upper() + what[1:]
    if not noise.duration > 0:
        return f"{subject} scatter about smooth curves by more than their noise ({sizes}); the uncertainty contains it."
    return (
        f"{subject} vary about smooth curves by more than their noise ({sizes}), alike for about "
        f"{noise.duration:.2g} s. The uncertainty of each error contains it, that of a mean or a slope over several "
        "instants does not. A motion that is as fast looks the same."
    )


def slow_noise(time: Array, values: Array, sd: Array, breaks: Sequence[float] = ()) -> SlowNoise | None:
    """Return the noise of values that their standard deviations do not contain; None if there is none.

    Parameters
    ----------
    time : ndarray, (n,)
        Increasing, s.
    values, sd : ndarray, (channel, n)
        Readings of smooth curves with their standard deviations, which are positive; NaN is unknown.
    breaks : sequence of float
        Times at which a curve may change abruptly.
    """
    known = np.isfinite(values).all(axis=0) & (sd > 0).all(axis=0)
    stretch = np.searchsorted(np.sort(np.asarray(breaks, dtype=float)), time, side="right")
    size, duration = np.zeros(len(values)), 0.0
    tests = list(_stretches(time[known], stretch[known]))
    for m, part in tests:
        at = np.flatnonzero(known)[part]
        t, y, s = (
            np.mean(each.reshape(*each.shape[:-1], -1, m), axis=-1) for each in (time[at], values[:, at], sd[:, at])
        )
        usual = np.median(s, axis=1, keepdims=True)
        relative = np.mean(np.square(s / usual), axis=0)
        ratio, phi = _beyond(t, y / usual * np.sqrt(m), relative, float(np.log(len(tests))))
        beyond = np.sqrt(ratio / m) * usual[:, 0]
        if (beyond > size).any():
            size = np.maximum(size, beyond)
            duration = max(duration, float(np.median(np.diff(t))) / -np.log(phi) if phi > 0 else 0.0)
    return SlowNoise(size, duration) if size.any() else None


def _stretches(time: Array, stretch: Index) -> list[tuple[int, slice]]:
    """Return the numbers of values in a mean, with the values of the longest stretch without a break."""
    edges = np.flatnonzero(np.diff(stretch, prepend=-1, append=-1))
    if len(edges) < 2:
        return []
    k = int(np.argmax(np.diff(edges)))
    first, end = int(edges[k]), int(edges[k + 1])
    lengths, m = [], 1
    interval = float(np.median(np.diff(time[first:end]))) if end - first > 1 else np.inf
    while (count := min((end - first) // m, _MOST)) >= FEWEST and (m == 1 or count * m * interval <= LONGEST):
        lengths.append((m, slice(end - count * m, end)))
        m *= _LENGTHS
    return lengths


def _beyond(t: Array, z: Array, relative: Array, more: float) -> tuple[Array, float]:
    """Return rho of each channel, 0 where it is not significant, and the most likely phi."""
    x, n = (t - t[0]) / np.ptp(t), len(t)
    interval = float(np.median(np.diff(t)))
    X = np.column_stack([x**k for k in range(_DEGREE)] + [np.exp(-(t - t[0]) / (interval * T)) for T in _RELAXATIONS])
    free = np.linalg.qr(X, mode="complete")[0][:, X.shape[1] :]
    root = free.T @ (np.maximum(x[:, None] - _NODES, 0.0) ** (_DEGREE - 1))
    K, white = root @ root.T / _NODES.size, free.T @ (relative[:, None] * free)
    z = z - z.mean(axis=1, keepdims=True)
    count = len(z)
    components = np.linalg.svd(z, full_matrices=False)[0].T @ z
    y = free.T @ np.concatenate([components, z]).T
    apart = np.abs(np.subtract.outer(t, t)) / interval
    logs = np.empty((len(_PHI), len(_RHO), y.shape[1]))
    base = _log_likelihood(K, white, y)
    for i, phi in enumerate(_PHI):
        R = free.T @ (np.power(phi, apart) if phi else np.eye(n)) @ free
        for j, rho in enumerate(_RHO):
            logs[i, j] = _log_likelihood(K, white + rho * R, y) - base
    together = logs[:, :, :count].sum(axis=2)
    likely = together.argmax()
    size, correlation = np.zeros(count), 0.0
    of_all = _mean(together) > ODDS[0] + more
    for c in range(count):
        own = logs[:, :, count + c]
        alone = _mean(own) - (own.flat[likely] if of_all else 0.0) > ODDS[1] + more
        if of_all or alone:
            log = own if alone else together
            weight = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
            size[c] = float((weight * _RHO).sum())
            correlation = max(correlation, float((weight * np.array(_PHI)[:, None]).sum()))
    return size, correlation


def _mean(logs: Array) -> float:
    """Return the logarithm of a mean of exponentials."""
    return float(logs.max() + np.log(np.mean(np.exp(logs - logs.max()))))


def _log_likelihood(K: Array, N: Array, y: Array) -> Array:
    """Return log L of each column of y for the noise N and its best amplitude of the curve."""
    values, vectors = eigh(K, N)
    w = vectors.T @ y
    v = 1.0 + _AMPLITUDES[:, None] * np.maximum(values, 0.0)
    deviance = np.log(v).sum(axis=1)[:, None] + (1.0 / v) @ np.square(w) + np.linalg.slogdet(N)[1]
    return np.asarray(-0.5 * deviance.min(axis=0))
