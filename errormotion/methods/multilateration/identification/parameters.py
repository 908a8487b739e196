"""The 21 errors of a three-axis machine from the errors of targets, by linear least squares on its chain.

Displacements of the reflector are linear in the errors (`errormotion.kinematics.machines`). Every error motion is a
series of Legendre polynomials over the measured part of its axis, from the first term that is not another's:

* six motions of the whole are the datum's and belong to no axis: they are estimated as well, and returned;
* constants of error motions and slopes of straightness are motions of the whole or squareness, so error motions have a
  mean of zero, straightness no slope, and squareness is that of the axes' mean lines;
* what an error does to no reflector, or nothing but what others do, is not seen. With one reflector these are the
  rotations of the axis that carries it, and of others whose lever never changes across.

How many terms an error motion has is decided by the evidence: the coefficient of order k has the prior standard
deviation tau / k^p, with tau of each error motion and one p for all of largest marginal likelihood (MacKay, Bayesian
interpolation, Neural Computation 4, 1992). Terms that the targets do not determine keep their prior, so that what may
be between the targets is in the uncertainty. Squareness and the slope of positioning have no prior.
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
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import cross_matrix

AXES = ("X", "Y", "Z")
INDEPENDENT_SHARE = 1e-6
"""A term with a smaller independent share is not distinguishable from the others."""
FALSE_ALARM = 1e-3
"""Probability of a note on axes that explain the targets' errors."""
FALLOFFS = (1.0, 2.0, 3.0, 4.0)
"""How fast coefficients may fall with their order: p of the prior."""
_PASSES = 100
_SETTLED = 0.01
_POOLED = 1.0
"""Terms' worth of weight that the other error motions of the same kind have in the size of one."""
_BLOCK = 4096


@dataclass(frozen=True)
class Unseen:
    """An error that the targets do not determine: the reason, and errors that have the same effect, where these are."""

    reason: str
    like: tuple[str, ...] = ()


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
    determined : ndarray (term,)
        How far the targets determine each, 0 (its prior stands) to 1.
    unseen : mapping of str to Unseen
        Errors that the targets do not determine.
    sigma0 : float
        Root mean square of what is left over what was expected: 1 where the axes explain the errors.
    freedom : float
        Values less what they have determined.
    datum : ndarray (6, term)
        What has to be taken off the displacements of each term, so that the measured targets have no motion with the
        whole; about ``centre`` (3,).
    """

    chain: Chain
    terms: list[Term]
    coefficient: Array
    covariance: Array = field(repr=False)
    determined: Array
    unseen: dict[str, Unseen]
    sigma0: float
    freedom: float
    datum: Array = field(repr=False)
    centre: Array = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def orders(self) -> dict[str, int]:
        """Highest order of every error motion that the targets determine rather than its prior; 0 where none."""
        found: dict[str, int] = {}
        for term, share in zip(self.terms, self.determined, strict=True):
            if term.order >= 0:
                found[term.error] = max(found.get(term.error, 0), term.order if share > 0.5 else 0)
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
        Of the polynomials.

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
    which = np.flatnonzero(known)
    position, error, at = position[which], error[which], at[which]
    model = Chain.of(chain, position, at)
    terms, levels = _candidates(model, position, max_order)
    centre = (position + at).mean(axis=0)
    N, b, square, datum = _normal_equations(model, terms, position, at, centre, error, own, influence, which)
    unseen = _unseen(terms, levels, N, len(N) - len(terms))
    kept = [k for k, term in enumerate(terms) if term.error not in unseen]
    S = kept + list(range(len(terms), len(N)))
    terms, datum = [terms[k] for k in kept], datum[:, kept]
    found = _most_evident(terms, N[np.ix_(S, S)], b[S], len(influence), square)
    freedom = 3 * len(position) - 6 - float(found.determined.sum())
    ratio = found.left / max(freedom, 1.0)
    scale, notes = 1.0, []
    if freedom > 0 and found.left > chdtri(freedom, FALSE_ALARM):
        scale = ratio
        notes.append(
            f"Errors of the axes leave {np.sqrt(ratio):.3g} times as much of the targets' errors as their uncertainty "
            "explains: a machine that is not rigid, hysteresis, or error motions of higher order than "
            f"{max_order}. The uncertainties of the axes are raised to match."
        )
    return Parametric(
        model, terms, found.value, scale * found.covariance, found.determined, unseen, float(np.sqrt(ratio)), freedom,
        datum, centre, tuple(notes),
    )  # fmt: skip


def first_order(error: str) -> int:
    """Return the lowest order of an error motion that belongs to it alone: 2 for straightness, else 1."""
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


def _candidates(model: Chain, position: Array, max_order: int) -> tuple[list[Term], list[int]]:
    """Return all terms, and the number of positions of each axis."""
    return unknowns(model, max_order), [len(np.unique(np.round(column, 6))) for column in position.T]


def _normal_equations(
    model: Chain, terms: list[Term], position: Array, reflector: Array, centre: Array, error: Array, own: Array,
    influence: Array, which: NDArray[np.intp],
) -> tuple[Array, Array, float, Array]:  # fmt: skip
    """Return N, b and y' W y over terms, six motions of the whole, and the shared sources, which have a prior of 1.

    ``own`` and ``influence`` are of all targets, of which the others are ``which``. And the motion with the whole that
    fits the displacements of each term best, (6, term).
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
        # Whitened by each target's own covariance.
        W = np.linalg.inv(np.linalg.cholesky(own[which[part]]))
        A = np.matmul(W, A).reshape(-1, size)
        y = np.matmul(W, error[part][:, :, None]).ravel()
        N += A.T @ A
        b += A.T @ y
        square += float(y @ y)
    N[len(terms) + 6 :, len(terms) + 6 :] += np.eye(len(influence))
    return N, b, square, np.asarray(np.linalg.lstsq(GG, GA)[0])


def _unseen(terms: list[Term], levels: list[int], N: Array, nuisance: int) -> dict[str, Unseen]:
    """Return errors whose first term moves no reflector, or is not distinguishable from earlier ones."""
    size = np.sqrt(np.diag(N))
    reference = size[: len(terms)].max()
    unit = np.where(size > 0, size, 1.0)
    R = N / np.outer(unit, unit)
    taken = list(range(len(terms), len(terms) + min(nuisance, 6)))
    unseen: dict[str, Unseen] = {}
    for k, term in enumerate(terms):
        name = term.error
        axes = {AXES.index(letter) for letter in (name[2], name[3:]) if letter in AXES}
        few = [AXES[i] for i in axes if levels[i] < (2 if term.order < 0 else first_order(name) + 1)]
        if name in unseen or (term.order >= 0 and term.order >= levels[AXES.index(name[2])]):
            if few and name not in unseen:
                unseen[name] = Unseen(f"too few positions of {few[0]}")
            continue
        if few:
            unseen[name] = Unseen(f"too few positions of {few[0]}")
        elif size[k] < 1e-9 * reference:
            if term.order <= first_order(name):
                unseen[name] = Unseen("it moves no reflector")
        else:
            others = linalg.solve(R[np.ix_(taken, taken)], R[taken, k], assume_a="sym")
            if 1.0 - float(R[taken, k] @ others) > INDEPENDENT_SHARE:
                taken.append(k)
            elif term.order <= first_order(name):
                unseen[name] = _like(terms, taken, others)
    return unseen


def _like(terms: list[Term], taken: list[int], weight: Array) -> Unseen:
    """Return why an error is not determined that is the sum of others with these weights."""
    parts: dict[str, float] = {}
    for i, share in zip(taken, weight, strict=True):
        if i < len(terms):
            parts[terms[i].error] = parts.get(terms[i].error, 0.0) + abs(float(share))
    like = tuple(name for name, part in parts.items() if part > 1e-3)
    return Unseen(f"not distinguishable from {' and '.join(like) or 'a shift'}", like)


@dataclass(frozen=True)
class _Evident:
    """Coefficients, their covariance, how far the data determine each (0 to 1), and the residual sum of squares."""

    value: Array
    covariance: Array
    determined: Array
    left: float
    evidence: float


def _most_evident(terms: list[Term], N: Array, b: Array, sources: int, square: float) -> _Evident:
    found = [_with_falloff(terms, N, b, sources, square, p) for p in FALLOFFS]
    return max(found, key=lambda each: each.evidence)


def _with_falloff(terms: list[Term], N: Array, b: Array, sources: int, square: float, p: float) -> _Evident:
    """Maximise the evidence over tau of every error motion, by expectation and maximisation."""
    n = len(terms)
    order = np.array([term.order for term in terms], dtype=float)
    flat = np.array([term.order < 0 or (term.order == 1 and term.error[1] == term.error[2]) for term in terms])
    names = [term.error for term in terms]
    groups = {name: np.flatnonzero([(e == name) and not f for e, f in zip(names, flat, strict=True)]) for name in names}
    groups = {name: group for name, group in groups.items() if len(group)}
    shape = np.where(flat, np.inf, np.maximum(order, 1.0) ** -p)
    kinds = {name: "EA EB EC".find(name[:2]) >= 0 for name in groups}
    # Columns of one size: metres and radians weigh alike.
    unit = 1 / np.sqrt(np.diag(N))
    scaled, right = N * np.outer(unit, unit), b * unit
    guess = {kind: float(np.median([unit[i] for name, g in groups.items() if kinds[name] == kind for i in g] or [1.0]))
             for kind in (False, True)}  # fmt: skip
    tau = {name: 30 * guess[kinds[name]] for name in groups}
    for _ in range(_PASSES):
        prior = np.zeros(len(N))
        for name, group in groups.items():
            prior[group] = 1 / (tau[name] * shape[group]) ** 2
        factor = linalg.cho_factor(scaled + np.diag(prior * unit**2))
        C = linalg.cho_solve(factor, np.eye(len(N))) * np.outer(unit, unit)
        x = unit * linalg.cho_solve(factor, right)
        variance = np.diag(C)
        second = {name: float(np.sum((x[g] ** 2 + variance[g]) / shape[g] ** 2)) for name, g in groups.items()}
        typical = {
            kind: float(np.exp(np.mean([np.log(tau[name] ** 2) for name in groups if kinds[name] == kind] or [0.0])))
            for kind in (False, True)
        }
        before = dict(tau)
        for name, group in groups.items():
            tau[name] = float(np.sqrt((second[name] + _POOLED * typical[kinds[name]]) / (len(group) + _POOLED)))
        if max(abs(np.log(tau[name] / before[name])) for name in groups) < _SETTLED:
            break
    determined = 1 - variance[:n] * prior[:n]
    # Twice the logarithm of the marginal likelihood, up to a constant that no choice changes.
    log_det = 2 * float(np.log(np.diag(factor[0])).sum()) - 2 * float(np.log(unit).sum())
    evidence = float(b @ x) - log_det + float(np.log(prior[prior > 0]).sum())
    shared = slice(len(N) - sources, len(N))
    left = max(square - 2 * float(b @ x) + float(x @ N @ x), float(x[shared] @ x[shared]))
    return _Evident(x[:n], C[:n, :n], determined, left, evidence)
