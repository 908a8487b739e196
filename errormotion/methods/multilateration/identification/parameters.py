"""The 21 errors of a three-axis machine from the errors of targets, by linear least squares on its chain.

Displacements of the reflector are linear in the errors (`errormotion.kinematics.machines`). Every error motion is a
series of Legendre polynomials over the measured part of its axis, starting with the first term that is distinguishable:

* the six rigid motions of the whole are those of the datum: they are estimated as well, and returned;
* constants of error motions and slopes of straightness are motions of the whole or squareness, so error motions have a
  mean of zero, straightness has no slope, and squareness is that of the mean lines of the axes;
* errors without effect on any reflector, or with the same effect as others, are not determined. With one reflector
  these are the rotations of the axis that carries it, and of others with a constant lever.

The number of terms of an error motion follows from the evidence: the coefficient of order k has the prior standard
deviation tau / k^p, with the tau of each error motion and the common p of largest marginal likelihood
(`errormotion.estimation.evidence`). Terms that the targets do not determine keep their prior, so that possible
errors between the targets are included in the uncertainty. Squareness and the slope of positioning have no prior.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import chdtri

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.evidence import Posterior, maximum_evidence
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import cross_matrix

AXES = ("X", "Y", "Z")
INDEPENDENT_SHARE = 1e-6
"""Smallest independent share of a term that is distinguishable from the others."""
FALSE_ALARM = 1e-3
"""Probability of a note on axes that explain the targets' errors."""
EXPONENTS = (1.0, 2.0, 3.0, 4.0)
"""Possible exponents p of the prior, by which coefficients decrease with their order."""
_POOLED = 1.0
"""Weight, in terms, of the other error motions of the same kind in the size of one."""
_BLOCK = 4096


@dataclass(frozen=True)
class Undetermined:
    """An error that the targets do not determine: the reason, and other errors with the same effect."""

    reason: str
    like: tuple[str, ...] = ()


@dataclass(frozen=True)
class Term:
    """One unknown: an error and the order of its polynomial; -1 for a squareness."""

    error: str
    order: int


@dataclass(frozen=True)
class Chain:
    """A three-axis machine, the position of its reflectors, and the measured part of its axes.

    Attributes
    ----------
    machine : Machine
        Error motions stated at ``reference``.
    reference : ndarray (3,)
        Mean position of the reflectors with all axes at zero, m.
    low, high : ndarray (3,)
        Of the axis positions, m.
    """

    machine: Machine
    reference: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, chain: str, position: Array, reflector: Array) -> Chain:
        """Return the chain of a machine with targets at ``position`` (m, 3) and reflectors at ``reflector`` (m, 3), m.

        Raises
        ------
        MethodError
            Not a chain, or other axes than X, Y and Z.
        """
        reference = np.asarray(reflector, dtype=float).mean(axis=0)
        try:
            machine = Machine(chain, dict.fromkeys(AXES, reference))
        except ValueError as error:
            raise MethodError(f"Chain of the machine: {error}") from error
        if machine.axis_names != AXES:
            raise MethodError(
                f"Parametric errors: expected a machine with the axes X, Y and Z; found {', '.join(machine.axis_names)}"
            )
        return cls(machine, reference, position.min(axis=0), position.max(axis=0))

    def polynomials(self, position: Array, order: int) -> Array:
        """Return the Legendre polynomials (m, 3, order + 1) of the axis positions (m, 3), m."""
        half = np.where(self.high > self.low, (self.high - self.low) / 2, 1.0)
        return np.asarray(legendre.legvander((position - (self.low + self.high) / 2) / half, order))

    def columns(self, terms: list[Term], position: Array, reflector: Array, dofs: int = 3) -> Array:
        """Return the effect of one unit of each term, (m, dofs, term): displacements, and with 6 dofs rotations."""
        P = self.polynomials(position, max(term.order for term in terms))
        J = np.empty((len(position), dofs, len(self.machine.error_names)))
        for point in np.unique(reflector, axis=0):
            chosen = (reflector == point).all(axis=1)
            J[chosen] = self.machine.jacobian(position[chosen], point)[:, :dofs]
        index = [self.machine.error_names.index(term.error) for term in terms]
        value = [
            np.ones(len(position)) if term.order < 0 else P[:, AXES.index(term.error[2]), term.order] for term in terms
        ]
        return np.asarray(J[:, :, index] * np.array(value).T[:, None, :])

    def motions(self, point: Array, centre: Array) -> Array:
        """Return the displacements of points (m, 3) by the six rigid motions, (m, 3, 6)."""
        eye = np.broadcast_to(np.eye(3), (len(point), 3, 3))
        return np.concatenate([eye, -cross_matrix(point - centre)], axis=2)


@dataclass(frozen=True)
class Parametric:
    """Errors of the axes.

    Attributes
    ----------
    chain : Chain
    terms : list of Term
        Of ``coefficient``.
    coefficient, covariance : ndarray (term,), (term, term)
        m, rad; squareness rad.
    determined : ndarray (term,)
        Degree to which the targets determine each, from 0 (by its prior only) to 1.
    undetermined : mapping of str to Undetermined
        Errors that the targets do not determine.
    sigma0 : float
        Rms of the residuals over the expected one: 1 if the axes explain the errors.
    freedom : float
        Number of values minus determined parameters.
    datum : ndarray (6, term)
        Rigid motion, about ``centre`` (3,), to subtract from the displacements of each term, so that those of the
        measured targets have none.
    """

    chain: Chain
    terms: list[Term]
    coefficient: Array
    covariance: Array = field(repr=False)
    determined: Array
    undetermined: dict[str, Undetermined]
    sigma0: float
    freedom: float
    datum: Array = field(repr=False)
    centre: Array = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def orders(self) -> dict[str, int]:
        """Highest order of every error motion that is determined by the targets rather than the prior, or 0."""
        orders: dict[str, int] = {}
        for term, share in zip(self.terms, self.determined, strict=True):
            if term.order >= 0:
                orders[term.error] = max(orders.get(term.error, 0), term.order if share > 0.5 else 0)
        return orders

    def curve(self, error: str, position: Array) -> tuple[Array, Array]:
        """Return an error motion and its standard uncertainty at axis positions (k,); NaN if it is not determined."""
        q = np.asarray(position, dtype=float)
        index = [k for k, term in enumerate(self.terms) if term.error == error]
        if not index:
            return np.full(q.shape, np.nan), np.full(q.shape, np.nan)
        axis = AXES.index(error[2])
        P = self.chain.polynomials(np.repeat(q[:, None], 3, axis=1), max(self.terms[k].order for k in index))
        B = P[:, axis, [self.terms[k].order for k in index]]
        inside = (q >= self.chain.low[axis] - 1e-9) & (q <= self.chain.high[axis] + 1e-9)
        variance = np.einsum("ka,ab,kb->k", B, self.covariance[np.ix_(index, index)], B)
        value = np.where(inside, B @ self.coefficient[index], np.nan)
        return value, np.where(inside, np.sqrt(np.maximum(variance, 0.0)), np.nan)

    def squareness(self) -> dict[str, tuple[float, float]]:
        """Return each squareness and its standard uncertainty, rad; NaN if it is not determined."""
        values = dict.fromkeys(self.chain.machine.error_names[18:], (float("nan"), float("nan")))
        for k, term in enumerate(self.terms):
            if term.order < 0:
                values[term.error] = float(self.coefficient[k]), float(np.sqrt(self.covariance[k, k]))
        return values


def fit_machine(
    chain: str,
    position: Array,
    error: Array,
    own: Array,
    influence: Array,
    *,
    reflector: Array | None = None,
    max_order: int = 8,
) -> Parametric:
    """Estimate the errors of the axes from displacements at targets.

    Parameters
    ----------
    chain : str
        Such as ``workpiece-X-Y-bed-Z-spindle-tool``.
    position : ndarray (m, 3)
        Commanded axis positions, m.
    error : ndarray (m, 3)
        Displacements in any datum, m; NaN if unknown.
    own : ndarray (m, 3, 3)
        Independent covariance of each target, m^2.
    influence : ndarray (source, m, 3)
        Effect of one standard uncertainty of each shared source, m.
    reflector : ndarray (m, 3), optional
        Position of the reflector of each target with all axes at zero, m; default: the origin.
    max_order : int
        Of the polynomials.

    Raises
    ------
    MethodError
        Not a chain of X, Y and Z; too few known targets.
    """
    known = np.isfinite(error).all(axis=1) & np.isfinite(own).all(axis=(1, 2))
    if np.count_nonzero(known) < 10:
        raise MethodError(
            f"Parametric errors: expected at least ten known targets; found {np.count_nonzero(known)}. Measure more."
        )
    at = np.zeros_like(position) if reflector is None else reflector
    which = np.flatnonzero(known)
    position, error, at = position[which], error[which], at[which]
    model = Chain.of(chain, position, at)
    terms = unknowns(model, max_order)
    levels = [len(np.unique(np.round(column, 6))) for column in position.T]
    centre = (position + at).mean(axis=0)
    N, b, square, datum = _normal_equations(model, terms, position, at, centre, error, own, influence, which)
    undetermined = _undetermined(terms, levels, N, len(N) - len(terms))
    kept = [k for k, term in enumerate(terms) if term.error not in undetermined]
    S = kept + list(range(len(terms), len(N)))
    terms, datum = [terms[k] for k in kept], datum[:, kept]
    N, b = N[np.ix_(S, S)], b[S]
    found, n = _estimate(terms, N, b), len(terms)
    x, determined = found.value, found.determined[:n]
    of_sources = x[len(x) - len(influence) :]
    residual = max(square - 2 * float(b @ x) + float(x @ N @ x), float(of_sources @ of_sources))
    freedom = 3 * len(position) - 6 - float(determined.sum())
    ratio = residual / max(freedom, 1.0)
    scale, notes = 1.0, []
    if freedom > 0 and residual > chdtri(freedom, FALSE_ALARM):
        scale = ratio
        notes.append(
            f"The residuals of the targets' errors after the errors of the axes are {np.sqrt(ratio):.3g} times their "
            "uncertainty. Possible causes: a machine that is not rigid, hysteresis, or error motions of higher order "
            f"than {max_order}. The uncertainties of the axes are increased accordingly."
        )
    return Parametric(
        model, terms, x[:n], scale * found.covariance[:n, :n], determined, undetermined,
        float(np.sqrt(ratio)), freedom, datum, centre, tuple(notes),
    )  # fmt: skip


def first_order(error: str) -> int:
    """Return the lowest distinguishable order of an error motion: 2 for straightness, else 1."""
    freedom, axis = DOF.index(error[:2]), AXES.index(error[2])
    return 2 if freedom < 3 and freedom != axis else 1


def unknowns(model: Chain, max_order: int) -> list[Term]:
    """Return all terms: squareness, displacements, then rotations."""
    terms = [Term(name, -1) for name in model.machine.error_names[18:]]
    motions = model.machine.error_names[:18]
    for rotations in (False, True):
        for name in motions:
            if (DOF.index(name[:2]) >= 3) == rotations:
                terms += [Term(name, order) for order in range(first_order(name), max(max_order, 2) + 1)]
    return terms


def _normal_equations(
    model: Chain, terms: list[Term], position: Array, reflector: Array, centre: Array, error: Array, own: Array,
    influence: Array, which: NDArray[np.intp],
) -> tuple[Array, Array, float, Array]:  # fmt: skip
    """Return N, b and y' W y over terms, six rigid motions, and the shared sources, which have a prior of 1.

    Also return the rigid motion that is the best fit to the displacements of each term, (6, term). ``own`` and
    ``influence`` are those of all targets, the other arrays those of the targets ``which``.
    """
    size = len(terms) + 6 + len(influence)
    N, b, square = np.zeros((size, size)), np.zeros(size), 0.0
    GG, GA = np.zeros((6, 6)), np.zeros((6, len(terms)))
    for first in range(0, len(position), _BLOCK):
        part = slice(first, first + _BLOCK)
        q, at = position[part], reflector[part]
        G, shared = model.motions(q + at, centre), influence[:, which[part]].transpose(1, 2, 0)
        A = np.concatenate([model.columns(terms, q, at), G, shared], axis=2)
        G = G.reshape(-1, 6)
        GG += G.T @ G
        GA += G.T @ A.reshape(-1, size)[:, : len(terms)]
        # whitened by the independent covariance of each target
        W = np.linalg.inv(np.linalg.cholesky(own[which[part]]))
        A = np.matmul(W, A).reshape(-1, size)
        y = np.matmul(W, error[part][:, :, None]).ravel()
        N += A.T @ A
        b += A.T @ y
        square += float(y @ y)
    N[len(terms) + 6 :, len(terms) + 6 :] += np.eye(len(influence))
    return N, b, square, np.asarray(np.linalg.lstsq(GG, GA)[0])


def _undetermined(terms: list[Term], levels: list[int], N: Array, nuisance: int) -> dict[str, Undetermined]:
    """Return errors without effect on the reflectors, or not distinguishable from earlier ones, by the first term.

    ``levels`` are the numbers of positions of the axes.
    """
    size = np.sqrt(np.diag(N))
    reference = size[: len(terms)].max()
    unit = np.where(size > 0, size, 1.0)
    R = N / np.outer(unit, unit)
    accepted = list(range(len(terms), len(terms) + min(nuisance, 6)))
    undetermined: dict[str, Undetermined] = {}
    for k, term in enumerate(terms):
        name = term.error
        axes = {AXES.index(letter) for letter in (name[2], name[3:]) if letter in AXES}
        few = [AXES[i] for i in axes if levels[i] < (2 if term.order < 0 else first_order(name) + 1)]
        if name in undetermined or (term.order >= 0 and term.order >= levels[AXES.index(name[2])]):
            if few and name not in undetermined:
                undetermined[name] = Undetermined(f"too few positions of {few[0]}")
            continue
        if few:
            undetermined[name] = Undetermined(f"too few positions of {few[0]}")
        elif size[k] < 1e-9 * reference:
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
    like = tuple(name for name, part in parts.items() if part > 1e-3)
    return Undetermined(f"not distinguishable from {' and '.join(like) or 'a shift'}", like)


def _estimate(terms: list[Term], N: Array, b: Array) -> Posterior:
    """Return the coefficients of the terms and of the nuisance parameters after them, for the priors of most evidence.

    Squareness and the slope of positioning have no prior.
    """
    free = [term.order >= 0 and (term.order > 1 or term.error[1] != term.error[2]) for term in terms]
    names = list(dict.fromkeys(term.error for term, penalised in zip(terms, free, strict=True) if penalised))
    group = np.full(len(N), -1, dtype=np.intp)
    group[: len(terms)] = [names.index(t.error) if penalised else -1 for t, penalised in zip(terms, free, strict=True)]
    order = np.zeros(len(N))
    order[: len(terms)] = [term.order for term in terms]
    kind = np.array([DOF.index(name[:2]) >= 3 for name in names], dtype=np.intp)  # displacements, rotations
    return maximum_evidence(N, b, group, order, exponents=EXPONENTS, kind=kind, pooled=_POOLED)
