"""Artefacts that moved between two scans, or were not scanned at their position.

A repeated cold scan must show no motion. The errors of an axis are smooth over position, so that those at one artefact
can be predicted from the others: an artefact that moved adds the same step to all its later scans, but its neighbours
do not show it.

The twists are expected as registered: in the profiler's frame, at its origin. At the carriage, behind a lever of 2 m,
the noise of the rotations dominates that of the displacements, and all of them are correlated. A step is the effect of
the motion of the artefact on the errors: the artefact itself moved by the opposite.

The rule of `errormotion.estimation.checks` tests residuals of a fit. Here there are none: six readings determine the
six unknowns of a scan, and the smoothness that contradicts them is itself estimated from few artefacts. The F
distribution of its test has the degrees of freedom of the smooth curve, which the rule does not know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.smoothing import ORDER, smooth
from errormotion.methods.crossbeam_scan.identification.model import Campaign

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

MINIMUM_ARTEFACTS = 4
"""Smallest number of artefacts that can be compared with each other."""
PREDICTION_ORDER = 2
"""Order of the curves that predict an artefact from the others. Seven artefacts in one cycle do not determine the
roughness of a guide; with order 3, a guide whose curvature changes abruptly would nearly always raise an alarm."""
FALSE_ALARM = 0.01
"""Probability of any false alarm in a campaign."""
MOVED = "the artefact had moved"
"""Reason stated for errors that are excluded because their artefact moved."""


@dataclass(frozen=True)
class ArtefactCheck:
    """Errors that are caused by the motion of an artefact.

    Attributes
    ----------
    wrong : ndarray of bool, (cycle, artefact)
        Scans of artefacts after they had moved.
    since : ndarray, (artefact,)
        Time of the first scan after an artefact moved, s; NaN where it did not.
    notes, doubts : list of str
        Messages for the user; the latter doubt the uncertainties.
    """

    wrong: NDArray[np.bool_]
    since: Array
    notes: list[str]
    doubts: list[str]

    def extras(self) -> dict[str, Any]:
        """Return the extra variables of the error dataset."""
        return {"moved": ("position", np.isfinite(self.since)), "moved_since": ("position", self.since, {"units": "s"})}


def check_artefacts(
    every: Campaign, settings: CrossbeamScanSettings, time: Array, cold: list[int], warm: list[int]
) -> ArtefactCheck:
    """Return which artefacts moved, from the repeated cold scans and from a comparison with their neighbours.

    Parameters
    ----------
    every : Campaign
        Of all cycles.
    settings : CrossbeamScanSettings
    time : (warm cycle,)
        s, increasing.
    cold, warm : list of int
        Cycles; those of ``cold`` after the first are repeats of it.
    """
    twist, covariance, by_cold = every.profiler()
    positions = every.positions
    repeatability = (settings.repeatability_shift, settings.repeatability_turn)
    wrong, since = np.zeros(twist.shape[:2], dtype=bool), np.full(positions.size, np.nan)
    repeats = cold[1:]
    notes = _cold_notes(twist[repeats], covariance[repeats], positions, repeatability)
    consistency = moved_artefacts(
        time, positions, twist[warm], covariance[warm], repeatability=repeatability, cold_covariance=by_cold[warm]
    )
    if not consistency.tested:
        notes.append("Too few artefacts to detect one that moved: at least four are needed.")
    for one in consistency.moved:
        wrong[warm[one.since :], one.artefact] = True
        since[one.artefact] = time[one.since]
    excluded = settings.moved == "exclude"
    moved = _moved_notes(consistency, positions, time, excluded)
    return ArtefactCheck(wrong, since, notes + moved * excluded, moved * (not excluded))


def _cold_notes(twist: Array, covariance: Array, positions: Array, repeatability: tuple[float, float]) -> list[str]:
    if not len(twist):
        return []
    notes = []
    for repeat, k in np.argwhere(cold_repeats(twist, covariance, repeatability=repeatability).suspicious):
        shift, turn = _size(twist[repeat, k])
        notes.append(
            f"The artefact at {positions[k]:g} m has moved between the cold scan and its repetition "
            f"({shift:.1f} um, {turn:.1f} urad). Check its clamping and the thermal equilibrium of the machine."
        )
    return notes


def _moved_notes(consistency: Consistency, positions: Array, time: Array, excluded: bool) -> list[str]:
    notes = []
    for one in consistency.moved:
        shift, turn = _size(one.step)
        notes.append(
            f"The artefact at {positions[one.artefact]:g} m moved before the scan at {time[one.since] / 60:.1f} min, "
            f"by {shift:.1f} um and {turn:.1f} urad relative to the others; its later errors are "
            + ("excluded." if excluded else "kept, but not reliable.")
        )
    return notes


def _size(twist: Array) -> tuple[float, float]:
    """Return the lengths of displacement and rotation, um and urad."""
    shift, turn = np.linalg.norm(np.nan_to_num(twist).reshape(2, 3), axis=1) * 1e6
    return float(shift), float(turn)


@dataclass(frozen=True)
class ColdRepeats:
    """Result of the repeated cold scans.

    Attributes
    ----------
    score : ndarray, (repeat, position)
        Chi-squared of the twist that should be zero; NaN where there is none.
    freedoms : ndarray of int, (repeat, position)
        Number of known freedoms: the degrees of freedom of the score.
    probability : ndarray, (repeat, position)
        Probability of such a score by chance.
    suspicious : ndarray of bool, (repeat, position)
        Whether the probability is below ``limit``.
    limit : float
        Probability of a false alarm of one test: that of any false alarm divided by the number of tests.
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
        Index of the first cycle that shows the motion: the artefact moved after the preceding scan.
    step : ndarray, (6,)
        Contribution of the motion to the errors from this cycle on, m and rad.
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
        Whether there were enough artefacts; if not, ``moved`` is empty without a test.
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
    """Return whether repeated cold scans show the artefacts at their original positions.

    Parameters
    ----------
    twist, covariance : (repeat, position, 6), (repeat, position, 6, 6)
        Motions registered relative to the first cold scan, m and rad, and their covariance; NaN for an unknown freedom.
    repeatability : (float, float)
        Standard deviation of the repeatability of the machine in each freedom, m and rad.
    false_alarm : float
        Probability of one or more false alarms in all tests (Bonferroni).

    Raises
    ------
    MethodError
        Shapes that do not match, a probability outside (0, 1).
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
    cold_covariance: ArrayLike = 0.0,
    false_alarm: float = FALSE_ALARM,
) -> Consistency:
    """Return the artefacts that moved between two scans, and when.

    The change of the errors at one artefact from one scan to the next is predicted from the changes at the others by
    curves that are smooth over position. The deviations of all scans of an artefact from their predictions, with their
    covariance, are tested for a step at each scan. Of the artefacts with a significant step, the one without which the
    others are most likely is excluded, and the test is repeated.

    Parameters
    ----------
    time : (t,)
        Of the warm cycles, s, increasing. The cold cycle is not included: all errors are relative to it.
    position : (n,)
        Of the artefacts, m.
    errors, covariance : (t, n, 6), (t, n, 6, 6)
        Twists relative to the cold scans, m and rad, preferably in the profiler's frame; a scan with NaN is not used.
    repeatability : (float, float)
        Standard deviation of the repeatability of the machine from scan to scan in each freedom, m and rad.
    cold_covariance : (t, n, 6, 6), optional
        What of the covariance is caused by the cold scan, one draw for all cycles of an artefact. Without it, the test
        is less sensitive, but valid.
    false_alarm : float
        Probability of one or more false alarms over all artefacts and cycles.

    Returns
    -------
    Consistency
        A step is tested in all six freedoms together. At the ends, where the prediction extrapolates, the threshold is
        higher. Two artefacts that move equally in the same cycle may mask each other.

    Raises
    ------
    MethodError
        Shapes that do not match, times that do not increase, a probability outside (0, 1).
    """
    E, C = _checked(errors, covariance, repeatability, false_alarm, "t, n")
    t, y = np.asarray(time, dtype=float), np.asarray(position, dtype=float)
    if t.shape != E.shape[:1] or y.shape != E.shape[1:2] or not (np.diff(t) > 0).all():
        raise MethodError(
            f"Expected increasing times ({E.shape[0]},) and positions ({E.shape[1]},) for errors of shape {E.shape}; "
            f"found {t.shape} and {y.shape}.",
            code="scan.consistency.shape",
        )
    cold = np.broadcast_to(np.asarray(cold_covariance, dtype=float), C.shape)
    known = np.asarray(np.isfinite(E).all(axis=-1) & np.isfinite(C).all(axis=(-2, -1)), dtype=bool)
    machine = np.diag(_spread(repeatability) ** 2)
    scans = _Scans(y, E, C - cold + machine, _mean(cold, known) + machine, known)
    used = np.flatnonzero(known.any(axis=0))
    tests = int(known[:, used].sum())
    if used.size < MINIMUM_ARTEFACTS or not tests:
        return Consistency((), False, np.nan)
    limit = false_alarm / tests
    moved: list[Moved] = []
    while used.size >= MINIMUM_ARTEFACTS:
        steps = [step for k in used if (step := scans.greatest_step(int(k), used)) is not None]
        steps = [step for step in steps if step.probability < limit]
        if not steps:
            break
        moved.append(max(steps, key=lambda step: scans.likelihood_gain(step, used)))
        used = used[used != moved[-1].artefact]
    return Consistency(tuple(moved), True, limit)


@dataclass(frozen=True)
class _Scans:
    """All scans of a campaign. Their noise is independent; apart from it, the cold scans are zero."""

    position: Array
    errors: Array  # (t, n, 6)
    noise: Array  # (t, n, 6, 6)
    cold: Array  # noise of the cold scans, (n, 6, 6)
    known: NDArray[np.bool_]  # (t, n)

    def greatest_step(self, k: int, used: NDArray[np.intp]) -> Moved | None:
        """Return the most significant step of artefact k relative to the other artefacts used; None if unknown."""
        cycles = np.flatnonzero(self.known[:, k])
        after, before, change, noise = self.changes(k, used)
        others = used != k
        s = cycles.size
        points = np.where(others[:, None], change, np.nan).swapaxes(1, 2)  # (s, 6, used)
        variance = np.diagonal(noise, axis1=-2, axis2=-1).swapaxes(1, 2)
        curve = smooth(self.position[used], points, variance, self.position[[k]], order=PREDICTION_ORDER)
        W = curve.weights[..., 0, :]
        deviation = change[:, ~others][:, 0] - curve.values[..., 0]
        model_variance = curve.variance[..., 0] - (W**2 * np.nan_to_num(variance)).sum(axis=-1)
        share = np.zeros((s, 6, self.errors.shape[0] + 1, self.errors.shape[1]))  # of the noise of each scan
        row, freedom = np.arange(s)[:, None], np.arange(6)
        for sign, which in ((1.0, after), (-1.0, before)):
            share[row, freedom, which[:, None], k] = sign
            share[row[..., None], freedom[:, None], which[:, None, None], used[others]] = -sign * W[..., others]
        usable = np.isfinite(deviation).all(axis=-1)
        if not usable.any():
            return None
        share, deviation, model_variance = share[usable], deviation[usable], np.maximum(model_variance[usable], 0.0)
        N = np.nan_to_num(np.concatenate([self.cold[None], self.noise]))
        V = np.einsum("idtn,jetn,tnde->idje", share, share, N)
        V = V.reshape(deviation.size, deviation.size) + np.diag(model_variance.ravel())
        degrees = np.isfinite(change[usable][:, others]).all(axis=-1).sum(axis=-1) - PREDICTION_ORDER
        return _most_significant(k, cycles[usable], deviation, V, model_variance, degrees)

    def likelihood_gain(self, step: Moved, used: NDArray[np.intp]) -> float:
        """Return by how much the log likelihood of all changes increases without the change of the step.

        An artefact that moved and its neighbour at the end both deviate. Without the right one, the others are as
        smooth as in the other cycles; to use this, all cycles share one amplitude.
        """
        k = step.artefact
        _, _, change, noise = self.changes(k, used)
        without = change.copy()
        without[np.flatnonzero(self.known[:, k]) == step.since, used == k] = np.nan
        positions = self.position[used]
        order = min(ORDER, used.size - 2)  # one artefact less still provides evidence
        variance = np.moveaxis(np.diagonal(noise, axis1=-2, axis2=-1), -1, 0)
        curves = [
            smooth(positions, np.moveaxis(points, -1, 0), variance, positions[:1], order=order, together=True, sets=6)
            for points in (change, without)
        ]
        # shared by the cycles of a freedom; NaN for a cycle with too few artefacts
        before, after = np.nanmax([each.log_likelihood for each in curves], axis=-1)
        return float(after.sum() - before.sum())

    def changes(self, k: int, used: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """Return the changes of the errors at the artefacts used between the scans of artefact k.

        Returns
        -------
        after, before : ndarray of int, (s,)
            Cycles, where 0 is the cold one.
        change, noise : ndarray, (s, used, 6), (s, used, 6, 6)
            NaN where one of the two scans is missing.
        """
        cycles = np.flatnonzero(self.known[:, k])
        after, before = cycles + 1, np.concatenate([[0], cycles[:-1] + 1])
        E = np.concatenate([np.zeros((1, *self.errors.shape[1:])), self.errors])[:, used]
        N = np.concatenate([self.cold[None], self.noise])[:, used]
        known = np.concatenate([np.any(self.known, axis=0, keepdims=True), self.known])[:, used]
        both = (known[after] & known[before])[..., None]
        change = np.where(both, E[after] - E[before], np.nan)
        return after, before, change, np.where(both[..., None], N[after] + N[before], np.nan)


def _most_significant(
    k: int, cycles: NDArray[np.intp], deviation: Array, V: Array, model_variance: Array, degrees: NDArray[np.intp]
) -> Moved:
    """Return the most significant step, by generalised least squares for a step before each of the cycles.

    The variance V of the deviations consists of noise and of ``model_variance``, that of the smooth curve. The latter
    is estimated with few degrees of freedom, so that the score is compared with an F distribution, whose degrees of
    freedom follow from both parts (Welch and Satterthwaite; freedoms are weighted by their share of the score).
    """
    unit = np.sqrt(np.diag(V))
    inverse = np.linalg.inv(V / np.outer(unit, unit)) / np.outer(unit, unit)
    pull = (inverse @ deviation.ravel()).reshape(-1, 6)
    model_share = (model_variance / (unit**2).reshape(-1, 6)) ** 2
    candidates = []
    for i, since in enumerate(cycles):
        block = slice(6 * i, 6 * i + 6)
        normal = inverse[block, block]
        scale = np.sqrt(np.diag(normal))
        covariance = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
        step = covariance @ pull[i]
        score = float(step @ pull[i])
        weight = np.abs(step * pull[i])
        total = degrees[i] * weight.sum() / max(float(weight @ model_share[i]), 1e-9 * float(weight.sum()))
        candidates.append(Moved(k, int(since), step, covariance, score, float(special.fdtrc(6, total, score / 6))))
    return max(candidates, key=lambda step: step.score)


def _checked(
    twist: ArrayLike, covariance: ArrayLike, repeatability: Sequence[float], false_alarm: float, dims: str
) -> tuple[Array, Array]:
    """Return twists and covariance as arrays; raise MethodError where their shapes do not match."""
    E, C = np.asarray(twist, dtype=float), np.asarray(covariance, dtype=float)
    if E.ndim != 3 or E.shape[-1] != 6 or C.shape != (*E.shape, 6):
        raise MethodError(
            f"Expected twists ({dims}, 6) and covariance ({dims}, 6, 6); found {E.shape} and {C.shape}.",
            code="scan.consistency.shape",
        )
    if len(repeatability) != 2 or not all(0 <= sigma < np.inf for sigma in repeatability):
        raise MethodError(
            f"repeatability: expected two standard deviations, m and rad; found {tuple(repeatability)}.",
            code="scan.consistency.repeatability",
        )
    if not 0 < false_alarm < 1:
        raise MethodError(
            f"false_alarm: expected a probability between 0 and 1; found {false_alarm}.",
            code="scan.consistency.false_alarm",
        )
    return E, C


def _spread(repeatability: Sequence[float]) -> Array:
    """Return the standard deviation of each freedom, (6,)."""
    return np.repeat(np.asarray(repeatability, dtype=float), 3)


def _mean(covariance: Array, known: NDArray[np.bool_]) -> Array:
    """Return the mean over the cycles in which a scan is known, (n, 6, 6)."""
    total = np.where(known[..., None, None], covariance, 0.0).sum(axis=0)
    return np.asarray(total / np.maximum(known.sum(axis=0), 1)[:, None, None])


def _chi_squared(x: Array, C: Array) -> float:
    """Return x C^-1 x, in units in which the diagonal of C is 1."""
    scale = np.sqrt(np.diag(C))
    unit = x / scale
    return float(unit @ np.linalg.solve(C / np.outer(scale, scale), unit))
