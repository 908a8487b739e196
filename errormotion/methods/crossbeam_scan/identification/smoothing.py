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

from dataclasses import dataclass
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
    sets: int = 1,
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
        Whether all curves of a set share one amplitude.
    sets : int
        Number of sets, along the first axis of the curves, with the same points known in each.
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
    _, place = np.unique(x, return_inverse=True)
    at_place = place[:, None] == np.arange(place.max(initial=-1) + 1)
    different = (known @ at_place).sum(axis=1) + int(exact_zero)
    if order is None:
        order = int(np.clip(different.max(initial=0) - 1, 1, ORDER))
    if order not in (1, 2, 3):
        raise MethodError(f"Expected order 1, 2 or 3 of the curves; found {order}.")
    rows = np.flatnonzero(different >= order)
    orders = (order, order - 1) if rougher and order > 1 else (order,)

    curves, spread = np.full((2, len(y), to.size), np.nan)
    W = np.full((len(y), to.size, n), np.nan)
    amplitude, evidence, likelihood, rough = np.full((4, len(y)), np.nan)
    contrasts = known[rows].sum(axis=1) - (order - int(exact_zero))
    if not together:
        rows = rows[contrasts > 0]
    if contrasts.any():
        alike = _alike(v[rows], known[rows])
        y = np.where(known, y, 0.0)[rows]
        by_order = [_Series.of(_Basis.of(x, to, order, q, exact_zero), y, alike) for q in orders]
        groups = sets if together else len(rows)
        of_row = np.arange(len(rows)) // (len(rows) // groups)
        weighed = [_weigh(*series.groups(groups)) for series in by_order]
        log = np.array([one.log_evidence for one in weighed])
        share = np.exp(log - log.max(axis=0))
        share /= share.sum(axis=0)  # of each order, (order, group)
        parts = [series.mixture(one, of_row) for series, one in zip(by_order, weighed, strict=True)]
        curves[rows], spread[rows], W[rows] = _mixed(share[:, of_row], parts)
        best = np.argmax([one.best_likelihood for one in weighed], axis=0)[of_row], of_row
        sizes = [series.amplitude_unit * one.amplitude for series, one in zip(by_order, weighed, strict=True)]
        amplitude[rows] = np.array(sizes)[best]
        evidence[rows] = np.array([one.evidence for one in weighed])[best]
        likelihood[rows] = np.array([one.best_likelihood for one in weighed])[best]
        rough[rows] = share[1:].sum(axis=0)[of_row]
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
    v = np.diagonal(C, axis1=-2, axis2=-1)
    known = np.isfinite(y) & np.isfinite(v)
    _, pattern = np.unique(known.reshape(-1, 6), axis=1, return_inverse=True)  # freedoms with the same points known
    each: dict[int, tuple[Smooth, int]] = {}
    for k in np.unique(pattern):
        some = np.flatnonzero(pattern == k)
        values_, variance = (np.moveaxis(array[..., some], -1, 0) for array in (y, v))
        found = smooth(
            positions, values_, variance, at, exact_zero=exact_zero, together=True, sets=some.size, order=order
        )
        each |= {int(d): (found, i) for i, d in enumerate(some)}
    arrays: dict[str, Any] = {
        name: np.stack([getattr(one, name)[i] for one, i in (each[d] for d in range(6))], axis=y.ndim - 2)
        for name in Smooth.__dataclass_fields__
        if name != "order"
    }
    merged = Smooth(**arrays, order=min(one.order for one, _ in each.values()))
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
class _Alike:
    """Curves with the same points known."""

    rows: NDArray[np.intp]  # of these curves
    points: NDArray[np.intp]  # that are known
    sigma: Array  # different sets of standard deviations of the points, (d, point)
    of_sigma: NDArray[np.intp]  # set of each curve


def _alike(v: Array, known: NDArray[np.bool_]) -> list[_Alike]:
    """Return the curves with variances v (r, n), grouped by the points that are known."""
    groups = []
    patterns, of_pattern = np.unique(known, axis=0, return_inverse=True)
    for k, some in enumerate(patterns):
        rows, points = np.flatnonzero(of_pattern == k), np.flatnonzero(some)
        variances, of_sigma = np.unique(v[np.ix_(rows, points)], axis=0, return_inverse=True)
        groups.append(_Alike(rows, points, np.sqrt(variances), of_sigma))
    return groups


@dataclass(frozen=True)
class _Series:
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
    def of(cls, basis: _Basis, y: Array, alike: list[_Alike]) -> _Series:
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

    def mixture(self, weighed: _Weighed, of_row: NDArray[np.intp]) -> tuple[Array, Array, Array]:
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


def _separated(basis: _Basis, sigma: Array, points: NDArray[np.intp]) -> tuple[Array, ...]:
    """Return the separation of some points into polynomial and contrasts, for several sets of their noise (d, point).

    Returns
    -------
    tuple
        gain, reach, own, noise, unit, fit and to_contrast of `_Series`, for each of the sets and these points only.
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
class _Weighed:
    """What the contrasts of some groups of curves tell about the amplitude (squared) of each group."""

    log_evidence: Array  # of the order, (group,)
    amplitudes: Array  # relevant ones, (group, amplitude)
    share: Array  # of each of these
    amplitude: Array  # with the best evidence, not squared, (group,)
    best_likelihood: Array  # (group,)
    evidence: Array  # (group,)


def _weigh(gain: Array, contrast: Array, unit: Array) -> _Weighed:
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
    return _Weighed(
        best + np.log(np.exp(log - best[:, None]).mean(axis=1)),
        chosen,
        share / share.sum(axis=1, keepdims=True),
        np.where(top > 0, np.sqrt(amplitudes[group, top]), 0.0),
        likeliest,
        likeliest - none,
    )


def _mixed(share: Array, parts: list[tuple[Array, Array, Array]]) -> tuple[Array, Array, Array]:
    """Return values, variance and weights of mixtures of curves; ``share`` of each part, (part, group)."""
    curves, spread, weights = (np.stack(part) for part in zip(*parts, strict=True))
    share = share[..., None]
    values = (share * curves).sum(axis=0)
    variance = (share * (spread + (curves - values) ** 2)).sum(axis=0)
    return values, variance, (share[..., None] * weights).sum(axis=0)


def _log_spaced(low: Array, high: Array, n: int) -> Array:
    """Return n numbers from low to high with a constant ratio, for each of several (group,): (group, n)."""
    return np.asarray(np.exp(np.linspace(np.log(low), np.log(high), n, axis=-1)))
