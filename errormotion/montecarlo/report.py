"""Chapter of a Monte Carlo evaluation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.montecarlo.result import Line, lines
from errormotion.montecarlo.validation import NOT_VALIDATED
from errormotion.report.document import Cell, KeyFigure, Part, Section, Source, Table, Text
from errormotion.report.page.language import texts_of

if TYPE_CHECKING:
    import xarray as xr

MICROMETRE = (1e6, "um")
HEAD = ["", "unit", "u linear", "u Monte Carlo", "difference", "tolerance", "linear interval"]
ARCSEC = (648000 / np.pi, "arcsec")


def catalogue(language: str) -> dict[str, str]:
    """Return the catalogue of these chapters: English text = text in the language."""
    return texts_of("errormotion.montecarlo", language)


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a Monte Carlo evaluation."""
    ds = source.errors
    shown = lines(ds)
    p = 100 * float(ds.attrs["probability"])
    verdicts, intervals = [_row(line) for line in shown], [_intervals(line) for line in shown]
    how = Text(
        f"{int(ds.attrs['trials'])} trials with seed {int(ds.attrs['seed'])}; each trial repeats the identification by "
        f"{ds.attrs['method']} {ds.attrs['method_version']} with new random draws of all sources (JCGM 101): "
        f"{', '.join(map(str, np.atleast_1d(ds.attrs['sources'])))}. The tolerance follows from "
        f"{int(ds.attrs['digits'])} meaningful digit{'s' if int(ds.attrs['digits']) > 1 else ''} of the standard "
        "uncertainty."
    )
    notes = [Text(str(note), "note") for note in np.atleast_1d(ds.attrs["notes"]) if str(note)]
    at = "at the place where both intervals differ most relative to the tolerance"
    tables = [
        Table(f"Standard uncertainties and difference of the intervals, {at} (JCGM 101, clause 8).", HEAD, verdicts),
        Table(f"Intervals of {p:g} %, {at}.", ["", "unit", "linear", "Monte Carlo", "place"], intervals),
    ]
    return [
        Part(
            f"Monte Carlo evaluation of {ds.attrs['component']} by {ds.attrs['method']}",
            [KeyFigure("trials", Cell(f"{int(ds.attrs['trials'])}"), "")],
            [verdict(shown)],
            [Section("monte-carlo", "Linear intervals and Monte Carlo", [how, *tables, *notes])],
            kind="Monte Carlo evaluation",
        )
    ]


def verdict(rows: list[Line]) -> str:
    """Return one sentence on all freedoms."""
    by_word = {
        word: [line.name for line in rows if line.word == word] for word in ("validated", "not validated", "undecided")
    }
    return (
        "Linear intervals: " + "; ".join(f"{', '.join(names)} {word}" for word, names in by_word.items() if names) + "."
    )


def _row(line: Line) -> list[Cell | str]:
    """Return the verdict on one freedom."""
    factor, unit = ARCSEC if line.name[-1] in "ABC" else MICROMETRE
    digits = _digits(line.uncertainty * factor)
    some = line.verdict == NOT_VALIDATED and line.places > 1
    word = line.word + (f" at {line.open_places} of {line.places} places" if some else "")
    numbers = (f"{value * factor:.{digits}f}" for value in (line.linear_uncertainty, line.uncertainty))
    ends = (f"{value * factor:.2g}" for value in (line.distance, line.tolerance))
    return [line.name, unit, *numbers, *ends, word]


def _intervals(line: Line) -> list[Cell | str]:
    """Return both intervals of one freedom."""
    factor, unit = ARCSEC if line.name[-1] in "ABC" else MICROMETRE
    digits = _digits(line.uncertainty * factor)
    ends = (f"[{a * factor:.{digits}f}, {b * factor:.{digits}f}]" for a, b in (line.linear, line.interval))
    return [line.name, unit, *ends, line.place]


def _digits(u: float) -> int:
    return max(0, 2 - int(np.floor(np.log10(u)))) if np.isfinite(u) and u > 0 else 3


def texts(ds: xr.Dataset) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of the table for the terminal."""
    rows = [[*map(str, _row(line)), line.place] for line in lines(ds)]
    return [*HEAD, "largest difference at"], rows
