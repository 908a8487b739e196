"""Drawing of the set-up: the bar with its levels and the five beams, and the displaced bar at the end of running."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source
from errormotion.report.drawings.series import LOOK, curves, end_of_running, last_known
from errormotion.report.elements import Column, Table
from errormotion.report.text import fixed, integer, listed

_NEEDED = ("beam_origin", "beam_direction", "bar_axis_point", "bar_axis_direction", "bar_radius")
_PATCH = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
_TAIL = 7e-3  # length of a beam drawn behind its origin, m


@dataclass(frozen=True)
class Setup:
    """Beams and bar in machine coordinates, m; ``hit`` is the point of each beam on the bar in the reference state."""

    names: list[str]
    origin: np.ndarray
    direction: np.ndarray
    hit: np.ndarray
    reading: np.ndarray
    axis_point: np.ndarray
    axis_direction: np.ndarray
    radius: float
    levels: np.ndarray

    @property
    def along(self) -> int:
        """Index of the machine axis along the bar."""
        return int(np.argmax(np.abs(self.axis_direction)))

    @property
    def offset(self) -> np.ndarray:
        """Distance between each beam's line and the bar's axis; for a beam along the bar, of its spot from the axis."""
        cross = np.cross(self.direction, self.axis_direction)
        size = np.linalg.norm(cross, axis=1)
        to_beam = self.hit - self.axis_point
        lateral = np.abs((to_beam * cross).sum(axis=1)) / np.where(size > 0.3, size, 1.0)
        radial = np.linalg.norm(to_beam - np.outer(to_beam @ self.axis_direction, self.axis_direction), axis=1)
        offset: np.ndarray = np.where(size > 0.3, lateral, radial)
        return offset


def setup_of(errors: xr.Dataset) -> Setup | None:
    """Return the set-up of a drift dataset; None where required data are missing or unknown."""
    if any(name not in errors for name in _NEEDED):
        return None
    origin = errors["beam_origin"].transpose("channel", "direction").values
    direction = errors["beam_direction"].transpose("channel", "direction").values
    point, axis = errors["bar_axis_point"].values, errors["bar_axis_direction"].values
    radius = float(errors["bar_radius"])
    if not (np.isfinite(origin).all() and np.isfinite(direction).all() and math.isfinite(radius) and radius > 0):
        return None
    if not (np.isfinite(point).all() and np.isfinite(axis).all() and np.linalg.norm(axis) > 0):
        return None
    axis = axis / np.linalg.norm(axis)
    reading = np.full(len(origin), np.nan)
    if "distance_mean" in errors:
        for i, row in enumerate(errors["distance_mean"].transpose("channel", "time").values):
            known = np.flatnonzero(np.isfinite(row))
            reading[i] = row[known[0]] if known.size else np.nan
    levels = _levels(errors)
    drawn = np.where(np.isfinite(reading), reading, 1e-3)
    return Setup(
        [str(name) for name in errors["channel"].values],
        origin,
        direction,
        origin + drawn[:, None] * direction,
        reading,
        point,
        axis,
        radius,
        levels,
    )


def _levels(errors: xr.Dataset) -> np.ndarray:
    """Return the heights of the levels, m; empty where the dataset does not contain them as numbers."""
    for name in ("level", "level_height", "level_z", "height"):
        if name in errors and errors[name].dtype.kind == "f":
            heights = np.atleast_1d(errors[name].values)
            known: np.ndarray = heights[np.isfinite(heights)]
            return known
    return np.array([])


def drawing(source: Source, key: str) -> list[Block]:
    """Return the drawing in three views, to scale, with the drift enlarged; nothing if the geometry is not known."""
    errors = source.errors
    setup = setup_of(errors)
    if setup is None:
        return []
    moved = _moved(errors, setup)
    factor = _exaggeration(moved)
    side = [i for i in range(3) if i != setup.along]
    views = [(side[0], setup.along), (side[1], setup.along), (side[0], side[1])]
    limits = np.array([_limits(setup, i) for i in range(3)])
    spans = np.ptp(limits, axis=1)
    room = canvas.LEFT * 3 + 0.1
    scale = min((canvas.WIDTH - room) / sum(spans[a] for a, _ in views), 5.5 / max(spans[b] for _, b in views))
    high = canvas.stack_height([scale * max(spans[b] for _, b in views)])

    def paint(drawing: Canvas) -> None:
        left = canvas.LEFT
        for view in views:
            size = scale * spans[list(view)] / (canvas.WIDTH, high)
            axes = drawing.add_axes((left / canvas.WIDTH, canvas.BOTTOM / high, *size))
            left += scale * spans[view[0]] + canvas.LEFT
            _view(axes, setup, view, moved, factor)
            axes.set_xlim(*(1e3 * limits[view[0]]))
            axes.set_ylim(*(1e3 * limits[view[1]]))

    svg = canvas.draw(paint, key, high)
    drift = (
        f" Dashed: the bar at the end of running, its displacement enlarged {integer(factor)} times." if factor else ""
    )
    caption = (
        f"Set-up in machine coordinates, to scale: bar of {fixed(2e3 * setup.radius, 3)} mm diameter, levels of "
        f"evaluation, and the beams from the start of their measuring range (dots) to the bar. Thin lines lead to "
        f"the sensors, which are not drawn; a ring is a beam along the line of sight.{drift}"
    )
    alt = (
        f"Views {listed(['XYZ'[a] + 'XYZ'[b] for a, b in views])} of a bar with the beams {listed(setup.names)}; "
        f"levels at {listed([f'{fixed(1e3 * z, 1)} mm' for z in setup.levels]) or 'unknown heights'}."
    )
    return [Figure(svg, caption, alt)]


def _beams(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the beams with their offset and first reading; None if the geometry is not known."""
    setup = setup_of(errors)
    if setup is None:
        return None
    own = {"offset": ("channel", setup.offset, {"units": "m"}), "reading": ("channel", setup.reading, {"units": "m"})}
    return errors.assign(own)


BEAMS = Table(
    "Beams as used for the evaluation. Origin: start of the measuring range. Offset: distance between the beam and the "
    "axis of the bar (for a beam along the bar, of its spot from the axis). Reading: at the first valid instant.",
    (
        *(
            Column(name, "none", unit, {"direction": axis}, head=head + axis, format=places, signed=False)
            for name, unit, head, places in (("beam_origin", "mm", "", ".3"), ("beam_direction", "", "u_", ".5"))
            for axis in "xyz"
        ),
        Column("offset", unit="um", format=".0", signed=False),
        Column("reading", unit="mm", format=".3", signed=False, reason="no valid reading"),
    ),
    over="channel",
    head="beam",
    of=_beams,
    groups=(("", 1), ("origin", 3), ("direction", 3), ("on the bar", 2)),
    absent="The result does not contain the geometry of beams and bar.",
)


def _limits(setup: Setup, i: int) -> tuple[float, float]:
    """Return the limits of the drawing along one machine axis, m: bar, beams, and room for their names."""
    tails = setup.origin[:, i] - _TAIL * setup.direction[:, i]
    bar = np.array(_ends(setup)) if i == setup.along else setup.axis_point[i] + setup.radius * np.array([-1.0, 1.0])
    room = 2e-3 if i == setup.along else 6e-3
    return float(min(tails.min() - 5e-3, bar[0] - room)), float(max(tails.max() + 5e-3, bar[1] + room))


def _ends(setup: Setup) -> tuple[float, float]:
    """Return the lowest and the highest position of the drawn bar along its main axis, m."""
    k = setup.along
    parallel = np.flatnonzero(np.abs(setup.direction[:, k]) > 0.7)
    heights = np.concatenate([setup.levels, setup.hit[:, k]])
    margin = 2 * setup.radius
    low, high = heights.min() - margin, heights.max() + margin
    if parallel.size:
        face, sense = setup.hit[parallel[0], k], setup.direction[parallel[0], k]
        low, high = (face, high) if sense > 0 else (low, face)
    return float(low), float(high)


def _axis_at(setup: Setup, height: float | np.ndarray) -> np.ndarray:
    k = setup.along
    steps = (np.atleast_1d(height) - setup.axis_point[k]) / setup.axis_direction[k]
    return setup.axis_point + np.outer(steps, setup.axis_direction)


def _moved(errors: xr.Dataset, setup: Setup) -> np.ndarray | None:
    """Return the displacement (2, 3) of the axis at the two levels at the end of running, m; None where unknown."""
    if setup.levels.size != 2 or setup.along != 2:
        return None
    found, stop = curves(errors), end_of_running(errors)
    moved = np.zeros((2, 3))
    for i in range(2):
        for j, name in enumerate((f"X{i + 1}", f"Y{i + 1}", "Z")):
            last = last_known(found[name].values, stop)
            moved[i, j] = 0.0 if last is None else found[name].values[last]
    return moved if np.abs(moved).max() > 0 else None


def _exaggeration(moved: np.ndarray | None) -> int:
    """Return 1, 2 or 5 times a power of ten that enlarges the largest displacement to at most 4 mm; 0 without one."""
    if moved is None:
        return 0
    wanted = 4e-3 / np.abs(moved).max()
    power = 10 ** math.floor(math.log10(wanted))
    return int(max(step * power for step in (1, 2, 5) if step * power <= wanted)) if wanted >= 1 else 0


def _view(axes: Axes, setup: Setup, view: tuple[int, int], moved: np.ndarray | None, factor: int) -> None:
    a, b = view
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set_xlabel(f"{'xyz'[a]} / mm")
    axes.set_ylabel(f"{'xyz'[b]} / mm")
    axes.set_title(f"View {'XYZ'[a]}{'XYZ'[b]}")
    low, high = _ends(setup)
    if b == setup.along:
        _bar_from_the_side(axes, setup, view, low, high)
        if moved is not None and factor:
            _moved_bar(axes, setup, view, moved, factor, (low, high))
    else:
        centre = 1e3 * _axis_at(setup, setup.levels.mean() if setup.levels.size else low)[0][[a, b]]
        angle = np.linspace(0, 2 * np.pi, 73)
        ring = 1e3 * setup.radius * np.array([np.cos(angle), np.sin(angle)])
        axes.fill(*(centre[:, None] + ring), facecolor="#e9e9e9", edgecolor="#666666", linewidth=0.8)
        axes.plot(*centre, marker="+", color="#666666", markersize=7, markeredgewidth=0.6)
        if moved is not None and factor:
            axes.plot(
                *(centre[:, None] + ring + 1e3 * factor * moved.mean(axis=0)[[a, b]][:, None]),
                color="#222222",
                linewidth=0.8,
                linestyle=(0, (4, 2)),
            )
    tails = 1e3 * (setup.origin - _TAIL * setup.direction)[:, list(view)]
    for i, name in enumerate(setup.names):
        twins = [j for j in range(len(tails)) if np.linalg.norm(tails[j] - tails[i]) < 3 and j != i]
        _beam(axes, setup, view, i, name, 4 * np.sign(twins[0] - i) if twins else 0.0)


def _bar_from_the_side(axes: Axes, setup: Setup, view: tuple[int, int], low: float, high: float) -> None:
    across = 1e3 * np.array([setup.radius, 0.0])
    ends = 1e3 * _axis_at(setup, np.array([low, high]))[:, list(view)]
    outline = np.array([ends[0] - across, ends[1] - across, ends[1] + across, ends[0] + across])
    axes.fill(*outline.T, facecolor="#e9e9e9", edgecolor="#666666", linewidth=0.8)
    axes.plot(*ends.T, color="#666666", linewidth=0.6, linestyle=(0, (8, 2, 1.5, 2)))
    for i, height in enumerate(setup.levels):
        middle = 1e3 * _axis_at(setup, height)[0][list(view)]
        reach = 1e3 * setup.radius + 1.5
        axes.plot(
            [middle[0] - reach, middle[0] + reach], [middle[1]] * 2, color="#666666", linewidth=0.6, dashes=(2, 2)
        )
        axes.text(
            middle[0] - reach - 0.6,
            middle[1],
            f"L{i + 1}",
            ha="right",
            va="center",
            color="#444444",
            fontsize=7,
            bbox=_PATCH,
        )


def _moved_bar(
    axes: Axes, setup: Setup, view: tuple[int, int], moved: np.ndarray, factor: int, ends: tuple[float, float]
) -> None:
    heights = np.array(ends)
    l1, l2 = setup.levels
    share = ((heights - l1) / (l2 - l1))[:, None]
    shift = factor * (moved[0] + share * (moved[1] - moved[0]))
    ends_drawn = 1e3 * (_axis_at(setup, heights) + shift)[:, list(view)]
    across = 1e3 * np.array([setup.radius, 0.0])
    outline = np.array([ends_drawn[1] - across, ends_drawn[0] - across, ends_drawn[0] + across, ends_drawn[1] + across])
    axes.plot(*outline.T, color="#222222", linewidth=0.8, linestyle=(0, (4, 2)))


def _beam(axes: Axes, setup: Setup, view: tuple[int, int], i: int, name: str, aside: float) -> None:
    """Draw one beam; ``aside`` is the displacement of its name perpendicular to the beam, in points."""
    plane = list(view)
    colour = LOOK.get(name, (canvas.BLACK, None))[0]
    origin, hit = 1e3 * setup.origin[i][plane], 1e3 * setup.hit[i][plane]
    direction = setup.direction[i][plane]
    if np.linalg.norm(direction) < 0.3:
        axes.plot(*hit, marker="o", markersize=5, markerfacecolor="white", markeredgecolor=colour, markeredgewidth=1.1)
        axes.plot(*hit, marker="o", markersize=1.5, color=colour)
        axes.annotate(name, hit, xytext=(5, 3), textcoords="offset points", color=colour, fontsize=7, fontweight="bold")
        return
    back = origin - 1e3 * _TAIL * direction
    axes.plot(*np.array([back, origin]).T, color=colour, linewidth=0.7)
    axes.plot(*np.array([origin, hit]).T, color=colour, linewidth=2.0, solid_capstyle="butt")
    axes.plot(*origin, marker="o", markersize=3, color=colour)
    flat = abs(direction[0]) > abs(direction[1])
    sense = np.sign(direction[0] if flat else direction[1])
    axes.annotate(
        name,
        back,
        xytext=(-3 * sense, aside) if flat else (2 * aside, -3 * sense),
        textcoords="offset points",
        ha=("right" if sense > 0 else "left") if flat else "center",
        va="center" if flat else ("top" if sense > 0 else "bottom"),
        color=colour,
        fontweight="bold",
    )
