"""What points tell about smooth curves: polynomial and contrasts, and the evidence of amplitudes.

Details of `errormotion.estimation.smoothing`. White noise of amplitude a, integrated q times from 0, has the covariance
``a^2 int_0^min(s,t) (s - r)^(q-1) (t - r)^(q-1) dr / (q-1)!^2``. Contrasts are combinations of the points that no
polynomial affects. In units of the noise of the points they are uncorrelated, with the variance ``1 + a^2 gain``, so
that the evidence of an amplitude is a sum over contrasts.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array

_EXAMINED, _AVERAGED = 400, 24
"""Number of amplitudes that are examined, and of those that are averaged."""
_LOWEST, _HIGHEST = 1e-2, 1e2
"""Range of the amplitudes: from not distinguishable from zero to decreasing evidence."""
_NEGLIGIBLE = 1e-5
"""Amplitudes with less than this share of the best evidence are neglected."""


@dataclass(frozen=True)
class Basis:
    """Polynomials and covariances of integrated noise of amplitude 1, with positions in units of their span."""

    unit: float  # of amplitudes
    T: Array  # polynomials at the points, (n, p)
    K: Array  # covariance of the points, (n, n)
    T_at: Array  # (m, p)
    K_at: Array  # of the positions requested with the points, (m, n)
    own: Array  # variance at the positions requested, (m,)

    @classmethod
    def of(cls, x: Array, to: Array, free: int, order: int, exact_zero: bool) -> Basis:
        """Return the basis of ``order``, with polynomials of degrees below ``free``, for points x (n,) and at (m,)."""
        start = 0.0 if exact_zero else min(x.min(initial=np.inf), to.min(initial=np.inf))
        span = float(np.ptp(x)) if x.size > 1 else 0.0
        span = span or abs(float(x.max(initial=1.0))) or 1.0
        u, w = (x - start) / span, np.maximum(to - start, 0.0) / span
        powers = np.arange(int(exact_zero), free)
        own = w ** (2 * order - 1) / ((2 * order - 1) * factorial(order - 1) ** 2)
        K, K_at = _integrated(u, u, order), _integrated(w, u, order)
        return cls(span ** (0.5 - order), u[:, None] ** powers, K, w[:, None] ** powers, K_at, own)


def _integrated(s: Array, t: Array, order: int) -> Array:
    """Return the covariance (s, t) of white noise integrated ``order`` times from 0."""
    low, apart = np.minimum(s[:, None], t), np.abs(s[:, None] - t)
    q = order - 1
    terms = (comb(q, j) * apart ** (q - j) * low ** (q + j + 1) / (q + j + 1) for j in range(q + 1))
    return np.asarray(sum(terms) / factorial(q) ** 2)


@dataclass(frozen=True)
class Alike:
    """Curves with the same points known."""

    rows: NDArray[np.intp]  # of these curves
    points: NDArray[np.intp]  # that are known
    sigma: Array  # different sets of standard deviations of the points, (d, point)
    of_sigma: NDArray[np.intp]  # set of each curve


def groups_alike(v: Array, known: NDArray[np.bool_]) -> list[Alike]:
    """Return the curves with variances v (r, n), grouped by the points that are known."""
    groups = []
    patterns, of_pattern = np.unique(known, axis=0, return_inverse=True)
    for k, some in enumerate(patterns):
        rows, points = np.flatnonzero(of_pattern == k), np.flatnonzero(some)
        variances, of_sigma = np.unique(v[np.ix_(rows, points)], axis=0, return_inverse=True)
        groups.append(Alike(rows, points, np.sqrt(variances), of_sigma))
    return groups


@dataclass(frozen=True)
class Series:
    """The points of several curves, and what they tell about these.

    In units of the noise, a set of points consists of a fitted polynomial and of contrasts that no polynomial affects:
    uncorrelated combinations of the points, of variance 1 + amplitude * gain. A curve is the fitted polynomial plus the
    effect of the contrasts at the requested positions. (The separation is accurate even where the noise is tiny.)
    Curves with fewer points than others have zeros in place of the missing points and contrasts.
    """

    y: Array  # points, (r, n)
    amplitude_unit: float
    gain: Array  # (r, c)
    contrast: Array  # (r, c)
    reach: Array  # effect of the contrasts, (r, m, c), per amplitude
    own: Array  # variance of the curve about the fitted polynomial, per amplitude, (r, m)
    fit: Array  # weights of the points in the fitted polynomial, (r, m, n)
    to_contrast: Array  # weights of the points in each contrast, (r, c, n)
    noise: Array  # variance of the polynomial due to the noise of the points, (r, m)
    unit: Array  # log of the density of the contrasts over that of the points, (r,)

    @classmethod
    def of(cls, basis: Basis, y: Array, alike: list[Alike]) -> Series:
        """Return the points (r, n) of some curves, 0 where they are missing."""
        (r, n), (m, p) = y.shape, basis.T_at.shape
        c = max(some.points.size for some in alike) - p
        gain, reach, to_contrast = np.zeros((r, c)), np.zeros((r, m, c)), np.zeros((r, c, n))
        own, noise, fit, unit = np.zeros((r, m)), np.zeros((r, m)), np.zeros((r, m, n)), np.zeros(r)
        for some in alike:
            rows, points, inner = some.rows, some.points, slice(some.points.size - p)
            parts = [part[some.of_sigma] for part in _separated(basis, some.sigma, points)]
            gain[rows, inner], reach[rows, :, inner], own[rows], noise[rows], unit[rows] = parts[:5]
            fit[rows[:, None], :, points], to_contrast[rows[:, None], inner, points] = (
                part.swapaxes(1, 2) for part in parts[5:]
            )
        contrast = (to_contrast @ y[..., None])[..., 0]
        return cls(y, basis.unit, gain, contrast, reach, own, fit, to_contrast, noise, unit)

    def groups(self, number: int) -> tuple[Array, Array, Array]:
        """Return gains and contrasts of each group with one amplitude, (group, c), and its log of the density."""
        gain, contrast, unit = (each.reshape(number, -1) for each in (self.gain, self.contrast, self.unit))
        return gain, contrast, unit.sum(axis=1)

    def mixture(self, weighed: Weighed, of_row: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """Return values (r, m), variance (r, m) and weights (r, m, n) over the amplitudes of each curve's group."""
        A, share = weighed.amplitudes[of_row, :, None], weighed.share[of_row, None]
        held = A / (1 + A * self.gain[:, None])  # of each contrast by each amplitude
        curves = (self.fit @ self.y[..., None]).mT + (held * self.contrast[:, None]) @ self.reach.mT
        values = share @ curves
        strength = np.divide(
            self.reach**2, self.gain[:, None], out=np.zeros_like(self.reach), where=self.gain[:, None] > 0
        )
        between = np.maximum(self.own - strength.sum(axis=-1), 0.0)  # of a curve through all points, per amplitude
        variance = self.noise[:, None] + A * between[:, None] + held @ strength.mT
        weights = self.fit + (self.reach * (share @ held)) @ self.to_contrast
        return values[:, 0], (share @ (variance + (curves - values) ** 2))[:, 0], weights


def _separated(basis: Basis, sigma: Array, points: NDArray[np.intp]) -> tuple[Array, ...]:
    """Return the separation of some points into polynomial and contrasts, for several sets of their noise (d, point).

    Returns
    -------
    tuple
        gain, reach, own, noise, unit, fit and to_contrast of `Series`, for each of the sets and these points only.
    """
    p, each = basis.T.shape[1], sigma[:, None]
    K, K_at = basis.K[np.ix_(points, points)] / (each.mT * each), basis.K_at[:, points] / each
    Q, R = np.linalg.qr(basis.T[points] / each.mT, mode="complete")
    inside, rest, R = Q[..., :p], Q[..., p:], R[:, :p]
    gain, axes = np.linalg.eigh(rest.mT @ K @ rest)
    gain = np.maximum(gain, 1e-14 * gain.max(axis=-1, initial=0.0, keepdims=True))
    rest = rest @ axes
    H = np.linalg.solve(R.mT, basis.T_at.T).mT  # of the fitted polynomial, (d, m, p)
    off = K_at - H @ inside.mT @ K
    own = basis.own - ((K_at + off) * (H @ inside.mT)).sum(axis=-1)
    density = np.log(sigma).sum(axis=-1) + np.log(np.abs(np.diagonal(R, axis1=1, axis2=2))).sum(axis=-1)
    unit = -density - gain.shape[-1] * np.log(2 * np.pi) / 2
    return gain, off @ rest, own, (H**2).sum(axis=-1), unit, H @ inside.mT / each, rest.mT / each


@dataclass(frozen=True)
class Weighed:
    """What the contrasts of some groups of curves tell about the amplitude (squared) of each group."""

    log_evidence: Array  # of the order, (group,)
    amplitudes: Array  # relevant ones, (group, amplitude)
    share: Array  # of each of these
    amplitude: Array  # with the best evidence, not squared, (group,)
    best_likelihood: Array  # (group,)
    evidence: Array  # (group,)


def weigh(gain: Array, contrast: Array, unit: Array) -> Weighed:
    """Return the amplitudes of groups of curves with these gains and contrasts (group, c)."""
    gains, squares = gain.T[..., None], contrast.T[..., None] ** 2  # (c, group, 1): sums over the first axis are fast

    def likelihood(amplitudes: Array) -> Array:
        """Return the log likelihood of amplitudes (group, amplitude), for any polynomial."""
        grown = 1 + amplitudes * gains
        terms = squares / grown
        terms += np.log(grown, out=grown)
        return np.asarray(unit[:, None] - terms.sum(axis=0) / 2)

    some = gains > 0
    needed = np.divide(np.maximum(squares, 1.0), gains, out=np.zeros_like(gains), where=some).max(axis=0)[:, 0]
    amplitudes = _log_spaced(_LOWEST / gains.max(axis=0)[:, 0], _HIGHEST * needed, _EXAMINED)
    log = likelihood(amplitudes)
    group, top = np.arange(len(log)), log.argmax(axis=1)
    best = log[group, top]
    relevant = log >= best[:, None] + np.log(_NEGLIGIBLE)
    first = np.maximum(relevant.argmax(axis=1) - 1, 0)
    last = np.minimum(_EXAMINED - relevant[:, ::-1].argmax(axis=1), _EXAMINED - 1)
    chosen = _log_spaced(amplitudes[group, first], amplitudes[group, last], _AVERAGED)
    share = np.exp(likelihood(chosen) - best[:, None])
    none = likelihood(np.zeros((len(log), 1)))[:, 0]
    likeliest = np.where(top > 0, best, none)
    return Weighed(
        best + np.log(np.exp(log - best[:, None]).mean(axis=1)),
        chosen,
        share / share.sum(axis=1, keepdims=True),
        np.where(top > 0, np.sqrt(amplitudes[group, top]), 0.0),
        likeliest,
        likeliest - none,
    )


def mixed(share: Array, parts: list[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    """Return values, variance and weights of mixtures of curves; ``share`` of each part, (part, group)."""
    curves, spread, weights = (np.stack(part) for part in zip(*parts, strict=True))
    share = share[..., None]
    values = (share * curves).sum(axis=0)
    variance = (share * (spread + (curves - values) ** 2)).sum(axis=0)
    return values, variance, (share[..., None] * weights).sum(axis=0)


def _log_spaced(low: Array, high: Array, n: int) -> Array:
    """Return n numbers from low to high with a constant ratio, for each of several (group,): (group, n)."""
    return np.asarray(np.exp(np.linspace(np.log(low), np.log(high), n, axis=-1)))
