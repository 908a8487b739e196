"""The chapter of a moving axis: the ranges of ISO 230-3 ahead of the generic chapter."""

from __future__ import annotations

from dataclasses import replace

import xarray as xr

from errormotion.report.document import Cell, Part, Section, Source, Table, estimate
from errormotion.report.parts import generic
from errormotion.report.text import SECOND_OF_ARC, UM, fixed

MEASURES = {
    "range_60min": "first 60 min",
    "range_moving": "moving",
    "range_total": "whole test",
    "end_of_moving": "at the end of moving",
}


def part(source: Source, key: str) -> Part:
    """Return the chapter; ``key`` keeps the identifiers of its figures apart."""
    errors = source.errors
    found = generic.part(source, key)
    title = f"Thermal distortion by the moving axis {errors.attrs['component']}"
    tables = [_table(errors, str(freedom)) for freedom in errors["freedom"].values]
    return replace(
        found, title=title, sections=[Section("distortion", "Figures of ISO 230-3", tables), *found.sections]
    )


def _table(errors: xr.Dataset, freedom: str) -> Table:
    unit, size = UM if freedom[1] in "XYZ" else SECOND_OF_ARC
    places = next(errors[name].values for name in "xyz" if name in errors.coords and errors[name].dims == ("position",))
    rows: list[list[Cell | str]] = []
    for quantity in map(str, errors["quantity"].values):
        of = errors.sel(freedom=freedom, quantity=quantity)
        cells = [
            estimate(
                float(of["distortion"].sel(measure=measure)) / size,
                2.0 * float(of["distortion_u"].sel(measure=measure)) / size,
                signed=measure == "end_of_moving",
                reason="the test is shorter",
            )
            for measure in MEASURES
        ]
        rows.append([quantity, *cells])
    caption = (
        f"Ranges of {freedom}, and its change at the end of moving, in {unit}, at P1 = {fixed(places[0] * 1e3, 1)} mm, "
        f"P2 = {fixed(places[1] * 1e3, 1)} mm, and of their difference. After ±: expanded uncertainty, k = 2."
    )
    return Table(caption, ["", *MEASURES.values()], rows)
