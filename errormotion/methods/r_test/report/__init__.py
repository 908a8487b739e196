"""Report chapter: location errors and error motions of a rotary table."""

from __future__ import annotations

from collections.abc import Callable

import xarray as xr

from errormotion.datasets.results.merit import is_planned
from errormotion.report.document import Part, Source
from errormotion.report.elements import (
    NOT_DETERMINED,
    PROVENANCE,
    UNCERTAINTY,
    Chapter,
    Curves,
    FigureBudget,
    FigureTable,
    KeyFigures,
    Notes,
    PolarPlot,
    Reliability,
    Section,
    Sentence,
)
from errormotion.report.page.language import texts_of

LOCATION, RANGE = ("E*0*",), ("range of *",)
"""Names of the figures of merit."""
MEANINGS = {
    **{f"E{axis}0*": f"offset of the axis average line in {axis}" for axis in "XYZ"},
    **{f"E{turn}0*": f"rotation of the axis average line about {axis}" for turn, axis in ("AX", "BY", "CZ")},
}
"""What a location error is, by its name."""


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a test; none for a plan, which has no values."""
    return [] if is_planned(source.errors) else [CHAPTER.made(source)]


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter, from English texts to those in the language."""
    return texts_of(__name__, language)


def _number_of(dim: str) -> Callable[[xr.Dataset], int]:
    return lambda errors: errors.sizes[dim]


def _spheres(errors: xr.Dataset) -> str:
    return f"{errors.sizes['sphere']} spheres" if errors.sizes["sphere"] > 1 else "one sphere"


def _point(errors: xr.Dataset) -> str:
    return ", ".join(f"{1e3 * each:.6g}" for each in errors.attrs["functional_point"])


CHAPTER = Chapter(
    "R-test of rotary axis {component}",
    (
        KeyFigures(LOCATION),
        Sentence(
            "Readings at {angles} angles, of {spheres} on the table by {sensors} sensors in the nest.",
            {"angles": _number_of("angle"), "spheres": _spheres, "sensors": _number_of("sensor")},
        ),
        Sentence("The errors are those at the point ({point}) mm in the frame '{frame}'.", {"point": _point}),
        NOT_DETERMINED,
        Section(
            "location",
            "Location errors",
            (
                FigureTable(
                    "Location errors of axis {component}: displacement of its average line, actual minus nominal. "
                    "After ±: expanded uncertainty, k = 2.",
                    LOCATION,
                    meanings=MEANINGS,
                ),
                FigureBudget(
                    LOCATION,
                    "Uncertainty budget: standard uncertainty (k = 1) of the location errors, by group of sources.",
                ),
            ),
        ),
        Section(
            "motions",
            "Error motions",
            (
                PolarPlot("Error motions of axis {component} over the angle, enlarged, relative to its average line."),
                Curves("Error motions of axis {component} over the angle, actual minus commanded."),
                FigureTable("Range of each error motion over the angles. After ±: expanded uncertainty, k = 2.", RANGE),
            ),
        ),
        UNCERTAINTY,
        Section(
            "quality",
            "Data quality",
            (
                Notes(),
                Curves(
                    "Residuals over the angle, reading minus fitted, by sphere and sensor.",
                    ("residual",),
                    over="angle",
                    band=False,
                    most=12,
                ),
                Reliability(),
            ),
        ),
        PROVENANCE,
    ),
)
