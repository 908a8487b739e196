"""Effects of constants that are taken as they are: on the unknowns, and through them and directly on errors at places.

One standard uncertainty of a constant changes the residuals by ``v = R f``, with their derivatives R by the constant
and its factor f. With the weight W of the residuals, and their derivatives A by the local row and B by the border,

    y = -T^-1 A' W v,    z = -S^-1 (B - A F)' W v,    e = J y + E z + (de/dc) f.

J are the derivatives of the errors by the local row, and E those by the border with ``-J F`` of the local row.

Where each reading sees a row of its own, places are computed in parts that stay in the cache of a core: their small
matrices ``J T^-1 A' W R`` first, then the factors of all sources at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array
from errormotion.estimation.blocks import Constant, Index, Table
from errormotion.estimation.derivatives import by_rows
from errormotion.estimation.fit import Fit
from errormotion.estimation.linear.system import by_slot

__all__ = ["Seen", "effects_of_constants"]

_CHUNK = 64
"""Sources whose effects are computed at a time."""
_ROWS = 2048
"""Places, or readings, whose effects are computed at a time."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What places see of a fit.

    Attributes
    ----------
    local : ndarray, (place, d, p)
        Derivatives of the errors by the local row.
    index : ndarray of int, (place,)
        The local row of each place.
    border : ndarray, (place, d, q)
        E: their derivatives by the border, with that of the local rows.
    """

    local: Array
    index: Index
    border: Array


@dataclass(frozen=True, eq=False)
class _Effect:
    """A constant: derivatives of the residuals (n, m, w, c), of the errors (place, d, w, c), and their index maps."""

    constant: Constant
    of_readings: Array | None
    of_errors: Array | None
    at: Table | None

    def change(self, rows: Index | slice, part: slice = slice(None)) -> Array:
        """Return the changes of the residuals of some readings by its sources, (rows, m, k)."""
        if self.of_readings is None:
            raise ValueError("the readings do not depend on this constant")
        return _times(self.of_readings[rows], self.constant, self.constant.index2[rows], part)

    def direct(self, places: Index | slice, part: slice = slice(None)) -> Array:
        """Return the direct effects on the errors of some places, (places, d, k)."""
        if self.of_errors is None or self.at is None:
            raise ValueError("the errors do not depend on this constant")
        its = self.at.index2[places]
        if self.at.common:
            factor = self.constant.factor[its[0]][..., part].reshape(-1, self.constant.factor[..., part].shape[2])
            return np.asarray(self.of_errors[places].reshape(*self.of_errors[places].shape[:2], -1) @ factor)
        return np.asarray(np.einsum("pdwc,pwcz->pdz", self.of_errors[places], self.constant.factor[its][..., part]))


def _times(R: Array, constant: Constant, index: Index, part: slice = slice(None)) -> Array:
    """Return derivatives (k, m, w, c) times the factors of a constant, (k, m, sources)."""
    factor = constant.factor[..., part]
    flat = R.reshape(*R.shape[:2], -1)
    if constant.common:
        return np.asarray(flat @ factor[constant.index2[0]].reshape(-1, factor.shape[2]))
    return np.asarray(flat @ factor[index].reshape(len(flat), flat.shape[2], -1))


def effects_of_constants(
    fit: Fit, tables: Mapping[int, Table], J: Mapping[int, Array], seen: Seen
) -> list[tuple[int, Array]]:
    """Return the effects (source, place, d) of every constant that is taken as it is, by its number.

    Parameters
    ----------
    fit : Fit
    tables, J : mapping
        By the number of a table among unknowns and constants: the rows that places see, and the derivatives of the
        errors by them, (place, d, w, c).
    seen : Seen
    """
    problem = fit.problem
    effects = {
        k: _effect(fit, tables, J, k)
        for k, constant in enumerate(problem.constants)
        if not constant.adjust and constant.sources
    }
    if not effects:
        return []
    each = list(effects.values())
    if fit.linear.numbering.in_order and not fit.normal.chained:
        by_constant = _by_parts(fit, each, seen)
    else:
        by_constant = [_at_once(fit, one, seen) for one in each]
    return list(zip(effects, by_constant, strict=True))


def _effect(fit: Fit, tables: Mapping[int, Table], J: Mapping[int, Array], k: int) -> _Effect:
    """Return what readings and errors see of a constant."""
    problem, linear = fit.problem, fit.linear
    constant: Constant = problem.constants[k]
    name, at = problem.constants._fields[k], len(problem.unknowns) + k
    given = fit.constant_derivatives
    if name in given:
        R = by_slot(given[name], constant)
    else:
        values = [*linear.at.tables, *problem.constant_tables(linear.at)]
        R = by_rows(lambda rows: problem.evaluate(problem.y, rows), problem.tables, values, [at])[0]
    if not linear.used.all():
        R = np.where(linear.used[:, :, None, None], R, 0.0)
    return _Effect(constant, R if R.any() else None, J.get(at), tables.get(at))


def _by_parts(fit: Fit, effects: Sequence[_Effect], seen: Seen) -> list[Array]:
    """Return the effects of constants where each reading sees a row of its own, in parts."""
    linear, normal = fit.linear, fit.normal
    A, W, P = linear.local_matrix, linear.whitener, normal.pivots
    places, d = seen.local.shape[:2]
    b = [np.zeros((normal.S.shape[0], one.constant.sources)) for one in effects]
    for first in range(0, len(A), _ROWS) if len(normal.S) else ():
        part = slice(first, first + _ROWS)
        if not linear.border[part].any() and not normal.coupling[part].any():
            continue
        # (B - A F)' W of each reading, as F' = G' T^-1
        of_border = _on_border(fit, part) @ W[part]
        for sums, one in zip(b, effects, strict=True):
            if one.of_readings is not None:
                sums -= np.tensordot(of_border, one.change(part), axes=((0, 2), (0, 1)))
    z = [normal.covariance @ sums for sums in b]
    effects_by_source = [np.empty((one.constant.sources, places, d)) for one in effects]
    for first in range(0, places, _ROWS):
        part = slice(first, first + _ROWS)
        rows, E = seen.index[part], seen.border[part]
        H = -seen.local[part] @ P[rows] @ np.swapaxes(A[rows], 1, 2) @ W[rows]
        border, local = E.any(), H.any()
        for its, one, of_border in zip(effects_by_source, effects, z, strict=True):
            effect = np.zeros((len(rows), d, len(its)))
            if one.of_readings is not None:
                if local:
                    R = one.of_readings[rows]
                    HR = (H @ R.reshape(*R.shape[:2], -1)).reshape(len(rows), d, *R.shape[2:])
                    effect += _times(HR, one.constant, one.constant.index2[rows])
                if border:
                    effect += E @ of_border
            if one.of_errors is not None:
                effect += one.direct(part)
            its[:, part] = np.moveaxis(effect, 2, 0)
    return effects_by_source


def _on_border(fit: Fit, part: slice) -> Array:
    """Return ``(B - A F)'`` of some readings that see rows of their own, (rows, q, m)."""
    linear = fit.linear
    q, columns = fit.normal.S.shape[0], linear.numbering.columns[part]
    B = np.zeros((len(columns), q + 1, linear.border.shape[1]))
    seen = np.swapaxes(linear.border[part], 1, 2)
    np.add.at(B, (np.arange(len(columns))[:, None], columns), seen)
    border = B[:, :q]
    if fit.normal.coupled:
        border = border - np.swapaxes(linear.local_matrix[part] @ fit.normal.F[part], 1, 2)
    return border


def _at_once(fit: Fit, effect: _Effect, seen: Seen) -> Array:
    """Return the effects of a constant, some sources at a time."""
    linear, normal = fit.linear, fit.normal
    places, d = seen.local.shape[:2]
    by_source = np.empty((effect.constant.sources, places, d))
    for first in range(0, len(by_source), _CHUNK):
        part = slice(first, first + _CHUNK)
        its = np.zeros((places, d, len(by_source[part])))
        if effect.of_readings is not None:
            a, b = linear.gradient(linear.whitener @ effect.change(slice(None), part))
            y, z = normal.eliminated(-a, -b)
            its += seen.border @ z
            if linear.numbering.local is not None:
                its += seen.local @ y[seen.index]
        if effect.of_errors is not None:
            its += effect.direct(slice(None), part)
        by_source[part] = np.moveaxis(its, 2, 0)
    return by_source
