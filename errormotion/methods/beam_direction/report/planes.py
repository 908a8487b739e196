"""The section on the planes: orientation, residuals, and corrections of the readings."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.methods.beam_direction.report.drawings import colour_of
from errormotion.methods.beam_direction.report.view import STROKES, Planes
from errormotion.report import canvas
from errormotion.report.document import Block, Cell, Figure, Table, Text, estimate, or_dash
from errormotion.report.text import DASH, finite, fixed, integer, listed

_MAX_PANELS = 12  # in the figure of residuals
_MAX_LISTED = 40  # left-out readings in the table
_MAX_CLOSURE = 3.0  # standard uncertainties from which on a closure is reported


def blocks(planes: Planes, key: str) -> list[Block]:
    """Return the section on the planes; ``key`` makes the identifiers of its figure unique."""
    if not len(planes):
        return [Text("The result contains no planes.", "note")]
    drawn = residuals(planes, key) or Text("The result contains no residuals.", "note")
    return [_table(planes), *_closures(planes), drawn, *left_out(planes)]


def rms(planes: Planes, plane: int) -> float:
    """Return the rms residual of the readings that were used, m."""
    return math.sqrt(finite(np.mean, planes.residual[plane][~planes.left_out[plane]] ** 2))


def _table(planes: Planes) -> Table:
    rows: list[list[Cell | str]] = []
    for k, name in enumerate(planes.names):
        used, out = int((planes.given[k] & ~planes.left_out[k]).sum()), int(planes.left_out[k].sum())
        rows.append(
            [
                name,
                or_dash(fixed(np.rad2deg(planes.inclination[k]), 2), "not determined"),
                or_dash(fixed(np.rad2deg(planes.rotation[k]), 2), "the triangulation plane is unknown"),
                integer(used),
                integer(out),
                or_dash(fixed(1e6 * rms(planes, k), 2), "no residuals"),
                or_dash(
                    fixed(1e6 * finite(np.max, np.abs(planes.residual[k][~planes.left_out[k]])), 2), "no residuals"
                ),
                estimate(1e6 * planes.closure[k], 2e6 * planes.closure_u[k]),
            ]
        )
    return Table(
        "The planes. Inclination: angle between beam and normal; rotation: azimuth of the tilt about the beam, from "
        "the triangulation plane. Residual: of the readings used. Closure: 1 + g·u, with g the change of the "
        "reading with the stage position; 0 without errors. After ±: expanded uncertainty, k = 2.",
        ["plane", "inclination / °", "rotation / °", "used", "left out", "rms / µm", "largest / µm", "closure / 10⁻⁶"],
        rows,
        [("", 1), ("tilt", 2), ("readings", 2), ("residual", 2), ("", 1)],
    )


def not_closed(planes: Planes) -> list[tuple[str, float]]:
    """Return the planes that do not close, with their closure in standard uncertainties."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.abs(planes.closure) / planes.closure_u
    return [(planes.names[k], float(ratio[k])) for k in range(len(planes)) if ratio[k] > _MAX_CLOSURE]


def _closures(planes: Planes) -> list[Block]:
    known = np.isfinite(planes.closure).sum()
    if known == 2:
        return [
            Text(
                "Two planes always fit a beam exactly: their closures are 0 by definition. A third plane is required "
                "for a check.",
                "note",
            )
        ]
    off = not_closed(planes)
    if not off:
        return []
    names = listed([f"plane {name} by {fixed(ratio, 1)} times its standard uncertainty" for name, ratio in off])
    return [
        Text(
            f"The closure is not 0 within its uncertainty: {names}. Possible causes: missing or insufficient "
            "compensation of the inclination error, a stage that is not straight or square, a plane that is not flat.",
            "warning",
        )
    ]


def residuals(planes: Planes, key: str) -> Figure | None:
    """Return the figure of the residuals of each plane by stroke; None without residuals."""
    shown = [k for k in range(len(planes)) if np.isfinite(planes.residual[k]).any()]
    if not shown:
        return None
    picks = shown[:_MAX_PANELS]
    strokes = planes.strokes
    heights = [0.72 if len(picks) <= 6 else 0.5] * len(picks)

    def paint(figure: Canvas) -> None:
        panels = canvas.stack(figure, heights, right=0.62)
        for axes, k in zip(panels, picks, strict=True):
            _residuals_of(axes, planes, k, strokes[k])
        panels[0].set_xlim(0, planes.residual.shape[1] + 1)
        panels[-1].set_xlabel("number of the reading")

    worst = "; ".join(f"plane {planes.names[k]} {fixed(1e6 * rms(planes, k), 2)} µm" for k in picks)
    more = f" {len(picks)} of {len(shown)} planes are shown." if len(picks) < len(shown) else ""
    caption = (
        "Residuals by plane: reading minus that of the fitted plane. Letters: the axis of the stroke. Crosses: left "
        "out of the fit, at the edge if they are outside the diagram. An error proportional to depth "
        f"does not change the residuals, but the closures of three planes or more.{more}"
    )
    return Figure(
        canvas.draw(paint, key, canvas.stack_height(heights)), caption, f"Residuals by plane and stroke; rms: {worst}."
    )


def _residuals_of(axes: Axes, planes: Planes, k: int, strokes: np.ndarray) -> None:
    residual, out = 1e6 * planes.residual[k], planes.left_out[k]
    number = np.arange(1, residual.size + 1)
    used = np.where(out, np.nan, residual)
    reach = 1.25 * finite(np.max, np.abs(used)) or 1.0
    reach = reach if math.isfinite(reach) else 1.25 * finite(np.max, np.abs(residual))
    axes.axhline(0, color="#888888", linewidth=0.6)
    known = np.flatnonzero(np.isfinite(residual))
    for stroke in np.split(known, np.flatnonzero(strokes[known][1:] != strokes[known][:-1]) + 1):
        axes.plot(number[stroke], used[stroke], color=colour_of(k), linewidth=0.8, marker=".", markersize=3)
        if stroke[0] != known[0]:
            axes.axvline(number[stroke[0]] - 0.5, color="#bbbbbb", linewidth=0.6)
        name = str(strokes[stroke[0]])
        if name and len(known) > 1:
            top = (float(number[stroke].mean()), 0.97)
            axes.annotate(
                name, top, xycoords=("data", "axes fraction"), color="#666666", fontsize=7, ha="center", va="top"
            )
    edge = np.clip(residual, -0.93 * reach, 0.93 * reach)
    axes.plot(number[out], edge[out], "x", color="#222222", markersize=4.5, markeredgewidth=1.0, clip_on=False)
    axes.set_ylim(-reach, reach)
    axes.set_ylabel("µm")
    axes.annotate(
        f"plane {planes.names[k]}",
        (1, 0.5),
        xycoords="axes fraction",
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        fontweight="bold",
        color=colour_of(k),
    )


def left_out(planes: Planes) -> list[Block]:
    """Return the table of the readings that were left out."""
    indices = np.argwhere(planes.left_out)
    if not len(indices):
        return []
    strokes = planes.strokes
    unknown = Cell(DASH, reason="the stage positions are not in the result")
    rows: list[list[Cell | str]] = []
    for k, i in indices[:_MAX_LISTED]:
        stage = planes.stage[k, i]
        position = "; ".join(f"{name} {fixed(1e3 * value, 3)}" for name, value in zip(STROKES, stage, strict=True))
        rows.append(
            [
                f"plane {planes.names[k]}, reading {i + 1}",
                str(strokes[k, i]) or unknown,
                position if np.isfinite(stage).all() else unknown,
                or_dash(fixed(1e3 * planes.raw[k, i], 4, signed=True), "the reading is not in the result"),
                or_dash(fixed(1e6 * planes.residual[k, i], 1, signed=True), "not compared with the plane"),
                "out of range" if planes.beyond[k, i] else "outlier",
            ]
        )
    notes = [f"{len(indices) - _MAX_LISTED} more are in the dataset."] if len(indices) > _MAX_LISTED else []
    return [
        Table(
            "Readings that were left out: outliers, and readings out of the sensor's range.",
            ["reading", "stroke", "stage / mm", "reading / mm", "residual / µm", "reason"],
            rows,
            notes=notes,
        )
    ]


def compensation(planes: Planes, key: str) -> list[Block]:
    """Return the corrections of the readings by plane; empty without corrections."""
    known = [k for k in range(len(planes)) if np.isfinite(planes.compensation[k]).any()]
    if not known:
        return []
    rows: list[list[Cell | str]] = []
    for k in known:
        correction, raw = planes.compensation[k], planes.raw[k]
        readings = [
            or_dash(fixed(finite(end, 1e3 * raw), 3, signed=True), "the raw readings are not in the result")
            for end in (np.min, np.max)
        ]
        corrections = [fixed(finite(end, 1e6 * correction), 2, signed=True) for end in (np.min, np.max)]
        rows.append([planes.names[k], *readings, *corrections, _per_depth(correction, raw)])
    table = Table(
        "Corrections of the raw readings, by plane.",
        ["plane", "lowest / mm", "highest / mm", "lowest / µm", "highest / µm", "µm per mm"],
        rows,
        [("", 1), ("raw reading", 2), ("correction", 3)],
    )

    def paint(figure: Canvas) -> None:
        (axes,) = canvas.stack(figure, [1.5], right=0.85)
        axes.axhline(0, color="#888888", linewidth=0.6)
        ends = []
        for k in known:
            order = np.argsort(planes.raw[k])
            x, y = 1e3 * planes.raw[k][order], 1e6 * planes.compensation[k][order]
            axes.plot(x, y, color=colour_of(k), linewidth=1.2)
            ends.append((float(y[np.isfinite(y)][-1]), f"plane {planes.names[k]}", colour_of(k)))
        axes.set_xlabel("raw reading / mm")
        axes.set_ylabel("correction / µm")
        axes.margins(x=0.0)
        canvas.label_ends(axes, ends)

    if not any(np.isfinite(planes.raw[k]).any() for k in known):
        return [table]
    ranges = "; ".join(f"plane {row[0]} {row[3]} to {row[4]} µm" for row in rows)
    return [
        table,
        Figure(
            canvas.draw(paint, key, canvas.stack_height([1.5])),
            "Inclination error that was subtracted from the readings, over the raw reading.",
            f"Corrections: {ranges}.",
        ),
    ]


def _per_depth(correction: Array, raw: Array) -> Cell | str:
    both = np.isfinite(correction) & np.isfinite(raw)
    if both.sum() < 2 or np.ptp(raw[both]) == 0:
        return Cell(DASH, reason="only one depth")
    return fixed(1e3 * float(np.polyfit(raw[both], correction[both], 1)[0]), 3, signed=True)
