"""Gauss-Newton of a multilateration network with each target's block eliminated: cost and memory linear in the targets.

A pass puts every target where its distances from the present stations are best fulfilled, and adds up what is left of
its readings: information and gradient of 4 n parameters, whatever the number of targets. Their step follows from a
system of that size, in which the six motions of the whole are left out. Levenberg's damping comes in when a step makes
things worse. Many targets are preceded by a sample of them, which takes the stations so far that two passes over all
will do.
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
_WORTH = 4
_FITTING = 10.0
_DAMPED = 1e-8
_UNDAMPED = 1e-11
_LONG = 12
_NEAR = 1e-6


@dataclass(frozen=True)
class State:
    """Stations and targets (3, m), their sums, passes, and whether the last step was small enough."""

    stations: Stations
    place: Array
    sums: Sums
    passes: int
    converged: bool


def descend(problem: Problem, stations: Stations, target: Array, tolerance: float) -> State:
    """Take steps until a further one would move no target by more than ``tolerance``, from targets (m, 3)."""
    Z, many = problem.basis(stations, problem.centre), len(target) // SAMPLE
    if many >= _WORTH and not problem.known:
        stations = _rehearsed(problem.sample(many), stations, Z)
    place = np.ascontiguousarray(target.T)
    sums = problem.reduce(stations, place)
    mu, moved, stepped, passes = 0.0, np.inf, np.inf, 1
    while passes < PASSES:
        step, size, gain = _step(Z, sums.H, sums.h, mu)
        trial = stations.stepped(step)
        if mu == 0.0 and _ahead(size, stepped) < tolerance:
            return State(trial, place, replace(sums, square=max(sums.square - gain, 0.0)), passes, True)
        found = problem.reduce(trial, place)
        passes += 1
        if not found.square <= sums.square * (1 + 1e-9) + 1e-6:
            place[:] = target.T
            mu, stepped = max(10 * mu, _DAMPED), np.inf
            if mu > 1e8:
                break
            continue
        stations, sums, stepped, mu = trial, found, size, (0.1 * mu if mu > _UNDAMPED else 0.0)
        ahead, moved = _ahead(found.moved, moved), found.moved
        # What no longer shrinks and is far below any noise is rounding.
        if mu == 0.0 and (ahead < tolerance or (passes > _LONG and moved < 1e-10)):
            return State(stations, place, sums, passes, True)
    return State(stations, place, sums, passes, False)


def _ahead(size: float, last: float) -> float:
    """Return how far it still is after a step: steps shrink at least as fast as they have; unknown after the first."""
    if last == np.inf:
        return float(np.inf)
    return size * min(1.0, size / last) if last > 0.0 else size


def _rehearsed(problem: Problem, stations: Stations, Z: Array) -> Stations:
    """Return the stations that a sample of the targets leads to; those given where it leads nowhere."""
    by_target, by_station = problem.by_target, problem.by_station
    unknown = len(problem.free) - 6
    if by_station.min() < 4 or np.maximum(by_target - 3, 0).sum() < 2 * unknown:
        return stations
    place, now, last = np.ascontiguousarray(problem.nominal.T), stations, np.inf
    for _ in range(_LONG):
        sums = problem.reduce(now, place)
        step, size, _ = _step(Z, sums.H, sums.h, 0.0)
        now = now.stepped(step)
        # The sample is off by its noise: closer than this to its own answer is of no use.
        if size < _NEAR or _ahead(size, last) < 0.1 * _NEAR:
            fits = sums.square < _FITTING**2 * problem.reading.size
            return now if fits else stations
        last = size
    return stations


def _step(Z: Array, H: Array, h: Array, mu: float) -> tuple[Array, float, float]:
    """Return the step of the stations' parameters within the columns of Z, damped by mu, its size, and its gain.

    The size is its largest part; the gain is that of the sum of squares, to second order.
    """
    A = Z.T @ H @ Z
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-30 * np.trace(A) + 1e-300))
    A *= np.outer(scale, scale)
    A[np.diag_indices_from(A)] += mu
    step = Z @ (scale * np.linalg.lstsq(A, scale * (Z.T @ h), 1e-15)[0])
    return step, float(np.abs(step).max()), float(step @ h)
