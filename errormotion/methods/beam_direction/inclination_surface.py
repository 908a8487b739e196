"""A smooth surface k through the slopes of calibrated settings, its order chosen by leaving settings out.

k is a sum of products of Legendre polynomials. A smooth function has coefficients that fall geometrically with their
degree n, so each is held at 0 within a standard deviation s rho^n, and every setting scatters by tau beyond its noise.
How well s, rho and tau suit the data is told by predictions of settings that were left out, one at a time: the sum of
the log densities of these predictions (Rasmussen and Williams, Gaussian Processes for Machine Learning, section 5.4.2).
Few settings tell the three only roughly, so the surface is the average over those that suit, and its covariance holds
how they differ.

The order is the smallest one that predicts no worse than all degrees together. The degrees beyond it stay in the fit,
held at what they may be: they are what the order leaves out, and make the uncertainty grow where there are no settings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.datasets.calibration import terms

Array = NDArray[np.float64]

HIGHEST = 10
"""Highest order that is tried."""
BEYOND = 3
"""Degrees in the fit beyond that."""

_MOST = 600
"""Settings that decide on s, rho and tau; more would only take longer."""
_STEPS = 120
"""Evaluations of the predictions while the best s, rho and tau are sought."""
_WALK, _BETWEEN = 120, 8
"""Steps of the walk over those that suit, and from which step on and how often one is taken."""
_STRIDE = np.array([0.5, 0.2, 0.6])
"""Standard deviations of one step, see `_Problem.habit`."""
_MIDDLE = 4
"""Degree at which the size of the coefficients is told; it hardly depends on rho there."""
_DECAY = (0.03, 1.0)
"""Bounds of rho: one coefficient tells all; no decay at all."""
_ON_LINE = 1e-6
"""x2 below which a setting lies on the line of symmetry."""


@dataclass(frozen=True)
class Prediction:
    """How a surface predicts each setting from all the others.

    Attributes
    ----------
    density : ndarray (setting,)
        Log density of each slope under its prediction.
    slope, variance : ndarray (setting,)
        The predicted k and its variance; noise and scatter of the setting itself are not in it.
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
        That was chosen; the degrees go further.
    mirror : bool
        Whether k is even in x2.
    scatter : float
        tau: standard deviation of k from setting to setting beyond the noise.
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
        Places, scaled so that the farthest is at 1.
    slope, variance : ndarray (setting,)
        k of each setting and its variance from noise.
    highest : int
        Highest order that the number of settings allows.
    order : int, optional
        Instead of the one that cross-validation chooses; the degrees then end there.
    mirror : bool, optional
        Whether k is even in x2; default: if that predicts no worse, and there are settings on both sides to tell.
    """
    both_sides = bool((x[:, 1] > _ON_LINE).any() and (x[:, 1] < -_ON_LINE).any())
    kinds = [mirror] if mirror is not None else [True, False] if both_sides else [False]
    last = HIGHEST + BEYOND if order is None else order
    found = []
    for kind in kinds:
        problem = _Problem.of(x, slope, variance, degrees_to(last, kind))
        place = problem.thinned().search()
        found.append((problem, place, problem.predict(place)))
    problem, place, prediction = found[-1] if _worse(found[0][2].density, found[-1][2].density) else found[0]
    coefficients, covariance = problem.average(problem.thinned().walk(place))
    # Nothing says that the prior fits: the covariance is no smaller than the settings that were left out show.
    widening = max(1.0, float(np.mean(prediction.z**2)))
    return Surface(
        problem.degrees,
        coefficients,
        covariance * widening,
        problem.choose_order(place, prediction, highest) if order is None else order,
        not (problem.degrees[:, 1] % 2).any(),
        problem.habit(place)[1],
        Prediction(prediction.density, prediction.slope, prediction.variance * widening, prediction.z),
    )


def _worse(density: Array, best: Array) -> bool:
    """Return whether predictions are worse than others by more than the standard error of their difference."""
    difference = best - density
    return bool(difference.sum() > np.sqrt(len(difference)) * difference.std())


@dataclass(frozen=True)
class _Problem:
    """Slopes and terms; a *place* (3,) is where the search stands: logs of s rho^4, rho, tau."""

    Phi: Array
    degrees: NDArray[np.int64]
    slope: Array
    variance: Array

    @classmethod
    def of(cls, x: Array, slope: Array, variance: Array, degrees: NDArray[np.int64]) -> _Problem:
        return cls(terms(x, degrees), degrees, slope, variance)

    def thinned(self) -> _Problem:
        """Return the problem with so many settings as are needed to find the place."""
        if len(self.slope) <= _MOST:
            return self
        some = np.linspace(0, len(self.slope) - 1, _MOST).astype(int)
        return _Problem(self.Phi[some], self.degrees, self.slope[some], self.variance[some])

    def up_to(self, degree: int) -> _Problem:
        """Return the problem with the terms up to a total degree."""
        kept = self.degrees.sum(axis=1) <= degree
        return _Problem(self.Phi[:, kept], self.degrees[kept], self.slope, self.variance)

    def bounds(self) -> tuple[Array, Array]:
        """Return the lowest and the highest place."""
        noise = float(np.sqrt(np.median(self.variance)))
        size = max(float(np.abs(self.slope).max()), noise)
        return np.log([size * 1e-7, _DECAY[0], noise * 1e-2]), np.log([size * 10, _DECAY[1], size])

    def habit(self, place: Array) -> tuple[Array, float]:
        """Return the standard deviation of each coefficient (term,), and tau."""
        middle, decay, scatter = np.exp(np.clip(place, *self.bounds()))
        return np.asarray(middle * decay ** (self.degrees.sum(axis=1) - float(_MIDDLE))), float(scatter)

    def whitened(self, place: Array) -> tuple[Array, Array, Array, Array]:
        """Return design and slopes over their deviations, the design in units of the prior; deviations and prior."""
        prior, scatter = self.habit(place)
        deviation = np.sqrt(self.variance + scatter**2)
        return self.Phi * prior / deviation[:, None], self.slope / deviation, deviation, prior

    def predict(self, place: Array) -> Prediction:
        """Return the prediction of each setting by all the others, in closed form."""
        from scipy.linalg import solve_triangular

        X, y, deviation, _ = self.whitened(place)
        L = np.linalg.cholesky(X.T @ X + np.eye(X.shape[1]))
        B = solve_triangular(L, X.T, lower=True, check_finite=False)
        rest = y - B.T @ (B @ y)
        free = np.maximum(1.0 - (B**2).sum(axis=0), 1e-9)  # 1 - leverage
        z = rest / np.sqrt(free)
        density = -0.5 * (z**2 + np.log(2 * np.pi * deviation**2 / free))
        return Prediction(density, self.slope - deviation * rest / free, deviation**2 * (1.0 / free - 1.0), z)

    def suits(self, place: Array) -> float:
        """Return the sum of the log densities of the predictions."""
        low, high = self.bounds()
        if (place < low).any() or (place > high).any():
            return -np.inf
        return float(self.predict(place).density.sum())

    def search(self) -> Array:
        """Return the place that suits best."""
        from scipy.optimize import minimize

        low, high = self.bounds()
        start = np.array([high[0] - np.log(1e3), np.log(0.4), low[2] + np.log(50.0)])
        simplex = np.vstack([start, start + np.diag([2.0, 0.7, 1.5])])

        def badness(place: Array) -> float:
            return -self.suits(np.clip(place, low, high))

        found = minimize(
            badness,
            start,
            method="Nelder-Mead",
            options={"maxfev": _STEPS, "initial_simplex": simplex, "fatol": 0.05, "xatol": 0.05},
        )
        return np.asarray(np.clip(found.x, low, high))

    def walk(self, place: Array) -> list[Array]:
        """Return places as often as they suit: a random walk (Metropolis), the same every time."""
        rng = np.random.default_rng(0)
        suits, taken = self.suits(place), []
        for step in range(1, _WALK + 1):
            other = place + _STRIDE * rng.normal(size=3)
            there = self.suits(other)
            if np.log(rng.uniform()) < there - suits:
                place, suits = other, there
            if step % _BETWEEN == 0:
                taken.append(place)
        return taken

    def average(self, places: list[Array]) -> tuple[Array, Array]:
        """Return the mean of the coefficients over places, and their covariance."""
        means, covariances = [], []
        for place in places:
            X, y, _, prior = self.whitened(place)
            C = np.linalg.inv(X.T @ X + np.eye(X.shape[1]))
            means.append(prior * (C @ (X.T @ y)))
            covariances.append(prior[:, None] * C * prior)
        mean = np.mean(means, axis=0)
        off = np.array(means) - mean
        C = np.mean(covariances, axis=0) + off.T @ off / len(places)
        return mean, (C + C.T) / 2

    def choose_order(self, place: Array, best: Prediction, highest: int) -> int:
        """Return the smallest order that predicts no worse than all degrees."""
        for order in range(highest):
            if not _worse(self.up_to(order).predict(place).density, best.density):
                return order
        return highest
