"""The chapter of any error dataset: figures of merit, error motions over the dims, uncertainty, data quality."""

from __future__ import annotations

import numpy as np

from errormotion.report import budget
from errormotion.report.document import Block, Part, Source
from errormotion.report.elements import (
    PROVENANCE,
    UNCERTAINTY,
    Chapter,
    Curves,
    FigureBudget,
    FigureTable,
    Further,
    KeyFigures,
    Notes,
    Own,
    Reliability,
    Section,
)
from errormotion.report.elements.standard import RELIABILITY
from errormotion.report.text import listed


def _values(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - a table has no identifiers
    """Return the table of the errors at a single place; nothing for errors over a dim, which are curves."""
    errors = source.errors
    return [] if errors.em.dims else [budget.twist_table(errors, {"value": errors}, errors.em.iso_names())]


def _summary(source: Source) -> list[str]:
    errors = source.errors
    names = errors.em.iso_names()
    seen = [name for name in errors.em.names if np.isfinite(errors[name].values).any()]
    unseen = [name for name in errors.em.names if name not in seen]
    places = " × ".join(f"{errors.sizes[dim]} {dim}s" for dim in errors.em.dims) or "one place"
    words = [f"Observed: {listed([names[name] for name in seen]) or 'nothing'}, at {places}."]
    if unseen:
        words.append(f"Not observed: {listed([names[name] for name in unseen])}. Reported as unknown, not as zero.")
    if "deviation" in errors:
        words.append("The errors are measured along one known direction only; no single freedom is determined.")
    return words


CHAPTER = Chapter(
    "Errors of component {component}",
    (
        KeyFigures(),
        _summary,
        Section("figures", "Figures of merit", (FigureTable(), FigureBudget())),
        Section("errors", "Error motions", (Own(_values), Curves(absent="No error is known."))),
        UNCERTAINTY,
        Section(
            "quality", "Data quality", (Notes(), Reliability(), Further(shown=(*RELIABILITY, "smallest_error_effect")))
        ),
        PROVENANCE,
    ),
)


def part(source: Source, key: str) -> Part:
    """Return the chapter of one error dataset; ``key`` makes the identifiers of its figures unique."""
    return CHAPTER.made(source, key)
