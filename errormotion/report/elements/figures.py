"""Figures of merit of a chapter as data: the key figures, their table, their budget, and what makes U large."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import xarray as xr
from markupsafe import escape

from errormotion.datasets.results.effects import effects_of, influence_of
from errormotion.datasets.results.merit import is_planned, states_figures
from errormotion.plugins import FigureOfMerit
from errormotion.report import document
from errormotion.report.budget import readable
from errormotion.report.document import Block, Cell, KeyFigure, Source, estimate, or_dash
from errormotion.report.elements.quantities import unit_of
from errormotion.report.elements.tables import filled
from errormotion.report.text import decimals_of, fixed, listed, rounded, significant
from errormotion.tolerances.conformity import matches

LARGE_OF_LIMIT = 1.0 / 3.0
"""U divided by the limit from which on the chapter states the source that makes it large."""
LARGE_OF_VALUE = 0.5
"""U divided by the value from which on it does so without a limit."""
INDEPENDENT = "independent"
Names = Sequence[str] | Callable[[xr.Dataset], Sequence[str]]
"""Names of figures of merit, in which ``*`` stands for any characters, or a function of the dataset."""
_PLACE = re.compile(r" at (.*)| (after .*)| \((.*)\)$")
"""What follows the name of a figure at the head: its place, its time, or the standard that defines it."""
_MOST = 8
"""Key figures; the table contains all."""
_NAMED = 3
"""Further names in a sentence."""


@dataclass(frozen=True)
class KeyFigures:
    """The main numbers of a result at its head, with the source of an uncertainty that is large.

    Attributes
    ----------
    names : sequence of str or callable
        Names of figures of merit, in this order; ``*`` stands for any characters; or a function of the dataset that
        returns them. By default all. A result without figures of merit states its largest errors.
    units : mapping of str to str
        Unit on the page by the SI unit, keys of `quantities.UNITS`; by default um and arcsec.
    note : str
        Below each figure that has no limit; by default the place or time in its name, which follows " at " or
        " after ", or the standard in parentheses at its end.
    signed : bool
        Whether a positive value has a plus sign.
    """

    names: Names = ()
    units: Mapping[str, str] | None = None
    note: str = ""
    signed: bool = False

    def key_figures(self, source: Source) -> list[KeyFigure]:
        """Return the figures for the head of the chapter."""
        found = []
        stated = chosen(source, self.names)
        for each in stated[:_MOST] or largest(source):
            unit, size = unit_of(each.unit, (self.units or {}).get(each.unit, ""))
            limit = limit_of(source, each)
            name, *place = _PLACE.split(each.name, 1)
            note = self.note or "".join(filter(None, place)) if stated else "largest"
            if math.isfinite(limit):
                note = f"limit {_with(significant(limit / size, 3), unit)}"
            cell = estimate(each.value / size, each.expanded_uncertainty / size, signed=self.signed or not stated)
            found.append(KeyFigure(name, cell, unit, note, named=True))
        return found

    def sentences(self, source: Source) -> list[str]:
        """Return what makes uncertainties large, a sentence for each leading group of sources."""
        if is_planned(source.errors):
            return []
        stated = chosen(source, self.names) or largest(source)
        return reasons(source, [each for each in stated if is_large(source, each)], self.units)


@dataclass(frozen=True)
class FigureTable:
    """The table of figures of merit.

    Attributes
    ----------
    caption : str
    names : sequence of str or callable
        As in `KeyFigures`.
    units : mapping of str to str
        As in `KeyFigures`.
    meanings : mapping of str to str
        What a figure is, by its name with ``*``; stated after the name.
    """

    caption: str = "Figures of merit. After ±: expanded uncertainty, k = 2."
    names: Names = ()
    units: Mapping[str, str] | None = None
    meanings: Mapping[str, str] | None = None

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a table has no identifiers
        """Return the table; nothing without figures."""
        figures = chosen(source, self.names)
        if not figures:
            return []
        limits = [limit_of(source, each) for each in figures]
        some = any(math.isfinite(limit) for limit in limits)
        rows: list[list[Cell | str]] = []
        for each, limit in zip(figures, limits, strict=True):
            unit, size = unit_of(each.unit, (self.units or {}).get(each.unit, ""))
            meaning = next((text for name, text in (self.meanings or {}).items() if matches(name, each.name)), "")
            cell = estimate(each.value / size, each.expanded_uncertainty / size, signed=False)
            row: list[Cell | str] = [f"{each.name}, {meaning}" if meaning else each.name, cell, unit]
            rows.append([*row, significant(limit / size, 3) if math.isfinite(limit) else ""] if some else row)
        head = ["figure", "value", "unit", *(["limit"] if some else [])]
        return [document.Table(filled(self.caption, source.errors), head, rows)]


@dataclass(frozen=True)
class FigureBudget:
    """The uncertainty budget of figures of merit by group of sources.

    Attributes
    ----------
    names : sequence of str or callable
        As in `KeyFigures`; figures without known effects of the sources are left out.
    caption : str
    units : mapping of str to str
        As in `KeyFigures`.
    """

    names: Names = ()
    caption: str = "Uncertainty budget: standard uncertainty (k = 1) of the figures, by group of sources."
    units: Mapping[str, str] | None = None

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a table has no identifiers
        """Return the table; nothing without known effects."""
        figures = [each for each in chosen(source, self.names) if each.influence is not None]
        found = [by_group(source, each) for each in figures]
        if not found:
            return []
        groups = list(dict.fromkeys(name for each in found for name in each))
        sizes = [unit_of(each.unit, (self.units or {}).get(each.unit, "")) for each in figures]
        total = [each.expanded_uncertainty / 2 for each in figures]
        decimals = [decimals_of(u / size, 3) for u, (_, size) in zip(total, sizes, strict=True)]

        def row(name: str, values: Sequence[float]) -> list[Cell | str]:
            return [
                name,
                *(
                    or_dash(fixed(value / size, places), "not determined")
                    for value, (_, size), places in zip(values, sizes, decimals, strict=True)
                ),
            ]

        rows = [row(readable(name), [math.sqrt(max(each.get(name, 0.0), 0.0)) for each in found]) for name in groups]
        rows += [row("combined, k = 1", total), row("expanded, k = 2", [2 * u for u in total])]
        names = [escape(f"{each.name} / {unit}") for each, (unit, _) in zip(figures, sizes, strict=True)]
        return [document.Table(filled(self.caption, source.errors), ["source", *names], rows)]


def chosen(source: Source, names: Names) -> list[FigureOfMerit]:
    """Return the figures of merit that the method states, with these names in their order; all without names."""
    figures = list(source.merit[0]) if states_figures(source.errors) else []
    if not names:
        return figures
    names = names(source.errors) if callable(names) else names
    return [each for name in names for each in figures if matches(name, each.name)]


def largest(source: Source) -> list[FigureOfMerit]:
    """Return the largest error of each freedom as a figure, with the effects of the sources there."""
    errors = source.errors
    names, found = errors.em.iso_names(), list[FigureOfMerit]()
    for k, name in enumerate(errors.em.names):
        extreme = errors.em.largest(name)
        if extreme is None:
            continue
        influence = None
        if (variable := influence_of(errors)) in errors:
            F = errors[variable].transpose("source", *errors.em.dims, ...).values
            F = F.reshape(len(F), -1, len(errors.em.names))[:, extreme.place, k]
            influence = dict(zip(map(str, errors["source"].values), F.tolist(), strict=True))
        unit = str(errors[name].attrs.get("units", "1"))
        found.append(FigureOfMerit(names[name], extreme.value, extreme.expanded, unit, influence=influence))
    return found


def limit_of(source: Source, figure: FigureOfMerit) -> float:
    """Return the largest accepted absolute value of a figure, SI; infinite without a limit."""
    if figure.limit is not None:
        return abs(figure.limit)
    freedoms = {iso: name for name, iso in source.errors.em.iso_names().items()}
    for name, interval in source.limits.items():
        if name == freedoms.get(figure.name) or (name not in freedoms.values() and matches(name, figure.name)):
            return max((abs(each) for each in interval if math.isfinite(each)), default=math.inf)
    return math.inf


def is_large(source: Source, figure: FigureOfMerit) -> bool:
    """Return whether an uncertainty is large against its limit, or without a limit against its value."""
    U, limit = figure.expanded_uncertainty, limit_of(source, figure)
    if not (math.isfinite(U) and U > 0 and math.isfinite(figure.value)):
        return False
    return LARGE_OF_LIMIT * limit < U if math.isfinite(limit) else LARGE_OF_VALUE * abs(figure.value) < U


def by_group(source: Source, figure: FigureOfMerit) -> dict[str, float]:
    """Return the part of each group of sources in the variance of a figure; empty if no effect is known.

    The rest, which no source with a name has, is independent: noise of the readings.
    """
    effects = effects_of(source.errors, figure)
    if effects is None:
        return {}
    errors = source.errors
    groups = dict(zip(map(str, errors["source"].values), map(str, errors["source_group"].values), strict=True))
    found: dict[str, float] = {}
    for name, effect in effects.items():
        group = groups.get(name, name)
        found[group] = found.get(group, 0.0) + effect**2
    rest = (figure.expanded_uncertainty / 2) ** 2 - sum(found.values())
    found[INDEPENDENT] = max(rest, 0.0)
    return found


def reasons(source: Source, figures: Sequence[FigureOfMerit], units: Mapping[str, str] | None = None) -> list[str]:
    """Return which group of sources makes these uncertainties large, and what they would be without it."""
    leading: dict[str, list[tuple[FigureOfMerit, float]]] = {}
    for each in figures:
        parts = by_group(source, each)
        total = sum(parts.values())
        if total > 0:
            group = max(parts, key=lambda name: parts[name])
            leading.setdefault(group, []).append((each, parts[group] / total))
    words = []
    for group, found in leading.items():
        first, share = max(found, key=lambda each: each[1])
        unit, size = unit_of(first.unit, (units or {}).get(first.unit, ""))
        U, limit = first.expanded_uncertainty / size, limit_of(source, first)
        against = f"its limit {_with(significant(limit / size, 3), unit)}" if math.isfinite(limit) else "its value"
        without = rounded(0.0, U * math.sqrt(max(1 - share, 0.0)))[1] if share < 1 - 1e-6 else "0"
        others = [each.name for each, _ in found if each is not first]
        others[_NAMED:] = [f"{len(others) - _NAMED} more"] if len(others) > _NAMED else []
        more = f" The same applies to {listed(others)}." if others else ""
        remedy = "more readings" if group == INDEPENDENT else "a smaller uncertainty of this source"
        words.append(
            f"U of {first.name} is {_with(significant(U), unit)}, which is large against {against}. Its largest source "
            f"is '{readable(group)}' with {fixed(100 * share, 0)} % of the variance: {remedy} would lower it, to "
            f"{_with(without, unit)} at best.{more}"
        )
    return words


def _with(number: str, unit: str) -> str:
    return f"{number} {unit}".strip()
