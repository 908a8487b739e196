"""The chapter of a moving axis: the ranges of ISO 230-3, then the generic chapter."""

from __future__ import annotations

from dataclasses import replace

import xarray as xr

from errormotion.methods.linear_positioning.report.view import coordinate
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
    """Return the chapter; ``key`` makes the identifiers of its figures unique."""
    errors = source.errors
    base = generic.part(source, key)
    title = f"Thermal distortion by the moving axis {errors.attrs['component']}"
    tables = [_table(errors, str(freedom)) for freedom in errors["freedom"].values]
    return replace(base, title=title, sections=[Section("distortion", "Figures of ISO 230-3", tables), *base.sections])


def _table(errors: xr.Dataset, freedom: str) -> Table:
    unit, size = UM if freedom[1] in "XYZ" else SECOND_OF_ARC
    P = errors[coordinate(errors)].values
    rows: list[list[Cell | str]] = []
    for quantity in map(str, errors["quantity"].values):
        selected = errors.sel(freedom=freedom, quantity=quantity)
        cells = [
            estimate(
                float(selected["distortion"].sel(measure=measure)) / size,
                2.0 * float(selected["distortion_u"].sel(measure=measure)) / size,
                signed=measure == "end_of_moving",
                reason="test too short",
            )
            for measure in MEASURES
        ]
        rows.append([quantity, *cells])
    caption = (
        f"Ranges of {freedom}, and its change at the end of moving, in {unit}, at P1 = {fixed(P[0] * 1e3, 1)} mm, "
        f"P2 = {fixed(P[1] * 1e3, 1)} mm, and of their difference. After ±: expanded uncertainty, k = 2."
    )
    return Table(caption, ["", *MEASURES.values()], rows)
