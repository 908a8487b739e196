"""Chapter of a Monte Carlo evaluation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.montecarlo.result import Line, lines
from errormotion.montecarlo.validation import NOT_VALIDATED, VALIDATED
from errormotion.report.document import Cell, KeyFigure, Part, Section, Source, Table, Text

if TYPE_CHECKING:
    import xarray as xr

MICROMETRE = (1e6, "um")
ARCSEC = (648000 / np.pi, "arcsec")


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a Monte Carlo evaluation."""
    ds = source.errors
    found = lines(ds)
    p = 100 * float(ds.attrs["probability"])
    rows = [_row(line) for line in found]
    intervals = [f"linear {p:g} %", f"Monte Carlo {p:g} %"]
    head = ["", "unit", "u linear", "u Monte Carlo", *intervals, "difference", "tolerance", "linear interval", "place"]
    caption = (
        "Standard uncertainties and intervals at the place where both intervals differ most against the tolerance "
        "(JCGM 101, clause 8)."
    )
    notes = [Text(note, "note") for note in ds.attrs["notes"] if note]
    how = Text(
        f"{int(ds.attrs['trials'])} trials with the seed {int(ds.attrs['seed'])}, each through the identification of "
        f"{ds.attrs['method']} {ds.attrs['method_version']} with {', '.join(ds.attrs['sources'])} drawn anew "
        f"(JCGM 101). The tolerance follows from {int(ds.attrs['digits'])} meaningful "
        f"digit{'s' if int(ds.attrs['digits']) > 1 else ''} of the standard uncertainty."
    )
    table = Table(caption, head, rows, numeric=True)
    return [
        Part(
            f"Monte Carlo evaluation of {ds.attrs['component']} by {ds.attrs['method']}",
            [KeyFigure("trials", Cell(f"{int(ds.attrs['trials'])}"), "")],
            [verdict(found)],
            [Section("monte-carlo", "Linear intervals and Monte Carlo", [how, table, *notes])],
            kind="Monte Carlo evaluation",
        )
    ]


def verdict(found: list[Line]) -> str:
    """Return one sentence on all freedoms."""
    by_word = {
        word: [line.name for line in found if line.word == word] for word in ("validated", "not validated", "undecided")
    }
    return (
        "Linear intervals: " + "; ".join(f"{', '.join(names)} {word}" for word, names in by_word.items() if names) + "."
    )


def _row(line: Line) -> list[Cell | str]:
    factor, unit = ARCSEC if line.name[-1] in "ABC" else MICROMETRE
    digits = _digits(line.uncertainty * factor)
    low, high = (f"[{a * factor:.{digits}f}, {b * factor:.{digits}f}]" for a, b in (line.linear, line.interval))
    word = line.word
    if line.verdict != VALIDATED and line.places > 1:
        word += f" at {line.open_places} of {line.places} places" if line.verdict == NOT_VALIDATED else ""
    numbers = (f"{value * factor:.{digits}f}" for value in (line.linear_uncertainty, line.uncertainty))
    ends = (f"{value * factor:.2g}" for value in (line.distance, line.tolerance))
    return [line.name, unit, *numbers, low, high, *ends, word, line.place]


def _digits(u: float) -> int:
    return max(0, 2 - int(np.floor(np.log10(u)))) if np.isfinite(u) and u > 0 else 3


def texts(ds: xr.Dataset) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of the table for the terminal."""
    head = [
        "",
        "unit",
        "u linear",
        "u Monte Carlo",
        "difference",
        "tolerance",
        "linear interval",
        "largest difference at",
    ]
    rows = [[str(cell) for cell in _row(line)] for line in lines(ds)]
    return head, [[*row[:4], *row[6:]] for row in rows]
