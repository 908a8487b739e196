"""Suspects among the numbers of a fit: which of them are improbable together, and by which noise they are judged."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri

from errormotion.arrays import Array
from errormotion.estimation.checks.effects import MIN_REDUNDANCY, SINGULAR, At, Numbers, reduced, solved, swept
from errormotion.estimation.checks.probability import log_chi2_tail, log_f_tail
from errormotion.estimation.fit import Fit

__all__ = ["RIVAL", "Scale", "Sequence", "Suspect"]

RIVAL = 6.0
"""Decrease of the sum of squares by which the worst must exceed another explanation: odds of 20 to 1."""
CONTRADICTED = 0.01
"""Probability of the sum of squares below which a stated noise counts as unknown in this search.

Otherwise a noise that is stated too small would make outliers of valid readings.
"""
_TOGETHER = 100
"""Largest number of suspicious numbers that are compared with one another in a pass."""
_SIZE = 2e7
"""Largest size of the array of their effects on the unknowns."""


@dataclass(frozen=True, eq=False)
class Suspect:
    """A number or a whole reading without which the others agree, given the other suspects."""

    at: At
    size: Array
    gain: float
    chance: float
    rivals: tuple[At, ...]


@dataclass(frozen=True)
class Scale:
    """The noise by which gains are judged: as stated, or from the sum of squares and its degrees of freedom."""

    known: bool
    stated: bool
    square: float
    freedom: int

    @property
    def unit(self) -> float:
        """The variance that gains have without effect."""
        return 1.0 if self.known or self.freedom < 1 else self.square / self.freedom

    def chance(self, gain: float, k: int) -> float:
        """Return the logarithm of the probability of a gain, which the sum of squares contains, of k unknowns."""
        if not gain > 0:
            return 0.0
        plain = float(log_chi2_tail(np.array(gain), k))
        if self.known:
            return plain
        rest = self.freedom - k
        if rest < 1:
            return 0.0
        scale = max((self.square - gain) / rest, 1e-15 * gain / k)
        log_chance = float(log_f_tail(np.array(gain / k / scale), k, rest))
        return max(log_chance, plain) if self.stated else log_chance

    def without(self, gain: float, k: int) -> Scale:
        """Return the noise once a gain is excluded."""
        return replace(self, square=max(self.square - gain, 0.0), freedom=self.freedom - k)


class Sequence:
    """The sequence of numbers that decrease the sum of squares most, each after those before.

    Several outliers hide each other in the scatter that they cause. Therefore the sequence is followed further than the
    first number that is not improbable, and all numbers up to the last improbable one are suspects (Rosner,
    Technometrics 25 (1983) 165: generalised extreme Studentised deviate). A suspect that is not improbable once all
    others are excluded is none.
    """

    def __init__(self, fit: Fit, numbers: Numbers, of_structure: float, limit: float) -> None:
        self.numbers, self.k, self.limit = numbers, numbers.k, limit
        # A noise that is itself an estimate makes outliers of valid readings where it is too small.
        stated = fit.problem.noise.stated and np.isinf(fit.problem.noise.freedom)
        self.noise = Scale(stated, stated, fit.chi2, fit.freedom)
        self.where = list[At]()
        gain = np.where(numbers.tested, numbers.gain, 0.0)
        consistent = stated and chdtrc(fit.freedom, fit.chi2) > CONTRADICTED
        if not gain.size or (consistent and self.noise.chance(float(gain.max()), self.k) >= limit):
            return
        unknowns = sum(block.start.size for block in fit.problem.unknowns)
        several = int(min(_TOGETHER, max(_SIZE / (unknowns * self.k), 1)))
        order = np.argsort(gain, axis=None)[::-1][:several]
        self.where = [(int(o) // gain.shape[1], int(o) % gain.shape[1]) for o in order if gain.flat[o] > 0]
        if not self.where:
            return
        self.u, self.N = reduced(fit, *numbers.columns(self.where))
        self.floor = MIN_REDUNDANCY * np.array([numbers.weight(at) for at in self.where])
        self.order = self._followed(min(len(self.where), max(fit.freedom // (4 * self.k), 1)))
        if stated:
            self.noise = replace(self.noise, known=self._as_stated(of_structure))

    def suspects(self) -> list[Suspect]:
        """Return the improbable numbers, each given the others, largest gain first."""
        if not self.where:
            return []
        noise, last = self.noise, 0
        for count, (_, gain) in enumerate(self.order, start=1):
            if noise.chance(gain, self.k) < self.limit:
                last = count
            noise = noise.without(gain, self.k)
        chosen = [j for j, _ in self.order[:last]]
        while chosen:
            chances = self._chances(chosen)
            worst = int(np.argmax(chances))
            if chances[worst] < self.limit:
                found = [self._given(j, [i for i in chosen if i != j]) for j in chosen]
                return sorted(found, key=lambda each: -each.gain)
            del chosen[worst]
        return []

    def _chances(self, chosen: list[int]) -> Array:
        """Return the logarithms of the probabilities of numbers, each given that the others are excluded.

        With ``a = N^-1 u`` of all of them and its covariance ``C = N^-1``, what the others leave of one is
        ``N' = C_jj^-1`` and ``u' = N' a_j``; the gain of the others is that of all without its own.
        """
        k = self.k
        at = (np.array(chosen)[:, None] * k + np.arange(k)).ravel()
        u, N = self.u[at], self.N[np.ix_(at, at)]
        values, vectors = np.linalg.eigh(N)
        if values[0] <= SINGULAR * values[-1]:
            return np.array([self._given(j, [i for i in chosen if i != j]).chance for j in chosen])
        C = (vectors / values) @ vectors.T
        a = C @ u
        each = np.arange(len(chosen))
        own = np.linalg.inv(C.reshape(len(chosen), k, len(chosen), k)[each, :, each])
        left = (own @ a.reshape(-1, k, 1))[..., 0]
        gains = solved(left, own, self.floor[chosen])[1]
        others = [self.noise.without(float(u @ a - gain), k * (len(chosen) - 1)) for gain in gains]
        return np.array([noise.chance(float(gain), k) for noise, gain in zip(others, gains, strict=True)])

    def _as_stated(self, of_structure: float) -> bool:
        """Return whether the readings without the sequence, or without one outlier or change, scatter as stated.

        Without the share a of the largest squares of k numbers, the expected sum of the others is smaller by
        ``F_(k+2)(q) / (1 - a)``, with the distribution function F of chi-square and ``F_k(q) = 1 - a``.
        """
        square, freedom = self.noise.square, self.noise.freedom
        rest = freedom - self.k * len(self.order)
        share = self.k * len(self.order) / freedom
        if rest < 1 or share >= 1:
            return True
        usual = chdtr(self.k + 2, chdtri(self.k, share)) / (1 - share)
        left = max(square - sum(gain for _, gain in self.order), 0.0) / usual
        other = max(square - max(of_structure, self.order[0][1]), 0.0)
        return bool(max(chdtrc(rest, left), chdtrc(freedom - self.k, other)) > CONTRADICTED)

    def _part(self, j: int) -> slice:
        return slice(j * self.k, (j + 1) * self.k)

    def _effects(self, u: Array, N: Array) -> tuple[Array, Array]:
        """Return sizes (K, k) and gains (K,) of all numbers."""
        count = len(self.where)
        own = N.reshape(count, self.k, count, self.k)[np.arange(count), :, np.arange(count)]
        size, gain, _ = solved(u.reshape(count, self.k), own, self.floor)
        return size, gain

    def _followed(self, count: int) -> list[tuple[int, float]]:
        """Return the first numbers of the sequence with their gains."""
        u, N = self.u, self.N
        steps = list[tuple[int, float]]()
        for _ in range(count):
            gain = self._effects(u, N)[1]
            gain[[j for j, _ in steps]] = 0.0
            j = int(np.argmax(gain))
            steps.append((j, float(gain[j])))
            u, N = swept(u, N, self._part(j))
        return steps

    def _given(self, j: int, others: list[int]) -> Suspect:
        """Return a number given that others are excluded, with its rivals."""
        u, N, noise = self.u, self.N, self.noise
        for i in others:
            part = self._part(i)
            noise = noise.without(float(solved(u[part], N[part, part])[1]), self.k)
            u, N = swept(u, N, part)
        size, gain = self._effects(u, N)
        gain[others] = 0.0
        its = float(gain[j])
        least = max(its - RIVAL * noise.without(its, self.k).unit, 0.0)
        rivals = tuple(self.where[i] for i in np.flatnonzero(gain > least) if i != j)
        error = self.numbers.root(self.where[j]) @ size[j] if self.numbers.whole else size[j]
        return Suspect(self.where[j], error, its, noise.chance(its, self.k), rivals)
