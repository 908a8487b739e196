"""Errors relative to a datum: a reference state, the line through two ends, a best-fit plane, a free network.

A datum is a few columns A (place, d, g) that are adapted to the errors with weights w, ``h = H e`` with
``H = (A' w A)^-1 A' w``, and subtracted: ``e - A h``. The coefficients h are results themselves: the location errors of
an axis of rotation, the slope of a line.

The effects of sources transform linearly. The part that is independent from place to place becomes partly common: where
few places have a weight, each of them becomes a source, which is exact. Where many have, their common effect is that of
h, ``-A root(H D H')``, and the covariance at a place i keeps its cross terms with it,
``D_i - D_i H_i' A_i' - A_i H_i D_i``: totals at each place are exact, covariances of two places with weight are not by
the order of one over their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.blocks import Index
from errormotion.estimation.sources import Errors, Source

__all__ = ["Datum", "Relative", "relative"]

EXACT = 256
"""Largest number of values with a weight that become sources of their own."""
ROUNDING = 1e-9
"""Remainder of an effect, relative to it, that is rounding: derivatives by differences are accurate to some 1e-10."""


@dataclass(frozen=True, eq=False)
class Datum:
    """What the errors are relative to.

    Attributes
    ----------
    columns : ndarray, (place, d, g)
        Effect of one unit of each coefficient on the errors.
    weight : ndarray, (place, d)
        0 where a value does not define the datum.
    group : str
        Of its uncertainty in the budget.
    names : sequence of str, (g,)
        Of the coefficients.
    beside : ndarray, (place, d, b), optional
        Columns that are adapted at the same time and stay in the errors, such as the radius of a circle of whose centre
        the errors are independent.
    """

    columns: Array
    weight: Array
    group: str
    names: Sequence[str] = ()
    beside: Array | None = None


@dataclass(frozen=True, eq=False)
class Relative:
    """Errors relative to a datum, and its coefficients.

    Attributes
    ----------
    errors : Errors
    coefficient : ndarray, (g,)
    covariance : ndarray, (g, g)
        Of the coefficients.
    influence : ndarray, (source, g)
        Effect of each source of the errors on the coefficients.
    """

    errors: Errors
    coefficient: Array
    covariance: Array
    influence: Array


def relative(errors: Errors, datum: Datum) -> Relative:
    """Return errors relative to a datum; a NaN has no weight, and stays.

    Raises
    ------
    FitError
        The values with a weight do not determine the datum.
    """
    A, known = datum.columns, np.isfinite(errors.value)
    w = np.where(known, np.broadcast_to(datum.weight, errors.value.shape), 0.0)
    every = A if datum.beside is None else np.concatenate([A, datum.beside], axis=2)
    N = np.einsum("pdg,pd,pdh->gh", every, w, every)
    if np.linalg.matrix_rank(N, hermitian=True) < len(N):
        raise FitError(
            "the known values do not determine the datum; measure more of the places that define it",
            code="estimation.datum.undetermined",
        )
    H = np.einsum("gh,pdh,pd->pgd", np.linalg.inv(N)[: A.shape[2]], every, w)  # (place, g, d)
    value = np.where(known, errors.value, 0.0)
    h = np.einsum("pgd,pd->g", H, value)
    F = np.nan_to_num(errors.influence)
    of_h = np.einsum("pgd,spd->sg", H, F)
    moved = [
        replace(source, effect=_difference(source.effect, np.einsum("pdg,g->pd", A, change)))
        for source, change in zip(errors.sources, of_h, strict=True)
    ]
    own = np.nan_to_num(errors.own)
    HDH = np.einsum("pgi,pij,phj->gh", H, own, H, optimize=True)
    weighted = np.flatnonzero((w > 0).any(axis=1) & own.any(axis=(1, 2)))
    if weighted.size * own.shape[1] <= EXACT:
        rest, added, more = _exact(own, A, H, weighted, datum.group)
    else:
        rest, added, more = _common(own, A, H, HDH, datum.group)
    found = Errors(np.where(known, value - np.einsum("pdg,g->pd", A, h), np.nan), rest, [*moved, *added])
    return Relative(found, h, HDH + of_h.T @ of_h, np.concatenate([of_h, more]))


def _exact(own: Array, A: Array, H: Array, weighted: Index, group: str) -> tuple[Array, list[Source], Array]:
    """Return the independent part without that of the places which define the datum, and this as sources.

    What does not change h, such as the errors of freedoms that the datum does not relate, stays independent.
    """
    rest, added, of_h = own.copy(), list[Source](), list[Array]()
    for place in weighted:
        root = _root(own[place])
        rest[place] = 0.0
        for k in range(root.shape[1]):
            change = H[place] @ root[:, k]
            if not change.any():
                rest[place] += np.outer(root[:, k], root[:, k])
                continue
            effect = -np.einsum("pdg,g->pd", A, change)
            effect[place] += root[:, k]
            if np.abs(effect).max() > 1e-9 * np.abs(root).max():
                added.append(Source(f"{group} {len(added) + 1}", group, effect))
                of_h.append(change)
    return rest, added, np.array(of_h).reshape(-1, A.shape[2])


def _common(own: Array, A: Array, H: Array, HDH: Array, group: str) -> tuple[Array, list[Source], Array]:
    """Return the independent part with its cross terms, and the common effect of the datum on errors and on h."""
    cross = own @ np.swapaxes(H, 1, 2) @ np.swapaxes(A, 1, 2)
    root = _root(HDH)
    added = [Source(f"{group} {k + 1}", group, -np.einsum("pdg,g->pd", A, root[:, k])) for k in range(root.shape[1])]
    return own - cross - np.swapaxes(cross, 1, 2), added, root.T


def _difference(effect: Array, removed: Array) -> Array:
    """Return the effect of a source without the part of the datum; exactly 0 where nothing but rounding remains."""
    left = effect - removed
    rounding = ROUNDING * float(np.nanmax(np.abs(effect), initial=0.0))
    return np.asarray(np.where(np.abs(left) <= rounding, 0.0, left))


def _root(C: Array) -> Array:
    """Return a square root of a covariance (d, d) without columns of 0, (d, r)."""
    power, vectors = np.linalg.eigh((C + C.T) / 2)
    kept = power > 1e-14 * max(float(power[-1]), 0.0)
    return np.asarray(vectors[:, kept] * np.sqrt(power[kept]))
