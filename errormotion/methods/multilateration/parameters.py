"""The 21 errors of a three-axis machine from the errors of targets, by linear least squares on its chain.

Displacements of the reflector are linear in the errors (`errormotion.kinematics.machines`). Every error motion is a
series of Legendre polynomials over the measured part of its axis, from the first term that is not another's:

* six motions of the whole are the datum's and belong to no axis: they are estimated beside, and given back;
* constants of error motions and slopes of straightness are motions of the whole or squareness, so error motions have a
  mean of zero, straightness no slope, and squareness is that of the axes' mean lines;
* what an error does to no reflector, or nothing but what others do, is not seen. With one reflector these are the
  rotations of the axis that carries it, and of others whose lever never changes across.

How many terms each error motion has is decided by the Bayesian information criterion, term by term.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy import linalg, stats

from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import cross_matrix

Array = NDArray[np.float64]

AXES = ("X", "Y", "Z")
UNSEEN = 1e-6
"""A term of which less than this share is its own is not told from the others."""
FALSE_ALARM = 1e-3
_BLOCK = 4096


@dataclass(frozen=True)
class Term:
    """One unknown: an error and the order of its polynomial; -1 for a squareness, which is one number."""

    error: str
    order: int


@dataclass(frozen=True)
class Chain:
    """A three-axis machine, where its reflectors are, and the measured part of its axes.

    Attributes
    ----------
    machine : Machine
        Error motions stated at ``reference``.
    reference : ndarray (3,)
        Mean of the reflectors' places with all axes at zero, m.
    low, high : ndarray (3,)
        Of the axis positions, m.
    """

    machine: Machine
    reference: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, chain: str, position: Array, reflector: Array) -> Chain:
        """Return the chain of a machine with targets at ``position`` (m, 3) seen at ``reflector`` (m, 3), m.

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
        """Return what one unit of each term does, (m, dofs, term): displacements, with 6 dofs rotations too."""
        P = self.polynomials(position, max(term.order for term in terms))
        J = np.empty((len(position), dofs, len(self.machine.error_names)))
        for at in np.unique(reflector, axis=0):
            chosen = (reflector == at).all(axis=1)
            J[chosen] = self.machine.jacobian(position[chosen], at)[:, :dofs]
        index = [self.machine.error_names.index(term.error) for term in terms]
        value = [
            np.ones(len(position)) if term.order < 0 else P[:, AXES.index(term.error[2]), term.order] for term in terms
        ]
        return np.asarray(J[:, :, index] * np.array(value).T[:, None, :])

    def motions(self, place: Array, centre: Array) -> Array:
        """Return what the six motions of the whole do, (m, 3, 6)."""
        eye = np.broadcast_to(np.eye(3), (len(place), 3, 3))
        return np.concatenate([eye, -cross_matrix(place - centre)], axis=2)


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
    unseen : mapping of str to str
        Error that the targets do not determine, to why.
    sigma0 : float
        Root mean square of what is left over what was expected: 1 where the axes explain the errors.
    freedom : int
    datum : ndarray (6, term)
        What has to be taken off the displacements of each term, so that the measured targets have no motion with the
        whole; about ``centre`` (3,).
    """

    chain: Chain
    terms: list[Term]
    coefficient: Array
    covariance: Array = field(repr=False)
    unseen: dict[str, str]
    sigma0: float
    freedom: int
    datum: Array = field(repr=False)
    centre: Array = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def orders(self) -> dict[str, int]:
        """Highest order of every error motion that is seen; squareness is not among them."""
        found: dict[str, int] = {}
        for term in self.terms:
            if term.order >= 0:
                found[term.error] = max(found.get(term.error, 0), term.order)
        return found

    def curve(self, error: str, position: Array) -> tuple[Array, Array]:
        """Return an error motion and its standard uncertainty at axis positions (k,); NaN where it is not seen."""
        q = np.asarray(position, dtype=float)
        mine = [k for k, term in enumerate(self.terms) if term.error == error]
        if not mine:
            return np.full(q.shape, np.nan), np.full(q.shape, np.nan)
        axis = AXES.index(error[2])
        P = self.chain.polynomials(np.repeat(q[:, None], 3, axis=1), max(self.terms[k].order for k in mine))
        B = P[:, axis, [self.terms[k].order for k in mine]]
        inside = (q >= self.chain.low[axis] - 1e-9) & (q <= self.chain.high[axis] + 1e-9)
        variance = np.einsum("ka,ab,kb->k", B, self.covariance[np.ix_(mine, mine)], B)
        value = np.where(inside, B @ self.coefficient[mine], np.nan)
        return value, np.where(inside, np.sqrt(np.maximum(variance, 0.0)), np.nan)

    def squareness(self) -> dict[str, tuple[float, float]]:
        """Return each squareness and its standard uncertainty, rad; NaN where it is not seen."""
        found = dict.fromkeys(self.chain.machine.error_names[18:], (float("nan"), float("nan")))
        for k, term in enumerate(self.terms):
            if term.order < 0:
                found[term.error] = float(self.coefficient[k]), float(np.sqrt(self.covariance[k, k]))
        return found


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
        Displacements in any datum, m; NaN where not known.
    own : ndarray (m, 3, 3)
        Covariance of each target for itself, m^2.
    influence : ndarray (source, m, 3)
        What one standard uncertainty of each shared source does, m.
    reflector : ndarray (m, 3), optional
        Where the reflector of each target is with all axes at zero, m; the origin where not given.
    max_order : int
        Of the polynomials; no more than the positions of an axis allow.

    Raises
    ------
    MethodError
        Not a chain of X, Y and Z; targets that leave even squareness and the lowest terms open.
    """
    known = np.isfinite(error).all(axis=1) & np.isfinite(own).all(axis=(1, 2))
    if np.count_nonzero(known) < 10:
        raise MethodError(
            f"Parametric errors: expected at least ten known targets; found {np.count_nonzero(known)}. Measure more."
        )
    at = np.zeros_like(position) if reflector is None else reflector
    position, error, own, at, influence = position[known], error[known], own[known], at[known], influence[:, known]
    model = Chain.of(chain, position, at)
    terms = _candidates(model, position, max_order)
    place = position + at
    centre = place.mean(axis=0)
    N, b, square = _normal_equations(model, terms, position, at, centre, error, own, influence)
    nuisance = list(range(len(terms), len(N)))
    seen, unseen = _seen(model, terms, N, nuisance)
    chosen, notes = _choose(terms, seen, N, b, nuisance, 3 * len(position))
    S = chosen + nuisance
    C = linalg.inv(N[np.ix_(S, S)])
    x = C @ b[S]
    freedom = 3 * len(position) - 6 - len(chosen)
    ratio = max(float(square - b[S] @ x), 0.0) / max(freedom, 1)
    scale = 1.0
    if freedom > 0 and ratio * freedom > stats.chi2.ppf(1 - FALSE_ALARM, freedom):
        scale = ratio
        notes.append(
            f"Errors of the axes leave {np.sqrt(ratio):.3g} times as much of the targets' errors as their uncertainty "
            "explains: a machine that is not rigid, hysteresis, or error motions of higher order than "
            f"{max_order}. The uncertainties of the axes are raised to match."
        )
    k = len(chosen)
    kept = [terms[i] for i in chosen]
    A = model.columns(kept, position, at)
    G = model.motions(place, centre)
    GG = np.einsum("mai,maj->ij", G, G)
    datum = np.linalg.lstsq(GG, np.einsum("mai,mat->it", G, A))[0]
    return Parametric(
        model, kept, x[:k], scale * C[:k, :k], unseen, float(np.sqrt(ratio)), freedom, datum, centre, tuple(notes)
    )


def first_order(error: str) -> int:
    """Return the lowest order of an error motion that belongs to it alone: 2 for straightness, else 1."""
    freedom, axis = DOF.index(error[:2]), AXES.index(error[2])
    return 2 if freedom < 3 and freedom != axis else 1


def _candidates(model: Chain, position: Array, max_order: int) -> list[Term]:
    """Return all terms that the positions of each axis allow: squareness, displacements, then rotations."""
    levels = [len(np.unique(np.round(column, 6))) for column in position.T]
    terms = [Term(name, -1) for name in model.machine.error_names[18:]]
    motions = model.machine.error_names[:18]
    for rotations in (False, True):
        for name in motions:
            if (DOF.index(name[:2]) >= 3) != rotations:
                continue
            top = min(max_order, levels[AXES.index(name[2])] - 1)
            terms += [Term(name, order) for order in range(first_order(name), top + 1)]
    return terms


def _normal_equations(
    model: Chain, terms: list[Term], position: Array, reflector: Array, centre: Array, error: Array, own: Array,
    influence: Array,
) -> tuple[Array, Array, float]:  # fmt: skip
    """Return N, b and y' W y over terms, six motions of the whole, and the shared sources, which have a prior of 1."""
    size = len(terms) + 6 + len(influence)
    N, b, square = np.zeros((size, size)), np.zeros(size), 0.0
    for begin in range(0, len(position), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        q, at = position[part], reflector[part]
        A = np.concatenate(
            [model.columns(terms, q, at), model.motions(q + at, centre), influence[:, part].transpose(1, 2, 0)], axis=2
        )
        # Whitened by each target's own covariance.
        L = np.linalg.cholesky(own[part])
        A = np.linalg.solve(L, A).reshape(-1, size)
        y = np.linalg.solve(L, error[part][:, :, None]).ravel()
        N += A.T @ A
        b += A.T @ y
        square += float(y @ y)
    N[len(terms) + 6 :, len(terms) + 6 :] += np.eye(len(influence))
    return N, b, square


def _seen(model: Chain, terms: list[Term], N: Array, nuisance: list[int]) -> tuple[set[int], dict[str, str]]:
    """Return the terms that are told from all before them, and the errors that are not seen, with the reason."""
    size = np.sqrt(np.diag(N))
    reference = max(size[: len(terms)])
    motions = nuisance[:6]
    R = N / np.outer(np.where(size > 0, size, 1.0), np.where(size > 0, size, 1.0))
    taken, unseen = list(motions), {}
    seen: set[int] = set()
    present = {term.error for term in terms}
    for name in model.machine.error_names:
        if name not in present:
            axis = name[2] if name[2] in AXES else name[3]
            unseen[name] = f"too few positions of {axis}"
    for k, term in enumerate(terms):
        if term.error in unseen:
            continue
        start = term.order < 0 or term.order == first_order(term.error)
        if size[k] < 1e-9 * reference:
            if start:
                unseen[term.error] = "it moves no reflector"
            continue
        with_ = linalg.solve(R[np.ix_(taken, taken)], R[taken, k], assume_a="sym") if taken else np.zeros(0)
        share = 1.0 - float(R[taken, k] @ with_)
        if share > UNSEEN:
            seen.add(k)
            taken.append(k)
        elif start:
            parts = {terms[i].error: 0.0 for i in taken if i < len(terms)}
            for i, weight in zip(taken, with_, strict=True):
                if i < len(terms):
                    parts[terms[i].error] += abs(float(weight))
            others = [name for name, weight in parts.items() if weight > 1e-3]
            unseen[term.error] = f"not told from {' and '.join(others) or 'a motion of the whole'}"
    return seen, unseen


def _choose(
    terms: list[Term], seen: set[int], N: Array, b: Array, nuisance: list[int], readings: int
) -> tuple[list[int], list[str]]:
    """Return the terms that the data ask for: squareness and the first of every motion, then one or two at a time."""
    by_error: dict[str, list[int]] = {}
    for k in sorted(seen):
        by_error.setdefault(terms[k].error, []).append(k)
    chosen = [motion.pop(0) for motion in by_error.values()]
    penalty = float(np.log(readings))
    while True:
        S = chosen + nuisance
        steps = [motion[: 1 + more] for motion in by_error.values() for more in (0, 1, 2) if len(motion) > more]
        if not steps:
            break
        open_ = sorted({k for step in steps for k in step})
        factor = linalg.cho_factor(N[np.ix_(S, S)])
        X = linalg.cho_solve(factor, N[np.ix_(S, open_)])
        M = N[np.ix_(open_, open_)] - N[np.ix_(open_, S)] @ X
        r = b[open_] - X.T @ b[S]
        at = {k: i for i, k in enumerate(open_)}
        gains = []
        for step in steps:
            i = [at[k] for k in step]
            gains.append(float(r[i] @ linalg.solve(M[np.ix_(i, i)], r[i], assume_a="pos")) - penalty * len(step))
        best = int(np.argmax(gains))
        if gains[best] <= 0:
            break
        chosen += steps[best]
        motion = by_error[terms[steps[best][0]].error]
        del motion[: len(steps[best])]
    return sorted(chosen), []
