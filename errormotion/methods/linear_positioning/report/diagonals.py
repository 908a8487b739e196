"""The chapter of a test along diagonals: figures of ISO 230-6, squareness, graphs of all diagonals and of each."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.figure import Figure as Canvas

from errormotion.methods.linear_positioning.report import drawings
from errormotion.methods.linear_positioning.report.chapter import figure_table, target_tables
from errormotion.methods.linear_positioning.report.view import View, diagonal_view
from errormotion.report import budget, canvas, provenance, quality
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text, estimate
from errormotion.report.text import SECOND_OF_ARC, fixed, listed

HEIGHT = 2.9
"""Height of the graph of all diagonals, inch."""
COLOURS = (canvas.BLUE, canvas.VERMILLION, canvas.GREEN, canvas.ORANGE)
SHOWN = ("E", "E_forward", "E_backward", "R", "B", "B_mean")
FACES = {"EC0Y": "Y to X", "EA0Z": "Z to Y", "EB0Z": "Z to X"}
_SYMBOLS = {"_forward": "↑", "_backward": "↓", "B_mean": "mean B"}


def part(source: Source, key: str) -> Part:
    """Return the chapter; ``key`` makes the identifiers of its figures unique."""
    errors = source.errors
    views = [diagonal_view(errors, str(name)) for name in errors["diagonal"].values]
    sections = [
        Section("figures", "Figures of ISO 230-6", [_all_diagonals(views, f"{key}-all"), _table(errors, views)]),
        *([Section("squareness", "Squareness", _squareness(errors))] if errors.sizes["squareness_of"] else []),
        *(
            Section(
                f"diagonal-{view.name}",
                f"Diagonal {view.name}",
                [drawings.over_position(view, f"{key}-{view.name}", {}), figure_table(view, {}), *target_tables(view)],
            )
            for view in views
        ),
        Section("uncertainty", "Uncertainty", _uncertainty(errors)),
        Section("quality", "Data quality", [*quality.notes(errors), *quality.sentences(errors, source.raw)]),
        Section("provenance", "Provenance", provenance.blocks(source)),
    ]
    summary = (
        f"Displacements along {listed([view.name for view in views])}: a letter for each of X, Y and Z, P for an axis "
        f"that moves in positive direction, N in negative direction, 0 for an axis at rest. {errors.sizes['target']} "
        f"stops, {errors.sizes['run']} runs in both directions. Errors are relative to the "
        f"{errors.attrs['reference']}."
    )
    return Part("Diagonals of the volume", _key_figures(errors, views), [summary], sections)


def _key_figures(errors: xr.Dataset, views: list[View]) -> list[KeyFigure]:
    unit, size = SECOND_OF_ARC
    return [
        *(
            KeyFigure(f"E of {view.name}", estimate(view.value["E"], view.expanded("E"), signed=False), view.unit, "")
            for view in views
            if math.isfinite(view.value["E"])
        ),
        *(
            KeyFigure(f"squareness {name}", estimate(value / size, U / size), unit, FACES[name])
            for name, value, U in _squareness_values(errors)
        ),
    ]


def _squareness_values(errors: xr.Dataset) -> list[tuple[str, float, float]]:
    """Return name, value and expanded uncertainty of each squareness, rad."""
    U = 2.0 * np.sqrt(np.diagonal(errors["squareness_covariance"].values))
    names = map(str, errors["squareness_of"].values)
    return list(zip(names, errors["squareness"].values.tolist(), U.tolist(), strict=True))


def _all_diagonals(views: list[View], key: str) -> Figure:
    """Return the graph of the mean bidirectional deviations of all diagonals over the distance."""

    def paint(figure: Canvas) -> None:
        (axes,) = canvas.stack(figure, [HEIGHT], right=0.75)
        ends = []
        for k, view in enumerate(views):
            colour, dash = COLOURS[k % len(COLOURS)], "-" if k < len(COLOURS) else "--"
            mean = np.nanmean(view.mean, axis=0)
            axes.plot(view.position, mean, dash, color=colour, linewidth=1.3, marker="o", markersize=3)
            known = np.flatnonzero(np.isfinite(mean))
            ends.append((float(mean[known[-1]]), view.name, colour))
        axes.axhline(0, color=drawings.DARK, linewidth=0.6)
        canvas.label_ends(axes, ends)
        axes.set_ylabel(f"deviation / {views[0].unit}", labelpad=2)
        axes.set_xlabel("distance along the diagonal / mm")

    caption = (
        "Mean bidirectional deviations along the diagonals over the distance from their first stop. If the curves of "
        "the two diagonals of a face diverge, its axes are not square."
    )
    alt = ", ".join(f"{view.name}: E {fixed(view.value['E'], 2)} {view.unit}" for view in views)
    return Figure(canvas.draw(paint, key, HEIGHT + canvas.TOP + canvas.BOTTOM), caption, f"{alt}.")


def _table(errors: xr.Dataset, views: list[View]) -> Table:
    rows: list[list[Cell | str]] = [
        [
            view.name,
            fixed(float(errors["distance"].sel(diagonal=view.name)[-1]) * 1e3, 1),
            *(
                estimate(view.value[name], view.expanded(name), signed=name == "B_mean", reason="not measured")
                for name in SHOWN
            ),
        ]
        for view in views
    ]
    caption = (
        f"Figures along each diagonal in {views[0].unit}, and its measured length. After ±: expanded uncertainty, "
        "k = 2, excess of extreme values by scatter included."
    )
    return Table(caption, ["diagonal", "length / mm", *map(_heading, SHOWN)], rows)


def _heading(name: str) -> str:
    for ending, symbol in _SYMBOLS.items():
        name = name.replace(ending, symbol)
    return name


def _squareness(errors: xr.Dataset) -> list[Block]:
    unit, size = SECOND_OF_ARC
    rows: list[list[Cell | str]] = [
        [
            name,
            FACES[name],
            estimate(value / size, U / size),
            estimate(value * 1e6, U * 1e6),
        ]
        for name, value, U in _squareness_values(errors)
    ]
    caption = (
        "Squareness from the slopes of two diagonals of one face; positive: the second axis is turned in the positive "
        "direction about the axis of the name. After ±: expanded uncertainty, k = 2."
    )
    return [
        Table(caption, ["squareness", "axes", f"in {unit}", "in µm/m"], rows),
        Text(
            "The squareness is that over the whole face: it contains slopes of straightness, and angles of the axes "
            "with their lever in the face. It is independent of the scale of the instrument and of uniform expansion."
        ),
    ]


def _uncertainty(errors: xr.Dataset) -> list[Block]:
    return [
        budget.table(errors.isel(diagonal=0, target=-1), f"at the end of {errors['diagonal'].values[0]}"),
        Text(
            "Independent: from stop to stop, by the scatter of the readings. Errors of drift and alignment are "
            "independent from diagonal to diagonal; the error of the scale of the lengths is the same for all."
        ),
    ]
