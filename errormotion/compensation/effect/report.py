"""The page of an effect: the reduction, the errors before and after, figures side by side, limits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.compare.stack import Estimate
from errormotion.compensation.effect import text
from errormotion.compensation.effect.result import Effect
from errormotion.report.canvas import BLUE, VERMILLION, WIDTH, curve, draw, style
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text
from errormotion.report.page.language import texts_of
from errormotion.report.write import PLAIN, Form, write_page
from errormotion.tolerances.conformity import FIELD_UNITS

PANEL = 1.55
"""Height of a panel, inches."""
COLOURS = {"before": VERMILLION, "after": BLUE}
K = 2.0
"""Coverage factor of the bands."""
SEVERAL = 6
"""Known points from which a line or marks show the errors; below, bars."""

Rows = list[Sequence[Cell | str]]


def write(found: Effect, after: xr.Dataset, out: Path, form: Form = PLAIN) -> Path:
    """Write the page; an older one is replaced in one step.

    Parameters
    ----------
    found : Effect
    after : Dataset
        The result with the compensation, for machine and date in the head.
    out : Path
    form : Form, optional
        Language, paper, and files written in addition to the page.
    """
    source = Source(after, None, {}, {})
    title = f"Effect of a compensation: {found.common.machine}"
    return write_page([source], lambda: [part(found, source.key)], out, title, form=form, texts=texts)


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of the page: English text = text in the language."""
    return texts_of("errormotion.compensation.effect", language)


def part(found: Effect, key: str) -> Part:
    """Return the chapter of an effect."""
    sections = [
        Section("errors", "Errors before and after", [_curves(found, key)]),
        Section("parts", "Reduction", _tables(found)),
        *_figures(found),
    ]
    if limits := text.limits(found):
        sections.append(Section("limits", "Limits", [Text(line) for line in limits]))
    sections.append(Section("ground", "Common ground", [Text(_ground(found)), *[Text(note) for note in found.notes]]))
    return Part("Effect of the compensation", _key_figures(found), text.verdict(found), sections, kind="Compensation")


def _key_figures(found: Effect) -> list[KeyFigure]:
    shown = []
    for row, each in zip(text.rows(found), found.parts, strict=True):
        if each.correctable:
            shown.append(KeyFigure(each.name, Cell(row[4].removesuffix(" %")), "%", f"reduction; 95 %: {row[5]}"))
    return shown


def _curves(found: Effect, key: str) -> Figure:
    height = PANEL * len(found.common.freedoms) + 0.6
    svg = draw(lambda figure: paint(figure, found), f"{key}-effect", height, WIDTH)
    return Figure(
        svg,
        "Errors before and with the compensation, on common ground, with expanded uncertainty (k = 2).",
        f"Curves of both results over {abscissa(found)[1]}",
    )


def _tables(found: Effect) -> list[Block]:
    rows: Rows = [row[:-1] for row in text.rows(found)]
    whole = Table(
        "Root mean squares over all common points, the measurement uncertainty subtracted, and their reduction with "
        "intervals of 95 %. Perfect model: expected value of the second measurement for a correction without error: "
        "its uncertainty, and for rotations, which linear axes do not compensate, also the errors before.",
        text.HEAD[:-1],
        rows,
    )
    floors: Rows = []
    for each in found.parts:
        factor, unit = FIELD_UNITS[each.unit]
        floors.append([each.name, f"{factor * each.floor:.3f}", f"{factor * each.reference:.3f}", unit])
    floor = Table(
        "Uncertainty of the second measurement as a root mean square (k = 1), and its part due to the reference state",
        ["", "measurement", "reference state", "unit"],
        floors,
    )
    return [whole, floor]


def _figures(found: Effect) -> list[Section]:
    rows: Rows = [list(row) for row in text.figure_rows(found)]
    if not rows:
        return []
    caption = "Figures of merit as the method states them. A dash: one of the results does not state the figure."
    return [Section("figures", "Figures side by side", [Table(caption, text.FIGURES_HEAD, rows)])]


def _ground(found: Effect) -> str:
    common = found.common
    point = ", ".join(f"{1e3 * float(each) + 0.0:g}" for each in np.atleast_1d(common.point))
    return f"Machine {common.machine}, {common.component}, frame '{common.frame}', functional point ({point}) mm."


def plot(found: Effect) -> Canvas:
    """Return the figure of the errors before and after, a row for each freedom."""
    with style():
        figure = Canvas(figsize=(WIDTH, PANEL * len(found.common.freedoms) + 0.6), facecolor="white")
        paint(figure, found)
    return figure


def paint(figure: Canvas, found: Effect) -> None:
    """Fill a figure with the errors before and after."""
    common = found.common
    high = figure.get_size_inches()[1]
    panels = figure.subplots(len(common.freedoms), 1, sharex=True, squeeze=False, gridspec_kw={"hspace": 0.18})[:, 0]
    figure.subplots_adjust(left=0.09, right=0.985, top=1 - 0.28 / high, bottom=0.42 / high)
    places, label, joined = abscissa(found)
    for k, (name, axes) in enumerate(zip(common.freedoms, panels, strict=True)):
        factor, unit = FIELD_UNITS["m" if name in ("EX", "EY", "EZ") else "rad"]
        axes.axhline(0, color="#888888", lw=0.5)
        for number, estimate in enumerate(common.estimates):
            _draw(axes, places, estimate, k, factor, joined, 0.12 * (number - 0.5))
        axes.set_ylabel(f"{name} / {unit}")
    figure.align_ylabels()
    panels[-1].set_xlabel(label)
    handles = [panels[0].plot([], [], color=colour, label=name)[0] for name, colour in COLOURS.items()]
    panels[0].legend(handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0)


def _draw(axes: Axes, places: Array, estimate: Estimate, k: int, factor: float, joined: bool, shift: float) -> None:
    value, band = factor * estimate.value[:, k], factor * K * np.sqrt(np.maximum(estimate.variance()[:, k], 0.0))
    colour = COLOURS[estimate.name]
    if joined and np.isfinite(value).sum() >= SEVERAL:
        curve(axes, places, value, band, colour=colour)
    else:
        step = float(np.min(np.diff(np.unique(places)))) if np.unique(places).size > 1 else 1.0
        axes.errorbar(places + shift * step, value, yerr=band, fmt="o", ms=3, lw=0.9, capsize=1.5, color=colour)


def abscissa(found: Effect) -> tuple[Array, str, bool]:
    """Return the abscissae of the common points, their label, and whether lines join the values."""
    common = found.common
    if common.dim == "time":
        return np.asarray(common.coords["time"].values, dtype=float) / 60.0, "time / min", True
    for name in ("x", "y", "z"):
        if common.dim == "position" and name in common.coords:
            return np.asarray(common.coords[name].values, dtype=float) * 1e3, f"{name.upper()} / mm", True
    count = len(common.estimates[0].value)
    return np.arange(count, dtype=float), f"{common.dim} number" if common.dim else "", False
