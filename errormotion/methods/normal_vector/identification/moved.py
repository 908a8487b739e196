"""Detection of outliers among the touches, and of balls that moved, by the improvement of the fit without them.

The distances between balls at rest are constant, so that a ball that moved contradicts the others. The gain (decrease
of chi-square) of a move is that of an additional unknown shift common to all cycles from one on. The gain of a single
outlier is its squared residual over its variance. The most improbable deviation is excluded first, and the fit is
repeated, until none is improbable at a false alarm rate of 1 in 1000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.normal_vector.identification.rigid import Observations, Rigid, determined, fit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.normal_vector.identification.freedoms import Motion

    Flags = NDArray[np.bool_]

FALSE_ALARM = 1e-3
"""Probability at which valid data are excluded."""
MAX_ITERATIONS = 60
AMBIGUITY = 12.0
"""Difference in chi-square from the best gain below which another ball may be the one that moved."""
OUTLIER_PREFERENCE = 0.95
"""Gain of an outlier, relative to that of a move, above which the outlier is the simpler explanation."""
ENOUGH_FOR_MEDIAN = 30
"""Degrees of freedom above which the noise is limited by a median."""
_SINGULAR = 1e-6


@dataclass(frozen=True)
class Move:
    """A ball that moved: its number, the first cycle after the move, the shift (3,), m, and other possible balls."""

    ball: int
    cycle: int
    shift: Array
    others: tuple[int, ...]


@dataclass(frozen=True)
class Cleaned:
    """The accepted data, and their fit.

    Attributes
    ----------
    seen : Observations
        All cycles, without the excluded touches.
    used : ndarray of int
        Cycles that determine the motion; those of ``fit``.
    fit : Rigid
    wrong : ndarray of bool (k, b, m)
        Outliers.
    moves : list of Move
    """

    seen: Observations
    used: NDArray[np.intp]
    fit: Rigid
    wrong: Flags
    moves: list[Move]


def clean(
    seen: Observations, motion: Motion, *, interpolate: bool, stated: bool, robust: bool, smallest_move: float
) -> Cleaned:
    """Fit, and exclude outliers and balls that moved.

    Parameters
    ----------
    seen : Observations
    motion : Motion
    interpolate : bool
        See `rigid.fit`.
    stated : bool
        Whether the weights are stated inverse variances; otherwise only their ratios are known.
    robust : bool
        Whether data may be excluded.
    smallest_move : float
        Smallest displacement of a ball that counts as a move, m.

    Raises
    ------
    MethodError
        The cold cycle, or all others, do not determine the motion.
    """
    wrong, moves = np.zeros(seen.valid.shape, dtype=bool), list[Move]()
    for _ in range(MAX_ITERATIONS):
        used = _used(seen, motion)
        found = fit(seen.cycles(used), motion, interpolate=interpolate)
        suspect = _suspect(seen.cycles(used), found, stated, smallest_move) if robust else None
        if suspect is None:
            return Cleaned(seen, used, found, wrong, moves)
        if isinstance(suspect, Move):
            move = Move(suspect.ball, int(used[suspect.cycle]), suspect.shift, suspect.others)
            excluded = np.zeros_like(wrong)
            excluded[move.cycle :, move.ball] = True
            moves.append(move)
        else:
            excluded = np.zeros_like(wrong)
            excluded[used] = suspect
            wrong |= excluded
        seen = seen.without(excluded)
    raise MethodError(
        f"More than {MAX_ITERATIONS} exclusions of outliers would be needed. Check the mounting of the balls and the "
        "repeatability of the probe; robust = false gives the residuals."
    )


def _used(seen: Observations, motion: Motion) -> NDArray[np.intp]:
    usable = determined(seen, motion)
    if not usable[0]:
        raise MethodError(
            "The cold cycle alone does not determine the positions of the balls: too many of its touches are missing "
            "or outliers. Probe the cold machine again, or use a later cycle as the reference."
        )
    return np.flatnonzero(usable)


def _suspect(seen: Observations, found: Rigid, stated: bool, smallest_move: float) -> Move | Flags | None:
    """Return the most improbable move, or the most improbable touches; None if there are none."""
    if found.freedom < 2:
        return None
    H, W = found.design, seen.weight
    size = np.sqrt(np.einsum("kbmp,kbmp->p", H, H)) + 1e-300
    H = H / size
    WH = W @ H
    inverse = np.linalg.inv(np.einsum("kbmp,kbmq->kpq", H, WH, optimize=True))
    residual = np.nan_to_num(found.residual)
    # A shift of ball i in cycle k: information I and right side u of its three unknowns.
    n = found.normal
    nWH = np.swapaxes(n, 2, 3) @ WH
    information = np.swapaxes(n, 2, 3) @ W @ n - nWH @ inverse[:, None] @ np.swapaxes(nWH, 2, 3)
    u = (np.swapaxes(n, 2, 3) @ (W @ residual[..., None]))[..., 0]
    # Reduced by the motion of the cycle, as the information is: otherwise little information has a large gain.
    u -= np.einsum("kbip,kpq,kcmq,kcm->kbi", nWH, inverse, WH, residual, optimize=True)
    level = _Level(found, seen, H, inverse, stated)
    move = _move(information, u, smallest_move, level)
    touch = _touches(level) if seen.touched else _centres(information, u, level)
    if move is not None and (touch is None or touch[0] < OUTLIER_PREFERENCE * move[0]):
        return move[1]
    return None if touch is None else touch[1]


class _Level:
    """Probability of a gain for the given noise."""

    def __init__(self, found: Rigid, seen: Observations, H: Array, inverse: Array, stated: bool) -> None:
        w = np.diagonal(seen.weight, axis1=2, axis2=3)
        leverage = w * np.einsum("kbmp,kpq,kbmq->kbm", H, inverse, H, optimize=True)
        # The reach of a touch is the mean of its cycles: its own weight in this mean is an additional leverage.
        own = np.maximum((1 - leverage) * (1 - w / np.maximum(w.sum(axis=0), 1e-300)), _SINGULAR)
        self.judged = (w > 0) & (own > 1e-3)
        self.square = np.where(self.judged, w * np.nan_to_num(found.residual) ** 2 / own, 0.0)
        self.chi2, self.freedom, self.stated = found.chi2, found.freedom, stated
        self.robust = np.inf
        if found.freedom > ENOUGH_FOR_MEDIAN:
            median_of_chi2 = float(2 * special.gammaincinv(0.5, 0.5))
            self.robust = float(np.median(self.square[self.judged])) / median_of_chi2

    def scale(self, gain: Array, unknowns: int) -> Array:
        """Return the remaining variance of a number of weight 1 after a gain."""
        rest = self.freedom - unknowns
        scale = np.maximum(self.chi2 - gain, 0.0) / rest if rest > 0 else np.full_like(gain, self.chi2)
        return np.asarray(np.maximum(np.minimum(scale, self.robust), 1.0 if self.stated else 1e-30))

    def log_chance(self, gain: Array, unknowns: int, trials: int) -> Array:
        """Return the logarithm of the probability that valid data have this gain in any of a number of trials."""
        rest = self.freedom - unknowns
        ratio = gain / self.scale(gain, unknowns)
        if self.stated or rest > 200:
            chance = special.chdtrc(unknowns, ratio)
        else:
            chance = special.fdtrc(unknowns, max(rest, 1), ratio / unknowns)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(chance) + np.log(trials))


def _move(information: Array, u: Array, smallest: float, level: _Level) -> tuple[float, Move] | None:
    """Return the largest gain of a move, and the move; None if the gain is not improbable."""
    k, b = u.shape[:2]
    before_I, before_u = np.cumsum(information, axis=0)[:-1], np.cumsum(u, axis=0)[:-1]
    after_I, after_u = information.sum(axis=0) - before_I, u.sum(axis=0) - before_u
    both_I, both_u = information.sum(axis=0), u.sum(axis=0)
    before, after, both = (_solved(*parts) for parts in ((before_I, before_u), (after_I, after_u), (both_I, both_u)))
    gain = np.maximum(before[1] + after[1] - both[1], 0.0)
    shift = after[0] - before[0]
    large = np.linalg.norm(shift, axis=-1) >= smallest
    if not large.any():
        return None
    gain = np.where(large, gain, 0.0)
    chance = level.log_chance(gain, 3, (k - 1) * b)
    at, ball = np.unravel_index(int(np.argmax(gain)), gain.shape)
    if chance[at, ball] >= np.log(FALSE_ALARM):
        return None
    ratio = gain / level.scale(gain, 3)[at, ball]
    others = tuple(i for i in range(b) if i != ball and ratio[:, i].max() > ratio[at, ball] - AMBIGUITY)
    return float(gain[at, ball]), Move(int(ball), int(at) + 1, shift[at, ball], others)


def _touches(level: _Level) -> tuple[float, Flags] | None:
    """Return the largest gain and the improbable touches, at most one for each cycle and each reach.

    An outlier affects the motion of its cycle, and the reach of its direction in all cycles: it is the worst of both.
    """
    return _worst(level.log_chance(level.square, 1, int(level.judged.sum())), level.square)


def _centres(information: Array, u: Array, level: _Level) -> tuple[float, Flags] | None:
    """Return the largest gain and the improbable centres, at most one for each cycle."""
    gain = _solved(information, u)[1]
    chance = level.log_chance(gain, 3, int(level.judged[..., 0].sum()))
    return _worst(*(np.repeat(part[..., None], 3, axis=2) for part in (chance, gain)))


def _worst(chance: Array, gain: Array) -> tuple[float, Flags] | None:
    least = np.minimum(chance.min(axis=(1, 2), keepdims=True), chance.min(axis=0))
    found = (chance <= least) & (chance < np.log(FALSE_ALARM))
    return (float(gain[found].max()), found) if found.any() else None


def _solved(information: Array, u: Array) -> tuple[Array, Array]:
    """Return the shifts (..., 3) for information (..., 3, 3) and right sides (..., 3), and their gains (...)."""
    values, vectors = np.linalg.eigh(information)
    regular = values > _SINGULAR * np.maximum(values[..., -1:], 1e-300)
    along = np.einsum("...ij,...i->...j", vectors, u)
    inside = np.where(regular, along / np.where(regular, values, 1.0), 0.0)
    return np.einsum("...ij,...j->...i", vectors, inside), np.sum(inside * along, axis=-1)
