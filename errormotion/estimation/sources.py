"""From a fit to errors at places, with their covariance as an independent part and the effects of named sources.

Errors are functions of rows of the same tables as the readings: ``e = errors(x, c)``. With the derivatives J by the
local row of a place, B by the border, and the normal equations of the fit

* the readings make the covariance ``J T^-1 J'``, independent from place to place, and with the effect
  ``E = B - J F`` of the border its covariance ``E S^-1 E'``, common to the places;
* a constant taken as it is changes the unknowns by ``-N^-1 R' V^-1 (dr/dc)``, and the errors directly by ``de/dc``;
* a prior, such as that of an adjusted constant, has the effect ``cov(e, z) / sd``; what remains of ``S^-1`` is that of
  the readings, ``S^-1 (S - prior) S^-1``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.blocks import Constant, Index, Table
from errormotion.estimation.derivatives import by_rows, column
from errormotion.estimation.fit import Fit
from errormotion.estimation.problem import Problem
from errormotion.estimation.propagation import Seen, effects_of_constants

__all__ = ["Errors", "Places", "Source", "errors_of"]

ROUNDING = 1e-12
"""Part of a variance that is rounding."""
_ROWS = 4096
"""Places whose effects are rearranged at a time, in the cache of a core."""


@dataclass(frozen=True, eq=False)
class Places:
    """Where errors are wanted.

    Attributes
    ----------
    equation : callable
        ``equation(x, c)`` returns the errors (place,) or (place, d) from the rows of unknowns and constants.
    rows : mapping of str to ndarray of int, (place,) or (place, w)
        The rows of each table, by its name among the unknowns and constants. A table of one row needs none; one with as
        many rows as there are places has one for each. Of any other the equation receives NaN: the errors do not
        depend on it.
    weights : mapping of str to ndarray, (place, w)
        The equation receives sums of rows with these weights.
    count : int
        Number of places.
    estimated : bool
        Whether places are unknown (NaN) whose row of the eliminated unknowns is not estimated.
    only : sequence of str
        Names of the tables that the errors depend on; default: all of which a place has a row.
    """

    equation: Callable[[Any, Any], Array]
    count: int
    only: Sequence[str] = ()
    rows: Mapping[str, Index] = field(default_factory=dict)
    weights: Mapping[str, Array] = field(default_factory=dict)
    estimated: bool = False

    def tables(self, problem: Problem, values: Sequence[Array]) -> list[Table | None]:
        """Return the index map of each table with these values; None for one that the errors do not depend on."""
        names = [*getattr(problem.unknowns, "_fields", ()), *getattr(problem.constants, "_fields", ())]
        return [
            self._table(name, table, len(value))
            for name, table, value in zip(names, problem.tables, values, strict=True)
        ]

    def _table(self, name: str, table: Table, size: int) -> Table | None:
        index = self.rows.get(name)
        if self.only and name not in self.only:
            return None
        if index is None:
            if size not in (1, self.count):
                return None
            index = np.arange(self.count) if size == self.count else np.zeros(self.count, dtype=np.intp)
        return Table(index=index, weight=self.weights.get(name), scale=table.scale)


@dataclass(frozen=True, eq=False)
class Source:
    """One draw for many places: its effect (place, d) by one standard uncertainty, name, group and identity.

    Draws without a meaning of their own, such as random effects, have in ``joined`` the name under which they may be
    replaced by fewer ones with the same covariance (`fewest`).
    """

    name: str
    group: str
    effect: Array
    identity: str = ""
    joined: str = ""


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors at places.

    Attributes
    ----------
    value : ndarray, (place, d)
    own : ndarray, (place, d, d)
        Covariance that is independent from place to place.
    sources : list of Source
        All others.
    """

    value: Array
    own: Array
    sources: list[Source]

    @cached_property
    def influence(self) -> Array:
        """Effects of all sources, (source, place, d)."""
        return np.array([source.effect for source in self.sources]).reshape(-1, *self.value.shape)

    @property
    def covariance(self) -> Array:
        """Total at each place, (place, d, d)."""
        F = self.influence
        return np.asarray(self.own + np.einsum("spi,spj->pij", F, F, optimize=True))

    def budget(self) -> dict[str, Array]:
        """Return the standard uncertainty by each group, (place, d); that of the independent part has the name ''."""
        by_group = {"": np.sqrt(np.maximum(np.diagonal(self.own, axis1=1, axis2=2), 0.0))}
        for source in self.sources:
            by_group[source.group] = np.hypot(by_group.get(source.group, 0.0), source.effect)
        return by_group


def errors_of(
    fit: Fit, places: Places, *, factor: float = 1.0, shared: str = "readings", sources: bool = True
) -> Errors:
    """Return the errors of a fit.

    Parameters
    ----------
    fit : Fit
    places : Places
    factor : float
        Variance factor of the readings; their part only is multiplied by it.
    shared : str
        Group of what the readings contribute to all places together, by the border. With one place it is independent.
    sources : bool
        Whether covariance and sources are wanted; otherwise they are 0 and none, as for a trial.
    """
    problem, linear, normal = fit.problem, fit.linear, fit.normal
    values = [*linear.at.tables, *problem.constant_tables(linear.at)]
    maps = places.tables(problem, values)
    seen = [k for k, table in enumerate(maps) if table is not None]
    unseen = [np.full((places.count, value.shape[1]), np.nan) for value in values]
    count = len(problem.unknowns)

    def equation(each: list[Array]) -> Array:
        rows = unseen.copy()
        for k, row in zip(seen, each, strict=True):
            rows[k] = row
        return column(places.equation(*problem.named(rows[:count], rows[count:])))

    tables = {k: table for k, table in enumerate(maps) if table is not None}
    value = equation([table.rows(values[k]) for k, table in tables.items()])
    if not np.isfinite(value).any():
        tables_of = [*problem.unknowns._fields, *getattr(problem.constants, "_fields", ())]
        without = ", ".join(name for k, name in enumerate(tables_of) if k not in tables)
        raise FitError(
            f"all errors are NaN; places need the rows of the tables that they depend on (without: {without})",
            code="estimation.places.no_errors",
        )
    local = linear.numbering.local
    if places.estimated and local in tables:
        estimated = problem.unknowns[local].freed[tables[local].index2[:, 0]].any(axis=1)
        value = np.where(estimated[:, None], value, np.nan)
    if not sources:
        return Errors(value, np.zeros((*value.shape, value.shape[1])), [])
    its = by_rows(equation, list(tables.values()), [values[k] for k in seen], range(len(seen)))
    J = dict(zip(seen, its, strict=True))
    its_own, places_see = _by_place(fit, tables, J)
    own, E = its_own * factor, places_see.border
    sources_of_errors = list[Source]()
    if E.shape[2]:
        root = normal.root
        information = _prior(fit)
        words, at = _priors(fit)
        of_priors = _by_source(E @ (root @ root[at].T * np.sqrt(information[at])))
        sources_of_errors += [
            Source(name, group, effect, identity, joined)
            for (name, group, identity, joined), effect in zip(words, of_priors, strict=True)
        ]
        K = E @ _of_readings(root, information) * np.sqrt(factor)
        if places.count == 1:
            own = own + K @ np.swapaxes(K, 1, 2)
        else:
            sources_of_errors += [
                Source(f"{shared} {k + 1}", shared, each, joined=shared)
                for k, each in enumerate(_by_source(K))
                if each.any()
            ]
    for k, effects in effects_of_constants(fit, tables, J, places_see):
        constant = problem.constants[k]
        names, identities = _named(constant, problem.constants._fields[k])
        sources_of_errors += [
            Source(name, constant.group, effect, identity)
            for name, effect, identity in zip(names, effects, identities, strict=True)
        ]
    unknown = np.isnan(value)
    own = np.where(unknown[:, :, None] | unknown[:, None, :], np.nan, own)
    return Errors(value, own, sources_of_errors)


def _of_readings(root: Array, information: Array) -> Array:
    """Return K (q, r) with ``K K' = S^-1 (S - prior) S^-1``, the part of the readings in the covariance of the border.

    ``K = root (1 - root' prior root)^(1/2)``.
    """
    if not information.any():
        return root
    power, vectors = np.linalg.eigh(np.eye(root.shape[1]) - (root.T * information) @ root)
    kept = power > ROUNDING
    return np.asarray(root @ (vectors[:, kept] * np.sqrt(power[kept])))


def _by_place(fit: Fit, tables: Mapping[int, Table], J: Mapping[int, Array]) -> tuple[Array, Seen]:
    """Return own covariances (place, d, d), and what places see of the unknowns."""
    problem, linear, normal = fit.problem, fit.linear, fit.normal
    number, q = linear.numbering, linear.numbering.size
    count, d = next(iter(J.values())).shape[:2]
    E = np.zeros((count, d, q + 1))
    own = np.zeros((count, d, d))
    local, index = np.zeros((count, d, 1)), np.zeros(count, dtype=np.intp)
    for k, block in enumerate(problem.unknowns):
        if k not in J:
            continue
        each = J[k]
        if k == number.local:
            if each.shape[2] > 1:
                raise FitError(
                    "places: expected one row of the eliminated unknowns for each place", code="estimation.places.rows"
                )
            index = tables[k].index2[:, 0]
            local = each[:, :, 0] * block.freed[index][:, None, :]
            own = local @ normal.own[index] @ np.swapaxes(local, 1, 2)
            if normal.coupled:
                E[..., :q] -= local @ normal.F[index]
            continue
        columns = number.border[k][tables[k].index2].reshape(count, -1)
        flat = each.reshape(count, d, -1)
        same = count > 0 and bool((columns == columns[0]).all())
        for j in range(flat.shape[2]):
            if same:
                E[:, :, columns[0, j]] += flat[:, :, j]
            else:
                E[np.arange(count), :, columns[:, j]] += flat[:, :, j]
    for (k, constant), its in zip(problem.adjusted.items(), number.adjusted, strict=True):
        at = len(problem.unknowns) + k
        if at in J:
            E[..., its] += np.einsum("pdwc,pwcz->pdz", J[at], constant.factor[tables[at].index2])
    return own, Seen(local, index, E[..., :q])


def _prior(fit: Fit) -> Array:
    """Return the information of the priors of the border, (q,)."""
    return fit.linear.border_prior()[0]


def _priors(fit: Fit) -> tuple[list[tuple[str, str, str, str]], list[int]]:
    """Return name, group, identity and ``joined``, and the number, of every unknown of the border that has a prior."""
    problem, number = fit.problem, fit.linear.numbering
    words, at = [], []
    for name, block, border in zip(problem.unknowns._fields, problem.unknowns, number.border, strict=True):
        if not border.size:
            continue
        group = block.group or name
        for row, col in np.argwhere(block.freed & (block.information > 0)):
            joined = block.component[col] if block.component else ""
            words.append((f"{group} {row + 1}.{col + 1}", group, "", joined))
            at.append(int(border[row, col]))
    for (k, constant), its in zip(problem.adjusted.items(), number.adjusted, strict=True):
        names, ids = _named(constant, problem.constants._fields[k])
        words += [(name, constant.group, one, "") for name, one in zip(names, ids, strict=True)]
        at += its.tolist()
    return words, at


def _named(constant: Constant, name: str) -> tuple[Sequence[str], Sequence[str]]:
    """Return names and identities of the sources of a constant."""
    k, base = constant.sources, constant.group or name
    names = constant.names or ([base] if k == 1 else [f"{base} {j + 1}" for j in range(k)])
    return names, constant.identity or [""] * k


def _by_source(effect: Array) -> Array:
    """Return effects (place, d, k) in the order of memory (k, place, d)."""
    places, d, k = effect.shape
    effects = np.empty((k, places, d))
    for first in range(0, places, _ROWS):
        effects[:, first : first + _ROWS] = np.moveaxis(effect[first : first + _ROWS], 2, 0)
    return effects
