"""Errors at other instants or positions, with the uncertainty of the interpolation.

Between two neighbours the errors are modelled as an integrated Wiener process of intensity q, whose mean is the
straight line. At the fraction w of an interval of length h, with an unknown slope, it adds the variance
``q h^3 w^2 (1 - w)^2 / 3``. The intensity is estimated for each freedom from second differences: with neighbours
``a, b, c`` at distances ``h`` and ``g``, the deviation of b from the line through a and c has the variance
``q h^2 g^2 / (3 (h + g))`` plus that of the noise of the three. The curvature is largest when a warm-up starts, so the
intensity of an interval is that of the second differences at its ends. The first interval of a record over time has no
value before it. The machine is assumed to be steady until then: the slope is 0 before, and its means over the first two
intervals are s and s'. The slope changes at least by the range J of these three, and ``q = J^2 / h``: the process whose
slope changes by J (one standard deviation) within the interval. A single change of this size, anywhere in it, deviates
from the line by sqrt(3) standard deviations.

A switched compensation, a reset or a stop makes a step somewhere between two values. The mean slope of its interval is
then outside of those of the intervals beside it, by S over its length; a smooth curve is between them but for turns of
its slope. A step S at any instant of the interval deviates from the line by no more than ``S max(w, 1 - w)``, which is
taken as sqrt(3) standard deviations, as that of one change of slope. Before the first value and after the last one a
slope of 0 is assumed. A warm-up that starts with the first interval has a slope in it that is up to e times that of the
next, if its time constant is not shorter than an interval. This is for records over time; along positions no step is
expected. A step of few standard deviations of a value is hidden by their noise, and not contained.

Sources that are one draw for many values are interpolated with the same weights.
Nothing is extrapolated.
"""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array, products
from errormotion.datasets.results.reduction import TOLERANCE, influence_of, rebuilt
from errormotion.datasets.schemas import DOF, INDEX
from errormotion.errors import DatasetError

SIGNIFICANT = 3.29
"""Size of a step in standard deviations of its noise from which it is one: one in a thousand by noise alone."""
Places = tuple[NDArray[np.intp], Array, NDArray[np.bool_], NDArray[np.bool_]]
"""For each new point: index of the known point before it, fraction of the interval, whether it is known or inside."""


def to_points(ds: xr.Dataset, dim: str, coordinate: str, points: ArrayLike) -> xr.Dataset:
    """Return the errors at other points along a dimension, by interpolation between neighbours.

    Parameters
    ----------
    ds : Dataset
        Error dataset of the six freedoms.
    dim, coordinate : str
        Dimension, and the increasing coordinate along it: ``time`` and ``time``, or ``position`` and ``y``.
    points : array_like, (n,)
        Increasing; s or m. The result is NaN outside of the dataset, and beside unknown neighbours.

    Returns
    -------
    Dataset
        Without the further results of the method. The attribute ``interpolation_intensity`` states the largest q
        for each of the six freedoms (m^2/s^3 or rad^2/s^3; per m^3 along positions).

    Raises
    ------
    DatasetError
        No such dimension, errors along one direction only, points that do not increase.
    """
    if "deviation" in ds.variables:
        raise DatasetError(
            "The errors are known along one direction only; the six freedoms are needed here",
            code="errors.freedoms.one_direction",
        )
    if dim not in ds["EX"].dims or coordinate not in ds.variables or ds[coordinate].dims != (dim,):
        raise DatasetError(
            f"Expected errors over '{dim}' with the coordinate '{coordinate}' along it",
            code="errors.coordinate.missing",
        )
    new = np.atleast_1d(np.asarray(points, dtype=float))
    t = np.asarray(ds[coordinate].values, dtype=float)
    if new.ndim != 1 or not np.isfinite(new).all() or (np.diff(new) <= 0).any():
        raise DatasetError(f"{coordinate}: expected finite points that increase", code="errors.points.not_increasing")
    if (np.diff(t) <= 0).any():
        raise DatasetError(
            f"{coordinate}: expected values that increase along '{dim}'", code="errors.coordinate.not_increasing"
        )
    axis = ds["EX"].dims.index(dim)
    E = np.moveaxis(np.stack([ds[name].values for name in DOF], axis=-1), axis, 0)
    F = np.moveaxis(influence_of(ds), axis + 1, 1)
    total = np.moveaxis(np.asarray(ds["covariance"].values, dtype=float), axis, 0)
    values, covariance, influence, q = interpolated(t, E, total, F, new, starting=dim == "time")
    before = _neighbours(t, new)[0]
    base = ds.isel({dim: np.clip(before, 0, len(t) - 1)}).drop_vars(f"{dim}{INDEX}", errors="ignore")
    base = base.drop_vars([name for name in base.coords if base[name].dims == (dim,) and name != coordinate])
    return rebuilt(
        base,
        np.moveaxis(values, 0, axis),
        np.moveaxis(covariance, 0, axis),
        np.moveaxis(influence, 1, axis + 1),
        [],
        {coordinate: (dim, new, dict(ds[coordinate].attrs))},
        interpolation_intensity=q.max(axis=tuple(range(q.ndim - 1)), initial=0.0),
    )


def interpolated(
    t: Array, E: Array, total: Array, F: Array, new: Array, *, starting: bool = False
) -> tuple[Array, Array, Array, Array]:
    """Return errors at new points with their covariance, influence and intensity; see `to_points`.

    Parameters
    ----------
    t, new : ndarray, (n,) and (m,)
        Known and new points, increasing.
    E, total, F : ndarray, (n, ..., 6), (n, ..., 6, 6), (source, n, ..., 6)
        Errors, total covariance, influence.
    starting : bool
        For errors over time: they are assumed to be constant before the first point, and may have steps.

    Returns
    -------
    E, total, F, q : ndarray, (m, ...)
    """
    before, share, exact, inside = _neighbours(t, new)
    if exact.all():
        return E[before], total[before], F[:, before], np.zeros((1, 6))
    own = total - products(F)
    after = np.minimum(before + ~exact, len(t) - 1)
    w = share.reshape(-1, *[1] * (E.ndim - 1))
    between = ~exact & inside
    q = intensity(t, E, own, starting=starting)
    q = np.where(between.reshape(w.shape), q[np.minimum(before, len(q) - 1)], 0.0)
    width = np.where(exact, 0.0, t[after] - t[before])
    added = (width**3 * share**2 * (1 - share) ** 2 / 3).reshape(w.shape) * q
    if starting:
        size = steps(t, E, own)[np.minimum(before, max(len(t) - 2, 0))]
        added = added + np.where(between.reshape(w.shape), variance_beside_a_step(w, size), 0.0)
    values = np.where(exact.reshape(w.shape), E[before], (1 - w) * E[before] + w * E[after])
    influence = np.where(exact.reshape(w.shape), F[:, before], (1 - w) * F[:, before] + w * F[:, after])
    ww = w[..., None]
    rest = (1 - ww) ** 2 * own[before] + ww**2 * own[after] + added[..., None] * np.eye(6)
    rest = np.where(exact.reshape(ww.shape), own[before], rest)
    values[~inside] = np.nan
    unknown = np.isnan(values)
    influence[:, unknown] = np.nan
    covariance = rest + products(influence)
    covariance[unknown[..., :, None] | unknown[..., None, :]] = np.nan
    return values, covariance, influence, q


def intensity(t: Array, values: Array, own: Array, *, starting: bool = False, together: bool = False) -> Array:
    """Return the intensity q of each interval, (n - 1, ..., 6), from second differences; NaN for less than 3 points.

    Parameters
    ----------
    t : ndarray, (n,)
    values : ndarray, (n, ..., 6)
    own : ndarray, (n, ..., 6, 6)
        Independent covariance of each value.
    starting : bool
        Whether the errors are assumed to be constant before the first point.
    together : bool
        One intensity for all axes between the first and the last one, which then have the length 1.
    """
    if len(t) < 3:
        return np.full((max(len(t) - 1, 1), *values.shape[1:]), np.nan)
    h, g = (np.diff(t)[:-1], np.diff(t)[1:])
    shape = (-1, *[1] * (values.ndim - 1))
    w = (h / (h + g)).reshape(shape)
    bend = values[1:-1] - (1 - w) * values[:-2] - w * values[2:]
    variance = np.diagonal(own, axis1=-2, axis2=-1)
    noise = variance[1:-1] + (1 - w) ** 2 * variance[:-2] + w**2 * variance[2:]
    unit = np.broadcast_to((h**2 * g**2 / (3 * (h + g))).reshape(shape), bend.shape)
    known = np.isfinite(bend) & np.isfinite(noise)
    excess, scale = np.where(known, bend**2 - noise, 0.0), np.where(known, unit, 0.0)
    if together:
        others = tuple(range(1, excess.ndim - 1))
        excess, scale = excess.sum(axis=others, keepdims=True), scale.sum(axis=others, keepdims=True)
    # The interval from value k to k + 1 has the second differences at k and k + 1.
    none = np.zeros((1, *excess.shape[1:]))
    beside, unit = (np.concatenate([none, each]) + np.concatenate([each, none]) for each in (excess, scale))
    intensity_at: Array = np.maximum(beside, 0.0) / np.where(unit > 0, unit, np.inf)
    if starting:
        intensity_at[0] = np.where(known[0], _starting(h[0], g[0], values[:3], variance[:3]), intensity_at[0])
    return intensity_at


def steps(t: Array, values: Array, own: Array, *, together: bool = False) -> Array:
    """Return the mean square S^2 of a step within each interval, (n - 1, ..., 6); 0 where nothing shows one.

    S is the difference of the values less h times the mean slope of the intervals beside, if the slope of the interval
    is outside of these two, and S more than `SIGNIFICANT` times its noise. The intervals beside a step may show half of
    it. Parameters as of `intensity`; ``together``: the mean over all axes between the first and the last one.
    """
    if len(t) < 2:
        return np.zeros((1, *values.shape[1:]))
    h = np.diff(t).reshape(-1, *[1] * (values.ndim - 1))
    slope = np.diff(values, axis=0) / h
    variance = np.diagonal(own, axis1=-2, axis2=-1)
    none = np.full((1, *slope.shape[1:]), np.nan)
    before, after = np.concatenate([none, slope[:-1]]), np.concatenate([slope[1:], none])
    # S = y_(k+1) - y_k - a (y_k - y_(k-1)) - b (y_(k+2) - y_(k+1))
    a, b = (np.where(np.isfinite(each), 0.5, 0.0) for each in (before, after))
    a[1:] *= h[1:] / h[:-1]
    b[:-1] *= h[:-1] / h[1:]
    before, after = (np.where(np.isfinite(each), each, 0.0) for each in (before, after))
    size = h * (slope - (before + after) / 2)
    limit = np.concatenate([math.e * after[:1], after[1:]])
    outside = (slope > np.maximum(before, limit)) | (slope < np.minimum(before, limit))
    v = np.concatenate([np.zeros_like(none), np.nan_to_num(variance), np.zeros_like(none)])
    noise = np.square(a) * v[:-3] + np.square(1 + a) * v[1:-2] + np.square(1 + b) * v[2:-1] + np.square(b) * v[3:]
    shown = outside & np.isfinite(size)
    square, noise = (np.where(shown, each, 0.0) for each in (np.square(size), noise))
    if not together:
        return np.where(square > SIGNIFICANT**2 * noise, square, 0.0)
    others = tuple(range(1, size.ndim - 1))
    square, noise, count = (each.sum(axis=others, keepdims=True) for each in (square, noise, np.isfinite(size)))
    # sums of squares of c values of noise: noise of its own size, with the relative standard deviation sqrt(2 / c)
    limit = noise * (1 + SIGNIFICANT * np.sqrt(2 / np.maximum(count, 1)))
    return np.asarray(np.where(square > limit, square, 0.0) / np.maximum(count, 1))


def variance_beside_a_step(share: Array, square: Array) -> Array:
    """Return the variance of the deviation from the line by a step of the mean square S^2 anywhere in the interval."""
    return np.asarray(square * np.square(np.maximum(share, 1 - share)) / 3)


def _starting(h: float, g: float, values: Array, variance: Array) -> Array:
    """Return the intensity of the first interval, (..., 6), of an error that is constant before its first value."""
    first, second = (values[1] - values[0]) / h, (values[2] - values[1]) / g
    changes = np.stack([first, second, second - first])
    v0, v1, v2 = variance
    noise = np.stack([(v0 + v1) / h**2, (v1 + v2) / g**2, v0 / h**2 + v1 * (1 / h + 1 / g) ** 2 + v2 / g**2])
    largest = np.abs(changes).argmax(axis=0)[None]
    square, of_noise = (np.take_along_axis(each, largest, axis=0)[0] for each in (changes**2, noise))
    found: Array = np.maximum(square - of_noise, 0.0) / h
    return found


def bracket(t: Array, new: Array) -> NDArray[np.intp]:
    """Return the indices of the two known points for each new point, (2, n); equal if it is a known point."""
    before, _, exact, _ = _neighbours(t, new)
    return np.array([before, np.minimum(before + ~exact, len(t) - 1)])


def _neighbours(t: Array, new: Array) -> Places:
    """Return for each new point: the known one before it, fraction of the interval, whether it is known or inside."""
    before = np.clip(np.searchsorted(t, new + TOLERANCE, side="right") - 1, 0, len(t) - 1)
    nearest = np.where(np.abs(t[np.minimum(before + 1, len(t) - 1)] - new) <= TOLERANCE, before + 1, before)
    nearest = np.minimum(nearest, len(t) - 1)
    exact = np.abs(t[nearest] - new) <= TOLERANCE
    before = np.where(exact, nearest, before)
    width = np.where(before < len(t) - 1, t[np.minimum(before + 1, len(t) - 1)] - t[before], 1.0)
    share = np.where(exact, 0.0, (new - t[before]) / np.where(width > 0, width, 1.0))
    inside = (new >= t[0] - TOLERANCE) & (new <= t[-1] + TOLERANCE)
    return before, np.clip(share, 0.0, 1.0), exact, inside
