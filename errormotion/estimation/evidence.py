"""Coefficients of series, such as polynomials, whose sizes and smoothness are estimated from the data as well.

The data have been reduced to normal equations ``N x = b``. Columns belong to groups, such as the terms of one error
motion. A coefficient of order n in group g has the prior standard deviation ``tau_g n^-p``. Columns without group have
no prior: known ones, and nuisance parameters, whose own prior is part of N. For each exponent p, the sizes tau are
those of largest marginal likelihood (MacKay, Bayesian interpolation, Neural Computation 4 (1992) 415), by expectation
and maximisation (Dempster, Laird, Rubin, J. R. Stat. Soc. B 39 (1977) 1)::

    C = (N + P)^-1,  x = C b,  P = diag(tau_g n^-p)^-2
    tau_g^2 = mean over the group of (x^2 + diag C) n^2p
    2 ln evidence = b' x - ln det (N + P) + ln det P + constant

The data rarely determine the exponent. The estimates of all exponents are therefore averaged with their evidence as
weight w, and their differences are part of the covariance::

    x = sum w_p x_p,  C = sum w_p (C_p + (x_p - x) (x_p - x)')

Terms that the data do not determine keep their prior, so that their possible size is contained in the covariance.
Groups of one kind have similar sizes: if their logarithms have the standard deviation s, the size of the kind counts as
much as ``1 / (2 s^2)`` terms (`pooled`), since w terms determine ``ln tau`` to ``1 / sqrt(2 w)``.

Few data hardly determine the sizes. Their logarithms have the covariance S about the maximum (Laplace)::

    Y = P^1/2 C P^1/2,  u = P^1/2 x
    S^-1 = -d2 ln evidence / d ln tau d ln tau + 2 pooled (1 - mean over the kind)
    -d2 ln evidence / d ln tau_g d ln tau_h = 2 [g = h] sum (u_i^2 + Y_ii) - sum (4 u_i Y_ij u_j + 2 Y_ij^2)

with sums over i in g and j in h. Their mean exceeds the maximum by S_gg: the likelihood of w terms is that of an
inverse chi-square distribution, with ``S = 1 / (2 w)`` and the third derivative 4 w. With ``dx = 2 C P_g x``,
``dC = 2 C P_g C`` and ``d2 C = 8 C P_g C P_h C - 4 [g = h] C P_g C`` by ``ln tau`` the covariance becomes, to the
second order (Kass, Steffey, J. Am. Stat. Assoc. 84 (1989) 717), and with S_ij of the groups of two coefficients,

    C + 4 C P^1/2 [S_ij (Y_ij + u_i u_j)] P^1/2 C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from errormotion.arrays import Array

_FIRST_SIZE = 30.0
"""Size of a prior at the start, relative to the typical standard uncertainty of a single column."""
_NO_WEIGHT = 1e-12
"""Weight of an exponent that is not counted."""
_LARGEST_U = 1.0
"""Standard deviation of the logarithm of a size that the data do not determine at all."""
_NO_EFFECT = 1e-9
"""Column of which the data know nothing: its size relative to the largest."""


@dataclass(frozen=True)
class Posterior:
    """Coefficients for one exponent of their prior, with their covariance.

    Attributes
    ----------
    value : ndarray, (column,)
    half : ndarray, (column, column)
        Root of the covariance ``half' half`` for these sizes.
    of_sizes : ndarray, (column, column)
        What the uncertainty of the sizes adds to it.
    determined : ndarray, (column,)
        Degree to which the data determine a column, from 0 (by its prior only) to 1.
    size : ndarray, (group,)
        Standard deviation tau of a coefficient of order 1, as estimated from these coefficients; at convergence that of
        their prior.
    exponent : float
        p of the priors ``tau n^-p``.
    evidence : float
        Twice the logarithm of the marginal likelihood, up to a constant that is common to all priors.
    """

    value: Array
    half: Array
    of_sizes: Array
    determined: Array
    size: Array
    exponent: float
    evidence: float

    @property
    def covariance(self) -> Array:
        """Covariance of the coefficients for these sizes, (column, column)."""
        return np.asarray(self.half.T @ self.half)


@dataclass(frozen=True)
class Averaged:
    """Coefficients averaged over the exponents of their prior, weighted by the evidence.

    Attributes
    ----------
    value : ndarray, (column,)
    covariance : ndarray, (column, column)
        With the uncertainty of the sizes, and the differences between the exponents.
    within : ndarray, (column, column)
        Mean of the covariances for each exponent and its sizes: the effect of nuisance parameters is that of
        `eliminated` with it.
    determined : ndarray, (column,)
        Degree to which the data determine a column, from 0 (by its prior only) to 1.
    parts : sequence of Posterior
    weight : ndarray, (part,)
    """

    value: Array
    covariance: Array
    within: Array
    determined: Array
    parts: Sequence[Posterior]
    weight: Array

    @property
    def exponent(self) -> float:
        """Mean exponent."""
        return float(self.weight @ [each.exponent for each in self.parts])

    def variance(self, order: ArrayLike) -> Array:
        """Return the mean prior variances (group, order) of coefficients of orders (order,)."""
        n = np.asarray(order, dtype=float)
        each = [np.outer(part.size**2, n ** (-2 * part.exponent)) for part in self.parts]
        return np.asarray(np.einsum("p,pgn->gn", self.weight, each))


def averaged(parts: Sequence[Posterior]) -> Averaged:
    """Return coefficients averaged over the exponents."""
    evidence = np.array([each.evidence for each in parts])
    weight = np.exp((evidence - evidence.max()) / 2)
    weight /= weight.sum()
    value = np.asarray(sum(w * each.value for w, each in zip(weight, parts, strict=True)))
    within, spread = np.zeros((2, value.size, value.size))
    for w, each in zip(weight, parts, strict=True):
        if w > _NO_WEIGHT:
            within += w * each.covariance
            spread += w * (each.of_sizes + np.outer(each.value - value, each.value - value))
    determined = np.asarray(sum(w * each.determined for w, each in zip(weight, parts, strict=True)))
    return Averaged(value, within + spread, within, determined, parts, weight)


def posteriors(
    N: Array,
    b: Array,
    group: NDArray[np.intp],
    order: Array,
    *,
    exponents: Sequence[float],
    kind: NDArray[np.intp] | None = None,
    pooled: float = 0.0,
    smallest: float = 0.0,
    regularisation: float = 0.0,
    passes: int = 100,
    tolerance: float = 0.01,
) -> list[Posterior]:
    """Return the coefficients for each exponent, with the sizes of largest evidence.

    Parameters
    ----------
    N, b : ndarray, (column, column), (column,)
        Normal matrix and right side, in any units; ``N^-1`` is the covariance without priors.
    group : ndarray of int, (column,)
        Group of each column, numbered from 0 without gaps; -1 for a column without prior.
    order : ndarray, (column,)
        Orders n; those below 1 count as 1.
    exponents : sequence of float
        Candidates of p.
    kind : ndarray of int, (group,), optional
        Groups of one kind, of the same unit, have similar sizes; by default each group is of its own kind.
    pooled : float
        Weight, in columns, of the typical size of its kind in the size of a group.
    smallest : float
        Smallest size of a group, relative to the typical standard uncertainty of a single column of its kind.
    regularisation : float
        Added to the diagonal of the scaled matrix, and prior of the columns without one, relative to their information:
        for columns that the data do not determine.
    passes, tolerance
        Largest number of iterations for the sizes, and the change of their logarithm that ends them.

    Raises
    ------
    numpy.linalg.LinAlgError
        Columns without prior are not determined, and there is no regularisation.
    """
    groups = int(group.max(initial=-1)) + 1
    _, kinds = np.unique(np.arange(groups) if kind is None else kind, return_inverse=True)
    size = np.sqrt(np.diag(N))
    unit = np.where(size > _NO_EFFECT * size.max(), 1 / np.where(size > 0, size, 1.0), 1.0)
    scaled, right = N * np.outer(unit, unit), b * unit
    members = np.flatnonzero(group >= 0)
    typical = [np.median(unit[members[kinds[group[members]] == k]]) for k in range(int(kinds.max(initial=-1)) + 1)]
    search = _Search(scaled, right, unit, members, group[members], np.maximum(order[members], 1.0), kinds,
                     np.array(typical), pooled, smallest, regularisation, passes, tolerance)  # fmt: skip
    return [search.with_exponent(p) for p in exponents]


def eliminated(N: Array, b: Array, square: float, count: int) -> tuple[Array, Array, float, Array]:
    """Return normal equations without their last ``count`` columns, nuisance parameters with their own prior in N.

    Returns
    -------
    N, b, square : ndarray, ndarray, float
        Of the other columns; ``square`` is the weighted sum of squares of the data, reduced likewise.
    gain : ndarray, (column, count)
        With the covariance C of the other columns, ``C gain`` is the effect of one standard deviation of the prior.
    """
    n = len(N) - count
    if not count:
        return N, b, square, np.zeros((n, 0))
    M, border = N[n:, n:], N[:n, n:]
    gain = np.asarray(np.linalg.solve(M, border.T).T)
    square -= float(b[n:] @ np.linalg.solve(M, b[n:]))
    return N[:n, :n] - gain @ border.T, b[:n] - gain @ b[n:], square, gain


@dataclass(frozen=True)
class _Search:
    """Normal equations in units in which the information of each column is 1, and what is known of the priors."""

    N: Array
    b: Array
    unit: Array  # (column,)
    members: NDArray[np.intp]  # columns with a prior
    group: NDArray[np.intp]  # of these
    order: Array  # of these
    kind: NDArray[np.intp]  # of each group
    typical: Array  # standard uncertainty of a single column of each kind
    pooled: float
    smallest: float
    regularisation: float
    passes: int
    tolerance: float

    def with_exponent(self, exponent: float) -> Posterior:
        """Return the coefficients for priors ``tau n^-p``, with tau of each group by expectation and maximisation."""
        shape = self.order**-exponent
        count = np.bincount(self.group, minlength=self.kind.size)
        of_kind = self.typical[self.kind]
        tau = _FIRST_SIZE * of_kind
        for _ in range(self.passes):
            prior = np.full(len(self.N), self.regularisation)
            prior[self.members] = (self.unit[self.members] / (tau[self.group] * shape)) ** 2
            half, log_det = _half_of_inverse(self.N, prior, self.regularisation)
            x = half.T @ (half @ self.b)
            variance = np.einsum("ij,ij->j", half, half)
            second = (x[self.members] ** 2 + variance[self.members]) * (self.unit[self.members] / shape) ** 2
            total = np.asarray(np.bincount(self.group, second, self.kind.size), dtype=float)
            used = tau
            if self.pooled:
                logs = np.bincount(self.kind, 2 * np.log(tau)) / np.bincount(self.kind)
                total = total + self.pooled * np.exp(logs)[self.kind]
            tau = np.maximum(np.sqrt(total / (count + self.pooled)), self.smallest * of_kind)
            if np.abs(np.log(tau / used)).max(initial=0.0) < self.tolerance:
                break
        evidence = float(self.b @ x) - log_det + float(np.log(prior[self.members]).sum())
        determined = 1 - variance * prior
        return Posterior(
            value=x * self.unit,
            half=half * self.unit,
            of_sizes=self._of_sizes(x, half, prior) * np.outer(self.unit, self.unit),
            determined=determined,
            size=tau,
            exponent=exponent,
            evidence=evidence,
        )

    def _of_sizes(self, x: Array, half: Array, prior: Array) -> Array:
        """Return what the uncertainty of the sizes adds to the covariance."""
        root = np.sqrt(prior[self.members])
        B = (half.T @ half[:, self.members]) * root  # C P^1/2
        Y, u = root[:, None] * B[self.members], root * x[self.members]
        one = np.equal.outer(np.arange(self.kind.size), self.group).astype(float)
        second = one @ (4 * u[:, None] * Y * u + 2 * Y**2) @ one.T
        A = 2 * np.diag(one @ (u**2 + np.diag(Y))) - second
        same = np.equal.outer(self.kind, self.kind)
        A += 2 * self.pooled * (np.eye(len(same)) - same / same.sum(axis=1))
        values, vectors = np.linalg.eigh((A + A.T) / 2)
        S = (vectors / np.maximum(values, _LARGEST_U**-2)) @ vectors.T
        each = S[np.ix_(self.group, self.group)]
        return np.asarray(B @ (4 * each * (Y + np.outer(u, u))) @ B.T)


def _half_of_inverse(N: Array, prior: Array, rounding: float) -> tuple[Array, float]:
    """Return H with H' H the inverse of N + diag(prior), scaled for accuracy, and the logarithm of its determinant."""
    scale = 1 / np.sqrt(np.diag(N) + prior)
    scaled = N * scale[:, None] * scale
    np.fill_diagonal(scaled, 1.0 + rounding)
    # in the order of LAPACK, and in place: copies would take half of the time
    factor = linalg.cholesky(scaled.T, lower=True, overwrite_a=True, check_finite=False)
    log_det = 2 * float(np.log(np.diag(factor) / scale).sum())
    inverse: Array = linalg.lapack.dtrtri(factor, lower=1, overwrite_c=1)[0]
    inverse *= scale
    return inverse, log_det
