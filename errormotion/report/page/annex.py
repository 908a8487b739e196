"""Annex of a report: values in SI units, settings and versions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from errormotion.report.document import Block, Cell, Part, Section, Source, Table, Text, or_dash
from errormotion.report.text import DASH, typographic

SECTION = "provenance"
"""Name of the sections of chapters that belong to the annex."""


def divided(parts: Sequence[Part]) -> tuple[list[Part], list[Section]]:
    """Return the chapters without the sections of the annex, and these sections."""
    body = [replace(part, sections=[section for section in part.sections if section.name != SECTION]) for part in parts]
    annex = []
    for k, part in enumerate(parts, 1):
        of = f": {k} {part.title}" if len(parts) > 1 else ""
        annex += [
            replace(section, name=f"{SECTION}-{k}", title=section.title + of)
            for section in part.sections
            if section.name == SECTION
        ]
    return body, annex


def values(sources: Sequence[Source]) -> list[Section]:
    """Return the section of the figures of merit in SI units, unrounded; empty without figures of merit."""
    blocks: list[Block] = []
    for source in sources:
        figures, failure = source.merit
        if failure:
            blocks.append(Text(f"The figures of merit could not be computed: {failure}.", "note"))
        rows: list[list[Cell | str]] = [
            [each.name, _number(each.value), _number(each.expanded_uncertainty), each.unit or "1"] for each in figures
        ]
        if rows:
            of = f" of {source.errors.attrs['method']}" if len(sources) > 1 else ""
            caption = f"Figures of merit{of} as computed, in SI units; U: expanded uncertainty, k = 2."
            blocks.append(Table(caption, ["figure", "value", "U", "unit"], rows))
    return [Section("values", "Values in SI units", blocks)] if blocks else []


def _number(value: float | None) -> Cell:
    text = DASH if value is None or not math.isfinite(value) else typographic(f"{value:.9g}")
    return or_dash(text, "not determined")
