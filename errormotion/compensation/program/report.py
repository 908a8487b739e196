"""Report page of a corrected program: the path, and the correction along it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.compensation.program.compensating import Outcome, ProgramSettings
from errormotion.compensation.program.reading.items import UNCHANGED
from errormotion.compensation.program.writing.rewriting import Summary
from errormotion.report import Form, canvas, provenance, write_page
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text
from errormotion.report.page.language import texts_of
from errormotion.report.text import DASH, fixed, integer, minutes, significant

_AXES = "XYZ"
_COLOURS = (canvas.BLUE, canvas.VERMILLION, canvas.GREEN)
_SHADES = 7
_VIEWS = ((0, 1), (0, 2))


def write_program_report(
    out: Path,
    errors: xr.Dataset,
    outcome: Outcome,
    settings: ProgramSettings,
    *,
    program: str,
    uncertainty: Array | None = None,
    notes: tuple[str, ...] = (),
    form: Form | None = None,
) -> Path:
    """Write the page.

    Parameters
    ----------
    out : Path
        The file; an older one is replaced in one step.
    errors : Dataset
        Errors that the correction is based on, for the head of the page.
    outcome : Outcome
    settings : ProgramSettings
    program : str
        Name of the program.
    uncertainty : array (n, 3), optional
        Standard uncertainty of the correction at ``outcome.summary.positions``, m; NaN where it is unknown.
    notes : tuple of str
        Notes on the correction.
    form : Form, optional
        Language, paper, and files written in addition to the page.

    Returns
    -------
    Path
        ``out``.
    """
    source = Source(errors, None, {}, provenance.read(errors) if "provenance" in errors.attrs else {})
    return write_page(
        [source],
        lambda: [_part(outcome, settings, program, uncertainty, notes)],
        out,
        f"Corrected program {program}",
        form=form or Form(),
        texts=texts,
    )


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of the page: English text = text in the language."""
    return texts_of("errormotion.compensation.program", language)


def _part(
    outcome: Outcome, settings: ProgramSettings, program: str, uncertainty: Array | None, notes: tuple[str, ...]
) -> Part:
    found = outcome.summary
    largest = np.abs(found.offsets).max(axis=0) if len(found.offsets) else np.zeros(3)
    known = np.zeros(3) * math.nan
    if uncertainty is not None and np.isfinite(uncertainty).any():
        known = 2 * np.nanmax(np.where(np.isfinite(uncertainty), uncertainty, 0.0), axis=0)
    figures = [
        KeyFigure("largest correction", Cell(fixed(1e6 * found.largest, 1)), "µm", f"in line {found.largest_line}"),
        KeyFigure("blocks", Cell(integer(found.written)), "", f"of {integer(found.read)} in the original"),
        KeyFigure("cuts", Cell(integer(found.cuts)), "", f"{integer(found.divided)} divided"),
        KeyFigure("time", Cell(minutes(found.seconds)), "", "cuts and dwells at the programmed feed"),
    ]
    axes = Table(
        "Largest correction of each axis along the path, added to the commands, and its expanded uncertainty (k = 2).",
        ["axis", "correction / µm", "uncertainty / µm"],
        [
            [
                axis,
                fixed(1e6 * largest[k], 2),
                Cell(fixed(1e6 * known[k], 2)) if known[k] == known[k] else Cell(DASH, reason="unknown"),
            ]
            for k, axis in enumerate(_AXES)
        ],
    )
    remarks: list[Block] = [Text(note, "note") for note in notes]
    return Part(
        f"Corrected program {program}",
        figures,
        _summary(outcome, settings),
        [
            Section("path", "Path", [_path(found, "program-path")] if len(found.positions) else []),
            Section(
                "correction",
                "Correction along the path",
                [_along(found, uncertainty), axes] if len(found.positions) else [],
            ),
            Section("left", "Moves without correction", _left(outcome)),
            Section("reading", "Reading of the program", [*_reading(outcome, settings), *remarks]),
        ],
        kind="Corrected NC program",
        stated=False,
    )


def _summary(outcome: Outcome, settings: ProgramSettings) -> list[str]:
    found = outcome.summary
    words = [
        f"Cuts follow the corrected path to {significant(1e6 * settings.tolerance, 2)} µm and the last printed digit.",
        f"Corrected: {integer(found.cuts)} cuts of {fixed(found.length, 3)} m, {integer(found.rapids)} rapid moves.",
    ]
    if found.outside[0]:
        count, line = found.outside
        words.append(
            f"{integer(count)} moves end outside the measured range, the first in line {line}: "
            "there the correction is that at its limit."
        )
    if found.uncorrected[0]:
        count, line = found.uncorrected
        words.append(f"{integer(count)} cuts start at a position without correction, the first in line {line}.")
    if outcome.checked:
        words.append(f"LinuxCNC's interpreter reads the new program as planned: {integer(outcome.checked)} moves.")
    return words


def _left(outcome: Outcome) -> list[Block]:
    left = outcome.summary.unchanged
    if not left:
        return [Text("None.")]
    rows: list[list[Cell | str]] = [
        [UNCHANGED[kind], integer(count), str(line)] for kind, (count, line) in sorted(left.items())
    ]
    return [Table("Moves without correction.", ["kind", "number", "first line"], rows, numeric=False)]


def _reading(outcome: Outcome, settings: ProgramSettings) -> list[Block]:
    reader = "the plain reader" if outcome.route == "plain" else "LinuxCNC's interpreter, which expanded it"
    rows: list[list[Cell | str]] = [
        ["read by", reader],
        ["SHA-256 of the original", outcome.digest],
        ["tolerance", f"{significant(1e6 * settings.tolerance, 3)} µm"],
        ["sampling interval", f"{significant(1e3 * settings.step, 3)} mm"],
        ["cuts with unknown feed", integer(outcome.summary.unfed)],
    ]
    if outcome.why:
        rows.append(["reason of the expansion", outcome.why])
    return [Table("Reading of the program.", ["", ""], rows, numeric=False)]


def _path(found: Summary, key: str) -> Figure:
    """Return two views of the path; colours are the size of the correction."""
    size = 1e6 * np.linalg.norm(found.offsets, axis=1)
    low, high = float(size.min()), float(size.max())
    edges = np.linspace(low, max(high, low + 0.01), _SHADES + 1)
    shade = np.clip(np.searchsorted(edges, size, side="right") - 1, 0, _SHADES - 1)
    shades = [_colour(number) for number in range(_SHADES)]
    positions = 1e3 * found.positions
    cut = found.lines > 0

    def paint(axes: Axes, first: int, second: int) -> None:
        for number, colour in enumerate(shades):
            x, y = [], []
            for k in np.flatnonzero(cut & (shade == number)):
                if k:
                    x += [positions[k - 1, first], positions[k, first], math.nan]
                    y += [positions[k - 1, second], positions[k, second], math.nan]
            axes.plot(x, y, color=colour, linewidth=1.2)
        x, y = [], []
        for k in np.flatnonzero(~cut):
            if k:
                x += [positions[k - 1, first], positions[k, first], math.nan]
                y += [positions[k - 1, second], positions[k, second], math.nan]
        axes.plot(x, y, color="#999999", linewidth=0.6, linestyle=(0, (3, 2)))
        axes.set_xlabel(f"{_AXES[first]} / mm")
        axes.set_ylabel(f"{_AXES[second]} / mm")
        axes.set_aspect("equal", adjustable="datalim")

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, 2)
        figure.subplots_adjust(left=0.075, right=0.985, top=0.86, bottom=0.14, wspace=0.25)
        for axes, (first, second) in zip(panels, _VIEWS, strict=True):
            paint(axes, first, second)
        for number, colour in enumerate(shades):
            left = 0.075 + number * 0.13
            figure.text(left, 0.94, "■", color=colour, fontsize=9)
            span = " to ".join(fixed(edge, 2 if high - low < 2 else 1) for edge in edges[number : number + 2])
            figure.text(left + 0.02, 0.94, span, fontsize=7)

    caption = (
        "Path in machine coordinates, from above and from the front. Colour: magnitude of the correction in µm; grey: "
        "rapid moves. Positions are those of the axes, including the offsets of work and tool."
    )
    alt = f"Two views of the path; the correction is at most {fixed(found.largest * 1e6, 1)} µm."
    return Figure(canvas.draw(draw, key, 3.4), caption, alt)


def _colour(number: int) -> tuple[float, float, float]:
    """Return a colour between blue and red through grey, for readers with red-green colour blindness."""
    part = number / (_SHADES - 1)
    stops = np.array([[0.27, 0.51, 0.78], [0.62, 0.62, 0.62], [0.80, 0.25, 0.10]])
    low = min(int(2 * part), 1)
    r, g, b = stops[low] + (2 * part - low) * (stops[low + 1] - stops[low])
    return float(r), float(g), float(b)


def _along(found: Summary, uncertainty: Array | None) -> Figure:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(found.positions, axis=0), axis=1))])

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(3, 1, sharex=True)
        figure.subplots_adjust(left=0.075, right=0.985, top=0.97, bottom=0.11, hspace=0.18)
        for k, axes in enumerate(panels):
            band = None if uncertainty is None else 2e6 * uncertainty[:, k]
            canvas.curve(axes, along, 1e6 * found.offsets[:, k], band, colour=_COLOURS[k])
            axes.axhline(0, color="#888888", linewidth=0.6)
            axes.set_ylabel(f"{_AXES[k]} / µm")
        panels[-1].set_xlabel("distance along the path / m")

    ends = "; ".join(
        f"{axis} from {fixed(float(values.min()), 1)} to {fixed(float(values.max()), 1)} µm"
        for axis, values in zip(_AXES, 1e6 * found.offsets.T, strict=True)
    )
    band = " Band: expanded uncertainty, k = 2." if uncertainty is not None else ""
    caption = f"Correction of each axis along the path, rapid moves included.{band}"
    return Figure(canvas.draw(draw, "program-along", 4.2), caption, f"Corrections along the path: {ends}.")
