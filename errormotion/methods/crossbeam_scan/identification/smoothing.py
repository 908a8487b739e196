"""Smooth curves through a few uncertain points, over position or time, with their uncertainty.

The curve is white noise integrated ``order`` times, with a free start (a Gaussian process; its mean is a smoothing
spline: cubic for order 2, quintic for order 3; Wahba, Spline Models for Observational Data, chapter 1). The amplitude
of the noise is unknown: 0 is a polynomial of degree order - 1, infinity a curve through all points. Curves of all
amplitudes are averaged, each weighted by its evidence (the marginal likelihood of the points). The single best
amplitude would be 0 for about half of all sets of eight points, with an uncertainty that is then too small.

Reasons for the choices, from the virtual gantry (eight positions, nine times, each point predicted from the others):

* Order 3 predicts the omitted point far better than order 2, with half the uncertainty. A beam in a smooth temperature
  field has a continuous curvature, as order 3 has and order 2 does not.
* One amplitude for all cycles of a freedom is as good as one for each cycle, or one in proportion to the errors of the
  cycle, with a ninth of the parameters: the cycles share the shape of the guide.
* On a linear scale of time, the curves bend most at the beginning, where their uncertainty would be too small. On
  ``warm_up_scale``, exponentials with time constants from 15 min to 2 h are about equally smooth.

Errors that all points share (pose of the profiler, lever, cold scan) are not reduced by smoothing. Pass the independent
variance only, and propagate the other errors with the same weights by ``carry``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import comb, factorial, prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError

#: Order of a curve with enough points.
ORDER = 3
#: Time at which the scale of time changes from linear to logarithmic, s.
LINEAR_TIME = 1500.0

#: Number of amplitudes that are examined, and of those that are averaged.
_EXAMINED, _AVERAGED = 400, 24
#: Range of the amplitudes: from not distinguishable from zero to decreasing evidence.
_LOWEST, _HIGHEST = 1e-2, 1e2
#: Amplitudes with less than this share of the best evidence are neglected.
_NEGLIGIBLE = 1e-5


@dataclass(frozen=True)
class Smooth:
    """Curves at the positions requested; NaN where the points do not determine them.

    Attributes
    ----------
    values, variance : ndarray, (..., m)
        Of the curve, without the errors that the points share.
    weights : ndarray, (..., m, n)
        The curve is ``weights @ values`` of the points; 0 for a point that is NaN.
    amplitude : ndarray, (...)
        Of the white noise with the best evidence, in units of the value per position**(order - 1/2) of the more likely
        order; 0: a polynomial.
    evidence : ndarray, (...)
        Log of the likelihood of that amplitude over that of a polynomial; 0 where a polynomial is sufficient.
    log_likelihood : ndarray, (...)
        Of that amplitude, comparable between sets of points at the same ``positions`` of which different ones are
        omitted. Curves that share an amplitude share this and the evidence.
    rough : ndarray, (...)
        Probability of the lower order.
    used : ndarray of int, (...)
        Number of points that are not NaN.
    order : int
        The higher of the two orders.
    """

    values: Array
    variance: Array
    weights: Array
    amplitude: Array
    evidence: Array
    log_likelihood: Array
    rough: Array
    used: NDArray[np.int64]
    order: int

    def carry(self, influence: ArrayLike) -> Array:
        """Return the effect of errors of the points, (source, ..., n), on the curves, (source, ..., m)."""
        effect = np.nan_to_num(np.asarray(influence, dtype=float))
        return np.asarray(np.einsum("...mn,s...n->s...m", self.weights, effect))


@dataclass(frozen=True)
class SmoothTwists:
    """Curves of six freedoms at the positions requested.

    Attributes
    ----------
    values : ndarray, (..., m, 6)
        m and rad.
    covariance : ndarray, (..., m, 6, 6)
        Between the freedoms at each position.
    freedoms : Smooth
        The curves of the single freedoms, (..., 6, m).
    """

    values: Array
    covariance: Array
    freedoms: Smooth

    def carry(self, influence: ArrayLike) -> Array:
        """Return the effect of errors of the points, (source, ..., n, 6), on the curves, (source, ..., m, 6)."""
        effect = np.swapaxes(np.asarray(influence, dtype=float), -1, -2)
        return np.swapaxes(self.freedoms.carry(effect), -1, -2)


def warm_up_scale(time: ArrayLike) -> Array:
    """Return log(1 + t / 25 min) of times t (s): the scale on which the errors of a warm-up are equally smooth."""
    return np.log1p(np.asarray(time, dtype=float) / LINEAR_TIME)


def smooth(
    positions: ArrayLike,
    values: ArrayLike,
    variance: ArrayLike,
    at: ArrayLike,
    *,
    exact_zero: bool = False,
    together: bool = False,
    order: int | None = None,
    rougher: bool = True,
) -> Smooth:
    """Return smooth curves through points, with their variance.

    Parameters
    ----------
    positions : (n,)
        Of the points: position, or time on the `warm_up_scale`.
    values, variance : (..., n)
        Points, and the variance of their independent errors; NaN for a missing point.
    at : (m,)
        Positions at which the curves are requested.
    exact_zero : bool
        Whether all curves start at position 0 with value 0; positions below 0 are then taken as 0.
    together : bool
        Whether all curves share one amplitude.
    order : {1, 2, 3}, optional
        By default 3, or less where even the curve with the most points has too few for evidence.
    rougher : bool
        Whether the next lower order is averaged too, weighted by its evidence, about the same polynomial.

    Returns
    -------
    Smooth
        A curve is NaN unless it has ``order`` points at different positions (one less with ``exact_zero``) and at least
        one of the curves that share its amplitude has one more, for evidence on the amplitude. The variance is that of
        a mixture over amplitudes: very large with only one or two points more than the order.

    Raises
    ------
    MethodError
        Shapes that do not match, a variance that is not above 0, an invalid order.
    """
    x, y, v, to = (np.asarray(given, dtype=float) for given in (positions, values, variance, at))
    _check(x, y, v, to, exact_zero)
    batch, n = y.shape[:-1], x.size
    y, v = y.reshape(prod(batch), n), v.reshape(prod(batch), n)
    known = np.isfinite(y) & np.isfinite(v)
    if (v[known] <= 0).any():
        raise MethodError("Expected variances above 0 of all points; leave out what is exact (the cold cycle).")
    fixed = int(exact_zero)
    different = np.array([np.unique(x[k]).size + fixed for k in known], dtype=int)
    if order is None:
        order = int(np.clip(different.max(initial=0) - 1, 1, ORDER))
    if order not in (1, 2, 3):
        raise MethodError(f"Expected order 1, 2 or 3 of the curves; found {order}.")
    rows = np.flatnonzero(different >= order)
    orders = (order, order - 1) if rougher and order > 1 else (order,)
    by_order = [_series(_Basis.of(x, to, order, q, exact_zero), y, v, known, rows) for q in orders]

    curves, spread = np.full((2, len(y), to.size), np.nan)
    W = np.full((len(y), to.size, n), np.nan)
    amplitude, evidence, likelihood, rough = np.full((4, len(y)), np.nan)
    for some in [range(rows.size)] if together else [[k] for k in range(rows.size)]:
        share = _weigh_all([[series[k] for k in some] for series in by_order])
        for k in some if share.size else ():
            each = [series[k] for series in by_order]
            best = max(each, key=lambda one: one.best_likelihood)
            row = rows[k]
            curves[row], spread[row], W[row] = _mixed(share, [one.mixture() for one in each])
            amplitude[row], evidence[row], likelihood[row] = best.amplitude, best.evidence, best.best_likelihood
            rough[row] = share[1:].sum()
    return Smooth(
        curves.reshape(*batch, to.size),
        spread.reshape(*batch, to.size),
        W.reshape(*batch, to.size, n),
        amplitude.reshape(batch),
        evidence.reshape(batch),
        likelihood.reshape(batch),
        rough.reshape(batch),
        known.sum(axis=-1).reshape(batch),
        order,
    )


def smooth_twists(
    positions: ArrayLike,
    values: ArrayLike,
    covariance: ArrayLike,
    at: ArrayLike,
    *,
    exact_zero: bool = False,
    order: int | None = None,
) -> SmoothTwists:
    """Return smooth curves of six freedoms, each with one amplitude for all its curves, and their covariance.

    The freedoms are smoothed separately: use the frame in which they are least correlated, that of the profiler. Over
    the lever of 2 m, the noise of the rotations would dominate that of the displacements. Transform the curves to the
    carriage afterwards; this adds the contributions of pose and lever.

    Parameters
    ----------
    positions : (n,)
        Of the points: position, or time on the `warm_up_scale`.
    values, covariance : (..., n, 6), (..., n, 6, 6)
        Twists, m and rad, and the covariance of their independent errors; NaN for a missing freedom.
    at : (m,)
        Positions at which the curves are requested.
    exact_zero, order
        As in `smooth`.

    Raises
    ------
    MethodError
        Shapes that do not match, a variance that is not above 0.
    """
    y, C = np.asarray(values, dtype=float), np.asarray(covariance, dtype=float)
    if y.ndim < 2 or y.shape[-1] != 6 or C.shape != (*y.shape, 6):
        raise MethodError(f"Expected values (..., n, 6) and covariance (..., n, 6, 6); found {y.shape}, {C.shape}.")
    each = [
        smooth(positions, y[..., d], C[..., d, d], at, exact_zero=exact_zero, together=True, order=order)
        for d in range(6)
    ]
    arrays: dict[str, Any] = {
        name: np.stack([getattr(one, name) for one in each], axis=y.ndim - 2)
        for name in Smooth.__dataclass_fields__
        if name != "order"
    }
    merged = Smooth(**arrays, order=min(one.order for one in each))
    W = merged.weights  # (..., 6, m, n)
    noise = np.einsum("...imn,...nij,...jmn->...mij", W, np.nan_to_num(C), W)
    own = np.swapaxes(merged.variance, -1, -2) - np.diagonal(noise, axis1=-2, axis2=-1)  # of the curves without noise
    total = noise + np.maximum(own, 0.0)[..., None] * np.eye(6)
    return SmoothTwists(np.swapaxes(merged.values, -1, -2), total, merged)


def _check(x: Array, y: Array, v: Array, to: Array, exact_zero: bool) -> None:
    """Raise MethodError where the arguments of `smooth` are invalid."""
    if x.ndim != 1 or to.ndim != 1 or y.shape[-1:] != x.shape or v.shape != y.shape:
        raise MethodError(
            "Expected positions (n,), values and variance (..., n), and requested positions (m,); found "
            f"{x.shape}, {y.shape}, {v.shape} and {to.shape}."
        )
    if not (np.isfinite(x).all() and np.isfinite(to).all()):
        raise MethodError("Expected finite positions; a missing point has the value NaN.")
    if exact_zero and (x <= 0).any():
        raise MethodError(f"Expected positions above 0 for curves that start at position 0; found {x.min():g}.")


@dataclass(frozen=True)
class _Basis:
    """Polynomials and covariances of integrated noise of amplitude 1, with positions in units of their span."""

    unit: float  # of amplitudes
    T: Array  # polynomials at the points, (n, p)
    K: Array  # covariance of the points, (n, n)
    T_at: Array  # (m, p)
    K_at: Array  # of the positions requested with the points, (m, n)
    own: Array  # variance at the positions requested, (m,)

    @classmethod
    def of(cls, x: Array, to: Array, free: int, order: int, exact_zero: bool) -> _Basis:
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
class _Design:
    """Information of points at known positions with known noise about a curve, independent of their values.

    In units of the noise, a set of points consists of a fitted polynomial and of contrasts that no polynomial affects:
    uncorrelated combinations of the points, of variance 1 + amplitude * gain. A curve is the fitted polynomial plus the
    effect of the contrasts at the requested positions. (The separation is accurate even where the noise is tiny.)
    """

    known: NDArray[np.bool_]
    gain: Array  # (c,)
    reach: Array  # effect of the contrasts, (m, c), per amplitude
    own: Array  # variance of the curve about the fitted polynomial, per amplitude, (m,)
    fit: Array  # weights of the points in the fitted polynomial, (m, n)
    to_contrast: Array  # weights of the points in each contrast, (c, n)
    noise: Array  # variance of the polynomial due to the noise of the points, (m,)
    unit: float  # log of the density of the contrasts over that of the points

    @classmethod
    def of(cls, basis: _Basis, v: Array, known: NDArray[np.bool_]) -> _Design:
        sigma = np.sqrt(v[known])
        K, K_at = basis.K[np.ix_(known, known)] / np.outer(sigma, sigma), basis.K_at[:, known] / sigma
        T = basis.T[known] / sigma[:, None]
        Q, R = np.linalg.qr(T, mode="complete")
        inside, rest = Q[:, : T.shape[1]], Q[:, T.shape[1] :]
        gain, axes = np.linalg.eigh(rest.T @ K @ rest)
        gain = np.maximum(gain, 1e-14 * gain.max(initial=0.0))
        rest = rest @ axes
        H = np.linalg.solve(R[: T.shape[1]].T, basis.T_at.T).T  # of the fitted polynomial, (m, p)
        off = K_at - H @ inside.T @ K
        own = basis.own - np.einsum("mn,mn->m", K_at + off, H @ inside.T)
        unit = -float(np.log(sigma).sum() + np.log(np.abs(np.diag(R))).sum()) - gain.size * np.log(2 * np.pi) / 2
        return cls(known, gain, off @ rest, own, H @ inside.T / sigma, rest.T / sigma, (H**2).sum(axis=1), unit)


@dataclass
class _Series:
    """The points of one curve, and the likelihood of each amplitude (squared)."""

    design: _Design
    y: Array
    amplitude_unit: float
    contrast: Array = field(init=False)  # (c,)
    amplitudes: Array = field(default_factory=lambda: np.empty(0))  # squared
    share: Array = field(default_factory=lambda: np.empty(0))  # of each amplitude
    amplitude: float = np.nan
    evidence: float = np.nan
    best_likelihood: float = np.nan

    def __post_init__(self) -> None:
        self.y = self.y[self.design.known]
        self.contrast = self.design.to_contrast @ self.y

    def log_likelihood(self, amplitudes: Array) -> Array:
        """Return the log likelihood of each amplitude, for any polynomial."""
        grown = 1 + amplitudes[:, None] * self.design.gain
        return np.asarray(self.design.unit - (self.contrast**2 / grown + np.log(grown)).sum(axis=1) / 2)

    def mixture(self) -> tuple[Array, Array, Array]:
        """Return values (m,), variance (m,) and weights (m, n) over all amplitudes."""
        d, A = self.design, self.amplitudes[:, None]
        held = A / (1 + A * d.gain)  # of each contrast by each amplitude
        curves = d.fit @ self.y + (held * self.contrast) @ d.reach.T
        values = self.share @ curves
        strength = d.reach**2 / d.gain
        between = np.maximum(d.own - strength.sum(axis=1), 0.0)  # of a curve through all points, per amplitude
        variance = d.noise + A * between + held @ strength.T
        weights = np.zeros((values.size, d.known.size))
        weights[:, d.known] = d.fit + (d.reach * (self.share @ held)) @ d.to_contrast
        return values, self.share @ (variance + (curves - values) ** 2), weights


def _series(basis: _Basis, y: Array, v: Array, known: NDArray[np.bool_], rows: NDArray[np.intp]) -> list[_Series]:
    """Return the points of the curves of some rows; curves with equal variances of their points share a design."""
    designs: dict[bytes, _Design] = {}
    series = []
    for row in rows:
        key = known[row].tobytes() + v[row].tobytes()
        if key not in designs:
            designs[key] = _Design.of(basis, v[row], known[row])
        series.append(_Series(designs[key], y[row], basis.unit))
    return series


def _weigh_all(by_order: list[list[_Series]]) -> Array:
    """Return the probability of each order for the curves of a group, (order,); empty without contrasts."""
    if not sum(one.contrast.size for one in by_order[0]):
        return np.empty(0)
    log = np.array([_weigh(group) for group in by_order])
    share = np.exp(log - log.max())
    return np.asarray(share / share.sum())


def _weigh(group: list[_Series]) -> float:
    """Set the relevant amplitudes and their shares for each curve of a group; return the log evidence of all."""
    gains = np.concatenate([one.design.gain for one in group])
    contrasts = np.concatenate([one.contrast for one in group])
    low, high = _LOWEST / gains.max(), _HIGHEST * (np.maximum(contrasts**2, 1.0) / gains).max()

    def likelihood(amplitudes: Array) -> Array:
        return np.asarray(sum(one.log_likelihood(amplitudes) for one in group))

    amplitudes = _log_spaced(low, high, _EXAMINED)
    log = likelihood(amplitudes)
    top = int(log.argmax())
    relevant = np.flatnonzero(log >= log[top] + np.log(_NEGLIGIBLE))
    first, last = max(relevant[0] - 1, 0), min(relevant[-1] + 1, _EXAMINED - 1)
    chosen = _log_spaced(amplitudes[first], amplitudes[last], _AVERAGED)
    share = np.exp(likelihood(chosen) - log[top])
    none = float(likelihood(np.zeros(1))[0])
    for one in group:
        one.amplitudes, one.share = chosen, share / share.sum()
        one.amplitude = np.sqrt(amplitudes[top]) * one.amplitude_unit if top else 0.0
        one.best_likelihood = log[top] if top else none
        one.evidence = one.best_likelihood - none
    return float(log[top] + np.log(np.exp(log - log[top]).mean()))


def _mixed(share: Array, parts: list[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    """Return values, variance and weights of a mixture of curves."""
    curves, spread, weights = (np.stack(part) for part in zip(*parts, strict=True))
    values = share @ curves
    return values, share @ (spread + (curves - values) ** 2), np.einsum("q,qmn->mn", share, weights)


def _log_spaced(low: float, high: float, n: int) -> Array:
    """Return n numbers from low to high with a constant ratio."""
    return np.asarray(np.exp(np.linspace(np.log(low), np.log(high), n)))
