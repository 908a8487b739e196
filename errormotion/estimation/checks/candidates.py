"""Candidates for structural changes: what may have happened besides single outliers, such as a ball that moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.blocks import Index
from errormotion.estimation.checks.effects import reduced, solved
from errormotion.estimation.fit import Fit

__all__ = ["Candidate", "steps"]

CUTS = 12
"""Instants at which the information on a step is computed at a time."""


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
    The gain is computed at the most likely instants only (`CUTS`). All instants count in the probability.
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
    """Return the cut with the largest gain.

    ``u`` is exact at all cuts. The information is computed at `CUTS` of them, and interpolated for the choice of half
    as many further ones.
    """
    k = J.shape[2]
    white = fit.linear.whitener[rows] @ J[rows]
    last = np.searchsorted(cuts, order[rows], side="right")  # the number of cuts before each reading, and at it
    each = np.einsum("nmk,nm->nk", white, fit.linear.residual[rows])
    u = np.stack([np.bincount(last, weights, cuts.size + 1) for weights in each.T], axis=1)[::-1].cumsum(axis=0)
    u = u[::-1][1:]

    def reduced_information(tried: Index) -> Array:
        late = last[:, None] > tried  # (rows, cuts)
        D = (white[:, :, None, :] * late[:, None, :, None]).reshape(rows.size, J.shape[1], -1)
        N = reduced(fit, D, rows)[1].reshape(tried.size, k, tried.size, k)
        return np.asarray(N[np.arange(tried.size), :, np.arange(tried.size)])

    tried = np.unique(np.linspace(0, cuts.size - 1, CUTS).astype(int))
    N = reduced_information(tried)
    gain = solved(u[tried], N)[1]
    if cuts.size > tried.size:
        at = np.arange(cuts.size)
        right = np.clip(np.searchsorted(tried, at), 1, tried.size - 1)
        part = ((at - tried[right - 1]) / (tried[right] - tried[right - 1]))[:, None, None]
        likely = solved(u, (1 - part) * N[right - 1] + part * N[right])[1]
        likely[tried] = -np.inf
        more = np.argsort(likely)[::-1][: CUTS // 2]
        tried, gain = np.append(tried, more), np.append(gain, solved(u[more], reduced_information(more))[1])
    return int(tried[np.argmax(gain)])
