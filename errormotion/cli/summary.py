"""Figures of merit and notes of an error dataset, as the command line prints them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from errormotion.cli.output import table
from errormotion.plugins import FigureOfMerit

FIELD_UNITS = {"m": (1e6, "um"), "rad": (648000 / np.pi, "arcsec")}
"""Factor and name of the printed unit, by SI unit."""
MM_FROM = 1e-3
"""Smallest length that is printed in mm, m."""


def as_printed(figure: FigureOfMerit) -> dict[str, Any]:
    """Return a figure in its printed unit: name, value, expanded_uncertainty (k = 2), unit, limit."""
    factor, unit = FIELD_UNITS.get(figure.unit, (1.0, figure.unit))
    if figure.unit == "m" and abs(figure.value) >= MM_FROM:
        factor, unit = 1e3, "mm"
    return {
        "name": figure.name,
        "value": figure.value * factor,
        "expanded_uncertainty": figure.expanded_uncertainty * factor,
        "unit": "" if unit == "1" else unit,
        "limit": None if figure.limit is None else figure.limit * factor,
    }


def digits_of(figure: dict[str, Any]) -> tuple[str, str]:
    """Return value and expanded uncertainty of a printed figure, rounded by the uncertainty."""
    u = figure["expanded_uncertainty"]
    digits = max(0, 1 - math.floor(math.log10(u))) if math.isfinite(u) and u > 0 else 2
    return f"{figure['value']:.{digits}f}", f"{u:.{digits}f}" if math.isfinite(u) else "unknown"


def figure_table(figures: Sequence[dict[str, Any]]) -> str:
    """Return printed figures as a table; each value is rounded by its uncertainty."""
    rows = []
    for figure in figures:
        value, stated = digits_of(figure)
        limit = "" if figure["limit"] is None else f"{figure['limit']:g}"
        rows.append([figure["name"], value, stated, figure["unit"], limit])
    if any(row[-1] for row in rows):
        return table(["", "value", "U (k=2)", "unit", "limit"], rows)
    return table(["", "value", "U (k=2)", "unit"], [row[:-1] for row in rows])


def notes_of(errors: xr.Dataset) -> list[str]:
    """Return the notes of a result: what is missing, doubtful or assumed."""
    notes = errors.attrs.get("notes", [])
    return [str(note) for note in np.atleast_1d(notes) if str(note)]
