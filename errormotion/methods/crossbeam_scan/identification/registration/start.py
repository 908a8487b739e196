"""Where Gauss-Newton starts: at rest where that fits, else at the best of a coarse grid of shifts and yaws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.identification.registration.solver import (
    Noise,
    Problem,
    State,
    normal_equations,
    solve,
)

SHIFTS = np.linspace(-2e-3, 2e-3, 5)
SETTLED = 1e-7
"""Steps that move the surface by less than this, m, end the descent: the next would be a thousandth of it."""
YAWS = np.linspace(-0.05, 0.05, 5)
_WHITE = Noise()
_LEVEL = [2, 3, 4]
_KEPT = 6
_STEPS = 25


@dataclass(frozen=True)
class Start:
    """A state, the robust scale of the residuals there (m), and the steps it took."""

    state: State
    scale: float
    steps: int
    overlap: float = 0.0
    """Share of the known warm blocks that have cold surface beneath them."""


def descend(problem: Problem, state: State, motions: Array, radius: float, steps: int = _STEPS) -> Start:
    """Take Gauss-Newton steps with the blocks that fit until they no longer move the surface by the noise."""
    gate, done, known = np.inf, 0, np.count_nonzero(np.isfinite(problem.stack[3]))
    for done in range(1, steps + 1):
        sums = problem.evaluate(state, gate)
        if 4 * sums.used < known:
            if gate < np.inf:
                gate = np.inf
                continue
            return Start(state, np.inf, done)
        step = solve(*normal_equations(sums, _WHITE), motions, radius)
        size = float(np.max(np.abs(step * [1, 1, 1, radius, radius, radius])))
        # A step beyond the surface's features leads nowhere.
        state = problem.stepped(state, step * min(1.0, 2e-3 / max(size, 1e-12)))
        gate = max(6 * sums.scale(), 1e-9)
        if size < SETTLED:
            break
    sums = problem.evaluate(state)
    return Start(state, sums.scale(), done, np.count_nonzero(np.isfinite(sums.residual)) / known)


def search(problem: Problem, motions: Array, radius: float) -> Start:
    """Return the best descent from a grid of shifts and yaws about the centre."""
    tried = []
    for x in SHIFTS:
        for y in SHIFTS:
            for yaw in YAWS:
                state = problem.stepped(problem.rest, np.array([x, y, 0.0, 0.0, 0.0, yaw]))
                for _ in range(2):
                    sums = problem.evaluate(state)
                    if sums.used < 16:
                        break
                    H, h = normal_equations(sums, _WHITE)
                    level = np.zeros(6)
                    level[_LEVEL] = -np.linalg.solve(H[np.ix_(_LEVEL, _LEVEL)], h[_LEVEL])
                    state = problem.stepped(state, level)
                else:
                    tried.append(Start(state, problem.evaluate(state).scale(), 3))
    tried.sort(key=lambda start: start.scale)
    ends = [descend(problem, start.state, motions, radius) for start in tried[:_KEPT]]
    return min(ends, key=lambda start: start.scale, default=Start(problem.rest, np.inf, 0))
