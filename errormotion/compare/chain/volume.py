"""The errors of an axis from those of the volume, by the kinematic chain of the machine.

The errors of the tool at a commanded position q are ``e = J(q) p + g(q) d``: p are the errors of all axes (polynomials
of their positions) and squareness errors, d the six rigid motions, in which the datum of a volume is free. Generalised
least squares determines p as far as the volume allows, and thus the errors of one axis at chosen positions. A prior
whose size decreases with the order, and which maximises the evidence, represents components that the targets do not
determine. Components that cannot be distinguished from squareness, datum and the other axes are removed on both sides:
positioning and rotations are relative to one position, straightness to the line through two positions. The derivation
is in the explanation of comparisons.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.polynomial import legendre
from numpy.typing import ArrayLike
from scipy import special

from errormotion.arrays import Array
from errormotion.compare.chain.curve import Curve, is_straightness, sources_of
from errormotion.datasets.results.reduction import influence_of
from errormotion.errors import DatasetError
from errormotion.estimation.evidence import eliminated, maximum_evidence
from errormotion.estimation.information import weights
from errormotion.estimation.low_rank import root_of
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import cross_matrix

SAME = 1e-6
"""Distance below which two positions of an axis are regarded as equal, m."""
HIGHEST = 12
"""Highest order of the polynomials; higher orders contribute to the uncertainty."""
TAIL = 60
"""Highest order that contributes to the uncertainty."""
FALLOFFS = (1.0, 2.0, 3.0, 5.0)
"""Exponents p of the prior n^-p of coefficients of order n."""
DECISIVE_ORDER = 2
"""Highest order that decides whether a freedom is determined."""
PASSES, SETTLED = 30, 0.05
"""Largest number of iterations for the size of the prior, and the change of its logarithm that ends them."""
SMALLEST = 1e-3
"""Smallest size of the prior, in units of the standard uncertainty of a single coefficient."""
FLAT = 1e-13
"""Weight of the prior of terms without a prior, in units of the information of one column."""
FALSE_ALARM = 1e-3
"""Probability of the residuals below which the uncertainty is increased accordingly."""
UNDETERMINED = 1e-10
"""Fraction of the largest eigenvalue of the scaled normal matrix below which a direction is not determined."""
LEAKAGE = 1e-6
"""Largest fraction of the square of an error in directions that are not determined."""
BLOCK = 20_000
"""Number of targets that are processed at a time."""


def predict(
    volume: xr.Dataset,
    axis: str,
    positions: ArrayLike,
    point: ArrayLike,
    *,
    notes: list[str] | None = None,
    name: str = "volume",
) -> Curve:
    """Return the errors of an axis that follow from a volume.

    Parameters
    ----------
    volume : Dataset
        Errors of the tool over ``target`` with ``x y z`` and the attribute ``chain``.
    axis : str
    positions : array_like, (n,)
        Positions of the axis within the volume, m.
    point : array_like, (3,)
        Functional point of the errors of the axis, m, in machine coordinates with all axes at zero.
    notes : list of str, optional
        Order of the polynomials and misfit are appended.

    Returns
    -------
    Curve
        Errors up to constants, for straightness up to a line; a freedom that the volume does not determine is NaN.

    Raises
    ------
    DatasetError
        The targets do not determine any error of the axis.
    """
    positions = np.asarray(positions, dtype=float)
    model = Machine(str(volume.attrs["chain"]), {axis: point})
    fit = _fitted(volume, model)
    k = model.axis_names.index(axis)
    S = np.zeros((positions.size, 6, len(fit.terms)))
    P = legendre.legvander(fit.scaled(positions, k), HIGHEST)
    for column, (error, order) in enumerate(fit.terms):
        if order >= 0 and error // 6 == k:
            S[:, error % 6, column] = P[:, order]
    value, root = S @ fit.value, S @ fit.root
    # Determined errors have no component in undetermined directions.
    left = (S @ fit.open) ** 2
    size = np.einsum("nkp->k", (S * fit.size) ** 2)
    seen = (size > 0) & (np.einsum("nkp->k", left) <= LEAKAGE * size)
    if not seen.any():
        raise DatasetError(f"'{name}': its targets do not determine the errors of {axis}; measure more targets")
    shared = np.moveaxis(S @ fit.shared, 2, 0)
    if notes is not None:
        notes.append(
            f"'{name}': error motions as polynomials up to order {HIGHEST}, with a prior of the coefficients of order "
            f"n proportional to n^-{fit.falloff:g} (maximum evidence)."
        )
        if fit.factor > 1:
            notes.append(
                f"'{name}': the residuals of the fit are {np.sqrt(fit.factor):.2g} times as large as its uncertainty "
                "allows; the uncertainty of the derived errors is increased by this factor."
            )
    F = np.concatenate([shared, np.moveaxis(root, 2, 0)])
    value[:, ~seen], F[:, :, ~seen] = np.nan, np.nan
    own = fit.tail(positions, k)[:, None, None] * np.eye(6)
    own[:, :3, :3] *= fit.tau[2 * k] ** 2
    own[:, 3:, 3:] *= fit.tau[2 * k + 1] ** 2
    own[:, ~seen], own[:, :, ~seen] = np.nan, np.nan
    number = volume.sizes.get("source", 0)
    source, group, identity = sources_of(volume)
    parts = len(F) - number
    return Curve(
        value, own, F, [*source, *(f"{name}, errors of the axes, part {k + 1}" for k in range(parts))],
        [*group, *["errors of the axes"] * parts], [*identity, *[""] * parts],
    )  # fmt: skip


@dataclass(frozen=True)
class _Fit:
    """Fitted errors of all axes of a volume.

    Terms are (number of the error, order); order -1 is squareness; ``flat`` terms have no prior. ``root`` (term, part)
    is the square root of the covariance without the sources, ``shared`` (term, source) the influence of the sources,
    ``open`` (term, direction) the undetermined directions, ``size`` (term,) the typical size of a term that decides
    this, ``tau`` and ``falloff`` are parameters of the prior by group, ``factor`` increases the covariance.
    """

    terms: list[tuple[int, int]]
    flat: list[bool]
    value: Array
    root: Array
    shared: Array
    open: Array
    size: Array
    tau: Array
    falloff: float
    factor: float
    low: Array
    high: Array

    def tail(self, q: Array, k: int) -> Array:
        """Return the variance of the orders above the highest one at positions of axis k, for a prior of size 1."""
        P = legendre.legvander(self.scaled(q, k), TAIL)[:, HIGHEST + 1 :]
        found: Array = (P**2) @ np.arange(HIGHEST + 1.0, TAIL + 1.0) ** (-2 * self.falloff)
        return found

    def scaled(self, q: Array, k: int) -> Array:
        """Return positions of axis k, scaled to -1 to 1."""
        half = max((self.high[k] - self.low[k]) / 2, SAME)
        found: Array = (q - (self.low[k] + self.high[k]) / 2) / half
        return found


def _fitted(volume: xr.Dataset, model: Machine) -> _Fit:
    """Return the errors of the axes by generalised least squares; sources are nuisance parameters with variance 1."""
    q = np.stack([np.asarray(volume[axis.lower()].values, dtype=float) for axis in model.axis_names], axis=-1)
    y = np.asarray(volume.em.twist().values, dtype=float)
    F = influence_of(volume)
    own = np.asarray(volume["covariance"].values, dtype=float) - np.einsum("sti,stj->tij", F, F)
    known = np.isfinite(y)
    turns = bool(known[:, 3:].any())
    low, high = q.min(axis=0), q.max(axis=0)
    terms, flat = _terms(model)
    none = np.zeros(0)
    blank = _Fit(terms, flat, none, none, none, none, none, none, 0.0, 1.0, low, high)
    columns, s = len(terms) + (9 if turns else 6), len(F)
    N, b, square = np.zeros((columns + s, columns + s)), np.zeros(columns + s), 0.0
    tool = np.asarray(volume.attrs["functional_point"], dtype=float)
    for first in range(0, len(q), BLOCK):
        part = slice(first, first + BLOCK)
        P = [legendre.legvander(blank.scaled(q[part, k], k), HIGHEST) for k in range(q.shape[1])]
        J = model.jacobian(q[part], tool)
        A = np.stack([J[:, :, e] * (P[e // 6][:, [o]] if o >= 0 else 1.0) for e, o in terms], axis=2)
        A = np.concatenate([A, _rigid_motions(model, q[part], tool, turns), np.moveaxis(F[:, part], 0, 2)], axis=2)
        W, _ = weights(y[part], own[part], F[:, part])
        A, data = np.where(known[part][:, :, None], A, 0.0), np.where(known[part], y[part], 0.0)
        WA = np.einsum("tij,tjp->tip", W, A)
        N += np.einsum("tip,tiq->pq", A, WA, optimize=True)
        b += np.einsum("tip,ti->p", WA, data)
        square += float(np.einsum("ti,tij,tj->", data, W, data))
    N[columns:, columns:] += np.eye(s)
    N, b, square, gain = eliminated(N, b, square, s)
    return _with_coefficients(blank, N, b, gain, square, int(known.sum()))


def _with_coefficients(blank: _Fit, N: Array, b: Array, gain: Array, square: float, count: int) -> _Fit:
    """Return the coefficients for the prior of maximum evidence, with their covariance."""
    n = len(blank.terms)
    order = np.concatenate([[o for _, o in blank.terms], np.full(len(N) - n, -1)]).astype(float)
    group = np.concatenate([[-1 if flat else _group(e) for (e, _), flat in zip(blank.terms, blank.flat, strict=True)],
                            np.full(len(N) - n, -1)]).astype(np.intp)  # fmt: skip
    found = maximum_evidence(
        N, b, group, order, exponents=FALLOFFS, smallest=SMALLEST, regularisation=FLAT, passes=PASSES, tolerance=SETTLED
    )
    C, value = found.covariance, found.value
    rest, degrees = max(square - float(b @ value), 0.0), max(count - int((group < 0).sum()), 1)
    factor = rest / degrees if special.chdtrc(degrees, rest) < FALSE_ALARM else 1.0
    shared = C @ gain
    own = np.sqrt(factor) * root_of(C - shared @ shared.T, unit=np.sqrt(np.diag(C)))
    size = np.sqrt(np.diag(N))
    unit = np.where(size > 1e-9 * size.max(), 1 / np.where(size > 0, size, 1.0), 1.0)
    low = np.flatnonzero((order <= DECISIVE_ORDER) | (group < 0))
    power, vectors = np.linalg.eigh((N * np.outer(unit, unit))[np.ix_(low, low)])
    lost = np.zeros((len(N), int((power <= UNDETERMINED * power[-1]).sum())))
    lost[low] = unit[low, None] * vectors[:, power <= UNDETERMINED * power[-1]]
    weight = np.where((order <= DECISIVE_ORDER) | (group < 0), unit, 0.0)
    return replace(
        blank, value=value[:n], root=own[:n], shared=shared[:n], open=lost[:n], size=weight[:n], tau=found.size,
        falloff=found.exponent, factor=factor,
    )  # fmt: skip


def _group(error: int) -> int:
    """Return the number of the group of an error motion: displacements or rotations of one axis."""
    return 2 * (error // 6) + (error % 6 >= 3)


def _terms(model: Machine) -> tuple[list[tuple[int, int]], list[bool]]:
    """Return all terms (squareness, and polynomials from the first order of each error), and which have no prior."""
    motions = 6 * len(model.axis_names)
    terms = [(error, -1) for error in range(motions, len(model.error_names))]
    flat = [True] * len(terms)
    for k, axis in enumerate(model.axis_names):
        for dof in range(6):
            first = 2 if is_straightness(dof, axis) else 1
            terms += [(6 * k + dof, order) for order in range(first, HIGHEST + 1)]
            flat += [order == 1 and dof < 3 for order in range(first, HIGHEST + 1)]
    return terms, flat


def _rigid_motions(model: Machine, q: Array, tool: Array, turns: bool) -> Array:
    """Return the effect of rigid motions (m, 6, 6); if rotations are known, with rotations of the tool (m, 6, 9)."""
    position = model.nominal_pose(q).apply(tool)
    G = np.zeros((len(q), 6, 9 if turns else 6))
    G[:, :3, :3], G[:, 3:, 3:6] = np.eye(3), np.eye(3)
    G[:, :3, 3:6] = -cross_matrix(position)
    G[:, 3:, 6:] = np.eye(3)[:, : G.shape[2] - 6]
    return G
