"""A smooth surface k through the slopes of calibrated settings, of an order chosen by leave-one-out cross-validation.

k is a sum of products of Legendre polynomials. The coefficients of a smooth function decrease geometrically with their
degree n, so the prior of each is 0 with the standard deviation s rho^n, and the settings scatter f times as much as
their noise. The agreement of s, rho and f with the data is the sum of the log densities of the predictions of each
setting by all the others (Rasmussen and Williams, Gaussian Processes for Machine Learning, section 5.4.2). A small
number of settings determines the three only approximately, so the surface is the average over a grid of them, weighted
by this density, and its covariance includes their differences.

The order is the smallest one with predictions no worse than those of all degrees together. Higher degrees remain in the
fit with their prior: they represent the truncation error, and increase the uncertainty where there are no settings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations.inclination import terms

MAX_ORDER = 12
EXTRA_DEGREES = 3
"""Degrees in the fit above the highest order."""

_MAX_SETTINGS = 600
"""Largest number of settings used to determine s, rho and f, to limit the computing time."""
_SIZES = 10.0 ** np.arange(-6.0, 1.1, 0.2)
"""Standard deviations of the coefficients of degree `_MIDDLE`, over the largest slope."""
_MIDDLE = 4
_DECAYS = 1.4 ** np.arange(-7.0, 1.0)
"""rho, from a tenth up to 1."""
_SCATTERS = np.array([1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0, 100.0])
"""f."""
_MIN_WEIGHT = 1e-3
"""Weight, relative to the largest, below which a point of the grid is ignored."""
_ROUNDING = 1e-9
"""Lower limit of 1 - leverage."""
_ON_LINE = 1e-6
"""x2 below which a setting lies on the line of symmetry."""


@dataclass(frozen=True)
class Prediction:
    """Prediction of each setting from all the others.

    Attributes
    ----------
    density : ndarray (setting,)
        Log density of each slope under its prediction.
    slope, variance : ndarray (setting,)
        The predicted k and its variance, without noise and scatter of the setting itself.
    z : ndarray (setting,)
        Deviation over its standard deviation.
    """

    density: Array
    slope: Array
    variance: Array
    z: Array


@dataclass(frozen=True)
class Surface:
    """A fitted surface.

    Attributes
    ----------
    degrees : ndarray (term, 2)
        Degrees of the two polynomials of each term.
    coefficients : ndarray (term,)
    covariance : ndarray (term, term)
    order : int
        Chosen order; `degrees` contains higher ones.
    mirror : bool
        Whether k is even in x2.
    scatter : float
        f: ratio of the scatter of the settings to their noise.
    prediction : Prediction
        Of every setting by all the others.
    """

    degrees: NDArray[np.int64]
    coefficients: Array
    covariance: Array
    order: int
    mirror: bool
    scatter: float
    prediction: Prediction


def degrees_to(highest: int, mirror: bool) -> NDArray[np.int64]:
    """Return the degrees (term, 2) of all products up to a total degree; even in the second if mirrored."""
    pairs = [(n - j, j) for n in range(highest + 1) for j in range(n + 1) if not (mirror and j % 2)]
    return np.array(pairs, dtype=np.int64)


def fit_surface(
    x: Array, slope: Array, variance: Array, *, highest: int, order: int | None = None, mirror: bool | None = None
) -> Surface:
    """Fit a surface to slopes.

    Parameters
    ----------
    x : ndarray (setting, 2)
        Tilts, scaled so that the largest is 1.
    slope, variance : ndarray (setting,)
        k of each setting and its variance from noise.
    highest : int
        Highest order that the number of settings allows.
    order : int, optional
        Replaces the order chosen by cross-validation; it is then the highest degree.
    mirror : bool, optional
        Whether k is even in x2; default: if its predictions are no worse, and there are settings on both sides.
    """
    both_sides = bool((x[:, 1] > _ON_LINE).any() and (x[:, 1] < -_ON_LINE).any())
    last = MAX_ORDER + EXTRA_DEGREES if order is None else order
    problem = _Problem.of(x, slope, variance, degrees_to(last, both_sides if mirror is None else mirror))
    points, weights = problem.thinned().grid()
    prediction = problem.predict(points[0])
    if mirror is None and both_sides:
        free = _Problem.of(x, slope, variance, degrees_to(last, mirror=False))
        if _worse(prediction.density, free.predict(points[0]).density):
            problem = free
            points, weights = problem.thinned().grid()
            prediction = problem.predict(points[0])
    coefficients, covariance = problem.average(points, weights)
    # In case the prior is wrong, the covariance is no smaller than the errors of the predictions.
    widening = max(1.0, float(np.mean(prediction.z**2)))
    return Surface(
        problem.degrees,
        coefficients,
        covariance * widening,
        problem.choose_order(points[0], prediction, highest) if order is None else order,
        not (problem.degrees[:, 1] % 2).any(),
        points[0].scatter,
        Prediction(prediction.density, prediction.slope, prediction.variance * widening, prediction.z),
    )


def _worse(density: Array, best: Array) -> bool:
    """Return whether predictions are worse than others by more than the standard error of their difference."""
    difference = best - density
    return bool(difference.sum() > np.sqrt(len(difference)) * difference.std())


@dataclass(frozen=True)
class _GridPoint:
    """One point of the grid: s rho^4 over the largest slope, rho, f."""

    size: float
    decay: float
    scatter: float


@dataclass(frozen=True)
class _Problem:
    """Terms and slopes divided by the standard deviations of the slopes."""

    Phi: Array
    degrees: NDArray[np.int64]
    y: Array
    deviation: Array

    @classmethod
    def of(cls, x: Array, slope: Array, variance: Array, degrees: NDArray[np.int64]) -> _Problem:
        deviation = np.sqrt(variance)
        return cls(terms(x, degrees) / deviation[:, None], degrees, slope / deviation, deviation)

    def thinned(self) -> _Problem:
        """Return the problem with at most `_MAX_SETTINGS` settings."""
        if len(self.y) <= _MAX_SETTINGS:
            return self
        some = np.linspace(0, len(self.y) - 1, _MAX_SETTINGS).astype(int)
        return _Problem(self.Phi[some], self.degrees, self.y[some], self.deviation[some])

    def up_to(self, degree: int) -> _Problem:
        """Return the problem with the terms up to a total degree."""
        kept = self.degrees.sum(axis=1) <= degree
        return _Problem(self.Phi[:, kept], self.degrees[kept], self.y, self.deviation)

    def prior(self, decay: float) -> Array:
        """Return the standard deviation of each coefficient (term,) where that of degree `_MIDDLE` is 1."""
        return np.asarray(decay ** (self.degrees.sum(axis=1) - float(_MIDDLE)))

    def spectrum(self, decay: float) -> tuple[Array, Array]:
        """Return eigenvalues (term,) and eigenvectors of the normal matrix in units of the prior."""
        X = self.Phi * self.prior(decay)
        values, vectors = np.linalg.eigh(X.T @ X)
        return np.maximum(values, 0.0), vectors

    def unit(self) -> float:
        """Return the largest slope, the unit of the sizes of the grid."""
        return float(np.max(np.abs(self.y * self.deviation)))

    def grid(self) -> tuple[list[_GridPoint], Array]:
        """Return the points with significant weight in decreasing order, and their weights, whose sum is 1."""
        sizes, scatters = (part.ravel() for part in np.meshgrid(_SIZES, _SCATTERS))
        square, noise = (sizes * self.unit()) ** 2, scatters**2
        densities = np.empty((len(_DECAYS), len(sizes)))
        for row, decay in enumerate(_DECAYS):
            values, vectors = self.spectrum(decay)
            T = (self.Phi * self.prior(decay)) @ vectors
            shrink = square / (square * values[:, None] + noise)
            densities[row] = _density(self.y[:, None] - T @ (shrink * (T.T @ self.y)[:, None]), T**2 @ shrink, noise)
        weights = np.exp(densities - densities.max()).ravel()
        order = np.argsort(-weights, kind="stable")
        order = order[weights[order] >= _MIN_WEIGHT]
        points = [
            _GridPoint(float(sizes[k % len(sizes)]), float(_DECAYS[k // len(sizes)]), float(scatters[k % len(sizes)]))
            for k in order
        ]
        return points, weights[order] / weights[order].sum()

    def average(self, points: list[_GridPoint], weights: Array) -> tuple[Array, Array]:
        """Return the mean of the coefficients over points of the grid, and their covariance."""
        means = np.empty((len(points), len(self.degrees)))
        C = np.zeros((len(self.degrees), len(self.degrees)))
        for decay in {point.decay for point in points}:
            values, vectors = self.spectrum(decay)
            D = self.prior(decay)
            along = vectors.T @ (D * (self.Phi.T @ self.y))
            rows = [k for k, point in enumerate(points) if point.decay == decay]
            square = np.array([(points[k].size * self.unit()) ** 2 for k in rows])[:, None]
            noise = np.array([points[k].scatter ** 2 for k in rows])[:, None]
            shrink = square / (square * values + noise)
            means[rows] = D * ((shrink * along) @ vectors.T)
            basis = D[:, None] * vectors
            C += (basis * (weights[rows] @ (shrink * noise))) @ basis.T
        mean = weights @ means
        off = (means - mean) * np.sqrt(weights)[:, None]
        C += off.T @ off
        return mean, (C + C.T) / 2

    def predict(self, point: _GridPoint) -> Prediction:
        """Return the prediction of each setting by all the others, in closed form."""
        from scipy.linalg import solve_triangular

        square, noise = (point.size * self.unit()) ** 2, point.scatter**2
        X = self.Phi * (self.prior(point.decay) * np.sqrt(square / noise))
        L = np.linalg.cholesky(X.T @ X + np.eye(X.shape[1]))
        B = solve_triangular(L, X.T, lower=True, check_finite=False)
        rest, leverage = self.y - B.T @ (B @ self.y), (B**2).sum(axis=0)
        free = np.maximum(1.0 - leverage, _ROUNDING)
        z = rest / np.sqrt(noise * free)
        return Prediction(
            -0.5 * (z**2 + np.log(2 * np.pi * noise * self.deviation**2 / free)),
            self.deviation * (self.y - rest / free),
            self.deviation**2 * noise * (1.0 / free - 1.0),
            z,
        )

    def choose_order(self, point: _GridPoint, best: Prediction, highest: int) -> int:
        """Return the smallest order with predictions no worse than those of all degrees."""
        for order in range(highest):
            if not _worse(self.up_to(order).predict(point).density, best.density):
                return order
        return highest


def _density(rest: Array, leverage: Array, noise: Array) -> Array:
    """Return sums of log densities of left-out slopes, without a constant, for residuals (setting, grid point)."""
    free = np.maximum(1.0 - leverage, _ROUNDING)
    return np.asarray(-0.5 * (rest**2 / (noise * free) + np.log(noise / free)).sum(axis=0))
