"""The planes of a beam: orientation, residuals, and corrections of the readings."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.methods.beam_direction.report.drawings import look_of
from errormotion.methods.beam_direction.report.view import STROKES, Planes
from errormotion.report import canvas
from errormotion.report.document import Block, Cell, Figure, Table, Text, estimate, or_dash
from errormotion.report.text import DASH, finite, fixed, integer, listed

_MOST = 12  # panels in the figure of residuals
_NAMED = 40  # left-out readings in the table
_CLOSED = 3.0  # closures beyond this many standard uncertainties are spoken of


def blocks(planes: Planes, key: str) -> list[Block]:
    """Return the section on the planes; ``key`` keeps its figure's identifiers apart."""
    if not len(planes):
        return [Text("The result does not describe the planes.", "note")]
    found: list[Block] = [_table(planes), *_closures(planes)]
    drawn = residuals(planes, key)
    return found + ([drawn] if drawn else [Text("The result contains no residuals.", "note")]) + left_out(planes)


def rms(planes: Planes, plane: int) -> float:
    """Return the rms residual (m) of the readings that were used."""
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
        "reading along the stage; 0 for a plane and a beam without error. After ±: expanded uncertainty, k = 2.",
        ["plane", "inclination / °", "rotation / °", "used", "left out", "rms / µm", "largest / µm", "closure / 10⁻⁶"],
        rows,
        [("", 1), ("tilt", 2), ("readings", 2), ("residual", 2), ("", 1)],
    )


def far_off(planes: Planes) -> list[tuple[str, float]]:
    """Return planes that do not close, and by how many standard uncertainties."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.abs(planes.closure) / planes.closure_u
    return [(planes.names[k], float(ratio[k])) for k in range(len(planes)) if ratio[k] > _CLOSED]


def _closures(planes: Planes) -> list[Block]:
    known = np.isfinite(planes.closure).sum()
    if known == 2:
        return [
            Text(
                "Two planes always fit a beam exactly: their closures are 0 by construction and are no check. A third "
                "plane is required for a check.",
                "note",
            )
        ]
    off = far_off(planes)
    if not off:
        return []
    words = listed([f"plane {name} by {fixed(ratio, 1)} times its standard uncertainty" for name, ratio in off])
    return [
        Text(
            f"The closure is not 0 within its uncertainty: {words}. Possible causes: missing or insufficient "
            "compensation of the inclination error, a stage that is not straight or square, a plane that is not flat.",
            "warning",
        )
    ]


def residuals(planes: Planes, key: str) -> Figure | None:
    """Return the residuals of each plane, stroke by stroke; None without residuals."""
    shown = [k for k in range(len(planes)) if np.isfinite(planes.residual[k]).any()]
    if not shown:
        return None
    picks = shown[:_MOST]
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
        "out of the fit, at the edge where they lie beyond it. An error in proportion to depth "
        f"does not change the residuals; it shows in the closures of three planes or more.{more}"
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
    for run in np.split(known, np.flatnonzero(strokes[known][1:] != strokes[known][:-1]) + 1):
        axes.plot(number[run], used[run], color=look_of(k), linewidth=0.8, marker=".", markersize=3)
        if run[0] != known[0]:
            axes.axvline(number[run[0]] - 0.5, color="#bbbbbb", linewidth=0.6)
        name = str(strokes[run[0]])
        if name and len(known) > 1:
            at = (float(number[run].mean()), 0.97)
            axes.annotate(
                name, at, xycoords=("data", "axes fraction"), color="#666666", fontsize=7, ha="center", va="top"
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
        color=look_of(k),
    )


def left_out(planes: Planes) -> list[Block]:
    """Return the table of the readings that were left out."""
    positions = np.argwhere(planes.left_out)
    if not len(positions):
        return []
    strokes = planes.strokes
    rows: list[list[Cell | str]] = []
    for k, i in positions[:_NAMED]:
        stroke = str(strokes[k, i])
        at = planes.stage[k, i]
        where = "; ".join(f"{name} {fixed(1e3 * value, 3)}" for name, value in zip(STROKES, at, strict=True))
        rows.append(
            [
                f"plane {planes.names[k]}, reading {i + 1}",
                stroke or Cell(DASH, reason="the stage positions are not in the result"),
                where if np.isfinite(at).all() else Cell(DASH, reason="the stage positions are not in the result"),
                or_dash(fixed(1e3 * planes.raw[k, i], 4, signed=True), "the reading is not in the result"),
                or_dash(fixed(1e6 * planes.residual[k, i], 1, signed=True), "it was not compared with the plane"),
                "out of range" if planes.beyond[k, i] else "off its plane",
            ]
        )
    notes = [f"{len(positions) - _NAMED} more are in the dataset."] if len(positions) > _NAMED else []
    return [
        Table(
            "Readings that were left out: far off the plane of the others, or out of the sensor's range.",
            ["reading", "stroke", "stage / mm", "reading / mm", "residual / µm", "why"],
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
        taken, raw = planes.compensation[k], planes.raw[k]
        row = [finite(np.min, 1e3 * raw), finite(np.max, 1e3 * raw)]
        cells = [or_dash(fixed(value, 3, signed=True), "the raw readings are not in the result") for value in row]
        spans = [finite(np.min, 1e6 * taken), finite(np.max, 1e6 * taken)]
        rows.append([planes.names[k], *cells, *(fixed(v, 2, signed=True) for v in spans), _per_depth(taken, raw)])
    table = Table(
        "Corrections of the raw readings, by plane.",
        ["plane", "lowest / mm", "highest / mm", "least / µm", "most / µm", "µm per mm"],
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
            axes.plot(x, y, color=look_of(k), linewidth=1.2)
            ends.append((float(y[np.isfinite(y)][-1]), f"plane {planes.names[k]}", look_of(k)))
        axes.set_xlabel("raw reading / mm")
        axes.set_ylabel("correction / µm")
        axes.margins(x=0.0)
        canvas.label_ends(axes, ends)

    if not any(np.isfinite(planes.raw[k]).any() for k in known):
        return [table]
    words = "; ".join(f"plane {row[0]} {cell_text(row[3])} to {cell_text(row[4])} µm" for row in rows)
    return [
        table,
        Figure(
            canvas.draw(paint, key, canvas.stack_height([1.5])),
            "Inclination error that was subtracted from the readings, over the raw reading.",
            f"Corrections: {words}.",
        ),
    ]


def cell_text(cell: Cell | str) -> str:
    """Return the text of a cell."""
    return str(cell.text) if isinstance(cell, Cell) else cell


def _per_depth(taken: Array, raw: Array) -> Cell | str:
    both = np.isfinite(taken) & np.isfinite(raw)
    if both.sum() < 2 or np.ptp(raw[both]) == 0:
        return Cell(DASH, reason="one depth only")
    return fixed(1e3 * float(np.polyfit(raw[both], taken[both], 1)[0]), 3, signed=True)
