"""Variances of random effects and of the noise by restricted maximum likelihood (REML).

With fixed effects X, random effects Z of variances d_j and a white noise of variance s, the whitened readings have the
covariance ``V = s + Z D Z'``, and error contrasts, which do not depend on the fixed effects, have the restricted
likelihood of Patterson and Thompson (Biometrika 58 (1971) 545). The fixed effects are eliminated once,

    A = Z' M Z,    b = Z' M y,    c = y' M y,    M = 1 - X (X' X)^-1 X',

after which everything needs matrices of the size of Z only. With ``K = s + A D`` and the projection P of V^-1 on the
contrasts

    Q = Z' P Z = K^-1 A,    v = Z' P y = K^-1 b,    y' P y = (c - b' D v) / s,
    -2 log L = (n - p) log s + log det(K / s) + y' P y,
    d(-2 log L)/d d_k = sum_k (Q_jj - v_j^2),    expected information 1/2 sum Q_ij^2,

and the terms of the noise follow from ``P V P = P``. Fisher scoring finds the maximum; variances may be 0. Unknowns
with a stated prior, such as adjusted constants, are random effects of known variance, which a factor would change.

The degrees of freedom of an estimated variance g are ``2 g^2 / var(g)`` (Satterthwaite, Biometrics Bull. 2 (1946) 110;
GUM G.4.1), with var(g) from the information of the variances, each with its effect on g.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.blocks import Block, Index, Noise
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.linear.normal import SingularError, factorised
from errormotion.estimation.linear.system import Linear, linearised
from errormotion.estimation.problem import Problem

__all__ = ["NOISE", "Components", "components", "noise_variance"]

NOISE = "noise"
"""Name of the variance of the noise, as a factor for the one in the weights."""
FLOOR = 1e-8
"""Smallest variance in the final fit, of that with which an effect is as large as the noise of its estimate."""
LEAST_NOISE = 1e-9
"""Smallest variance of the noise, of that of the readings with all effects: less cannot be told from rounding."""
CONVERGED = 1e-12
"""Increase of the likelihood that the next step promises, at which the scoring ends."""
CHANGED = 1e-6
"""Relative change of the variances from one linearisation to the next, at which these end."""
STALLED = 1e-3
"""The same for changes that do not decrease any more, and the square root of the increase at which the scoring ends if
it does not: rounding, where variances differ by many orders of magnitude."""
MAX_STEPS = 200
MAX_FITS = 20


@dataclass(frozen=True, eq=False)
class Components:
    """Estimated variances, and the fit with them.

    Attributes
    ----------
    fit : Fit
        With the variances as priors of the random effects, and the noise in its weights.
    names : tuple of str
        Of the components; `NOISE` is the noise.
    variance : ndarray, (k,)
        In the square of the unit of the unknowns; of the noise, the factor for the variance in the problem's weights.
    covariance : ndarray, (k, k)
        Of the variances, from their expected information.
    log_likelihood : float
        Restricted, up to a constant.
    """

    fit: Fit
    names: tuple[str, ...]
    variance: Array
    covariance: Array
    log_likelihood: float
    _floor: Array
    _columns: tuple[Index, ...]

    @property
    def used(self) -> Array:
        """Variances of the final fit: at least a negligible one, (k,)."""
        return np.maximum(self.variance, self._floor)

    @property
    def freedom(self) -> Array:
        """Degrees of freedom of each variance; 0 where it is 0."""
        spread = np.diagonal(self.covariance)
        return np.asarray(2 * np.square(self.variance) / np.where(spread > 0, spread, np.inf))

    def freedom_of(self, a: Array, b: Array) -> Array:
        """Return the degrees of freedom of the variances of linear functions of the unknowns, (k,).

        Parameters
        ----------
        a, b : ndarray, (R, p, k) and (q, k)
            Derivatives by the eliminated unknowns and by those of the border.

        Notes
        -----
        Of ``g = l' C l``, the noise makes the part ``|J C l|^2``, a random effect j the part ``(C l)_j^2 / d_j``.
        As the estimate has minimum variance, the derivative of g by a variance is its part over the variance.
        """
        x, z = self.fit.normal.solve(a, b)
        g = np.einsum("rpk,rpk->k", a, x) + np.einsum("qk,qk->k", b, z)
        parts = []
        for name, theta, at in zip(self.names, self.used, self._columns, strict=True):
            noise = name == NOISE
            effect = self.fit.linear.effect(x, z).reshape(-1, g.size) if noise else z[at] / np.sqrt(theta)
            parts.append(np.sum(np.square(effect), axis=0))
        return self.freedom_of_parts(np.array(parts).reshape(len(self.names), g.size), g)

    def freedom_of_parts(self, parts: Array, variance: Array) -> Array:
        """Return the degrees of freedom of variances (...), of which ``parts`` (k, ...) are due to each component.

        The part of the noise is that of the readings, those of the others are the squared effects of their sources.
        """
        slope = parts / self.used.reshape(-1, *[1] * np.ndim(variance))
        spread = np.einsum("i...,ij,j...->...", slope, self.covariance, slope)
        return np.asarray(2 * np.square(variance) / np.maximum(spread, 1e-300 + 1e-9 * np.square(variance)))


def components(
    problem: Problem,
    *,
    noise: bool | None = None,
    refresh: Callable[[Problem, Any], Problem] | None = None,
    what: str = "the readings",
) -> Components:
    """Return the variances of the random effects of a problem (`Block.component`), and its fit.

    Parameters
    ----------
    problem : Problem
    noise : bool, optional
        Whether the size of the noise is estimated as well. Default: if it is not stated.
    refresh, what
        See `fit`.

    Raises
    ------
    FitError
        As `fit`; or the fixed effects are undetermined, or the variances do not converge.
    """
    estimated = (not problem.noise.stated) if noise is None else noise
    problem = _bordered(problem)
    names = tuple(dict.fromkeys(name for block in problem.unknowns for name in block.component if name))
    linear = linearised(problem, problem.start)
    theta: Array | None = None
    weighted_fit: Fit | None = None
    change = np.inf
    for _ in range(MAX_FITS):
        contrasts = _Contrasts.of(linear, names, estimated, what)
        last, (theta, information, likelihood) = theta, contrasts.maximised(theta)
        floor = contrasts.floor()
        used = np.maximum(theta, floor)
        if last is not None:
            # Of a variance, or of its standard uncertainty where this is larger: the likelihood shows no less.
            size = np.maximum(used, 1.0 / np.sqrt(np.maximum(np.diagonal(information), 1e-300)))
            before, change = change, float((np.abs(used - np.maximum(last, floor)) / size).max(initial=0.0))
            if change <= CHANGED or (change <= STALLED and change > before / 2):
                break
        start = linear.at if weighted_fit is not None else None
        weighted = _weighted(problem, contrasts.names, used)
        weighted_fit = fit(weighted, refresh=refresh, what=what, start=start, numbering=linear.numbering)
        if problem.linear and refresh is None:
            break  # the contrasts are the same at any solution
        linear = _unweighted(weighted_fit.linear, problem, contrasts.names, used)
    else:
        raise FitError(
            f"the variances of {', '.join(names) or NOISE} have not converged in {MAX_FITS} fits to {what}",
            code="estimation.variances.not_converged",
        )
    if weighted_fit is None:
        raise FitError("no fit", code="estimation.no_fit")
    unit = np.where(used > 0, used, 1.0)
    inverse = np.linalg.pinv(information * unit * unit[:, None], hermitian=True)
    covariance = np.asarray(inverse * unit * unit[:, None], dtype=float)
    at = tuple(contrasts.at[name] for name in contrasts.names)
    return Components(weighted_fit, contrasts.names, theta, covariance, likelihood, floor, at)


def noise_variance(fit: Fit) -> tuple[float, float]:
    """Return the factor for the variance of the noise by REML, and its degrees of freedom, with stated priors as such.

    The estimate that `variance_factor` needs for a problem with priors or adjusted constants.
    """
    linear = fit.linear
    if _bordered(fit.problem) is not fit.problem:
        linear = linearised(_bordered(fit.problem), linear.at)
    contrasts = _Contrasts.of(linear, (), True, "the readings")
    theta, information, _ = contrasts.maximised(None)
    return float(theta[0]), float(2 * theta[0] ** 2 * information[0, 0])


@dataclass(frozen=True, eq=False)
class _Contrasts:
    """Readings reduced by the fixed effects.

    Attributes
    ----------
    names : tuple of str
        Variances that are estimated.
    at : dict
        For each name the numbers of its effects in the border; empty for the noise.
    which : list of ndarray of int
        For each name the numbers of its effects among the random ones.
    known : ndarray, (u,)
        Variances of the effects that are stated, otherwise 0.
    A, b, c : ndarray
        See the module.
    freedom : int
        n - p.
    """

    names: tuple[str, ...]
    at: dict[str, Index]
    which: list[Index]
    known: Array
    A: Array
    b: Array
    c: float
    freedom: int

    @classmethod
    def of(cls, linear: Linear, names: Sequence[str], noise: bool, what: str) -> _Contrasts:
        """Eliminate the fixed effects of a linearised problem in units of its stated noise."""
        problem, number = linear.problem, linear.numbering
        q = number.size
        by_column, known, offset = _random(linear, names)
        random = np.flatnonzero(by_column >= -1)
        fixed = np.flatnonzero(by_column < -1)
        # Residuals for random effects of 0.
        shift = np.zeros(q)
        shift[random] = offset[random]
        zero = np.zeros((0, 1, 1)) if number.local is None else np.zeros((*linear.at.tables[number.local].shape, 1))
        r = linear.residual - linear.effect(zero, shift[:, None])[..., 0]
        band, G, D = linear.sums()
        a, g = linear.gradient(r)
        if number.local is not None:
            freed = problem.unknowns[number.local].freed
            band[0] = band[0] + np.where(freed, 0.0, 1.0)[:, :, None] * np.eye(freed.shape[1])
        gauge = linear.gauge()
        gauge = None if gauge is None else gauge[fixed]
        try:
            normal = factorised(band, G[..., fixed], D[np.ix_(fixed, fixed)], gauge)
        except SingularError as error:
            raise FitError(
                f"{what} do not determine all unknowns that are not random effects; measure more, or state a prior",
                code="estimation.fixed.undetermined",
            ) from error
        right = np.concatenate([G[..., random], a[..., None]], axis=2)
        below = np.concatenate([D[np.ix_(fixed, random)], g[fixed][:, None]], axis=1)
        x, z = normal.solve(right, below)
        whole = np.tensordot(right, x, axes=((0, 1), (0, 1))) + below.T @ z
        A = D[np.ix_(random, random)] - whole[:-1, :-1]
        b = g[random] - whole[:-1, -1]
        unknown = int(fixed.size) - (0 if gauge is None else gauge.shape[1])
        if number.local is not None:
            unknown += int(problem.unknowns[number.local].freed.sum())
        groups = (*names, NOISE) if noise else tuple(names)
        at = {name: np.flatnonzero(by_column == i) for i, name in enumerate(names)}
        which = [np.flatnonzero(by_column[random] == i) for i in range(len(names))]
        if noise:
            at[NOISE], which = np.zeros(0, dtype=np.intp), [*which, np.zeros(0, dtype=np.intp)]
        c = max(float(np.vdot(r, r) - whole[-1, -1]), 0.0)
        return cls(groups, at, which, known[random], (A + A.T) / 2, b, c, int(linear.used.sum()) - unknown)

    def floor(self) -> Array:
        """Return the smallest variances of the final fit, (k,)."""
        return FLOOR * self._reference()

    def maximised(self, start: Array | None) -> tuple[Array, Array, float]:
        """Return the variances of maximum likelihood (k,), their information (k, k), and the likelihood.

        Projected Fisher scoring, halving steps that do not increase the likelihood.
        """
        if self.freedom < 1:
            raise FitError(
                "no redundancy: the variances of noise and random effects cannot be estimated",
                code="estimation.no_redundancy",
            )
        unit = self._reference()
        t = np.ones(len(unit)) if start is None else np.maximum(start / unit, FLOOR)
        noise = len(unit) - 1 if self.names and self.names[-1] == NOISE else -1
        least = np.zeros(len(unit))
        if noise >= 0:
            least[noise] = LEAST_NOISE
        value, score, information = self._likelihood(t * unit)
        gain = np.inf
        for _ in range(MAX_STEPS):
            g, F = score * unit, information * unit * unit[:, None]
            free = (t > least) | (g > 0)
            step = np.zeros_like(t)
            if free.any():
                step[free] = np.linalg.lstsq(F[np.ix_(free, free)], g[free], rcond=1e-12)[0]
            before, gain = gain, float(g @ step)
            if gain <= CONVERGED or (gain <= STALLED**2 and gain > before / 2):
                break
            for _ in range(40):
                tried = np.maximum(t + step, least)
                new = self._likelihood(tried * unit)
                if new[0] >= value - 1e-13 * abs(value):
                    break
                step /= 2
            t, (value, score, information) = tried, new
        return t * unit, information, value

    def _reference(self) -> Array:
        """Return the scale of each variance: with which an effect is as large as the noise of its estimate, (k,)."""
        s = self.c / self.freedom if self.names and self.names[-1] == NOISE else 1.0
        s = max(s, 1e-300)
        alone = [float(self.A[i, i].mean()) if i.size else 1.0 for i in self.which]
        return np.array([s / a if a > 0 else s for a in alone])

    def _likelihood(self, theta: Array) -> tuple[float, Array, Array]:
        """Return the logarithm of the likelihood, its derivatives (k,), and the expected information (k, k)."""
        noise = bool(self.names) and self.names[-1] == NOISE
        s = float(theta[-1]) if noise else 1.0
        d = self.known.copy()
        for i, variance in zip(self.which, theta, strict=True):
            d[i] = variance
        K = s * np.eye(d.size) + self.A * d
        both = np.linalg.solve(K, np.concatenate([self.A, self.b[:, None]], axis=1)) if d.size else np.zeros((0, 1))
        Q, v = both[:, :-1], both[:, -1]
        square = (self.c - float(self.b @ (d * v))) / s
        logdet = float(np.linalg.slogdet(K)[1]) if d.size else 0.0
        value = -0.5 * ((self.freedom - d.size) * np.log(s) + logdet + square)
        # column j: 1 for the effects of variance j
        member = np.zeros((d.size, len(self.which)))
        for j, i in enumerate(self.which):
            member[i, j] = 1.0
        score = -0.5 * (np.diagonal(Q) - v**2) @ member
        F = 0.5 * member.T @ np.square(Q) @ member
        if noise:
            # s tr P = n - p - sum d_j Q_jj; s Z' P P Z = Q - Q D Q; s y' P P y = y' P y - sum d_j v_j^2
            trace = (self.freedom - float(d @ np.diagonal(Q))) / s
            PP = (np.diagonal(Q) - np.einsum("ij,j,ji->i", Q, d, Q)) / s
            score[-1] = -0.5 * (trace - (square - float(d @ v**2)) / s)
            F[-1, :] = F[:, -1] = 0.5 * PP @ member
            F[-1, -1] = 0.5 * (trace - float(d @ PP)) / s
        return value, score, F


def _random(linear: Linear, names: Sequence[str]) -> tuple[NDArray[np.intp], Array, Array]:
    """Return for every column of the border its component, -1 for a stated variance, -2 for a fixed effect.

    And its stated variance, and the distance from its expected value, (q,).
    """
    problem, number = linear.problem, linear.numbering
    q = number.size
    component = np.full(q + 1, -2, dtype=np.intp)
    known, offset = np.zeros(q + 1), np.zeros(q + 1)
    for block, table, border in zip(problem.unknowns, linear.at.tables, number.border, strict=True):
        if not border.size:
            continue
        stated = block.information > 0
        component[border[stated]] = -1
        known[border[stated]] = 1.0 / block.information[stated]
        offset[border] = table - block.start
        for k, name in enumerate(block.component):
            if name in names:
                component[border[:, k]] = names.index(name)
                known[border[:, k]] = 0.0
    for z, at in zip(linear.at.adjusted, number.adjusted, strict=True):
        component[at], known[at], offset[at] = -1, 1.0, z
    return component[:q], known[:q], offset[:q]


def _bordered(problem: Problem) -> Problem:
    """Return the problem with every block that has a prior in the border; the same one if that is so."""
    blocks = {
        name: replace(block, group=name)
        for name, block in zip(problem.unknowns._fields, problem.unknowns, strict=True)
        if not block.group and not any(block.component) and block.information.any()
    }
    return replace(problem, unknowns=problem.unknowns._replace(**blocks)) if blocks else problem


def _weighted(problem: Problem, names: Sequence[str], theta: Array) -> Problem:
    """Return the problem with these variances as priors of its random effects, and of its noise."""
    by_name = dict(zip(names, theta, strict=True))
    blocks = {}
    for name, block in zip(problem.unknowns._fields, problem.unknowns, strict=True):
        if any(block.component):
            prior = _prior(block)
            for k, each in enumerate(block.component):
                if each:
                    prior[:, k] = np.sqrt(by_name[each])
            blocks[name] = replace(block, prior=prior)
    noise = problem.noise
    if NOISE in by_name:
        size = float(np.sqrt(by_name[NOISE]))
        noise = Noise(
            sd=None if noise.sd is None else size * noise.sd,
            root=None if noise.root is None else size * noise.root,
            stated=noise.stated,
        )
    return replace(problem, unknowns=problem.unknowns._replace(**blocks), noise=noise)


def _prior(block: Block) -> Array:
    """Return the standard deviations of the prior, (size, width)."""
    if block.prior is None:
        return np.full(block.start.shape, np.inf)
    return np.array(np.broadcast_to(np.asarray(block.prior, dtype=float), block.start.shape))


def _unweighted(linear: Linear, problem: Problem, names: Sequence[str], theta: Array) -> Linear:
    """Return the linearisation of the weighted problem in units of the noise of the given one."""
    size = float(np.sqrt(theta[-1])) if names and names[-1] == NOISE else 1.0
    base = replace(linear.problem, unknowns=problem.unknowns, noise=problem.noise)
    return replace(
        linear,
        problem=base,
        residual=linear.residual * size,
        whitener=linear.whitener * size,
        local=linear.local * size,
        border=linear.border * size,
    )
