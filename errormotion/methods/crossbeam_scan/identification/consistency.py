"""Artefacts that moved between two scans, or were scanned off their position.

A cold scan repeated must find no motion. And the errors of an axis are smooth over its position, so that those of one
artefact follow from the others: one that moved adds the same step to all its later scans, which its neighbours lack.

Give the twists in the profiler's frame, at its origin, as they are registered. At the carriage, behind a lever of 2 m,
the noise of the rotations is that of the displacements too, and all of them correlate. A step is what the motion of the
artefact does to the errors: the artefact itself moved by the opposite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan.identification.smoothing import ORDER, smooth

#: artefacts without which their neighbours carry no information
FEWEST = 4
#: order of the curves that predict an artefact from the others: seven artefacts do not tell in one cycle how rough a
#: guide is, and with order 3 one whose curvature jumps about would alarm nearly always
CAUTIOUS = 2
#: probability of any false alarm in a campaign
FALSE_ALARM = 0.01


@dataclass(frozen=True)
class ColdRepeats:
    """Result of the repeated cold scans.

    Attributes
    ----------
    score : ndarray, (repeat, position)
        Chi-squared of the twist that should be zero; NaN where there is none.
    freedoms : ndarray of int, (repeat, position)
        Freedoms that are known, of which the score has so many degrees.
    probability : ndarray, (repeat, position)
        That a score is as high without a cause.
    suspicious : ndarray of bool, (repeat, position)
        Where that is below ``limit``.
    limit : float
        Probability of a false alarm of one test: that of any, over the number of tests.
    """

    score: Array
    freedoms: NDArray[np.int64]
    probability: Array
    suspicious: NDArray[np.bool_]
    limit: float


@dataclass(frozen=True)
class Moved:
    """An artefact that moved.

    Attributes
    ----------
    artefact : int
        Index of its position.
    since : int
        Index of the first cycle that shows it: it moved after the scan before.
    step : ndarray, (6,)
        What it adds to the errors from then on, m and rad.
    covariance : ndarray, (6, 6)
        Of the step.
    score : float
        Chi-squared of the step in its six freedoms.
    probability : float
        Probability of such a score by chance, given the few artefacts that determine the smoothness.
    """

    artefact: int
    since: int
    step: Array
    covariance: Array
    score: float
    probability: float


@dataclass(frozen=True)
class Consistency:
    """Result of the comparison of the artefacts.

    Attributes
    ----------
    moved : tuple of Moved
        Worst first.
    tested : bool
        Whether there were enough artefacts; if not, ``moved`` is empty and carries no information.
    limit : float
        Probability of a false alarm of one test; NaN where nothing was tested.
    """

    moved: tuple[Moved, ...]
    tested: bool
    limit: float


def cold_repeats(
    twist: ArrayLike,
    covariance: ArrayLike,
    *,
    repeatability: Sequence[float] = (0.0, 0.0),
    false_alarm: float = FALSE_ALARM,
) -> ColdRepeats:
    """Return whether repeated cold scans find the artefacts where they were.

    Parameters
    ----------
    twist, covariance : (repeat, position, 6), (repeat, position, 6, 6)
        Registered motions against the first cold scan, m and rad, and their covariance; NaN for a freedom that is not
        known.
    repeatability : (float, float)
        Standard deviation of how the machine comes back, m and rad, in each freedom.
    false_alarm : float
        Probability of one false alarm or more over all tests (Bonferroni).

    Raises
    ------
    MethodError
        Shapes that do not fit, a probability out of (0, 1).
    """
    E, C = _checked(twist, covariance, repeatability, false_alarm, "repeat, position")
    C = C + np.diag(_spread(repeatability) ** 2)
    known = np.isfinite(E) & np.isfinite(np.diagonal(C, axis1=-2, axis2=-1))
    freedoms = known.sum(axis=-1)
    score = np.full(E.shape[:-1], np.nan)
    for where in np.argwhere(freedoms > 0):
        at = tuple(where)
        some = known[at]
        score[at] = _chi_squared(E[at][some], C[at][np.ix_(some, some)])
    probability = np.where(freedoms > 0, special.chdtrc(np.maximum(freedoms, 1), score), np.nan)
    limit = false_alarm / max(int((freedoms > 0).sum()), 1)
    return ColdRepeats(score, freedoms, probability, probability < limit, limit)


def moved_artefacts(
    time: ArrayLike,
    position: ArrayLike,
    errors: ArrayLike,
    covariance: ArrayLike,
    *,
    repeatability: Sequence[float] = (0.0, 0.0),
    cold_share: ArrayLike = 0.0,
    false_alarm: float = FALSE_ALARM,
) -> Consistency:
    """Return the artefacts that moved between two scans, and when.

    What an artefact gains from one scan to the next is predicted from what the others gain, smooth over position. The
    excess of all its scans, with its covariance, is searched for a step at each of them; the artefact with the
    greatest is left out, and the rest searched again.

    Parameters
    ----------
    time : (t,)
        Of the warm cycles, s, increasing; the cold one is not among them: it is the zero of all.
    position : (n,)
        Of the artefacts, m.
    errors, covariance : (t, n, 6), (t, n, 6, 6)
        Twists against the cold scans, m and rad, best those in the profiler's frame; a scan with a NaN is left out.
    repeatability : (float, float)
        Standard deviation of how the machine comes back from scan to scan, m and rad, in each freedom.
    cold_share : float or (t, n)
        Share of the covariance that comes from the cold scan, one draw for all cycles of an artefact. Without it the
        test is blunter, no worse.
    false_alarm : float
        Probability of one false alarm or more over all artefacts and cycles.

    Returns
    -------
    Consistency
        A step is sought over all six freedoms, so that its threshold at the ends, where the prediction reaches out,
        is higher. Two artefacts that move alike in the same cycle may hide each other.

    Raises
    ------
    MethodError
        Shapes that do not fit, times that do not increase, a probability out of (0, 1).
    """
    E, C = _checked(errors, covariance, repeatability, false_alarm, "t, n")
    t, y = np.asarray(time, dtype=float), np.asarray(position, dtype=float)
    if t.shape != E.shape[:1] or y.shape != E.shape[1:2] or not (np.diff(t) > 0).all():
        raise MethodError(
            f"Errors of shape {E.shape} need increasing times ({E.shape[0]},) and positions ({E.shape[1]},); found "
            f"{t.shape} and {y.shape}."
        )
    share = np.broadcast_to(np.asarray(cold_share, dtype=float), E.shape[:2])[..., None, None]
    there = np.asarray(np.isfinite(E).all(axis=-1) & np.isfinite(C).all(axis=(-2, -1)), dtype=bool)
    machine = np.diag(_spread(repeatability) ** 2)
    scans = _Scans(y, E, (1 - share) * C + machine, _mean(share * C, there) + machine, there)
    left = np.flatnonzero(there.any(axis=0))
    tests = int(there[:, left].sum())
    if left.size < FEWEST or not tests:
        return Consistency((), False, np.nan)
    limit = false_alarm / tests
    moved: list[Moved] = []
    while left.size >= FEWEST:
        steps = [step for k in left if (step := scans.greatest_step(int(k), left)) is not None]
        steps = [step for step in steps if step.probability < limit]
        if not steps:
            break
        moved.append(max(steps, key=lambda step: scans.relief(step, left)))
        left = left[left != moved[-1].artefact]
    return Consistency(tuple(moved), True, limit)


@dataclass(frozen=True)
class _Scans:
    """All scans of a campaign; their noise is independent, and the cold ones are zero but for it."""

    position: Array
    errors: Array  # (t, n, 6)
    noise: Array  # (t, n, 6, 6)
    cold: Array  # noise of the cold scans, (n, 6, 6)
    there: NDArray[np.bool_]  # (t, n)

    def greatest_step(self, k: int, left: NDArray[np.intp]) -> Moved | None:
        """Return the most significant step of artefact k against the others that are left; None where none is known."""
        cycles = np.flatnonzero(self.there[:, k])
        after, before, gain, noise = self.gains(k, left)
        others = left != k
        s = cycles.size
        excess, doubt = np.zeros((s, 6)), np.zeros((s, 6))
        share = np.zeros((s, 6, self.errors.shape[0] + 1, self.errors.shape[1]))  # of the noise of each scan
        row = np.arange(s)
        for d in range(6):
            known = np.where(others, gain[..., d], np.nan)
            curve = smooth(self.position[left], known, noise[..., d, d], self.position[[k]], order=CAUTIOUS)
            W = curve.weights[:, 0]
            excess[:, d] = gain[:, ~others, d][:, 0] - curve.values[:, 0]
            doubt[:, d] = curve.variance[:, 0] - (W**2 * np.nan_to_num(noise[..., d, d])).sum(axis=-1)
            for sign, which in ((1.0, after), (-1.0, before)):
                share[row, d, which, k] = sign
                share[row[:, None], d, which[:, None], left[others]] = -sign * W[:, others]
        usable = np.isfinite(excess).all(axis=-1)
        if not usable.any():
            return None
        share, excess = share[usable], excess[usable]
        N = np.nan_to_num(np.concatenate([self.cold[None], self.noise]))
        V = np.einsum("idtn,jetn,tnde->idje", share, share, N)
        V = V.reshape(excess.size, excess.size) + np.diag(np.maximum(doubt[usable], 0.0).ravel())
        spare = np.isfinite(gain[usable][:, others]).all(axis=-1).sum(axis=-1) - CAUTIOUS
        return _greatest(k, cycles[usable], excess, V, np.maximum(doubt[usable], 0.0), spare)

    def relief(self, step: Moved, left: NDArray[np.intp]) -> float:
        """Return by how much more likely all gains are, each freedom smooth, without one of one artefact (log).

        The artefact that moved and its neighbour at the end both look out of line; without the right one, the rest is
        as smooth as in the other cycles: for that, all cycles share one amplitude.
        """
        k = step.artefact
        _, _, gain, noise = self.gains(k, left)
        without = gain.copy()
        without[np.flatnonzero(self.there[:, k]) == step.since, left == k] = np.nan
        positions, order = self.position[left], _order(left)
        likelihood = [
            smooth(
                positions, points[..., d], noise[..., d, d], positions[:1], order=order, together=True
            ).log_likelihood
            for points in (gain, without)
            for d in range(6)
        ]
        each = np.nanmax(likelihood, axis=-1)  # shared; NaN for a cycle with too few artefacts
        return float(each[6:].sum() - each[:6].sum())

    def gains(self, k: int, left: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """Return what the artefacts left gain between the scans of artefact k.

        Returns
        -------
        after, before : ndarray of int, (s,)
            Cycles, where 0 is the cold one.
        gain, noise : ndarray, (s, left, 6), (s, left, 6, 6)
            NaN where one of the two scans is not there.
        """
        cycles = np.flatnonzero(self.there[:, k])
        after, before = cycles + 1, np.concatenate([[0], cycles[:-1] + 1])
        E = np.concatenate([np.zeros((1, *self.errors.shape[1:])), self.errors])[:, left]
        N = np.concatenate([self.cold[None], self.noise])[:, left]
        there = np.concatenate([np.any(self.there, axis=0, keepdims=True), self.there])[:, left]
        both = (there[after] & there[before])[..., None]
        gain = np.where(both, E[after] - E[before], np.nan)
        return after, before, gain, np.where(both[..., None], N[after] + N[before], np.nan)


def _order(left: NDArray[np.intp]) -> int:
    """Return the order of curves that leaves evidence when one of the artefacts is left out."""
    return min(ORDER, left.size - 2)


def _greatest(
    k: int, cycles: NDArray[np.intp], excess: Array, V: Array, doubt: Array, spare: NDArray[np.intp]
) -> Moved:
    """Return the most significant step, by generalised least squares for a step before each of the cycles.

    How smooth a gain is, is known from the few artefacts to spare. As far as this doubt, and not the noise, makes up
    the variance V of the excess, the score is judged by F with so few degrees of freedom (after Welch and
    Satterthwaite, freedoms weighted by what they add to the score).
    """
    unit = np.sqrt(np.diag(V))
    inverse = np.linalg.inv(V / np.outer(unit, unit)) / np.outer(unit, unit)
    pull = (inverse @ excess.ravel()).reshape(-1, 6)
    doubtful = (doubt / (unit**2).reshape(-1, 6)) ** 2
    found = []
    for i, since in enumerate(cycles):
        block = slice(6 * i, 6 * i + 6)
        normal = inverse[block, block]
        scale = np.sqrt(np.diag(normal))
        covariance = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
        step = covariance @ pull[i]
        score = float(step @ pull[i])
        weight = np.abs(step * pull[i])
        degrees = spare[i] * weight.sum() / max(float(weight @ doubtful[i]), 1e-9 * float(weight.sum()))
        found.append(Moved(k, int(since), step, covariance, score, float(special.fdtrc(6, degrees, score / 6))))
    return max(found, key=lambda step: step.score)


def _checked(
    twist: ArrayLike, covariance: ArrayLike, repeatability: Sequence[float], false_alarm: float, dims: str
) -> tuple[Array, Array]:
    """Return twists and covariance as arrays; raise MethodError where they do not fit."""
    E, C = np.asarray(twist, dtype=float), np.asarray(covariance, dtype=float)
    if E.ndim != 3 or E.shape[-1] != 6 or C.shape != (*E.shape, 6):
        raise MethodError(f"Expected twists ({dims}, 6) and covariance ({dims}, 6, 6); found {E.shape} and {C.shape}.")
    if len(repeatability) != 2 or not all(0 <= sigma < np.inf for sigma in repeatability):
        raise MethodError(f"The repeatability is two standard deviations, m and rad; found {tuple(repeatability)}.")
    if not 0 < false_alarm < 1:
        raise MethodError(f"The probability of a false alarm lies between 0 and 1; found {false_alarm}.")
    return E, C


def _spread(repeatability: Sequence[float]) -> Array:
    """Return the standard deviation of each freedom, (6,)."""
    return np.repeat(np.asarray(repeatability, dtype=float), 3)


def _mean(covariance: Array, there: NDArray[np.bool_]) -> Array:
    """Return the mean over cycles of what is there, (n, 6, 6)."""
    total = np.where(there[..., None, None], covariance, 0.0).sum(axis=0)
    return np.asarray(total / np.maximum(there.sum(axis=0), 1)[:, None, None])


def _chi_squared(x: Array, C: Array) -> float:
    """Return x C^-1 x, in units in which the diagonal of C is 1."""
    scale = np.sqrt(np.diag(C))
    unit = x / scale
    return float(unit @ np.linalg.solve(C / np.outer(scale, scale), unit))
