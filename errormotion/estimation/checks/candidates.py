"""Candidates for structural changes: what may have happened besides single outliers, such as a ball that moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.blocks import Index
from errormotion.estimation.checks.effects import information, solved
from errormotion.estimation.fit import Fit

__all__ = ["Candidate", "steps"]

CUTS = 12
"""Instants at which a step is tried at a time."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Candidate:
    """A possible change that affects several readings.

    Attributes
    ----------
    words : str
        What happened: "ball 3 moved before cycle 7".
    design : ndarray, (n, k) or (n, m, k)
        Derivatives of the residuals by its k unknowns.
    excluded : ndarray of bool, (n,), optional
        Readings that are excluded if it is found; without, its unknowns are added to the problem.
    trials : int
        How many candidates of its kind there are, if only the best one is given.
    smallest : float
        Smallest size (norm of its unknowns) that matters.
    """

    words: str
    design: Array
    excluded: NDArray[np.bool_] | None = None
    trials: int = 1
    smallest: float = 0.0


def steps(
    order: Array,
    label: Index,
    design: Array,
    words: Callable[[int, float], str],
    *,
    exclude: bool = True,
    smallest: float = 0.0,
) -> Callable[[Fit], list[Candidate]]:
    """Return a search for the best step of each label, such as a ball that moved, for ``suspects``.

    Parameters
    ----------
    order : ndarray, (n,)
        Instant or number along which the step is searched; it affects readings from an instant on.
    label : ndarray of int, (n,)
        What moves: the ball, the station; negative for readings that cannot have a step.
    design : ndarray, (n, k) or (n, m, k)
        Derivatives of the residuals by the step.
    words : callable
        From the label and the first instant after the step to the words of the candidate.
    exclude : bool
        Whether readings after the step are excluded; otherwise the step is estimated.
    smallest : float
        See `Candidate`.

    Notes
    -----
    The gain decreases on both sides of the true instant, so that it is searched at `CUTS` instants at a time. All
    instants count in the probability.
    """
    J = design[:, None, :] if design.ndim == 2 else design

    def found(fit: Fit) -> list[Candidate]:
        best = []
        for which in np.unique(label[label >= 0]):
            rows = np.flatnonzero((label == which) & fit.linear.used.any(axis=1))
            cuts = np.unique(order[rows])[1:]
            if not cuts.size:
                continue
            cut = cuts[_best_cut(fit, J, order, rows, cuts)]
            after = np.zeros(len(J), dtype=bool)
            after[rows[order[rows] >= cut]] = True
            best.append(
                Candidate(
                    words=words(int(which), float(cut)),
                    design=J * after[:, None, None],
                    excluded=after if exclude else None,
                    trials=cuts.size,
                    smallest=smallest,
                )
            )
        return best

    return found


def _best_cut(fit: Fit, J: Array, order: Array, rows: Index, cuts: Array) -> int:
    """Return the cut with the largest gain."""
    k = J.shape[2]
    low, high = 0, cuts.size - 1
    while True:
        tried = np.unique(np.linspace(low, high, CUTS).astype(int))
        late = order[rows][:, None] >= cuts[tried]  # (rows, cuts)
        D = (J[rows][:, :, None, :] * late[:, None, :, None]).reshape(rows.size, J.shape[1], -1)
        u, N = information(fit, D, rows)
        at = np.arange(tried.size)
        best = int(np.argmax(solved(u.reshape(-1, k), N.reshape(tried.size, k, tried.size, k)[at, :, at])[1]))
        if high - low < CUTS:
            return int(tried[best])
        low, high = int(tried[max(best - 1, 0)]), int(tried[min(best + 1, tried.size - 1)])
