"""Reliability: which errors of single readings would be found, and what the others do to the result.

With the redundancy r of a number (the part of its information that the fit leaves), the rule of `exclusions` finds a
gross error ``e`` with the non-centrality ``delta = e sqrt(N)``, where N is its information reduced by the fit. With the
limit of the test ``z = z(1 - alpha / 2 n)`` (Bonferroni) and the power ``beta``

    smallest error found  = delta0 / sqrt(N),    delta0 = z(1 - alpha / 2 n) + z(beta)           internal reliability
    its effect on f = l'x = l' C J' D e,         at most delta0 sqrt((1 - r) / r) u(f)            external reliability

(Baarda, A testing procedure for use in geodetic networks, 1968; Pope, NOAA TR NOS 65 NGS 1, 1976, for an unknown noise
with Student's distribution, here of the noise from the other readings). Two numbers whose tests are correlated by more
than 0.9 mask one another: which one is wrong is hardly determined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import nctdtrinc, ndtri, stdtrit

from errormotion.arrays import Array
from errormotion.estimation.checks.effects import At, Numbers
from errormotion.estimation.checks.exclusions import FALSE_ALARM
from errormotion.estimation.fit import Fit

__all__ = ["MASKED", "POWER", "Reliability", "non_centrality", "reliability"]

POWER = 0.8
"""Probability with which the smallest error is found."""
MASKED = 0.9
"""Correlation of the tests of two numbers from which on they mask one another."""
MAX_PAIRED = 2000
"""Numbers among which masking pairs are searched: those with the least redundancy."""
_CHUNK = 100


@dataclass(frozen=True, eq=False)
class Reliability:
    """Reliability of the numbers of a fit.

    Attributes
    ----------
    redundancy : ndarray, (n, m)
        0 to 1: what remains of an error in the residuals; NaN where missing.
    smallest : ndarray, (n, m)
        Smallest gross error that would be found with a probability of 80 %, in the unit of the residuals; infinite for
        a number that nothing checks.
    bias : ndarray, (n, m)
        Largest effect of this error on any linear function of the unknowns, in standard uncertainties of the function.
    effect : ndarray, (n, m, k)
        Its effect on each of the given functions, in their unit, with the sign for a positive error; infinite for one
        that nothing checks, unless the function does not depend on it.
    masked : tuple of (At, At, float)
        Pairs of numbers that mask one another, with their correlation; largest first.
    complete : bool
        Whether all numbers were compared for ``masked``.
    """

    redundancy: Array
    smallest: Array
    bias: Array
    effect: Array
    masked: tuple[tuple[At, At, float], ...]
    complete: bool

    @property
    def worst(self) -> list[tuple[At, float]]:
        """For each function the number whose undetected error has the largest effect, and this effect."""
        rows = []
        for k in range(self.effect.shape[2]):
            size = np.where(np.isfinite(self.redundancy), np.abs(self.effect[..., k]), -np.inf)
            i, j = np.unravel_index(int(np.argmax(size)), size.shape)
            rows.append(((int(i), int(j)), float(self.effect[i, j, k])))
        return rows


def reliability(
    fit: Fit,
    functions: tuple[Array, Array] | None = None,
    *,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    factor: float = 1.0,
    pairs: bool = True,
) -> Reliability:
    """Return the reliability of a fit.

    Parameters
    ----------
    fit : Fit
    functions : tuple of ndarray, (R, p, k) and (q, k), optional
        Derivatives of k linear functions by the eliminated unknowns and by those of the border.
    false_alarm, power : float
        Of the test: probability of an alarm in valid data, and of finding the smallest error.
    factor : float
        Variance factor, for an unknown noise.
    pairs : bool
        Whether pairs that mask one another are searched, which takes most of the time.
    """
    numbers = Numbers(fit, whole=False)
    linear = fit.linear
    used, r = linear.used, numbers.redundancy
    tested = numbers.tested
    trials = max(int(tested.sum()), 1)
    delta = non_centrality(false_alarm / trials, power, np.inf if fit.problem.noise.stated else fit.freedom - 1)
    alone = np.sum(np.square(linear.whitener), axis=1)  # information of each number if nothing else were unknown
    N = np.where(tested, r * alone, 1.0)
    smallest = np.where(tested, np.sqrt(factor) * delta / np.sqrt(N), np.inf)
    bias = np.where(tested, delta * np.sqrt(np.maximum(1 - r, 0.0) / np.where(tested, r, 1.0)), np.inf)
    n, m = used.shape
    effect = np.zeros((n, m, 0))
    if functions is not None:
        # D_i' J C l for each number i
        change = linear.effect(*fit.normal.solve(*functions))
        per_unit = -np.einsum("nij,nik->njk", linear.whitener, change)
        some = np.abs(per_unit) > 1e-9 * np.abs(per_unit).max(axis=(0, 1), initial=1e-300)
        size = np.where(np.isfinite(smallest), smallest, 0.0)[..., None]
        unchecked = np.where(some, np.copysign(np.inf, per_unit), 0.0)
        effect = np.where(tested[..., None], per_unit * size, unchecked)
        effect = np.where(used[..., None], effect, np.nan)
    masked, complete = _masked(fit, numbers) if pairs else ((), False)
    missing = np.where(used, 0.0, np.nan)
    return Reliability(r + missing, smallest + missing, bias + missing, effect, masked, complete)


def non_centrality(alpha: float, power: float, freedom: float = np.inf) -> float:
    """Return the error, in standard deviations of its estimate, that a two-sided test of level alpha finds.

    Of the normal distribution, or of Student's with ``freedom`` degrees of freedom.
    """
    if np.isfinite(freedom) and freedom < 1:
        return float(np.inf)
    if freedom > 1000:
        return float(ndtri(1 - alpha / 2) + ndtri(power))
    limit = float(-stdtrit(freedom, alpha / 2))
    return float(nctdtrinc(freedom, 1 - power, limit))


def _masked(fit: Fit, numbers: Numbers) -> tuple[tuple[tuple[At, At, float], ...], bool]:
    """Return the pairs of numbers whose tests are correlated, ``N_ij / sqrt(N_ii N_jj)``, and whether all were tried.

    As ``|H_ij| <= sqrt(H_ii H_jj)``, only numbers with little redundancy can have such a partner.
    """
    r = numbers.redundancy
    odds = np.where(numbers.tested, (1 - r) / np.where(numbers.tested, r, 1.0), 0.0)
    highest = float(odds.max(initial=0.0))
    # For one number a reading; with correlated noise of a vector reading others may be masked, too.
    several = r.shape[1] > 1
    possible = numbers.tested if several else numbers.tested & (odds * highest >= MASKED**2)
    at = np.argwhere(possible)
    order = np.argsort(r[possible], kind="stable")[:MAX_PAIRED]
    complete = len(at) <= MAX_PAIRED
    at = at[np.sort(order)]
    if len(at) < 2:
        return (), complete
    N = np.empty((len(at), len(at)))
    rows = at[:, 0]
    W = np.stack([fit.linear.whitener[i, :, j] for i, j in at])  # (K, m)
    for first in range(0, len(at), _CHUNK):
        part = slice(first, first + _CHUNK)
        its = [(int(i), int(j)) for i, j in at[part]]
        some = np.unique(rows[part])
        D = np.zeros((some.size, W.shape[1], len(its)))
        D[np.searchsorted(some, rows[part]), :, np.arange(len(its))] = W[part]
        x, z = fit.normal.solve(*fit.linear.gradient(D, some))
        # D_i' (1 - H) D_j
        predicted = np.swapaxes(fit.linear.whitener, 1, 2) @ fit.linear.effect(x, z)
        N[:, part] = -predicted[rows, at[:, 1]]
    same = rows[:, None] == rows
    N += np.where(same, W @ W.T, 0.0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    correlation = np.triu(N * scale * scale[:, None], 1)
    pairs = np.argwhere(np.abs(correlation) > MASKED)
    found = [
        ((int(at[i, 0]), int(at[i, 1])), (int(at[j, 0]), int(at[j, 1])), float(correlation[i, j])) for i, j in pairs
    ]
    return tuple(sorted(found, key=lambda pair: -abs(pair[2]))), complete
