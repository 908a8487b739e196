"""Errors relative to a datum: a reference state, the line through two ends, a best-fit plane, a free network.

A datum is a few columns A (place, d, g) that are adapted to the errors with weights w, ``h = H e`` with
``H = (A' w A)^-1 A' w``, and subtracted: ``e - A h``. The coefficients h are results themselves: the location errors of
an axis of rotation, the slope of a line.

The effects of sources transform linearly. The part that is independent from place to place becomes partly common: what
it adds to h is common to all places, and a source of the datum. What it does not add to h is noise of the places. It
stays independent where no place has more than a tenth of the weight (its leverage): the totals at each place, and the
covariances with h, are exact, and the covariance of two such remainders, which is neglected, is below this part. Where
few places define the datum, such as the ends of a line, the remainders are sources as well, and all of it is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.sources import Errors, Source

__all__ = ["Datum", "Relative", "relative"]

EXACT = 256
"""Largest number of values with a weight whose noise becomes sources."""
LEVERAGE = 0.1
"""Part of the variance of a value, in any direction, up to which its covariance with others is neglected."""
ROUNDING = 1e-9
"""Remainder of an effect, relative to it, that is rounding: derivatives by differences are accurate to some 1e-10."""

ROUNDING_OF_VARIANCE = 1e-12


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


def relative(errors: Errors, datum: Datum, *, noise: str = "readings") -> Relative:
    """Return errors relative to a datum; a NaN has no weight, and stays.

    Parameters
    ----------
    errors : Errors
    datum : Datum
    noise : str
        Group of the noise of the places that define the datum, where it does not stay independent.

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
    of_h = np.einsum("pgd,spd->sg", H, np.nan_to_num(errors.influence), optimize=True)
    effects = _differences(errors.influence, np.einsum("pdg,sg->spd", A, of_h, optimize=True))
    moved = [replace(source, effect=effect) for source, effect in zip(errors.sources, effects, strict=True)]
    own = np.nan_to_num(errors.own)
    rest, added, more = _noise(own, A, H, datum.group, noise)
    found = Errors(np.where(known, value - np.einsum("pdg,g->pd", A, h), np.nan), rest, [*moved, *added])
    influence = np.concatenate([of_h, more])
    return Relative(found, h, influence.T @ influence, influence)


def _noise(own: Array, A: Array, H: Array, group: str, noise: str) -> tuple[Array, list[Source], Array]:
    """Return what stays independent of the noise, its common effects as sources, and their effects on h.

    With ``H D H' = R R'`` the noise is ``G x + r``: x, of unit variance, determines ``h = R x``, and the remainder r
    has no effect on h,

    G_i = D_i H_i' R^-T,    e = (G - A R) x + r,    cov(r_i, r_j) = D_i [i = j] - G_i G_j'.
    """
    HDH = np.einsum("pgi,pij,phj->gh", H, own, H, optimize=True)
    unit = np.sqrt(np.diagonal(HDH))
    unit = np.where(unit > 0, unit, 1.0)
    R = unit[:, None] * _root(HDH / np.outer(unit, unit))
    if not R.size:
        return own, [], np.zeros((0, len(HDH)))
    G = own @ np.swapaxes(H, 1, 2) @ (np.linalg.pinv(R / unit[:, None]) / unit).T
    common = _differences(np.moveaxis(-A @ R, 2, 0), np.moveaxis(-G, 2, 0))
    sources = [Source(f"{group} {k + 1}", group, each, joined=group) for k, each in enumerate(common)]
    rest = _without_rounding(own - G @ np.swapaxes(G, 1, 2), own)
    weighted = np.flatnonzero(G.any(axis=(1, 2)))
    if weighted.size > EXACT:
        return rest, sources, R.T
    roots = [_root(own[place]) for place in weighted]
    inside = [
        np.linalg.svd(np.linalg.pinv(L) @ G[i], full_matrices=False) for i, L in zip(weighted, roots, strict=True)
    ]
    seen = [s > ROUNDING for _, s, _ in inside]
    if max(float(s[0]) ** 2 for _, s, _ in inside) <= LEVERAGE or sum(int(each.sum()) for each in seen) > EXACT:
        return rest, sources, R.T
    # In the directions U of each place that x shares, r = L U y with the covariance 1 - B B' of y, B = U' L^-1 G.
    B = np.concatenate([s[k, None] * V[k] for (_, s, V), k in zip(inside, seen, strict=True)])
    along = np.linalg.qr(B, mode="complete")[0][:, R.shape[1] :]  # (N, N - r)
    effects, first = np.zeros((along.shape[1], *own.shape[:2])), 0
    for place, L, (U, _, _), k in zip(weighted, roots, inside, seen, strict=True):
        LU = L @ U[:, k]
        rest[place] = own[place] - LU @ LU.T
        effects[:, place] = along[first : first + LU.shape[1]].T @ LU.T
        first += LU.shape[1]
    sources += [
        Source(f"{noise} of the datum {k + 1}", noise, each, joined=f"{noise} of the datum")
        for k, each in enumerate(effects)
    ]
    rest = _without_rounding(rest, own)
    return rest, sources, np.concatenate([R.T, np.zeros((len(effects), len(HDH)))])


def _without_rounding(rest: Array, own: Array) -> Array:
    """Return covariances (place, d, d) that are exactly 0 where nothing but rounding remains of ``own``."""
    u = np.sqrt(np.diagonal(own, axis1=1, axis2=2))
    return np.asarray(np.where(np.abs(rest) <= ROUNDING_OF_VARIANCE * u[:, :, None] * u[:, None], 0.0, rest))


def _differences(effects: Array, removed: Array) -> Array:
    """Return effects of sources (s, place, d) without a part; exactly 0 where nothing but rounding remains."""
    rounding = ROUNDING * np.abs(np.nan_to_num(effects)).max(axis=(1, 2), initial=0.0, keepdims=True)
    left = effects - removed
    return np.asarray(np.where(np.abs(left) <= rounding, 0.0, left))


def _root(C: Array) -> Array:
    """Return a square root of a covariance (d, d) without columns of 0, (d, r)."""
    power, vectors = np.linalg.eigh((C + C.T) / 2)
    kept = power > 1e-14 * max(float(power[-1]), 0.0)
    return np.asarray(vectors[:, kept] * np.sqrt(power[kept]))
