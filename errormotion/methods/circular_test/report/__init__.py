"""Report chapter: figures of ISO 230-4, the paths, and the errors of the axes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr

from errormotion.datasets.results.merit import is_planned
from errormotion.methods.circular_test.figures import MEANINGS
from errormotion.methods.circular_test.path import PARAMETERS, over_sectors
from errormotion.report.document import Block, Cell, Part, Source, estimate
from errormotion.report.document import Table as Rows
from errormotion.report.elements import (
    PROVENANCE,
    UNCERTAINTY,
    Chapter,
    Column,
    Curves,
    FigureBudget,
    FigureTable,
    KeyFigures,
    Notes,
    Of,
    Own,
    PolarPlot,
    Section,
    Sentence,
    Table,
)
from errormotion.report.page.language import texts_of
from errormotion.report.text import fixed, integer, listed

#: Words, field unit and its size in SI of each parameter; {0} and {1} are the axes.
WORDS = {
    "squareness": ("squareness of {1} to {0}", "µrad", 1e-6),
    "scale_mismatch": ("scale of {0} minus that of {1}", "µm/m", 1e-6),
    "servo_mismatch": ("following lag of {0} minus that of {1}", "ms", 1e-3),
    "backlash_1": ("backlash of {0}", "µm", 1e-6),
    "backlash_2": ("backlash of {1}", "µm", 1e-6),
    "bow_1": ("straightness of {0} (bow)", "µm", 1e-6),
    "bow_2": ("straightness of {1} (bow)", "µm", 1e-6),
    "spike_1": ("reversal spike of {0}", "µm", 1e-6),
    "spike_2": ("reversal spike of {1}", "µm", 1e-6),
}


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a test; none for a plan, which has no values."""
    return [] if is_planned(source.errors) else [CHAPTER.made(source)]


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter, from English texts to those in the language."""
    return texts_of(__name__, language)


def contributions(errors: xr.Dataset) -> dict[str, float]:
    """Return the range of the radial deviation that each single parameter causes, m."""
    R, V, decay = (float(each) for each in (errors.nominal_radius, errors.feed, errors["spike_decay"]))
    path = over_sectors(errors.sizes["angle"], R, V, decay)[..., 3:].reshape(-1, len(PARAMETERS))
    return dict(zip(PARAMETERS, np.ptp(path * errors["parameters"].values, axis=0).tolist(), strict=True))


def _parameters(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - a table has no identifiers
    """Return the parameters of the path with their uncertainty and their contribution."""
    errors, rows = source.errors, list[list[Cell | str]]()
    parts, u = contributions(errors), np.sqrt(np.diagonal(errors["parameter_covariance"].values))
    for name, value, sigma in zip(PARAMETERS, errors["parameters"].values, u, strict=True):
        words, unit, size = WORDS[name]
        cell = estimate(float(value) / size, 2 * float(sigma) / size)
        rows.append([words.format(*errors.attrs["plane"]), unit, cell, fixed(1e6 * parts[name], 2)])
    caption = (
        "Errors of the two axes by the model of the path. After ±: expanded uncertainty, k = 2. Contribution: range of "
        "the radial deviation caused by this error."
    )
    return [Rows(caption, ["error", "unit", "value", "contribution / µm"], rows)]


def _largest(errors: xr.Dataset) -> str:
    parts = contributions(errors)
    order = sorted(parts, key=lambda name: -parts[name])[:3]
    return listed([WORDS[name][0].format(*errors.attrs["plane"]) for name in order])


def _along(variable: str, direction: str) -> Callable[[xr.Dataset], xr.DataArray]:
    return lambda errors: errors[variable].sel(direction_of_travel=direction).rename(direction)


CCW, CW = (Of(_along("deviation", name), uncertainty=_along("noise_u", name)) for name in ("CCW", "CW"))


CHAPTER = Chapter(
    "Circular test in plane {plane}",
    (
        KeyFigures(),
        Sentence(
            "Circles of radius {radius} mm at a feed of {feed} mm/min, {count} readings in both directions.",
            {
                "radius": lambda errors: fixed(1e3 * errors.attrs["nominal_radius"], 1),
                "feed": lambda errors: fixed(6e4 * errors.attrs["feed"], 0),
                "count": lambda errors: integer(int(errors["reading_count"].sum())),
            },
        ),
        Sentence("Largest contributions to the circular deviation: {largest}.", {"largest": _largest}),
        Sentence(
            "Noise of a reading: {noise} µm; chi-square of the model of the path by degree of freedom: {misfit}.",
            {
                "noise": lambda errors: fixed(1e6 * float(errors["reading_noise"]), 3),
                "misfit": lambda errors: fixed(float(errors["misfit"]), 2),
            },
        ),
        Section(
            "circle",
            "Paths",
            (
                PolarPlot(
                    "Radial deviation on the circle in plane {plane}, enlarged, positive outward, without the "
                    "set-up error. Bands: uncertainty by noise only.",
                    (CCW, CW, (CCW, CW)),
                ),
                FigureTable(
                    "Figures of ISO 230-4. After ±: expanded uncertainty, k = 2. G and H compare the paths with one "
                    "another; F and D depend on the calibrated length of the bar.",
                    meanings={f"{name} *": meaning for name, meaning in MEANINGS.items()},
                ),
                FigureBudget(),
            ),
        ),
        Section(
            "model",
            "Errors of the axes",
            (
                Own(_parameters),
                Curves("Radial deviation over the angle, and the fitted model of the path.", ("deviation", "model")),
            ),
        ),
        UNCERTAINTY,
        Section(
            "quality",
            "Data quality",
            (
                Notes(),
                Table(
                    "Set-up error, removed. After ±: expanded uncertainty, k = 2.",
                    (Column("offset", head="set-up error", unit="um"),),
                    over="axis",
                ),
            ),
        ),
        PROVENANCE,
    ),
)
