"""Touches that are wrong, and balls that moved: found by what the fit gains without them.

Balls that stand still keep their distances, so that a ball that moved contradicts the others. Its gain is that of one
more unknown shift, the same in all cycles from one on: the sum over its touches of what a shift before and one behind
explain. A single wrong touch gains the square of its residual over its variance. The most improbable of all goes first,
and the fit is made anew; what stays has to be so improbable that sound data are accused once in a thousand times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.normal_vector.identification.rigid import Observations, Rigid, determined, fit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.normal_vector.identification.freedoms import Motion

    Flags = NDArray[np.bool_]

FALSE_ALARM = 1e-3
MOST_ROUNDS = 60
SURE = 12.0
"""Less gain of another ball, in chi-square, than this below the best: it may be the one that moved."""
SIMPLER = 0.95
"""A single wrong touch that explains at least this share of what a move does is the simpler explanation."""
_MANY = 30
_WEAK = 1e-6


@dataclass(frozen=True)
class Move:
    """A ball that moved: its number, the first cycle that shows it, the shift (3,), m, and others that it may be."""

    ball: int
    cycle: int
    shift: Array
    others: tuple[int, ...]


@dataclass(frozen=True)
class Cleaned:
    """What was believed, and what came of it.

    Attributes
    ----------
    seen : Observations
        Without what was left out, all cycles.
    used : ndarray of int
        Cycles that determine the motion; ``fit`` has these.
    fit : Rigid
    wrong : ndarray of bool (k, b, m)
        Touches that are wrong.
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
    """Fit, and leave out what is wrong until nothing is.

    Parameters
    ----------
    seen : Observations
    motion : Motion
    interpolate : bool
        See `rigid.fit`.
    stated : bool
        Whether the weights are inverse variances that were stated; otherwise only their ratios count.
    robust : bool
        Whether anything may be left out.
    smallest_move : float
        A ball that is off by less has not moved, m.

    Raises
    ------
    MethodError
        The cold cycle, or all others, do not determine the motion.
    """
    wrong, moves = np.zeros(seen.valid.shape, dtype=bool), list[Move]()
    for _ in range(MOST_ROUNDS):
        used = _used(seen, motion)
        found = fit(seen.cycles(used), motion, interpolate=interpolate)
        suspect = _suspect(seen.cycles(used), found, stated, smallest_move) if robust else None
        if suspect is None:
            return Cleaned(seen, used, found, wrong, moves)
        if isinstance(suspect, Move):
            move = Move(suspect.ball, int(used[suspect.cycle]), suspect.shift, suspect.others)
            gone = np.zeros_like(wrong)
            gone[move.cycle :, move.ball] = True
            moves.append(move)
        else:
            gone = np.zeros_like(wrong)
            gone[used] = suspect
            wrong |= gone
        seen = seen.without(gone)
    raise MethodError(
        f"After {MOST_ROUNDS} rounds of leaving out wrong touches there are still more. Expected balls that stand "
        "still and a probe that repeats; look at the residuals (robust = false)."
    )


def _used(seen: Observations, motion: Motion) -> NDArray[np.intp]:
    sound = determined(seen, motion)
    if not sound[0]:
        raise MethodError(
            "The cold cycle alone does not determine where the balls are: too many of its touches are missing or "
            "wrong. Probe the cold machine again, or take a later cycle for the reference."
        )
    return np.flatnonzero(sound)


def _suspect(seen: Observations, found: Rigid, stated: bool, smallest_move: float) -> Move | Flags | None:
    """Return the move, or the touches, that contradict the rest most; None where nothing does."""
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
    # Less what a motion of the cycle takes of it, as in the information: else little information makes a great gain.
    u -= np.einsum("kbip,kpq,kcmq,kcm->kbi", nWH, inverse, WH, residual, optimize=True)
    level = _Level(found, seen, H, inverse, stated)
    move = _move(information, u, smallest_move, level)
    touch = _touches(level) if seen.touched else _centres(information, u, level)
    if move is not None and (touch is None or touch[0] < SIMPLER * move[0]):
        return move[1]
    return None if touch is None else touch[1]


class _Level:
    """How improbable a gain is, given the noise."""

    def __init__(self, found: Rigid, seen: Observations, H: Array, inverse: Array, stated: bool) -> None:
        w = np.diagonal(seen.weight, axis1=2, axis2=3)
        leverage = w * np.einsum("kbmp,kpq,kbmq->kbm", H, inverse, H, optimize=True)
        # The reach of a touch is the mean of its cycles: its own share in that is one more leverage.
        own = np.maximum((1 - leverage) * (1 - w / np.maximum(w.sum(axis=0), 1e-300)), _WEAK)
        self.judged = (w > 0) & (own > 1e-3)
        self.square = np.where(self.judged, w * np.nan_to_num(found.residual) ** 2 / own, 0.0)
        self.chi2, self.freedom, self.stated = found.chi2, found.freedom, stated
        self.robust = np.inf
        if found.freedom > _MANY:
            self.robust = float(np.median(self.square[self.judged])) / stats.chi2.ppf(0.5, 1)

    def scale(self, gain: Array, unknowns: int) -> Array:
        """Return the variance of a number of weight 1 that is left when so much is gained."""
        rest = self.freedom - unknowns
        scale = np.maximum(self.chi2 - gain, 0.0) / rest if rest > 0 else np.full_like(gain, self.chi2)
        return np.asarray(np.maximum(np.minimum(scale, self.robust), 1.0 if self.stated else 1e-30))

    def log_chance(self, gain: Array, unknowns: int, tries: int) -> Array:
        """Return the logarithm of the chance that sound data gain so much in any of so many tries."""
        rest = self.freedom - unknowns
        ratio = gain / self.scale(gain, unknowns)
        if self.stated or rest > 200:
            chance = stats.chi2.logsf(ratio, unknowns)
        else:
            chance = stats.f.logsf(ratio / unknowns, unknowns, max(rest, 1))
        return np.asarray(chance + np.log(tries))


def _move(information: Array, u: Array, smallest: float, level: _Level) -> tuple[float, Move] | None:
    """Return the move that gains most, in units of the noise, and the gain; None where it may be luck."""
    k, b = u.shape[:2]
    before_I, before_u = np.cumsum(information, axis=0)[:-1], np.cumsum(u, axis=0)[:-1]
    after_I, after_u = information.sum(axis=0) - before_I, u.sum(axis=0) - before_u
    both_I, both_u = information.sum(axis=0), u.sum(axis=0)
    before, after, both = (_solved(*parts) for parts in ((before_I, before_u), (after_I, after_u), (both_I, both_u)))
    gain = np.maximum(before[1] + after[1] - both[1], 0.0)
    shift = after[0] - before[0]
    alive = np.linalg.norm(shift, axis=-1) >= smallest
    if not alive.any():
        return None
    gain = np.where(alive, gain, 0.0)
    chance = level.log_chance(gain, 3, (k - 1) * b)
    at, ball = np.unravel_index(int(np.argmax(gain)), gain.shape)
    if chance[at, ball] >= np.log(FALSE_ALARM):
        return None
    ratio = gain / level.scale(gain, 3)[at, ball]
    others = tuple(i for i in range(b) if i != ball and ratio[:, i].max() > ratio[at, ball] - SURE)
    return float(gain[at, ball]), Move(int(ball), int(at) + 1, shift[at, ball], others)


def _touches(level: _Level) -> tuple[float, Flags] | None:
    """Return the touches that are too improbable, at most one of a cycle and of a reach, and the most gain.

    A wrong touch spoils the motion of its cycle, and the reach of its direction in all others: it is the worst in both.
    """
    return _worst(level.log_chance(level.square, 1, int(level.judged.sum())), level.square)


def _centres(information: Array, u: Array, level: _Level) -> tuple[float, Flags] | None:
    """Return the centres, at most one of a cycle, that are too improbable."""
    gain = _solved(information, u)[1]
    chance = level.log_chance(gain, 3, int(level.judged[..., 0].sum()))
    return _worst(*(np.repeat(part[..., None], 3, axis=2) for part in (chance, gain)))


def _worst(chance: Array, gain: Array) -> tuple[float, Flags] | None:
    least = np.minimum(chance.min(axis=(1, 2), keepdims=True), chance.min(axis=0))
    found = (chance <= least) & (chance < np.log(FALSE_ALARM))
    return (float(gain[found].max()), found) if found.any() else None


def _solved(information: Array, u: Array) -> tuple[Array, Array]:
    """Return shifts (..., 3) of information (..., 3, 3) and right sides (..., 3), and what they gain, (...)."""
    values, vectors = np.linalg.eigh(information)
    sound = values > _WEAK * np.maximum(values[..., -1:], 1e-300)
    along = np.einsum("...ij,...i->...j", vectors, u)
    inside = np.where(sound, along / np.where(sound, values, 1.0), 0.0)
    return np.einsum("...ij,...j->...i", vectors, inside), np.sum(inside * along, axis=-1)
