"""Variation of the readings along one line: scatter from reading to reading, and drift from run to run.

Model of a reading of approach a, run j, target i, with the position scaled to z = -1 ... 1::

    x_aji = mu_i +- b_i + (o_j + q_j z_i) +- (p_j + w_j z_i) + e_aji

``o`` and ``q`` are an offset and a slope that both approaches of a run share (drift of the machine, expansion of its
scale); ``p`` and ``w`` have the sign of the approach. All are independent from run to run: random effects, whose
variances are estimated by restricted likelihood (`errormotion.estimation.components`). That of e is the scatter about
lines through each run and approach, whatever these are; each approach has its own. If no reading is missing, and no
variance is 0, these are the estimates of an analysis of variance.

An estimated variance has the Student factor of `errormotion.estimation.variance.expansion`, with which an interval of
k = 2 contains the truth in 95 % of all cases or more, whatever the degrees of freedom. It belongs to the variance of a
mean, not to that of the random effect alone: the offset of a mean curve has the variance ``V = (s_o + g s_e) / n`` with
the variance s_e of e and a constant g. V has a chi-square distribution of n - 1 degrees of freedom, while its part s_o,
the difference of two estimates, has far fewer and may be 0. What V lacks is stated as part of s_o.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from errormotion.arrays import Array
from errormotion.errors import FitError, MethodError
from errormotion.estimation.blocks import Block, Noise
from errormotion.estimation.components import NOISE, Components, components
from errormotion.estimation.problem import READINGS, Problem
from errormotion.estimation.variance import expansion
from errormotion.kinematics.iso import DOF, direction_of

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

T = TypeVar("T")
EFFECTS = ("offset", "slope", "opposite offset", "opposite slope")
"""Random effects of a run."""
MIN_RUNS = 4
"""For an estimate of the drift: with fewer runs, its Student factor would exceed 2."""
MIN_APPROACH = 10.0
"""Degrees of freedom of each approach from which it has its own variance."""
MIN_FREEDOM = 3
"""Smallest number of degrees of freedom for the scatter of all readings."""
SIGNIFICANT = 1e-3
"""Probability in Bartlett's test of equal variances below which each target has its own variance."""
ANY = 10.0
"""Standard deviation of the effects of a run about which nothing is known, in that of the readings."""
SMALLEST = 1e-6
"""Variance of a target, of the common one, below which its readings agree by accident, or by rounding."""
EQUAL = 1e-15
"""Standard deviation below which readings are exactly equal, m or rad."""


class Unknowns(NamedTuple, Generic[T]):
    """Mean and half reversal at each target, and the effects of each run."""

    curve: T
    run: T


@dataclass(frozen=True, eq=False, kw_only=True)
class Scatter:
    """Variances along one line, m^2 or rad^2.

    Attributes
    ----------
    own : ndarray, (approach, target)
        Of one reading, independent from reading to reading; estimate.
    own_freedom : float
        Its degrees of freedom; infinite if it is stated.
    own_stated : ndarray, (approach, target)
        The same with its Student factor, at least the stated one.
    run : ndarray, (4,)
        Of the effects of a run, in the order of `EFFECTS`; estimate, at least the stated one.
    run_stated : ndarray, (4,)
        The same for the mean of several runs: with the Student factors of the mean curves.
    noise : ndarray, (4,)
        Variance of the same coefficients of the readings of one run, by ``own``.
    freedom : ndarray, (4,)
        Degrees of freedom of ``run + noise``; 0 where it is stated.
    pooled : bool
        Whether all targets have one variance, of each approach.
    unequal : bool
        Whether the variances of the targets differ significantly, with too few runs for one of each: it is then at
        least the common one.
    """

    own: Array
    own_freedom: float
    own_stated: Array
    run: Array
    run_stated: Array
    noise: Array
    freedom: Array
    pooled: bool
    unequal: bool = False


def scatter(
    x: Array, z: Array, *, kind: Literal["auto", "pooled", "target"], drift: float | None, stated: float | None
) -> Scatter:
    """Return the variances of readings (approach, run, target).

    Parameters
    ----------
    x : ndarray
        NaN for missing readings.
    z : ndarray, (target,)
        Position, scaled to -1 ... 1.
    kind : {"auto", "pooled", "target"}
        Whether each target has its own variance.
    drift : float, optional
        Standard deviation of a run of one approach by drift; a smaller estimate is replaced by it.
    stated : float, optional
        Standard deviation of a reading; a smaller estimate is replaced by it.

    Raises
    ------
    MethodError
        Too few runs to estimate what is not stated.
    """
    known = np.isfinite(x)
    measured = known.any(axis=(1, 2))
    both, runs = bool(measured.all()), x.shape[1]
    seen = known.any(axis=1)
    least = np.array([0.0 if drift is None else drift**2 / measured.sum(), 0.0] * 2) * [1, 1, both, both]
    if runs == 1 and (stated is None or drift is None):
        raise MethodError(
            "The scatter of the readings cannot be estimated from one run. Measure more runs, or state the settings "
            "uncertainty.scatter and uncertainty.drift.",
            code="position.runs.one",
        )
    if drift is None and runs < MIN_RUNS:
        raise MethodError(
            f"Expected {MIN_RUNS} runs or more, or the drift during one run (setting uncertainty.drift); found "
            f"{runs} runs: the drift from run to run cannot be estimated.",
            code="position.runs.too_few",
        )
    if runs == 1 or _equal(x):
        own = np.where(seen, 0.0 if stated is None else stated**2, np.nan)
        return Scatter(
            own=own, own_freedom=np.inf, own_stated=own, run=least, run_stated=least, noise=np.zeros(4),
            freedom=np.zeros(4), pooled=True,
        )  # fmt: skip
    _check_freedom(known)
    own, freedom, pooled, unequal = _own(_estimated(x, z, None, both), x.shape, kind)
    own = np.where(seen, own, np.nan)
    run, noise, of_run = _of_runs(_estimated(x, z, own, both), z, both)
    student = np.square(expansion(freedom))
    if runs >= MIN_RUNS:
        more = (np.square(expansion(of_run)) - 1.0) * (run + noise) - (student - 1.0) * noise
        run_stated = run + np.maximum(more, 0.0) * [1, 1, both, both]
    else:
        run_stated, of_run = run, np.zeros(4)
    smallest = 0.0 if stated is None else stated**2
    return Scatter(
        own=np.maximum(own, smallest),
        own_freedom=freedom,
        own_stated=np.maximum(student * own, smallest),
        run=np.maximum(run, least),
        run_stated=np.maximum(run_stated, least),
        noise=noise,
        freedom=of_run,
        pooled=pooled,
        unequal=unequal,
    )


def lacking(settings: LinearPositioningSettings) -> dict[str, str]:
    """Return by setting what `scatter` will lack whatever is measured; only that of the positioning can be stated."""
    stated, only = settings.uncertainty, settings.freedoms == (DOF[direction_of(settings.axis)],)
    if settings.runs == 1:
        if only and stated.scatter is not None and stated.drift is not None:
            return {}
        needed = "uncertainty.scatter and uncertainty.drift"
    elif settings.runs >= MIN_RUNS or (only and stated.drift is not None):
        return {}
    else:
        needed = "uncertainty.drift"
    other = f", or the setting {needed}" if only else " for freedoms other than the positioning"
    return {"runs": f"expected {MIN_RUNS} runs or more{other}, to estimate scatter and drift; found {settings.runs}"}


def _equal(x: Array) -> bool:
    """Return whether the readings of all runs are exactly equal."""
    return bool(np.nanmax(np.fmax.reduce(x, axis=1) - np.fmin.reduce(x, axis=1)) < EQUAL)


def _check_freedom(known: NDArray[np.bool_]) -> None:
    """Refuse readings with too few degrees of freedom left by the means of the targets and a line for each run."""
    n = known.sum(axis=1)
    usable = known & (n > 1)[:, None]
    lines = np.minimum(usable.sum(axis=2), 2).sum(axis=1) - 2 * usable.any(axis=(1, 2))  # the means contain one
    freedom = int(np.maximum(n - 1, 0).sum() - np.maximum(lines, 0).sum())
    if freedom < MIN_FREEDOM:
        raise MethodError(
            f"Too few readings to estimate their scatter: expected {MIN_FREEDOM} degrees of freedom or more; found "
            f"{freedom}. Measure more targets or runs.",
            code="readings.too_few",
        )


def _estimated(x: Array, z: Array, own: Array | None, both: bool) -> Components:
    """Return the variances of the runs' effects, with a noise in the ratios of ``own``.

    Without ``own`` the effects of a run may be any, and only the noise is estimated. Otherwise an effect whose variance
    is estimated as 0 would count as noise, although it is smaller than noise by accident: the estimate would be 7 % too
    small without drift.
    """
    a, j, i = (index.ravel() for index in np.indices(x.shape))
    sign, one = np.where(a == 0, 1.0, -1.0), np.ones(a.size)
    designs = Unknowns(np.stack([one, sign], axis=1), np.stack([one, z[i], sign, sign * z[i]], axis=1))
    used = np.array([True, True, both, both])
    known = np.isfinite(x)
    seen = known.any(axis=1)
    rows = Unknowns(i, j)

    def equation(y: Array, u: Unknowns[Array], _: object) -> Array:
        return np.asarray(y - sum(np.einsum("nk,nk->n", A, each) for A, each in zip(designs, u, strict=True)))

    derivatives = {name: -A[:, None] for name, A in zip(Unknowns._fields, designs, strict=True)}
    derivatives[READINGS] = np.ones((a.size, 1, 1))
    mean = np.where(known, x, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    centred = x - mean[:, None]  # which the means of the targets contain: rounding is that of the scatter
    spread = float(np.sqrt(np.mean(np.square(centred[known]))))
    sd = np.full(a.size, spread) if own is None else np.sqrt(np.maximum(own, EQUAL**2))[a, i]
    problem = Problem(
        equation=equation,
        readings=centred.ravel(),
        unknowns=Unknowns(
            Block(
                start=np.zeros((z.size, 2)),
                index=rows.curve,
                scale=1.0,
                free=np.stack([seen.any(axis=0), seen.all(axis=0)], axis=1),
            ),
            Block(
                start=np.zeros((x.shape[1], 4)),
                index=rows.run,
                scale=1.0,
                free=np.tile(used, (x.shape[1], 1)),
                group="runs",
                prior=ANY * spread if own is None else None,
                component=() if own is None else tuple(np.where(used, EFFECTS, "")),
            ),
        ),
        noise=Noise(sd=np.nan_to_num(sd, nan=spread), stated=False),
        derivatives=lambda *_: derivatives,
        linear=True,
    )
    try:
        return components(problem, noise=True)
    except FitError as error:
        raise MethodError(
            f"deviation: expected readings that determine their scatter; {error}.", code=error.code
        ) from error


def _own(estimate: Components, shape: tuple[int, ...], kind: str) -> tuple[Array, float, bool, bool]:
    """Return the variance of a reading (approach, target), its degrees of freedom, whether it is pooled, and unequal.

    The sum of squares of the residuals at a target has the expectation of the variance times their redundancy.
    """
    at = estimate.names.index(NOISE)
    noise = estimate.fit.problem.noise.sd
    pooled, freedom = float(np.square(np.nanmin(np.asarray(noise)))), float(estimate.freedom[at])
    residual, left = estimate.fit.residual[:, 0], 1.0 - estimate.fit.leverage[:, 0]
    known = np.isfinite(residual)
    square = np.where(known, np.square(residual), 0.0).reshape(shape).sum(axis=1)
    redundancy = np.where(known, left, 0.0).reshape(shape).sum(axis=1)
    # Readings of one approach may scatter more than those of the other, by friction or a spring: each has its own
    common, of_approach = np.full(square.shape, pooled), redundancy.sum(axis=1)
    if of_approach.min() >= MIN_APPROACH and square.any():
        ratio = square.sum(axis=1) / of_approach / (square.sum() / of_approach.sum())
        common *= np.maximum(ratio, SMALLEST)[:, None]
        freedom *= float(of_approach.min() / of_approach.sum())
    if kind == "pooled" or (kind == "auto" and not _differ(square / common, redundancy)):
        return common, freedom, True, False
    variance = np.where(redundancy > 0.5, square / np.maximum(redundancy, 0.5), common)
    variance = np.maximum(variance, SMALLEST * pooled)
    of_each = float(np.median(redundancy[redundancy > 0.5]))
    if of_each > 2:
        return variance, of_each, False, False
    if kind == "auto":
        return np.maximum(variance, common), freedom, False, True
    least = int(np.ceil(2.0 * shape[1] / of_each)) + 1
    raise MethodError(
        f"Variances by target: expected {least} runs or more at these targets; found {shape[1]}. Use scatter 'pooled'.",
        code="position.runs.too_few",
    )


def _differ(square: Array, redundancy: Array) -> bool:
    """Return whether the variances of the targets differ significantly (Bartlett's test)."""
    usable = (redundancy > 1) & (square > 0)
    if usable.sum() < 2:
        return False
    k, v = usable.sum(), redundancy[usable]
    variance = square[usable] / v
    pooled = (v @ variance) / v.sum()
    if not pooled > 0:
        return False
    statistic = v.sum() * np.log(pooled) - v @ np.log(variance)
    correction = 1.0 + ((1.0 / v).sum() - 1.0 / v.sum()) / (3.0 * (k - 1))
    return bool(special.chdtrc(k - 1, statistic / correction) < SIGNIFICANT)


def _of_runs(estimate: Components, z: Array, both: bool) -> tuple[Array, Array, Array]:
    """Return the variances of the runs' effects, those of the same coefficients of a run by its noise, and freedoms.

    All (4,). The coefficients are offset and slope of the mean curve and of the reversal, with the variance
    ``V = (s + noise) / n`` by n runs, of which the fit states the parts.
    """
    fit = estimate.fit
    free = fit.problem.unknowns.curve.freed
    a = np.zeros((*free.shape, 4))
    for k in range(2 if both else 1):
        here = free[:, k]
        Z = np.stack([np.ones(int(here.sum())), z[here]], axis=1)
        a[here, k, 2 * k : 2 * k + 2] = np.linalg.pinv(Z).T
    q = fit.linear.numbering.size
    b = np.zeros((q, 4))
    effect, at_border = fit.normal.solve(a, b)
    V = np.einsum("rpk,rpk->k", a, effect)
    by_name = dict(zip(estimate.names, zip(estimate.variance, estimate.used, strict=True), strict=True))
    factor = by_name[NOISE][1]  # the noise of the fit, of that in the weights
    run, noise, freedom = np.zeros(4), np.zeros(4), estimate.freedom_of(a, b)
    for k, name in enumerate(EFFECTS):
        if name not in by_name or not V[k] > 0:
            continue
        run[k], used = by_name[name]
        # V = sum of the squared effects of the runs on it, n^-1 s each ... and the part of the noise
        part = float(np.sum(np.square(at_border[fit.linear.numbering.border[1][:, k], k]))) / used
        noise[k] = max(V[k] - part, 0.0) / factor * used / part
    return run, noise, freedom
