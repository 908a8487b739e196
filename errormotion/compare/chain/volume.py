"""The errors of an axis from those of the volume, through the kinematic chain of the machine.

The errors of the tool at a commanded position q are ``e = J(q) p + g(q) d``: p the errors of all axes, polynomials of
their positions and squareness; d the six motions of the whole, in which the datum of a volume is free. Generalised
least squares gives p as far as the volume determines it, and so the errors of one axis at chosen positions. What
squareness, datum and the other axes share with an axis is taken off on both sides: positioning and rotations count
from one position, straightness from the line through two. The derivation is in the explanation of comparisons.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.polynomial import legendre
from numpy.typing import ArrayLike
from scipy.stats import chi2

from errormotion.arrays import Array
from errormotion.compare.chain.curve import Curve, factor_of, is_straightness, sources_of
from errormotion.compare.normal import Information
from errormotion.compare.stack import Estimate
from errormotion.datasets.reduction import influence_of
from errormotion.errors import DatasetError
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import cross_matrix

SAME = 1e-6
"""Distance below which two positions of an axis are the same, m."""
ORDERS = range(2, 9)
"""Orders of the polynomials among which the volume chooses, by Schwarz's criterion."""
FALSE_ALARM = 1e-3
"""Probability of residuals at which uncertainties are raised to match them."""
UNDETERMINED = 1e-10
"""Share of the largest eigenvalue of the scaled normal matrix below which a direction is not determined."""
LEAKAGE = 1e-6
"""Share of an error, squared, that may lie in directions that are not determined."""
BLOCK = 20_000
"""Targets at a time."""


def predict(
    volume: xr.Dataset,
    axis: str,
    positions: ArrayLike,
    point: ArrayLike,
    *,
    notes: list[str] | None = None,
    name: str = "volume",
) -> Curve:
    """Return the errors of an axis that a volume implies.

    Parameters
    ----------
    volume : Dataset
        Errors of the tool over ``target`` with ``x y z`` and the attribute ``chain``.
    axis : str
    positions : array_like, (n,)
        Of the axis, within the volume, m.
    point : array_like, (3,)
        Functional point of the errors of the axis, m, in machine coordinates with all axes at zero.
    notes : list of str, optional
        Order of the polynomials and misfit are added.

    Returns
    -------
    Curve
        Up to constants, and lines of the straightness; a freedom that the volume does not determine is NaN.

    Raises
    ------
    DatasetError
        Fewer values than errors of the axes to be determined.
    """
    positions = np.asarray(positions, dtype=float)
    model = Machine(str(volume.attrs["chain"]), {axis: point})
    fit = _fitted(volume, model, name)
    k = model.axis_names.index(axis)
    S = np.zeros((positions.size, 6, len(fit.terms)))
    P = legendre.legvander(fit.scaled(positions, k), max(ORDERS))
    for column, (error, order) in enumerate(fit.terms):
        if order >= 0 and error // 6 == k:
            S[:, error % 6, column] = P[:, order]
    value, root = S @ fit.value, S @ fit.root
    # What is determined is free of the directions that are not.
    left = (S @ fit.open) ** 2
    size = np.einsum("nkp->k", (S * fit.size) ** 2)
    seen = (size > 0) & (np.einsum("nkp->k", left) <= LEAKAGE * size)
    shared = np.moveaxis(S @ fit.shared, 2, 0)
    if notes is not None:
        notes.append(f"'{name}': polynomials of order {fit.order}, chosen by Schwarz's criterion.")
        if fit.factor > 1:
            notes.append(
                f"'{name}': the errors of the axes leave {np.sqrt(fit.factor):.2g} times as much as its uncertainty "
                "explains; the uncertainty of the derived errors is raised to match."
            )
    F = np.concatenate([shared, np.moveaxis(root, 2, 0)])
    value[:, ~seen], F[:, :, ~seen] = np.nan, np.nan
    own = np.zeros((positions.size, 6, 6))
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
    """Errors of all axes of a volume.

    Terms are (number of the error, order); order -1 is squareness. ``root`` (term, part) of their covariance without
    the sources, ``shared`` (term, source), ``open`` (term, direction) what is not determined, ``size`` (term,) the
    typical size of a term, ``factor`` by which the covariance was raised.
    """

    terms: list[tuple[int, int]]
    value: Array
    root: Array
    shared: Array
    open: Array
    size: Array
    order: int
    factor: float
    low: Array
    high: Array

    def scaled(self, q: Array, k: int) -> Array:
        """Return positions of axis k in -1 to 1."""
        half = max((self.high[k] - self.low[k]) / 2, SAME)
        found: Array = (q - (self.low[k] + self.high[k]) / 2) / half
        return found


def _fitted(volume: xr.Dataset, model: Machine, name: str) -> _Fit:
    """Return the errors of the axes by generalised least squares; shared sources are nuisances with variance 1."""
    q = np.stack([np.asarray(volume[axis.lower()].values, dtype=float) for axis in model.axis_names], axis=-1)
    y = np.asarray(volume.em.twist().values, dtype=float)
    F = influence_of(volume)
    own = np.asarray(volume["covariance"].values, dtype=float) - np.einsum("sti,stj->tij", F, F)
    known = np.isfinite(y)
    turns = bool(known[:, 3:].any())
    low, high = q.min(axis=0), q.max(axis=0)
    levels = [np.unique(np.round(column / SAME)).size for column in q.T]
    terms = _terms(model, levels, max(ORDERS))
    none = np.zeros(0)
    blank = _Fit(terms, none, none, none, none, none, 0, 1.0, low, high)
    columns, s = len(terms) + (9 if turns else 6), len(F)
    N, b, square = np.zeros((columns + s, columns + s)), np.zeros(columns + s), 0.0
    tool = np.asarray(volume.attrs["functional_point"], dtype=float)
    for first in range(0, len(q), BLOCK):
        part = slice(first, first + BLOCK)
        P = [legendre.legvander(blank.scaled(q[part, k], k), max(ORDERS)) for k in range(q.shape[1])]
        J = model.jacobian(q[part], tool)
        A = np.stack([J[:, :, e] * (P[e // 6][:, [o]] if o >= 0 else 1.0) for e, o in terms], axis=2)
        A = np.concatenate([A, _whole(model, q[part], tool, turns), np.moveaxis(F[:, part], 0, 2)], axis=2)
        W = Information.of(Estimate(name, y[part], own[part], F[:, part], ()), {}).W
        A, data = np.where(known[part][:, :, None], A, 0.0), np.where(known[part], y[part], 0.0)
        WA = np.einsum("tij,tjp->tip", W, A)
        N += np.einsum("tip,tiq->pq", A, WA, optimize=True)
        b += np.einsum("tip,ti->p", WA, data)
        square += float(np.einsum("ti,tij,tj->", data, W, data))
    N[columns:, columns:] += np.eye(s)
    M, right = N[columns:, columns:], N[:columns, columns:]
    gain: Array = np.linalg.solve(M, right.T).T if s else np.zeros((columns, 0))
    square -= float(b[columns:] @ np.linalg.solve(M, b[columns:])) if s else 0.0
    b, N = b[:columns] - gain @ b[columns:], N[:columns, :columns] - gain @ right.T
    return _chosen(blank, N, b, gain, square, int(known.sum()), name)


def _chosen(blank: _Fit, N: Array, b: Array, gain: Array, square: float, count: int, name: str) -> _Fit:
    """Return the fit of the order with the least of chi-square plus ln(count) for each parameter."""
    best, least, n = None, np.inf, len(blank.terms)
    for order in ORDERS:
        kept = np.array([k for k, (_, o) in enumerate(blank.terms) if o <= order] + list(range(n, len(N))))
        size = np.sqrt(np.diag(N)[kept])
        unit = np.where(size > 1e-9 * size.max(), 1 / np.where(size > 0, size, 1.0), 1.0)
        power, vectors = np.linalg.eigh(N[np.ix_(kept, kept)] * np.outer(unit, unit))
        good = power > UNDETERMINED * power[-1]
        rank = int(good.sum())
        if rank >= count:
            break
        root = unit[:, None] * vectors[:, good] / np.sqrt(power[good])
        value = root @ (root.T @ b[kept])
        rest = max(square - float(b[kept] @ value), 0.0)
        if rest + rank * np.log(count) >= least:
            continue
        least = rest + rank * np.log(count)
        shared = root @ (root.T @ gain[kept])
        factor = rest / (count - rank) if chi2.sf(rest, count - rank) < FALSE_ALARM else 1.0
        own = np.sqrt(factor) * factor_of(root @ root.T - shared @ shared.T, unit)
        terms = kept[kept < n]

        def whole(part: Array, terms: Array = terms) -> Array:
            full = np.zeros((n, *part.shape[1:]))
            full[terms] = part[: terms.size]
            return full

        best = replace(
            blank, value=whole(value), root=whole(own), shared=whole(shared), size=whole(unit), order=order,
            open=whole(unit[:, None] * vectors[:, ~good]), factor=factor,
        )  # fmt: skip
    if best is None:
        raise DatasetError(f"'{name}': {count} values do not determine the errors of its axes; measure more targets")
    return best


def _terms(model: Machine, levels: Sequence[int], highest: int) -> list[tuple[int, int]]:
    """Return all terms: squareness, and polynomials from the first order that belongs to an error alone."""
    motions = 6 * len(model.axis_names)
    terms = [(error, -1) for error in range(motions, len(model.error_names))]
    for k, axis in enumerate(model.axis_names):
        for dof in range(6):
            first = 2 if is_straightness(dof, axis) else 1
            terms += [(6 * k + dof, order) for order in range(first, min(highest, levels[k] - 1) + 1)]
    return terms


def _whole(model: Machine, q: Array, tool: Array, turns: bool) -> Array:
    """Return the effect of the motions of the whole (m, 6, 6); with rotations of the tool alone (m, 6, 9)."""
    place = model.nominal_pose(q).apply(tool)
    G = np.zeros((len(q), 6, 9 if turns else 6))
    G[:, :3, :3], G[:, 3:, 3:6] = np.eye(3), np.eye(3)
    G[:, :3, 3:6] = -cross_matrix(place)
    G[:, 3:, 6:] = np.eye(3)[:, : G.shape[2] - 6]
    return G
