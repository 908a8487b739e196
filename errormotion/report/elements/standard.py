"""Parts that every error dataset can have: spans, budget, quality of the readings, further results, provenance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr

from errormotion.datasets.results.places import place_of
from errormotion.report import budget, document, provenance, quality
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Cell, Source, Text, or_dash
from errormotion.report.elements.chapter import Section, Sentence
from errormotion.report.elements.quantities import FIELD, unit_of
from errormotion.report.elements.tables import Column, Table
from errormotion.report.text import DASH, decimals_of, finite, fixed, listed, percent, significant

UNSEEN = "not observed by this method"
WORDS = {"time": "instant"}
"""Name of a place along a dim, if it is not that of the dim."""
_KNOWN = {*FREEDOMS, "covariance", "influence", "deviation", "deviation_variance", "deviation_influence", "sensitivity"}
RELIABILITY = ("residual", "redundancy", "smallest_error", "left_out")
"""Variables of a method that is a measurement model, over the dims of its readings."""


@dataclass(frozen=True)
class Spans:
    """Lowest and highest value of each error, and its expanded uncertainty."""

    caption: str = "Span of the error motions and their expanded uncertainty, k = 2."

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a table has no identifiers
        """Return the table."""
        errors = source.errors
        names, u, rows = errors.em.iso_names(), errors.em.expanded(2.0), list[list[Cell | str]]()
        for name in errors.em.names:
            unit, size = unit_of(str(errors[name].attrs.get("units", "1")))
            values, expanded = errors[name].values / size, u.sel(dof=name).values / size
            U = [finite(of, expanded) for of in (np.median, np.max)]
            places = decimals_of(U[0], 2) if U[0] > 0 else 2
            ends = [fixed(finite(of, values), places, signed=True) for of in (np.min, np.max)]
            unstated = UNSEEN if ends[0] == DASH else "no uncertainty is stated for this value"
            cells = [*(or_dash(end, UNSEEN) for end in ends), *(or_dash(significant(each), unstated) for each in U)]
            rows.append([names[name], unit, *cells, percent(float(np.isfinite(values).mean()))])
        head = ["error", "unit", "lowest", "highest", "U, median", "U, largest", "determined"]
        return [document.Table(self.caption, head, rows)]


def last_place(errors: xr.Dataset) -> list[int]:
    """Return the indices of the last place."""
    return [errors.sizes[dim] - 1 for dim in errors.em.dims]


def _at(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:
    place = place_of(errors, dims, index)
    return f"at {place}" if place else ""


@dataclass(frozen=True)
class Budget:
    """The uncertainty budget of the errors at one place.

    Attributes
    ----------
    at : callable
        Returns the indices of the place along the dims of the errors, None for no budget; by default the last place.
    place : callable
        ``place(dataset, dims, index)``: the place in words; by default ``at`` it in field units.
    noise : str
        Name of the part that is independent from place to place.
    words : mapping of str to str
        Further names of groups of sources on the page.
    """

    at: Callable[[xr.Dataset], Sequence[int] | None] = last_place
    place: Callable[[xr.Dataset, Sequence[str], Sequence[int]], str] = _at
    noise: str = ""
    words: Mapping[str, str] = field(default_factory=dict)

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a table has no identifiers
        """Return the table; nothing if the dataset states no effects of sources."""
        errors = source.errors
        if not {"influence", "deviation_influence"} & set(errors.data_vars):
            return []
        dims = errors.em.dims
        index = self.at(errors)
        if index is None:
            return []
        place = self.place(errors, dims, index)
        noise = self.noise
        if dims and not noise:
            along = " and ".join(WORDS.get(dim, dim) for dim in dims)
            noise = f"noise, independent from {along} to {along}"
        here = errors.isel(dict(zip(dims, index, strict=True)))
        made = budget.table(here, place, noise or budget.readable("independent"))
        return [replace(made, rows=[[self.words.get(str(row[0]), row[0]), *row[1:]] for row in made.rows])]


@dataclass(frozen=True)
class Notes:
    """The notes of the method, the completeness of the record, and its counts."""

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - texts have no identifiers
        """Return the texts."""
        return [*quality.notes(source.errors), *quality.sentences(source.errors, source.raw)]


@dataclass(frozen=True)
class Reliability:
    """Residuals and reliability of the readings of a measurement model, by the dims that the errors do not have."""

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the table; nothing if the dataset states no residuals of readings."""
        errors = source.errors
        if not set(RELIABILITY) <= set(errors.data_vars):
            return []
        over = [str(dim) for dim in errors["residual"].dims if dim not in errors.em.dims]
        if not over:
            return []
        si = str(errors["residual"].attrs.get("units", "1"))
        unit = FIELD.get(si, "")
        table = Table(
            "Residuals and reliability of the readings. Residual: reading minus fitted, of the readings used. "
            "Redundancy: share of a wrong reading that its residual shows. Smallest error: wrong reading that would be "
            "found with a probability of 80 %.",
            (
                Column(_used, unit=unit, head="rms", reduce="rms", signed=False, format="3"),
                Column(_used, unit=unit, head="largest", reduce="largest", signed=False, format="3"),
                Column("redundancy", head="lowest", reduce="lowest", signed=False, format=".2"),
                Column("smallest_error", unit=unit, head="smallest error", reduce="highest", signed=False, format="3"),
                Column("left_out", head="left out", reduce="sum", format="integer"),
            ),
            over,
            groups=(("", 1), ("residual", 2), ("redundancy", 1), ("", 2)),
        )
        return table.blocks(source, key)


def _used(errors: xr.Dataset) -> xr.DataArray:
    """Return the residuals of the readings used."""
    return errors["residual"].where(errors["left_out"] == 0).assign_attrs(errors["residual"].attrs)


@dataclass(frozen=True)
class Further:
    """All further variables of the dataset, with their span in SI units; ``shown`` are those of other parts."""

    shown: Sequence[str] = ()

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a table has no identifiers
        """Return the table."""
        rows: list[list[Cell | str]] = []
        for name, variable in source.errors.data_vars.items():
            if name in _KNOWN or name in self.shown or str(name).endswith("_index"):
                continue
            span = ""
            if variable.dtype.kind in "iuf" and np.isfinite(np.asarray(variable.values, float)).any():
                values = np.asarray(variable.values, float)
                span = f"{finite(np.min, values):.4g} to {finite(np.max, values):.4g}"
            shape = ", ".join(f"{dim} {variable.sizes[dim]}" for dim in variable.dims) or "scalar"
            rows.append([str(name), shape, str(variable.attrs.get("units", "")), span])
        if not rows:
            return [Text("The result contains only the errors and their covariance.", "note")]
        caption = "Further results in the dataset, in SI units."
        return [document.Table(caption, ["name", "dims", "unit", "span"], rows, numeric=False)]


@dataclass(frozen=True)
class Provenance:
    """Instruments, settings, software and hashes."""

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - tables have no identifiers
        """Return the tables."""
        return provenance.blocks(source)


def _not_determined(errors: xr.Dataset) -> str | None:
    names = errors.em.iso_names()
    return listed([names[name] for name in errors.em.names if not np.isfinite(errors[name].values).any()]) or None


NOT_DETERMINED = Sentence("Not determined: {names}. Reported as unknown, not as zero.", {"names": _not_determined})
"""Which errors the measurement does not determine at any place."""
UNCERTAINTY = Section("uncertainty", "Uncertainty", (Spans(), Budget()))
PROVENANCE = Section("provenance", "Provenance", (Provenance(),))
