"""The errors of the axes of a machine from the errors of its tool at targets in the volume, by linear least squares.

The errors at the commanded position q are, to first order and with the chain of the machine,

    e = J(q) p(q) + G(q) d + F z

p are the error motions of every axis at its own position, and the errors of orientation between the axes; d the rigid
motions of the whole, in which the datum of a volume is free; z the sources that targets share, with a variance of 1.
An error motion is a series of Legendre polynomials (`errormotion.estimation.polynomials`), which starts with the first
order that is neither a motion of the whole nor a squareness: a constant error of an axis displaces and rotates all
that follows in the chain, and so does the slope of a straightness. Positioning and rotations start with order 1,
straightness with order 2. Error motions have therefore a mean of zero and straightness no slope; squareness is that of
the mean lines of the axes.

Squareness, the slope of positioning and d have no prior: the first is due to assembly, the second to scales and
temperature, the third to the set-up, and none of them to the smoothness of a guideway.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import chdtri

from errormotion.arrays import Array
from errormotion.estimation.evidence import eliminated
from errormotion.estimation.information import weights
from errormotion.estimation.low_rank import root_of
from errormotion.estimation.polynomials import ORDERS, Interval, estimated, rest_of
from errormotion.kinematics.iso import DOF, is_straightness
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import rigid_motions

__all__ = ["AxisErrors", "Targets", "Term", "Undetermined", "Volume", "fitted"]

SAME = 1e-6
"""Distance below which two positions of an axis are the same, m."""
INDEPENDENT_SHARE = 1e-6
"""Smallest independent share of a term that is distinguishable from the others."""
DECISIVE_ORDER = 3
"""Highest order of terms that can have the same effect as a first term."""
NO_EFFECT = 1e-9
"""Size of a term without an effect, relative to the largest."""
LIKE = 1e-3
"""Smallest weight of a term with the same effect that is named."""
FALSE_ALARM = 1e-3
"""Probability of residuals that increase the uncertainty."""
_BLOCK = 4096


@dataclass(frozen=True)
class Term:
    """One unknown: an error by its name in ISO 230-1, and the order of its polynomial; -1 for a squareness."""

    error: str
    order: int


@dataclass(frozen=True)
class Undetermined:
    """An error that the targets do not determine: the reason, and other errors with the same effect."""

    reason: str
    like: tuple[str, ...] = ()


@dataclass(frozen=True)
class Targets:
    """Errors of the tool at commanded positions.

    Attributes
    ----------
    position : ndarray, (m, axis)
        m.
    tool : ndarray, (m, 3)
        The functional point of each error with all axes at zero, m.
    error : ndarray, (m, d)
        Displacements (d = 3) or twists (d = 6), in any datum; NaN if unknown.
    own : ndarray, (m, d, d)
        Covariance that is independent from target to target.
    influence : ndarray, (source, m, d)
        Effect of one standard uncertainty of each source that targets share.
    """

    position: Array
    tool: Array
    error: Array
    own: Array
    influence: Array


@dataclass(frozen=True)
class Volume:
    """A machine, and the part of each of its linear axes over which error motions are stated.

    Attributes
    ----------
    machine : Machine
        Error motions are stated at its references.
    low, high : ndarray, (axis,)
        m.
    """

    machine: Machine
    low: Array
    high: Array

    @classmethod
    def of(cls, machine: Machine, position: Array) -> Volume:
        """Return the volume of targets at axis positions (m, axis), m."""
        return cls(machine, position.min(axis=0), position.max(axis=0))

    @property
    def motions(self) -> tuple[str, ...]:
        """Names of the error motions."""
        return self.machine.error_names[: 6 * len(self.machine.axis_names)]

    @property
    def locations(self) -> tuple[str, ...]:
        """Names of the errors of orientation, such as squareness."""
        return self.machine.error_names[6 * len(self.machine.axis_names) :]

    def axis(self, motion: str) -> int:
        """Return the number of the axis of an error motion."""
        return self.machine.axis_names.index(motion[2])

    def interval(self, axis: int) -> Interval:
        """Return the part of an axis, by its number."""
        return Interval(float(self.low[axis]), float(self.high[axis]))

    def inside(self, position: Array) -> NDArray[np.bool_]:
        """Return whether axis positions (m, axis) are in the volume, (m,)."""
        return np.asarray(((position >= self.low - SAME) & (position <= self.high + SAME)).all(axis=1), dtype=bool)

    def terms(self, order: int = ORDERS) -> list[Term]:
        """Return all terms up to an order, at least 2: squareness, displacements, then rotations."""
        terms = [Term(name, -1) for name in self.locations]
        for rotations in (False, True):
            for name in self.motions:
                if is_rotation(name) == rotations:
                    terms += [Term(name, n) for n in range(first_order(name), max(order, 2) + 1)]
        return terms

    def columns(self, terms: Sequence[Term], position: Array, tool: Array, freedoms: int = 3) -> Array:
        """Return the effect of one unit of each term, (m, freedoms, term), at positions (m, axis) with tools (m, 3)."""
        highest = max(term.order for term in terms)
        P = Interval(self.low, self.high).polynomials(position, highest)
        J = np.empty((len(position), freedoms, len(self.machine.error_names)))
        axes = position.shape[1]
        for point in np.unique(tool, axis=0):
            chosen = (tool == point).all(axis=1)
            # Levers are linear in the positions of linear axes: J(q) = J(0) + sum_k q_k (J(e_k) - J(0))
            first, *others = self.machine.jacobian(np.vstack([np.zeros(axes), np.eye(axes)]), point)[:, :freedoms]
            J[chosen] = first + np.tensordot(position[chosen], np.array(others) - first, axes=1)
        index = [self.machine.error_names.index(term.error) for term in terms]
        axis = [0 if term.order < 0 else self.axis(term.error) for term in terms]
        value = np.where([term.order < 0 for term in terms], 1.0, P[:, axis, [max(term.order, 0) for term in terms]])
        columns = np.take(J, index, axis=2)
        columns *= value[:, None, :]
        return columns

    def wholes(self, position: Array, tool: Array, centre: Array, freedoms: int = 3) -> Array:
        """Return the effect of motions of the whole about ``centre``, (m, freedoms, 6).

        With six freedoms also that of rotations of the tool, (m, 6, 9).
        """
        G = rigid_motions(self.points(position, tool), centre)
        if freedoms == 3:
            return G
        wholes = np.zeros((len(G), 6, 9))
        wholes[:, :3, :6], wholes[:, 3:, 3:6], wholes[:, 3:, 6:] = G, np.eye(3), np.eye(3)
        return wholes

    def points(self, position: Array, tool: Array) -> Array:
        """Return the commanded points of the tool in the workpiece frame, (m, 3), m."""
        directions = self.machine.nominal_pose(np.eye(position.shape[1])).apply(np.zeros(3))  # of linear axes
        return np.asarray(position @ directions + tool)


def first_order(motion: str) -> int:
    """Return the lowest distinguishable order of an error motion: 2 for straightness, else 1."""
    return 2 if is_straightness(DOF.index(motion[:2]), motion[2]) else 1


def is_rotation(motion: str) -> bool:
    """Return whether an error motion is a rotation."""
    return DOF.index(motion[:2]) >= 3


def has_prior(term: Term) -> bool:
    """Return whether a term has a prior: not squareness, nor the slope of positioning."""
    return term.order >= 0 and (term.order > 1 or is_rotation(term.error))


@dataclass(frozen=True)
class AxisErrors:
    """Errors of the axes.

    Attributes
    ----------
    volume : Volume
    terms : list of Term
        Of ``coefficient``.
    coefficient, covariance : ndarray, (term,), (term, term)
        m, rad.
    shared : ndarray, (term, source)
        Effect of the sources of the targets; ``covariance`` contains it.
    rest : mapping of str to ndarray, (order,)
        Variances of the coefficients of each error motion above the fitted orders.
    determined : ndarray, (term,)
        Degree to which the targets determine each, from 0 (by its prior only) to 1.
    undetermined : mapping of str to Undetermined
        Errors that the targets do not determine; they have no terms.
    exponent : float
        Of the prior, mean.
    sigma0 : float
        Rms of the residuals over the expected one: 1 if the axes explain the errors.
    factor : float
        By which the variance was increased, since the residuals contradict the uncertainty of the targets.
    freedom : float
        Number of values minus determined parameters.
    datum : ndarray, (6, term)
        Motion of the whole, about ``centre`` (3,), that is the best fit to the displacements by each term.
    """

    volume: Volume
    terms: list[Term]
    coefficient: Array
    covariance: Array = field(repr=False)
    shared: Array = field(repr=False)
    rest: Mapping[str, Array] = field(repr=False)
    determined: Array
    undetermined: Mapping[str, Undetermined]
    exponent: float
    sigma0: float
    factor: float
    freedom: float
    datum: Array = field(repr=False)
    centre: Array = field(repr=False)

    @property
    def orders(self) -> dict[str, int]:
        """Highest order of every error motion that is determined by the targets rather than the prior, or 0."""
        orders: dict[str, int] = {}
        for term, share in zip(self.terms, self.determined, strict=True):
            if term.order >= 0:
                orders[term.error] = max(orders.get(term.error, 0), term.order if share > 0.5 else 0)
        return orders

    @property
    def root(self) -> Array:
        """Square root (term, part) of the covariance without the sources."""
        return root_of(self.covariance - self.shared @ self.shared.T, unit=np.sqrt(np.diag(self.covariance)))

    def distinguished(self, error: str) -> bool:
        """Return whether the targets determine an error alone, and not only together with others of the same effect."""
        return error not in self.undetermined and all(error not in each.like for each in self.undetermined.values())

    def design(self, motion: str, position: Array) -> Array:
        """Return the derivative of an error motion at axis positions (k,) by the coefficients, (k, term)."""
        index = [k for k, term in enumerate(self.terms) if term.error == motion]
        design = np.zeros((len(position), len(self.terms)))
        if index:
            orders = [self.terms[k].order for k in index]
            interval = self.volume.interval(self.volume.axis(motion))
            design[:, index] = interval.polynomials(position, max(orders))[:, orders]
        return design

    def rest_at(self, motion: str, position: Array) -> Array:
        """Return the variance (k,) of an error motion by its orders above the fitted ones."""
        return self.volume.interval(self.volume.axis(motion)).rest(position, self.rest[motion])

    def curve(self, motion: str, position: Array) -> tuple[Array, Array]:
        """Return an error motion and its standard uncertainty at axis positions (k,); NaN if it is not determined."""
        q = np.asarray(position, dtype=float)
        S, axis = self.design(motion, q), self.volume.axis(motion)
        if not S.any():
            return np.full(q.shape, np.nan), np.full(q.shape, np.nan)
        inside = (q >= self.volume.low[axis] - SAME) & (q <= self.volume.high[axis] + SAME)
        variance = np.einsum("ka,ka->k", S @ self.covariance, S) + self.rest_at(motion, q)
        value = np.where(inside, S @ self.coefficient, np.nan)
        return value, np.where(inside, np.sqrt(np.maximum(variance, 0.0)), np.nan)

    def locations(self) -> dict[str, tuple[float, float]]:
        """Return each error of orientation and its standard uncertainty, rad; NaN if it is not determined."""
        values = dict.fromkeys(self.volume.locations, (float("nan"), float("nan")))
        for k, term in enumerate(self.terms):
            if term.order < 0:
                values[term.error] = float(self.coefficient[k]), float(np.sqrt(self.covariance[k, k]))
        return values


def fitted(volume: Volume, targets: Targets, order: int = ORDERS) -> AxisErrors:
    """Return the errors of the axes from those of the tool at targets.

    The noise of the targets is increased if the residuals contradict it. Their sum of squares over the noise,
    ``r' D^-1 r + z' z``, has the expectation n - sum(determined) for curves that follow the prior.
    """
    terms = volume.terms(order)
    centre = volume.points(targets.position, targets.tool).mean(axis=0)
    N, b, square, count, datum = _normal_equations(volume, terms, targets, centre)
    s = len(targets.influence)
    nuisance = len(N) - len(terms) - s
    levels = [len(np.unique(np.round(column / SAME))) for column in targets.position.T]
    undetermined = _undetermined(volume, terms, levels, N, nuisance)
    kept = [k for k, term in enumerate(terms) if term.error not in undetermined]
    S = kept + list(range(len(terms), len(N)))
    terms, datum, n = [terms[k] for k in kept], datum[:, kept], len(kept)
    N, b, square, gain = eliminated(N[np.ix_(S, S)], b[S], square, s)
    motions = list(dict.fromkeys(term.error for term in terms if has_prior(term)))
    group, orders = np.full(len(N), -1, dtype=np.intp), np.zeros(len(N))
    group[:n] = [motions.index(term.error) if has_prior(term) else -1 for term in terms]
    orders[:n] = [term.order for term in terms]
    estimate = estimated(N, b, group, orders, np.array([is_rotation(name) for name in motions], dtype=np.intp))
    residual = square - 2 * float(b @ estimate.value) + float(estimate.value @ N @ estimate.value)
    freedom = count - float(estimate.determined.sum())
    ratio = max(residual, 0.0) / max(freedom, 1.0)
    factor = ratio if freedom > 0 and residual > chdtri(freedom, FALSE_ALARM) else 1.0
    of_sources = estimate.within @ gain
    shared = of_sources @ of_sources.T
    covariance = factor * (estimate.covariance - shared) + shared
    rest = rest_of(estimate, max(order, 2))
    return AxisErrors(
        volume, terms, estimate.value[:n], covariance[:n, :n], of_sources[:n],
        dict(zip(motions, rest, strict=True)), estimate.determined[:n], undetermined, estimate.exponent,
        float(np.sqrt(ratio)), factor, freedom, datum, centre,
    )  # fmt: skip


def _normal_equations(
    volume: Volume, terms: list[Term], targets: Targets, centre: Array
) -> tuple[Array, Array, float, int, Array]:
    """Return N, b and y' W y over terms, motions of the whole, and shared sources, which have a prior of 1.

    Also return the number of known values, and the motion of the whole that is the best fit to the displacements of
    each term at the targets with known displacements, (6, term).
    """
    d, n, s = targets.error.shape[1], len(terms), len(targets.influence)
    has_rotations = d == 6 and bool(np.isfinite(targets.error[:, 3:]).any())
    size, count = n + (9 if has_rotations else 6) + s, 0
    N, b, square = np.zeros((size, size)), np.zeros(size), 0.0
    GG, GA = np.zeros((6, 6)), np.zeros((6, n))
    use = 6 if has_rotations else 3
    for first in range(0, len(targets.position), _BLOCK):
        part = slice(first, first + _BLOCK)
        q, tool, y = targets.position[part], targets.tool[part], targets.error[part, :use]
        G, F = volume.wholes(q, tool, centre, use), targets.influence[:, part, :use].transpose(1, 2, 0)
        A = np.concatenate([volume.columns(terms, q, tool, use), G, F], axis=2)
        W, known = weights(y, targets.own[part, :use, :use], targets.influence[:, part, :use])
        placed = known[:, :3].all(axis=1)
        G = G[placed, :3, :6].reshape(-1, 6)
        GG += G.T @ G
        GA += G.T @ A[placed, :3, :n].reshape(-1, n)
        # W = H' H, by which the independent covariance of each target is whitened; 0 for unknown values
        H = np.swapaxes(np.linalg.cholesky(np.where(known[:, :, None] & known[:, None], W, np.eye(use))), 1, 2)
        H = H * known[:, None]
        A[~known], y = 0.0, np.where(known, y, 0.0)
        A = np.matmul(H, A).reshape(-1, size)
        y = np.matmul(H, y[:, :, None]).ravel()
        N += A.T @ A
        b += A.T @ y
        square, count = square + float(y @ y), count + int(known.sum())
    N[size - s :, size - s :] += np.eye(s)
    return N, b, square, count, np.asarray(np.linalg.lstsq(GG, GA)[0])


def _undetermined(
    volume: Volume, terms: list[Term], levels: list[int], N: Array, nuisance: int
) -> dict[str, Undetermined]:
    """Return errors without effect on the tool, or not distinguishable from earlier ones, by the first term.

    ``levels`` are the numbers of positions of the axes. With a lever along the axis, a first term of order 2 has the
    order 3, so that terms of higher order have other effects.
    """
    names = volume.machine.axis_names
    size = np.sqrt(np.diag(N))
    reference = size[: len(terms)].max()
    unit = np.where(size > 0, size, 1.0)
    R = N / np.outer(unit, unit)
    accepted = list(range(len(terms), len(terms) + nuisance))
    undetermined: dict[str, Undetermined] = {}
    for k, term in enumerate(terms):
        name = term.error
        axes = {names.index(letter) for letter in (name[2], name[3:]) if letter in names}
        few = [names[i] for i in axes if levels[i] < (2 if term.order < 0 else first_order(name) + 1)]
        if term.order > DECISIVE_ORDER:
            continue
        if name in undetermined or (term.order >= 0 and term.order >= levels[volume.axis(name)]):
            if few and name not in undetermined:
                undetermined[name] = Undetermined(f"too few positions of {few[0]}")
            continue
        if few:
            undetermined[name] = Undetermined(f"too few positions of {few[0]}")
        elif size[k] < NO_EFFECT * reference:
            if term.order <= first_order(name):
                undetermined[name] = Undetermined("no effect on the reflector")
        else:
            others = linalg.solve(R[np.ix_(accepted, accepted)], R[accepted, k], assume_a="sym")
            if 1.0 - float(R[accepted, k] @ others) > INDEPENDENT_SHARE:
                accepted.append(k)
            elif term.order <= first_order(name):
                undetermined[name] = _same_effect(terms, accepted, others)
    return undetermined


def _same_effect(terms: list[Term], accepted: list[int], weight: Array) -> Undetermined:
    """Return the reason for an error whose effect is the sum of those of others with these weights."""
    parts: dict[str, float] = {}
    for i, share in zip(accepted, weight, strict=True):
        if i < len(terms):
            parts[terms[i].error] = parts.get(terms[i].error, 0.0) + abs(float(share))
    like = tuple(name for name, part in parts.items() if part > LIKE)
    return Undetermined(f"not distinguishable from {' and '.join(like) or 'a shift'}", like)
