"""Set-up of a crossbeam campaign: beam, carriage, lever, profiler and artefacts to scale, and the pose as a table."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.report import pose as crossbeam_pose
from errormotion.methods.crossbeam_scan.report.view import Campaign, campaign, millimetres
from errormotion.report import canvas
from errormotion.report.canvas import BLUE, GREEN, PURPLE, VERMILLION
from errormotion.report.document import Block, Cell, Figure, Source, Text
from errormotion.report.text import fixed

_OVERHANG = 0.25  # of the beam drawn beyond the first and the last artefact, m
_SHORTEST = 1.2  # drawn beam, m
_BEAM = 0.14  # side of the drawn beam, m
_CARRIAGE = 0.2  # width of the drawn carriage, m
_BLOCK = 0.06  # height of a drawn artefact, m
_ROOM = 0.66  # left of a view, inch
_TALLEST = 3.7  # of the drawing, inch


@dataclass(frozen=True)
class Setup:
    """Lengths of the set-up in the carriage's frame, m; ``profiler`` and ``patch`` (x, y) NaN where not known."""

    lever: Array
    profiler: Array
    below: float
    patch: Array

    @property
    def head(self) -> Array:
        """Position of the profiler's origin; that of the tool frame where its pose is not known."""
        return self.lever + np.nan_to_num(self.profiler)


def setup_of(seen: Campaign) -> Setup | None:
    """Return the set-up stated in the dataset; None without a lever."""
    errors = seen.errors
    if "lever" not in errors:
        return None
    lever = np.asarray(errors["lever"].values, float)
    if lever.shape != (3,) or not np.isfinite(lever).all():
        return None
    pose = crossbeam_pose.matrix(errors)
    profiler = np.full(3, np.nan) if pose is None else pose[:3, 3]
    patch, below = np.full(2, np.nan), 0.0
    if "surface_x" in errors and "surface_y" in errors:
        sides = [np.asarray(errors[name].values, float) for name in ("surface_x", "surface_y")]
        if all(np.isfinite(side).sum() > 1 for side in sides):
            patch = np.array([np.nanmax(side) - np.nanmin(side) for side in sides])
    if "surface" in errors and np.isfinite(errors["surface"].values).any():
        below = float(np.nanmedian(errors["surface"].values))
    return Setup(lever, profiler, below, patch)


def blocks(source: Source, key: str) -> list[Block]:
    """Return drawing and tables of the set-up, or a text where they are unknown."""
    seen = campaign(source.errors)
    setup, tables = setup_of(seen), _tables(seen)
    if setup is None:
        return [Text("The result does not contain the lever: the set-up cannot be drawn.", "note"), *tables]
    return [_figure(seen, setup, key), *tables]


def _tables(seen: Campaign) -> list[Block]:
    pose = crossbeam_pose.matrix(seen.errors)
    if pose is None:
        return [Text("The result does not contain the pose of the profiler.", "note")]
    more: list[list[Cell | str]] = []
    if "lever" in seen.errors:
        lever = 1e3 * np.asarray(seen.errors["lever"].values, float)
        more += [
            [f"lever in {axis}", "mm", fixed(value, 3, signed=True)] for axis, value in zip("xyz", lever, strict=True)
        ]
    return [crossbeam_pose.table(pose, crossbeam_pose.uncertainty(seen.errors), more)]


def _figure(seen: Campaign, setup: Setup, key: str) -> Figure:
    shown = seen.shown()
    active = seen.position[shown[1]] if shown else float(np.median(seen.position))
    low, high = _beam(seen)
    ground = setup.head[2] + setup.below - _BLOCK
    y = np.array([min(low, active + setup.lever[1] - 0.2), max(high, active + setup.lever[1] + 0.2)])
    x = np.array([min(0.0, setup.head[0]) - 0.3, max(0.0, setup.head[0]) + 0.3])
    z = np.array([min(ground - 0.17, -0.3), max(0.22, setup.head[2] + 0.1)])
    room = 2 * _ROOM + 0.1
    scale = min((canvas.WIDTH - room) / (np.ptp(x) + np.ptp(y)), _TALLEST / np.ptp(z))
    tall = canvas.stack_height([scale * np.ptp(z)])

    def paint(drawing: Canvas) -> None:
        left = _ROOM
        for name, span, front in (("View YZ", y, True), ("View XZ", x, False)):
            size = scale * np.ptp(span) / canvas.WIDTH, scale * np.ptp(z) / tall
            axes = drawing.add_axes((left / canvas.WIDTH, canvas.BOTTOM / tall, *size))
            left += scale * np.ptp(span) + _ROOM
            axes.set_aspect("equal")
            axes.grid(visible=False)
            axes.set_title(name)
            axes.set_xlabel(f"{'y' if front else 'x'} / mm")
            axes.set_ylabel("z / mm")
            if front:
                _front(axes, seen, setup, active, scale)
            else:
                _side(axes, setup)
            axes.set_xlim(*(1e3 * span))
            axes.set_ylim(*(1e3 * z))

    caption = (
        "Set-up to scale, x and z from the origin of the carriage: the carriage on the crossbeam, the lever to the "
        "tool frame, and the profiler, drawn over the artefact with the largest error. Numbers: position y of the axis "
        "over each artefact in mm. Thickness of beam and carriage and height of the artefacts are not to scale."
    )
    moved = _moved(seen)
    if moved.any():
        caption += " Vermillion: artefacts that moved."
    positions = ", ".join(f"{millimetres(value)} mm" for value in seen.position)
    return Figure(canvas.draw(paint, key, tall), caption, f"Set-up in two views, artefacts at y = {positions}.")


def _moved(seen: Campaign) -> NDArray[np.bool_]:
    if "moved" not in seen.errors or seen.errors["moved"].dims != ("position",):
        return np.zeros(seen.position.size, dtype=bool)
    return np.asarray(np.nan_to_num(np.asarray(seen.errors["moved"].values, float)), dtype=bool)


def _beam(seen: Campaign) -> tuple[float, float]:
    """Return the ends of the drawn beam, m; the true ends are not known."""
    low, high = float(seen.position.min()), float(seen.position.max())
    more = max(_OVERHANG, (_SHORTEST - (high - low)) / 2)
    return low - more, high + more


def _front(axes: Axes, seen: Campaign, setup: Setup, active: float, scale: float) -> None:
    """Draw the view along X: the beam lengthwise, all artefacts."""
    low, high = (1e3 * end for end in _beam(seen))
    half = 5e2 * _BEAM
    axes.fill([low, high, high, low], [-half, -half, half, half], facecolor="#ececec", edgecolor="none")
    for side in (-half, half):
        axes.plot([low, high], [side, side], color="#888888", linewidth=0.7)
    axes.text(low + 20, half + 25, "crossbeam", color="#555555", fontsize=7, va="bottom")
    _hanging(axes, setup, 1e3 * active, 1)
    width = 1e3 * (setup.patch[1] if np.isfinite(setup.patch[1]) else 0.05)
    top = 1e3 * (setup.head[2] + setup.below)
    moved = _moved(seen)
    shift = 1e3 * setup.head[1]
    crowded = 72 * scale * np.diff(np.sort(seen.position)).min(initial=1.0) < 18  # points
    for i, place in enumerate(seen.position):
        middle = 1e3 * place + shift
        colour = VERMILLION if moved[i] else GREEN
        axes.add_patch(
            Rectangle((middle - width / 2, top - 1e3 * _BLOCK), width, 1e3 * _BLOCK, color=colour, linewidth=0)
        )
        axes.annotate(
            millimetres(place),
            (middle, top - 1e3 * _BLOCK),
            xytext=(0, -2),
            textcoords="offset points",
            ha="right" if crowded else "center",
            va="top",
            rotation=60 if crowded else 0,
            rotation_mode="anchor",
            fontsize=6.5,
            color=colour if moved[i] else "#333333",
        )


def _side(axes: Axes, setup: Setup) -> None:
    """Draw the view along Y: the beam in section, one artefact, and the lengths."""
    half = 5e2 * _BEAM
    axes.add_patch(
        Rectangle((-half, -half), 2 * half, 2 * half, facecolor="#ececec", edgecolor="#888888", linewidth=0.7)
    )
    _hanging(axes, setup, 0.0, 0)
    width = 1e3 * (setup.patch[0] if np.isfinite(setup.patch[0]) else 0.04)
    head, tool = 1e3 * setup.head, 1e3 * setup.lever
    top = head[2] + 1e3 * setup.below
    axes.add_patch(Rectangle((head[0] - width / 2, top - 1e3 * _BLOCK), width, 1e3 * _BLOCK, color=GREEN, linewidth=0))
    _dimension(axes, (0.0, tool[2]), (tool[0], tool[2]), f"{fixed(abs(tool[0]), 1)} mm")
    _dimension(axes, (0.0, 0.0), (0.0, tool[2]), f"{fixed(abs(tool[2]), 1)} mm")
    names = [((0.0, 0.0), "carriage", (14, 8)), ((tool[0], tool[2]), "tool frame", (5, 6))]
    if np.isfinite(setup.profiler).all():
        lift = fixed(abs(head[2] - tool[2]), 1)
        names.append(((head[0], head[2]), f"frame of the profiler, {lift} mm below", (8, -1)))
    for place, name, aside in names:
        axes.annotate(name, place, xytext=aside, textcoords="offset points", fontsize=7, va="center")


def _dimension(axes: Axes, start: tuple[float, float], end: tuple[float, float], text: str) -> None:
    """Draw a dimension line with its text."""
    if math.dist(start, end) < 100:
        return
    axes.annotate(
        "",
        end,
        start,
        arrowprops={"arrowstyle": "<->", "linewidth": 0.6, "color": "#666666", "shrinkA": 0, "shrinkB": 0},
    )
    level = abs(end[1] - start[1]) < abs(end[0] - start[0])
    axes.annotate(
        text,
        ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2),
        xytext=(0, -3) if level else (3, 0),
        textcoords="offset points",
        ha="center" if level else "left",
        va="top" if level else "center",
        rotation=0 if level else 90,
        fontsize=7,
        color="#444444",
    )


def _hanging(axes: Axes, setup: Setup, at: float, k: int) -> None:
    """Draw carriage, lever and profiler, seen along X (k = 1) or Y (k = 0), with the carriage at ``at`` mm."""
    lever, head = 1e3 * setup.lever, 1e3 * setup.head
    half = 5e2 * _CARRIAGE
    axes.add_patch(
        Rectangle((at - half, -half), 2 * half, 2 * half, facecolor="white", edgecolor=BLUE, linewidth=1.1, alpha=0.9)
    )
    axes.plot([at, at + lever[k]], [0, lever[2]], color=BLUE, linewidth=1.4)
    axes.plot([at, at + lever[k]], [0, lever[2]], linestyle="", marker="o", markersize=3, color=BLUE)
    if not np.isfinite(setup.profiler).all():
        return
    axes.plot([at + lever[k], at + head[k]], [lever[2], head[2]], color=PURPLE, linewidth=1.4)
    axes.plot(at + head[k], head[2], marker="o", markersize=3, color=PURPLE)
