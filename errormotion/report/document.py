"""Elements of a report: parts, sections and blocks, independent of layout.

Chapters build them from datasets; templates render them. Text is plain text, which the templates escape.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import xarray as xr
from markupsafe import Markup

from errormotion.datasets.results.merit import figures_of
from errormotion.plugins import ERRORS_SCHEMA, FigureOfMerit
from errormotion.report.text import DASH, rounded


@dataclass(frozen=True)
class Cell:
    """One cell of a table: text, an optional expanded uncertainty, and the reason of a missing value."""

    text: str | Markup
    uncertainty: str = ""
    reason: str = ""


def estimate(
    value: float, expanded: float, *, reason: str = "", signed: bool = True, unit: str = "", digits: int = 4
) -> Cell:
    """Return a value with its expanded uncertainty, rounded consistently; a dash with its reason for NaN."""
    text, uncertainty = rounded(value, expanded, signed=signed, digits=digits)
    if text == DASH:
        return Cell(DASH, reason=reason or "not determined")
    suffix = f" {unit}" if unit else ""
    if uncertainty == DASH:
        return Cell(text + suffix, reason="no uncertainty is stated for this value")
    return Cell(text, uncertainty + suffix)


def or_dash(text: str, reason: str) -> Cell:
    """Return a cell of this text; if the text is a dash, with its reason."""
    return Cell(text, reason=reason if text == DASH else "")


@dataclass(frozen=True)
class Text:
    """One paragraph; ``kind`` is ``plain``, ``note`` or ``warning``."""

    text: str
    kind: str = "plain"


def noted(text: str, kind: str = "note") -> list[Block]:
    """Return a text in place of what is missing; nothing without a text."""
    return [Text(text, kind)] if text else []


@dataclass(frozen=True)
class Table:
    """A table with a head (one or two rows), a caption, and footnotes collected from its cells."""

    caption: str
    head: Sequence[str | Markup]
    rows: Sequence[Sequence[Cell | str]]
    groups: Sequence[tuple[str | Markup, int]] = ()
    numeric: bool = True
    notes: Sequence[str] = ()

    @property
    def wide(self) -> bool:
        """Whether its columns need smaller letters to fit beside one another."""
        texts = [[str(name) for name in self.head], *([_shown(cell) for cell in row] for row in self.rows)]
        columns = zip(*(row for row in texts[1:] if len(row) == len(self.head)), strict=True)
        return self.numeric and (len(self.head) > 7 or sum(2 + max(map(len, column)) for column in columns) > _FITTING)

    @property
    def footnotes(self) -> dict[str, str]:
        """Marks of all reasons in cells, in reading order: a, b, c ..."""
        reasons = (cell.reason for row in self.rows for cell in row if isinstance(cell, Cell) and cell.reason)
        return {reason: _mark(i) for i, reason in enumerate(dict.fromkeys(reasons))}


_FITTING = 104
"""Characters of a row that fit in letters of the usual size, with two for the room of each column."""


def _shown(cell: Cell | str) -> str:
    if not isinstance(cell, Cell):
        return str(cell)
    return f"{cell.text} ± {cell.uncertainty}" if cell.uncertainty else str(cell.text)


def _mark(index: int) -> str:
    letters = "abcdefghijklmnopqrstuvwxyz"
    more, last = divmod(index, 26)
    return (letters[more - 1] if more else "") + letters[last]


@dataclass(frozen=True)
class Figure:
    """A drawing as inline SVG, with a caption and a description for readers who cannot see it."""

    svg: Markup
    caption: str
    alt: str


@dataclass(frozen=True)
class KeyFigure:
    """One of the most important numbers, for the head of the report.

    ``named``: the label is a name of the data, which the page translates only if a catalogue contains it.
    """

    label: str
    value: Cell
    unit: str
    note: str = ""
    named: bool = False


Block = Text | Table | Figure

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Section:
    """A titled sequence of blocks; ``name`` is its anchor in the page."""

    name: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Part:
    """One chapter of a report.

    ``kind`` is the title line of a report that starts with this chapter. ``stated`` is whether the chapter states
    errors with their uncertainty; a log does not.
    """

    title: str
    key_figures: Sequence[KeyFigure]
    summary: Sequence[str]
    sections: Sequence[Section]
    overview: Figure | None = None
    kind: str = "Test report"
    stated: bool = True


@dataclass(frozen=True)
class Source:
    """Source of a chapter: one dataset, and other data of the measurement.

    Attributes
    ----------
    errors : Dataset
        An error dataset, or another dataset for which a plugin writes chapters, such as a log.
    raw : Dataset, optional
        The raw dataset that the errors come from.
    run : mapping
        The content of ``run.json``, if there is one.
    provenance : mapping
        The provenance of the errors, read from its JSON.
    key : str
        Prefix that makes the identifiers of figures unique in the page.
    limits : mapping of str to (lower, upper)
        Limits of freedoms and figures of merit by name, SI; infinite where there is none. Those of freedoms are lines
        in the drawings.
    """

    errors: xr.Dataset
    raw: xr.Dataset | None = None
    run: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    key: str = "p1"
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @cached_property
    def merit(self) -> tuple[Sequence[FigureOfMerit], str]:
        """The figures of merit; and if the plugin could not compute them, what failed."""
        if str(self.errors.attrs.get("schema")) != ERRORS_SCHEMA:
            return (), ""
        try:
            return figures_of(self.errors), ""
        except Exception as error:  # of a plugin
            log.exception("the figures of merit failed")
            return (), f"{type(error).__name__}: {error}"

    @property
    def settings(self) -> Mapping[str, Any]:
        """Effective settings of the method from the provenance; empty if there are none."""
        settings = self.provenance.get("settings")
        return settings if isinstance(settings, Mapping) else {}
