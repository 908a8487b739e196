"""The chapter of a test along diagonals: figures of ISO 230-6, squareness, a graph of all of them and of each."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.figure import Figure as Canvas

from errormotion.methods.linear_positioning.report import drawings
from errormotion.methods.linear_positioning.report.chapter import figure_table, target_tables
from errormotion.methods.linear_positioning.report.view import View
from errormotion.report import budget, canvas, provenance, quality
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text, estimate
from errormotion.report.text import SECOND_OF_ARC, UM, fixed, listed

HEIGHT = 2.9
"""Of the graph of all diagonals, inch."""
COLOURS = (canvas.BLUE, canvas.VERMILLION, canvas.GREEN, canvas.ORANGE)
SHOWN = ("E", "E_forward", "E_backward", "R", "B", "B_mean")
FACES = {"EC0Y": "Y to X", "EA0Z": "Z to Y", "EB0Z": "Z to X"}
_SYMBOLS = {"_forward": "↑", "_backward": "↓", "B_mean": "mean B"}


def part(source: Source, key: str) -> Part:
    """Return the chapter; ``key`` keeps the identifiers of its figures apart."""
    errors = source.errors
    seen = [_view(errors, str(name)) for name in errors["diagonal"].values]
    sections = [
        Section("figures", "Figures of ISO 230-6", [_together(seen, f"{key}-all"), _table(errors, seen)]),
        *([Section("squareness", "Squareness", _squareness(errors))] if errors.sizes["squareness_of"] else []),
        *(
            Section(
                f"diagonal-{view.name}",
                f"Diagonal {view.name}",
                [drawings.over_position(view, f"{key}-{view.name}", {}), figure_table(view, {}), *target_tables(view)],
            )
            for view in seen
        ),
        Section("uncertainty", "Uncertainty", _uncertainty(errors)),
        Section("quality", "Data quality", [*quality.notes(errors), *quality.sentences(errors, source.raw)]),
        Section("provenance", "Provenance", provenance.blocks(source)),
    ]
    words = (
        f"Displacements along {listed([view.name for view in seen])}: a letter for each of X, Y and Z, P where the "
        f"axis rises, N where it falls, 0 where it rests. {errors.sizes['target']} stops, {errors.sizes['run']} runs "
        f"in both directions. Errors are relative to the {errors.attrs['reference']}."
    )
    return Part("Diagonals of the volume", _key_figures(errors, seen), [words], sections)


def _view(errors: xr.Dataset, name: str) -> View:
    unit, size = UM
    of = errors.sel(diagonal=name)
    figures = [str(figure) for figure in errors["figure"].values]

    def named(part: str) -> dict[str, float]:
        return dict(zip(figures, (of[part].values / size).tolist(), strict=True))

    return View(
        name=name,
        unit=unit,
        size=size,
        position=np.asarray(of["distance"].values * 1e3),
        readings=of["deviations"].transpose("approach", "run", "target").values / size,
        mean=of["unidirectional_mean"].transpose("approach", "target").values / size,
        s=of["unidirectional_s"].transpose("approach", "target").values / size,
        value=named("figure_value"),
        bias=named("figure_bias"),
        u=named("figure_u"),
    )


def _key_figures(errors: xr.Dataset, seen: list[View]) -> list[KeyFigure]:
    found = [
        KeyFigure(f"E of {view.name}", estimate(view.value["E"], view.expanded("E"), signed=False), view.unit, "")
        for view in seen
        if math.isfinite(view.value["E"])
    ]
    unit, size = SECOND_OF_ARC
    for name, value, U in _squares(errors):
        found.append(KeyFigure(f"squareness {name}", estimate(value / size, U / size), unit, FACES[name]))
    return found


def _squares(errors: xr.Dataset) -> list[tuple[str, float, float]]:
    """Return name, value and expanded uncertainty of each squareness, rad."""
    U = 2.0 * np.sqrt(np.diagonal(errors["squareness_covariance"].values))
    names = map(str, errors["squareness_of"].values)
    return list(zip(names, errors["squareness"].values.tolist(), U.tolist(), strict=True))


def _together(seen: list[View], key: str) -> Figure:
    """Return the mean bidirectional deviations of all diagonals over the distance."""

    def paint(figure: Canvas) -> None:
        (axes,) = canvas.stack(figure, [HEIGHT], right=0.75)
        ends = []
        for k, view in enumerate(seen):
            colour, dash = COLOURS[k % len(COLOURS)], "-" if k < len(COLOURS) else "--"
            mean = np.nanmean(view.mean, axis=0)
            axes.plot(view.position, mean, dash, color=colour, linewidth=1.3, marker="o", markersize=3)
            known = np.flatnonzero(np.isfinite(mean))
            ends.append((float(mean[known[-1]]), view.name, colour))
        axes.axhline(0, color=drawings.DARK, linewidth=0.6)
        canvas.label_ends(axes, ends)
        axes.set_ylabel(f"deviation / {seen[0].unit}", labelpad=2)
        axes.set_xlabel("distance along the diagonal / mm")

    caption = (
        "Mean bidirectional deviations along the diagonals over the distance from their first stop. Two diagonals of "
        "one face that part from one another show that its axes are not square."
    )
    alt = ", ".join(f"{view.name}: E {fixed(view.value['E'], 2)} {view.unit}" for view in seen)
    return Figure(canvas.draw(paint, key, HEIGHT + canvas.TOP + canvas.BOTTOM), caption, f"{alt}.")


def _table(errors: xr.Dataset, seen: list[View]) -> Table:
    rows: list[list[Cell | str]] = [
        [
            view.name,
            fixed(float(errors["distance"].sel(diagonal=view.name)[-1]) * 1e3, 1),
            *(
                estimate(view.value[name], view.expanded(name), signed=name == "B_mean", reason="not measured")
                for name in SHOWN
            ),
        ]
        for view in seen
    ]
    heads = [_heading(name) for name in SHOWN]
    caption = (
        f"Figures along each diagonal in {seen[0].unit}, and its measured length. After ±: expanded uncertainty, "
        "k = 2, with the excess that scatter adds to an extreme value."
    )
    return Table(caption, ["diagonal", "length / mm", *heads], rows)


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
        for name, value, U in _squares(errors)
    ]
    caption = (
        "Squareness from the slopes of two diagonals of one face; positive: the second axis is turned to the positive "
        "side about the axis of the name. After ±: expanded uncertainty, k = 2."
    )
    return [
        Table(caption, ["squareness", "axes", f"in {unit}", "in µm/m"], rows),
        Text(
            "It is the squareness over the whole face: slopes of straightness, and angles of the axes with their lever "
            "in the face, are contained in it. The scale of the instrument and uniform expansion are not."
        ),
    ]


def _uncertainty(errors: xr.Dataset) -> list[Block]:
    name = str(errors["diagonal"].values[0])
    far = errors.isel(diagonal=0, target=-1)
    return [
        budget.table(far, f"at the end of {name}"),
        Text(
            "Independent: from stop to stop, by the scatter of the readings. Drift and alignment are new for each "
            "diagonal; the scale of the lengths is one draw for all of them."
        ),
    ]
