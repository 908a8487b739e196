"""The chapter of a test of an axis: figures, graphs and the tables of the standard, uncertainty, data."""

from __future__ import annotations

import xarray as xr

from errormotion.methods.linear_positioning.report import lines
from errormotion.methods.linear_positioning.settings import LIMITS
from errormotion.plugins import FigureOfMerit
from errormotion.report.document import Source
from errormotion.report.elements import (
    PROVENANCE,
    AgainstLimits,
    Budget,
    Chapter,
    KeyFigures,
    Notes,
    On,
    Section,
    Sentence,
)
from errormotion.report.elements.figures import chosen
from errormotion.report.text import fixed, listed

KEY_FIGURES = ("A", "R", "E", "B", "M")


def _first(errors: xr.Dataset) -> list[str]:
    """Return the names of the figures at the head: those of the first freedom."""
    name = lines.freedoms(errors)[0].attrs["line"]
    return [f"{figure} of {name} (*" for figure in KEY_FIGURES]


def _targets(errors: xr.Dataset) -> str:
    place, runs = 1e3 * lines.freedoms(errors)[0]["place"].values, errors.sizes["run"]
    ends = " to ".join(f"{fixed(end, 1)} mm" for end in (place[0], place[-1]))
    return f"{place.size} targets from {ends}, {runs} run{'s' if runs > 1 else ''}"


def _measured(errors: xr.Dataset) -> str:
    return listed([each.attrs["line"] for each in lines.freedoms(errors)])


def _verdicts(source: Source) -> list[str]:
    """Return the decisions on the limits, with the expanded uncertainty as guard band (ISO 14253-1)."""
    found = {each.name.split()[0]: each for each in chosen(source, ()) if each.limit is not None}
    return [
        f"{name} is {_verdict(found.get(name), source.errors.attrs[limit])} {1e6 * source.errors.attrs[limit]:g} µm."
        for name, limit in LIMITS.items()
        if limit in source.errors.attrs and lines.freedoms(source.errors)[0].attrs["kind"] == lines.ALONG
    ]


def _verdict(figure: FigureOfMerit | None, limit: float) -> str:
    if figure is None:
        return "unknown, with a limit of"
    if figure.value + figure.expanded_uncertainty <= limit:
        return "within its limit of"
    if figure.value - figure.expanded_uncertainty > limit:
        return "above its limit of"
    return "not decided, since its uncertainty contains the limit of"


_INDEPENDENT = "independent noise"

CHAPTER = Chapter(
    "Positioning of axis {component}",
    (
        KeyFigures(_first),
        Sentence(
            "{targets}; {measured} measured. Errors are relative to the {reference}.",
            {"targets": _targets, "measured": _measured},
        ),
        _verdicts,
        Section(
            "figures",
            "Figures of ISO 230-2",
            (AgainstLimits(), On(lines.freedoms, (lines.FIGURES, lines.ALIGNED))),
        ),
        On(lines.freedoms, (Section("graph-{line}", "{kind} {line}", (lines.GRAPH, lines.BY_TARGET)),)),
        Section(
            "uncertainty",
            "Uncertainty",
            (
                Budget(lambda errors: [errors.sizes["position"] // 2], noise=_INDEPENDENT),
                Budget(noise=_INDEPENDENT),
                Sentence(
                    "Independent: from target to target, by the scatter of the readings. The error of every other "
                    "source is the same in the whole test. Bands and figures use the readings corrected for expansion."
                ),
            ),
        ),
        Section("quality", "Data quality", (Notes(),)),
        PROVENANCE,
    ),
)
