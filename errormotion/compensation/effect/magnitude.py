"""Magnitudes of measured curves, and the ratio of two of them, with intervals of 95 %.

The sum of squares ``y'y`` of measured values ``y = m + e``, ``cov e = V``, is larger than ``m'm`` by ``tr V`` on
average. Estimates are therefore ``m'm = y'y - tr V``, 0 where this is negative. An interval contains the
magnitudes that a test does not reject. The statistic of the ratio r of two curves is the quadratic form

    q(r) = a'a - r^2 b'b,

with the joint covariance of both: a common source is fully correlated. Its distribution under the hypothesis
``|m_a| = r |m_b|`` is approximated by a shifted gamma distribution of the same mean, variance and third moment
(Imhof 1961, Biometrika 48, 419; Pearson's type III). The cumulants of a quadratic form ``y'Ay`` are

    k1 = tr AV + m'Am,    k2 = 2 tr (AV)^2 + 4 m'AVAm,    k3 = 8 tr (AV)^3 + 24 m'AVAVAm.

The direction of the unknown m is that of y. The derivation is in docs/explanation/compensation-effect.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import gammainc, gammaincc, ndtr

from errormotion.arrays import Array

ENDS = (0.025, 0.975)
"""Probabilities below the ends of the intervals."""

MAX_RATIO = 1e6
"""Ratios above are unbounded."""

NORMAL = 1e-4
"""Skewness below which a normal distribution is used."""

ROUNDING = 1e-10
"""Fraction of the largest value below which a value is set to 0."""


class Interval(NamedTuple):
    """An estimate with the ends of its interval of 95 %; NaN = unknown, an infinite end = unbounded."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Curve:
    """Measured values with a covariance that is diagonal plus low rank, reduced to the sums in the cumulants.

    Attributes
    ----------
    count : int
        Number of points, by which mean squares are computed.
    square : float
        y'y
    noise : (3,)
        Sums of the powers 1 to 3 of the diagonal part d.
    weighted : (2,)
        d'y^2 and (d^2)'y^2.
    inner : (3, source, source)
        F D^k F', k = 0 to 2; F has a row for each source.
    along : (3, source)
        F D^k y, k = 0 to 2.
    """

    count: int
    square: float
    noise: Array
    weighted: Array
    inner: Array
    along: Array

    @classmethod
    def of(cls, value: Array, own: Array, influence: Array) -> Curve:
        """Reduce n points of d values.

        Parameters
        ----------
        value : (n, d)
            Without unknown values.
        own : (n, d, d)
            Covariance that is independent between points.
        influence : (source, n, d)
            Effect of one standard uncertainty of each source.
        """
        variance, axes = np.linalg.eigh((own + np.swapaxes(own, 1, 2)) / 2)  # rotations keep sums of squares
        y = np.einsum("nij,ni->nj", axes, value).ravel()
        F = np.einsum("nij,sni->snj", axes, influence).reshape(len(influence), y.size)
        D = np.maximum(variance, 0.0).ravel()
        return cls(
            len(value),
            float(y @ y),
            np.array([D.sum(), (D**2).sum(), (D**3).sum()]),
            np.array([D @ y**2, D**2 @ y**2]),
            np.array([F @ (D**k * F).T for k in range(3)]),
            np.array([F @ (D**k * y) for k in range(3)]),
        )

    @cached_property
    def expected(self) -> float:
        """Expected square of values with a true magnitude of 0: tr V."""
        return float(self.noise[0] + self.traces[0])

    @cached_property
    def traces(self) -> tuple[float, float, float]:
        """Traces of the matrices of ``inner``."""
        first, second, third = (float(np.trace(each)) for each in self.inner)
        return first, second, third

    @cached_property
    def spectrum(self) -> tuple[Array, Array]:
        """Eigenvalues and eigenvectors of FF'."""
        values, vectors = np.linalg.eigh(self.inner[0])
        return values, vectors

    @property
    def true_square(self) -> float:
        """Estimate of m'm, not below 0."""
        return max(self.square - self.expected, 0.0)


class Term(NamedTuple):
    """A curve in a quadratic form, and the hypothesis ``m = scale y + effects of the sources``."""

    weight: float
    curve: Curve
    scale: float
    sources: Array

    @property
    def true_square(self) -> float:
        """Square of the hypothetical magnitude, m'm."""
        s, b, c = self.scale, self.sources, self.curve
        return float(s**2 * c.square + 2 * s * (b @ c.along[0]) + b @ c.inner[0] @ b)

    def weighted(self, power: int) -> float:
        """Return m'D^power m for the powers 1 and 2."""
        s, b, c = self.scale, self.sources, self.curve
        cross = 2 * s * (b @ c.along[power]) + b @ c.inner[power] @ b
        return float(s**2 * c.weighted[power - 1] + cross)

    def along(self, power: int) -> Array:
        """Return F D^power m for the powers 0 and 1."""
        found: Array = self.scale * self.curve.along[power] + self.curve.inner[power] @ self.sources
        return found


def scaled(weight: float, curve: Curve, true_square: float) -> Term:
    """Return the hypothesis that m has the direction of y."""
    scale = math.sqrt(true_square / curve.square) if curve.square > 0 else 0.0
    return Term(weight, curve, scale, np.zeros(len(curve.along[0])))


def displaced(weighted: Sequence[tuple[float, Curve]], target: float) -> list[Term] | None:
    """Return the hypothesis that effects of the sources reduce the measured curves.

    Of all effects z of the sources for which the sum of weight times m'm is ``target``, with ``m = y + F'z`` (y scaled
    down by its noise), the most likely one is ``z = x F A m``: one scalar equation for x, from the eigenvalues of F'AF.
    None if no effect of the sources yields this sum.
    """
    factors = [math.sqrt(max(1 - c.noise[0] / c.square, 0.0)) if c.square > 0 else 0.0 for _, c in weighted]
    start = sum(w * s**2 * c.square for (w, c), s in zip(weighted, factors, strict=True)) - target
    if len(weighted) == 1:
        ((w, curve),) = weighted
        L, Q = w * curve.spectrum[0], curve.spectrum[1]
    else:
        L, Q = np.linalg.eigh(sum(w * c.inner[0] for w, c in weighted))
    g = Q.T @ sum(w * s * c.along[0] for (w, c), s in zip(weighted, factors, strict=True))
    if not len(L) or not np.abs(L).max() > 0:
        return None
    L = np.where(np.abs(L) > ROUNDING * np.abs(L).max(), L, 0.0)
    g = np.where(np.abs(g) > ROUNDING * np.abs(g).max(), g, 0.0)

    squares = g**2

    def excess(x: float) -> float:
        part = x * L
        return start + float(np.add.reduce(squares * x * (2 - part) / (1 - part) ** 2))

    end = L[-1] if start < 0 else L[0]
    most = (1 - 1e-9) / end if end * start < 0 else -1e9 / L[-1] if start > 0 and L[-1] > 0 else 0.0
    if not excess(most) * start < 0:
        return None
    x = brentq(excess, min(most, 0.0), max(most, 0.0), xtol=1e-12 * abs(most), rtol=1e-10)
    z = x * (Q @ (g / (1 - x * L)))
    return [Term(w, c, s, z) for (w, c), s in zip(weighted, factors, strict=True)]


def below(q: float, terms: Sequence[Term]) -> float:
    """Return the probability that the sum of weight times y'y is below q, for common sources of the curves."""
    k1 = k2 = k3 = 0.0
    inner: Array = sum((t.weight * t.curve.inner[0] for t in terms), start=np.zeros(()))  # F'AF
    powered: Array = sum((t.weight**2 * t.curve.inner[1] for t in terms), start=np.zeros(()))  # F'ADAF
    g: Array = sum((t.weight * t.along(0) for t in terms), start=np.zeros(()))  # F'Am
    for term in terms:
        w, curve = term.weight, term.curve
        _, d2, d3 = curve.noise
        k1 += w * (curve.expected + term.true_square)
        k2 += 2 * w**2 * (d2 + 2 * curve.traces[1]) + 4 * w**2 * term.weighted(1)
        k3 += 8 * w**3 * (d3 + 3 * curve.traces[2])
        k3 += 24 * w * (w**2 * term.weighted(2) + 2 * w * (term.along(1) @ g) + g @ curve.inner[0] @ g)
    k2 += 2 * float(np.trace(inner @ inner)) + 4 * float(g @ g)
    k3 += 8 * float(3 * np.trace(powered @ inner) + np.trace(inner @ inner @ inner))
    if not k2 > 0:
        return math.nan
    return _pearson((q - k1) / math.sqrt(k2), k3 / k2**1.5)


def _pearson(x: float, skewness: float) -> float:
    """Return the distribution function of a standardised shifted gamma variable."""
    if abs(skewness) < NORMAL:
        return float(ndtr(x))
    shape = 4 / skewness**2
    at = max(shape + math.copysign(1.0, skewness) * x * math.sqrt(shape), 0.0)
    return float(gammainc(shape, at) if skewness > 0 else gammaincc(shape, at))


def ratio(after: Curve, before: Curve) -> Interval:
    """Return the ratio of the magnitudes of two curves with the same points and the same sources."""
    if not before.true_square > 0:
        return Interval(math.nan, 0.0, math.inf)
    value = math.sqrt(after.true_square / before.true_square)

    def probability(r: float, square: float) -> float:
        terms = displaced(((1.0, after), (-(r**2), before)), 0.0) or [
            scaled(1.0, after, r**2 * before.true_square),
            scaled(-(r**2), before, before.true_square),
        ]
        return below(square - r**2 * before.square, terms)

    return Interval(value, *_ends(value, after, probability))


def magnitude(curve: Curve) -> Interval:
    """Return the root mean square of the true values."""
    scale = math.sqrt(curve.count)

    def probability(size: float, square: float) -> float:
        return below(square, displaced(((1.0, curve),), size**2) or [scaled(1.0, curve, size**2)])

    value = math.sqrt(curve.true_square)
    found = Interval(value, *_ends(value, curve, probability))
    return Interval(*(each / scale for each in found))


def _ends(value: float, curve: Curve, probability: Callable[[float, float], float]) -> tuple[float, float]:
    """Return the ends of the interval around a value.

    ``probability`` is that of a smaller square of the curve than the given one, for a value; it falls with the value.
    For the upper end the square is at least the expected one of a curve that is 0: values that are small by chance, or
    an uncertainty that is stated too large, give no interval of width 0.
    """
    low_p, high_p = ENDS
    if not math.isfinite(at_zero := probability(0.0, curve.square)):
        return value, value  # without any uncertainty
    low = 0.0
    if at_zero > high_p:
        low = float(brentq(lambda v: probability(v, curve.square) - high_p, 0.0, value, rtol=1e-6, xtol=1e-12 * value))
    square = max(curve.square, curve.expected)
    top = max(value, math.sqrt(curve.expected)) if value == 0 else value
    while probability(top, square) > low_p:
        top *= 2.0
        if top > MAX_RATIO * max(1.0, value):
            return low, math.inf
    bottom = 0.0 if value == 0 else value
    return low, float(brentq(lambda v: probability(v, square) - low_p, bottom, top, rtol=1e-6, xtol=1e-12 * top))
