"""Report chapter: values of ISO 230-7, polar plots of the error motions, and what the record contains."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
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
    Of,
    PolarPlot,
    Section,
    Sentence,
)
from errormotion.report.elements.panels import Panel
from errormotion.report.page.language import texts_of
from errormotion.report.text import fixed, integer

KEY = (
    "synchronous radial, rotating",
    "asynchronous radial, rotating",
    "synchronous radial, fixed ?",
    "synchronous axial",
    "synchronous tilt, rotating",
)
MEANINGS = {
    "synchronous *, MZC": "about the centre of the minimum zone circles",
    "synchronous *, MIC": "about the centre of the maximum inscribed circle",
    "synchronous *, MCC": "about the centre of the minimum circumscribed circle",
    "synchronous *": "range of the mean over turns",
    "asynchronous *": "largest range at one angle over all turns",
    "total *": "range of all turns",
    "structural *": "range with the spindle at rest",
    "fundamental axial": "range of what occurs once a turn",
    "residual synchronous axial": "range of the other synchronous motion",
}
KINDS = ("radial, rotating", "radial, fixed X", "radial, fixed Y", "radial, fixed Z", "axial", "tilt, rotating")


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a test; none for a plan, which has no values."""
    return [] if is_planned(source.errors) else [CHAPTER.made(source)]


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter, from English texts to those in the language."""
    return texts_of(__name__, language)


def _curve(name: str, variable: str, extreme: str = "", word: str = "") -> Callable[[xr.Dataset], xr.DataArray | None]:
    """Return the reader of a curve over the angle, or of the outermost or innermost one of all turns."""

    def read(errors: xr.Dataset) -> xr.DataArray | None:
        if "curve" not in errors.coords or name not in errors["curve"].values.tolist():
            return None
        values = errors[variable].sel(curve=name, drop=True)
        if extreme:
            values = values + errors[extreme].sel(curve=name, drop=True)
        values.attrs["units"] = "rad" if name.startswith("tilt") else "m"
        return values.rename(word or name)

    return read


def _plot(name: str) -> Panel:
    mean = Of(_curve(name, "synchronous"), uncertainty=_curve(name, "synchronous_u"))
    outer = Of(_curve(name, "synchronous", "asynchronous_high", "max"), uncertainty="none")
    inner = Of(_curve(name, "synchronous", "asynchronous_low", "min"), uncertainty="none")
    return (mean, outer, inner)


def _number(name: str) -> Callable[[xr.Dataset], str]:
    return lambda errors: integer(int(errors.attrs[name]))


def _eccentric(errors: xr.Dataset) -> str:
    value = float(errors["eccentricity"])
    return f"{fixed(1e6 * value, 2)} µm" if np.isfinite(value) else "unknown"


CHAPTER = Chapter(
    "Error motions of spindle axis {component}",
    (
        KeyFigures(KEY),
        Sentence(
            "{turns} turns, {samples} samples of each sensor; synchronous motion up to {harmonics} undulations in one "
            "turn.",
            {name: _number(name) for name in ("turns", "samples", "harmonics")},
        ),
        Sentence("Eccentricity of the artefact, removed: {size}.", {"size": _eccentric}),
        NOT_DETERMINED,
        Section(
            "polar",
            "Polar plots",
            (
                PolarPlot(
                    "Error motions over the angle of the spindle, enlarged, about the centre of the least-squares "
                    "circle (axial: of the chart): mean over turns, and largest and smallest values of all turns.",
                    tuple(_plot(name) for name in KINDS),
                    columns=2,
                ),
                FigureTable(
                    "Values of ISO 230-7. After ±: expanded uncertainty, k = 2, with the bias of an extreme value.",
                    meanings=MEANINGS,
                ),
                FigureBudget(KEY),
            ),
        ),
        Section(
            "motions",
            "Error motions",
            (Curves("Synchronous error motions of axis {component} over the angle, without eccentricity."),),
        ),
        UNCERTAINTY,
        Section("quality", "Data quality", (Notes(),)),
        PROVENANCE,
    ),
)
