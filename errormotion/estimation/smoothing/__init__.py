"""Smooth curves through a few uncertain points, over position or time, with their uncertainty.

The curve is white noise integrated ``order`` times, with a free start (a Gaussian process; its mean is a smoothing
spline: cubic for order 2, quintic for order 3; Wahba, Spline Models for Observational Data, chapter 1). The amplitude
of the noise is unknown: 0 is a polynomial of degree order - 1, infinity a curve through all points. Curves of all
amplitudes are averaged, each weighted by its evidence (the marginal likelihood of the points). The single best
amplitude would be 0 for about half of all sets of eight points, with an uncertainty that is then too small.

Errors that all points share are not reduced by smoothing. Pass the independent variance only, and propagate the other
errors with the same weights by ``carry``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.smoothing.basis import Basis, Series, groups_alike, mixed, weigh

ORDER = 3
"""Order of a curve with enough points."""


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
class SmoothVectors:
    """Curves of d components at the positions requested.

    Attributes
    ----------
    values : ndarray, (..., m, d)
        In the units of the points.
    covariance : ndarray, (..., m, d, d)
        Between the components at each position.
    components : Smooth
        The curves of the single components, (..., d, m).
    """

    values: Array
    covariance: Array
    components: Smooth

    def carry(self, influence: ArrayLike) -> Array:
        """Return the effect of errors of the points, (source, ..., n, d), on the curves, (source, ..., m, d)."""
        effect = np.swapaxes(np.asarray(influence, dtype=float), -1, -2)
        return np.swapaxes(self.components.carry(effect), -1, -2)


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
        Of the points: a position, or a time on a scale on which the curves are about equally smooth.
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
        raise MethodError(
            "Expected variances above 0 of all points; leave out what is exact (the cold cycle).",
            code="smoothing.variance.not_positive",
        )
    _, place = np.unique(x, return_inverse=True)
    at_place = place[:, None] == np.arange(place.max(initial=-1) + 1)
    different = (known @ at_place).sum(axis=1) + int(exact_zero)
    if order is None:
        order = int(np.clip(different.max(initial=0) - 1, 1, ORDER))
    if order not in (1, 2, 3):
        raise MethodError(f"Expected order 1, 2 or 3 of the curves; found {order}.", code="smoothing.order")
    rows = np.flatnonzero(different >= order)
    orders = (order, order - 1) if rougher and order > 1 else (order,)

    curves, spread = np.full((2, len(y), to.size), np.nan)
    W = np.full((len(y), to.size, n), np.nan)
    amplitude, evidence, likelihood, rough = np.full((4, len(y)), np.nan)
    contrasts = known[rows].sum(axis=1) - (order - int(exact_zero))
    if not together:
        rows = rows[contrasts > 0]
    if contrasts.any():
        alike = groups_alike(v[rows], known[rows])
        y = np.where(known, y, 0.0)[rows]
        by_order = [Series.of(Basis.of(x, to, order, q, exact_zero), y, alike) for q in orders]
        groups = sets if together else len(rows)
        of_row = np.arange(len(rows)) // (len(rows) // groups)
        weighed = [weigh(*series.groups(groups)) for series in by_order]
        log = np.array([one.log_evidence for one in weighed])
        share = np.exp(log - log.max(axis=0))
        share /= share.sum(axis=0)  # of each order, (order, group)
        parts = [series.mixture(one, of_row) for series, one in zip(by_order, weighed, strict=True)]
        curves[rows], spread[rows], W[rows] = mixed(share[:, of_row], parts)
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


def smooth_vectors(
    positions: ArrayLike,
    values: ArrayLike,
    covariance: ArrayLike,
    at: ArrayLike,
    *,
    exact_zero: bool = False,
    order: int | None = None,
) -> SmoothVectors:
    """Return smooth curves of d components, each with one amplitude for all its curves, and their covariance.

    The components are smoothed separately: use the coordinates in which their noise is least correlated.

    Parameters
    ----------
    positions : (n,)
        Of the points: a position, or a time on a scale on which the curves are about equally smooth.
    values, covariance : (..., n, d), (..., n, d, d)
        Points, and the covariance of their independent errors; NaN for a missing component.
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
    if y.ndim < 2 or C.shape != (*y.shape, y.shape[-1]):
        raise MethodError(
            f"Expected values (..., n, d) and covariance (..., n, d, d); found {y.shape}, {C.shape}.",
            code="smoothing.shape",
        )
    d = y.shape[-1]
    v = np.diagonal(C, axis1=-2, axis2=-1)
    known = np.isfinite(y) & np.isfinite(v)
    _, pattern = np.unique(known.reshape(-1, d), axis=1, return_inverse=True)  # components with the same points known
    each: dict[int, tuple[Smooth, int]] = {}
    for k in np.unique(pattern):
        some = np.flatnonzero(pattern == k)
        values_, variance = (np.moveaxis(array[..., some], -1, 0) for array in (y, v))
        smoothed = smooth(
            positions, values_, variance, at, exact_zero=exact_zero, together=True, sets=some.size, order=order
        )
        each |= {int(component): (smoothed, i) for i, component in enumerate(some)}
    arrays: dict[str, Any] = {
        name: np.stack([getattr(one, name)[i] for one, i in (each[k] for k in range(d))], axis=y.ndim - 2)
        for name in Smooth.__dataclass_fields__
        if name != "order"
    }
    merged = Smooth(**arrays, order=min(one.order for one, _ in each.values()))
    W = merged.weights  # (..., d, m, n)
    noise = np.einsum("...imn,...nij,...jmn->...mij", W, np.nan_to_num(C), W)
    own = np.swapaxes(merged.variance, -1, -2) - np.diagonal(noise, axis1=-2, axis2=-1)  # of the curves without noise
    total = noise + np.maximum(own, 0.0)[..., None] * np.eye(d)
    return SmoothVectors(np.swapaxes(merged.values, -1, -2), total, merged)


def _check(x: Array, y: Array, v: Array, to: Array, exact_zero: bool) -> None:
    """Raise MethodError where the arguments of `smooth` are invalid."""
    if x.ndim != 1 or to.ndim != 1 or y.shape[-1:] != x.shape or v.shape != y.shape:
        raise MethodError(
            "Expected positions (n,), values and variance (..., n), and requested positions (m,); found "
            f"{x.shape}, {y.shape}, {v.shape} and {to.shape}.",
            code="smoothing.shape",
        )
    if not (np.isfinite(x).all() and np.isfinite(to).all()):
        raise MethodError(
            "Expected finite positions; a missing point has the value NaN.", code="smoothing.position.not_finite"
        )
    if exact_zero and (x <= 0).any():
        raise MethodError(
            f"Expected positions above 0 for curves that start at position 0; found {x.min():g}.",
            code="smoothing.position.not_positive",
        )
