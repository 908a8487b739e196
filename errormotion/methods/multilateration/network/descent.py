"""Gauss-Newton of a network with the block of each target eliminated: cost and memory are linear in the targets.

A pass moves every target to the best fit of its distances from the present stations, and sums the information and
gradient of the 4 n parameters of the stations. Their step follows from a system of that size, without the six rigid
motions. Levenberg's damping is used when a step increases the sum of squares. With many targets the stations are first
fitted to a sample of them, so that two passes over all are sufficient.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.model import Stations
from errormotion.methods.multilateration.network.problem import Problem, Sums

PASSES = 200
SAMPLE = 512
"""Targets in a sample."""
_MIN_SAMPLES = 4  # numbers of targets, in samples, from which a sample is used
_MAX_RMS = 10.0  # over the noise; a sample that fits worse is not used
_FIRST_DAMPING, _MIN_DAMPING = 1e-8, 1e-11
_MANY_PASSES = 12
_SAMPLE_TOLERANCE = 1e-6  # m


@dataclass(frozen=True)
class State:
    """Stations and targets (3, m), their sums, number of passes, and whether the iteration converged."""

    stations: Stations
    position: Array
    sums: Sums
    passes: int
    converged: bool


def descend(problem: Problem, stations: Stations, target: Array, tolerance: float) -> State:
    """Iterate from targets (m, 3) until a further step would move no target by more than ``tolerance``, m."""
    Z, many = problem.basis(stations, problem.centre), len(target) // SAMPLE
    if many >= _MIN_SAMPLES and not problem.known:
        stations = _fitted_to_sample(problem.sample(many), stations, Z)
    position = np.ascontiguousarray(target.T)
    sums = problem.reduce(stations, position)
    mu, moved, stepped, passes = 0.0, np.inf, np.inf, 1
    while passes < PASSES:
        step, size, gain = _step(Z, sums.H, sums.h, mu)
        trial = stations.stepped(step)
        if mu == 0.0 and _remaining(size, stepped) < tolerance:
            return State(trial, position, replace(sums, square=max(sums.square - gain, 0.0)), passes, True)
        found = problem.reduce(trial, position)
        passes += 1
        if not found.square <= sums.square * (1 + 1e-9) + 1e-6:
            position[:] = target.T
            mu, stepped = max(10 * mu, _FIRST_DAMPING), np.inf
            if mu > 1e8:
                break
            continue
        stations, sums, stepped, mu = trial, found, size, (0.1 * mu if mu > _MIN_DAMPING else 0.0)
        remaining, moved = _remaining(found.moved, moved), found.moved
        # Steps far below any noise that no longer decrease are rounding errors.
        if mu == 0.0 and (remaining < tolerance or (passes > _MANY_PASSES and moved < 1e-10)):
            return State(stations, position, sums, passes, True)
    return State(stations, position, sums, passes, False)


def _remaining(size: float, last: float) -> float:
    """Return an upper estimate of the next step from the last two; infinite after the first."""
    if last == np.inf:
        return float(np.inf)
    return size * min(1.0, size / last) if last > 0.0 else size


def _fitted_to_sample(problem: Problem, stations: Stations, Z: Array) -> Stations:
    """Return the stations fitted to a sample of the targets; unchanged if it does not determine or fit them."""
    by_target, by_station = problem.by_target, problem.by_station
    unknown = len(problem.free) - 6
    if by_station.min() < 4 or np.maximum(by_target - 3, 0).sum() < 2 * unknown:
        return stations
    position, now, last = np.ascontiguousarray(problem.nominal.T), stations, np.inf
    for _ in range(_MANY_PASSES):
        sums = problem.reduce(now, position)
        step, size, _ = _step(Z, sums.H, sums.h, 0.0)
        now = now.stepped(step)
        # The error of the sample by its noise is larger than this.
        if size < _SAMPLE_TOLERANCE or _remaining(size, last) < 0.1 * _SAMPLE_TOLERANCE:
            fits = sums.square < _MAX_RMS**2 * problem.reading.size
            return now if fits else stations
        last = size
    return stations


def _step(Z: Array, H: Array, h: Array, mu: float) -> tuple[Array, float, float]:
    """Return the step of the stations' parameters within the columns of Z, with damping mu, its size, and its gain.

    The size is its largest component; the gain is the decrease of the sum of squares, to second order.
    """
    A = Z.T @ H @ Z
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-30 * np.trace(A) + 1e-300))
    A *= np.outer(scale, scale)
    A[np.diag_indices_from(A)] += mu
    step = Z @ (scale * np.linalg.lstsq(A, scale * (Z.T @ h), 1e-15)[0])
    return step, float(np.abs(step).max()), float(step @ h)
