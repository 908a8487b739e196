"""Stacked panels over one time axis: errors with their bands, temperatures, spindle speed, feed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.report import canvas
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Cell, Table, estimate
from errormotion.report.drawings.series import Event
from errormotion.report.text import DASH, SECOND_OF_ARC, UM, finite, fixed, integer

DOTTED = 80
"""Largest number of instants that are drawn as dots: values between them were not measured."""

UNKNOWN = "#B3261E"
_HOUR, _DAY = 3600.0, 86400.0
_SHADE = "#f3c9a8"
_MIN_SPAN = 1.0  # K; smallest span of the axis of temperatures, so that noise does not resemble warming
_LEGEND_ROW = 0.135  # inch
_LOOKS = tuple((colour, dash) for dash in canvas.DASHES for colour in canvas.COLOURS)


@dataclass(frozen=True)
class Line:
    """A curve (n,) in the unit of the page, with its expanded uncertainty if known."""

    name: str
    values: Array
    expanded: Array | None = None
    colour: str = canvas.BLUE
    dash: tuple[float, ...] | None = None

    @property
    def last(self) -> float:
        """Last known value; NaN if there is none."""
        known = np.flatnonzero(np.isfinite(self.values))
        return float(self.values[known[-1]]) if known.size else math.nan


@dataclass(frozen=True)
class Panel:
    """Curves with one ordinate; named at their ends, or in a legend.

    ``strip`` panels are low and filled from 0, for working parameters. ``held``: each value applies since the previous
    instant, like a mean, not from its own instant on. ``empty`` stands in a panel without known values;
    ``zero``: whether a line marks zero.
    """

    title: str
    unit: str
    lines: Sequence[Line]
    height: float = 1.35
    legend: bool = False
    strip: bool = False
    held: bool = False
    limits: Sequence[tuple[str, float, float]] = ()
    empty: str = ""
    zero: bool = True

    @property
    def heading(self) -> str:
        """Title with the unit."""
        unit = f"({self.unit})" if "/" in self.unit else self.unit
        return f"{self.title} / {unit}" if self.unit else self.title

    def in_words(self) -> str:
        """Return a description of the curves for readers who cannot see them."""
        words = [
            f"{line.name} {fixed(finite(np.min, line.values), 2)} to {fixed(finite(np.max, line.values), 2)}, "
            f"last {fixed(line.last, 2)} {self.unit}"
            for line in self.lines
            if np.isfinite(line.values).any()
        ]
        return f"{self.title}: {'; '.join(words) or 'unknown'}"


@dataclass(frozen=True)
class Clock:
    """Instants (n,) in a unit suitable for their span; ``size`` is the unit in seconds."""

    values: Array
    unit: str
    size: float


def clock(seconds: Array) -> Clock:
    """Return a time axis in s, min, h or days, by the length of the record."""
    span = float(np.ptp(seconds)) if seconds.size else 0.0
    for unit, size, most in (("s", 1.0, 180.0), ("min", 60.0, 8 * _HOUR), ("h", _HOUR, 4 * _DAY)):
        if span <= most:
            return Clock(seconds / size, unit, size)
    return Clock(seconds / _DAY, "days", _DAY)


def errors(dataset: xr.Dataset, limits: Mapping[str, tuple[float, float]] | None = None) -> list[Panel]:
    """Return displacements and rotations of an error dataset over time; unknown errors have no curve.

    ``limits`` of errors by name, SI, are drawn as lines.
    """
    panels = []
    for title, first, (unit, size) in (("Displacements", 0, UM), ("Rotations", 3, SECOND_OF_ARC)):
        lines = []
        for i in range(first, first + 3):
            values = np.asarray(dataset[FREEDOMS[i]].values, float)
            if np.isfinite(values).any():
                colour = canvas.COLOURS[i % 3]
                lines.append(Line(FREEDOMS[i], values / size, 2 * sigma(dataset, i) / size, colour))
        if lines:
            stated = [(line.name, *limits[line.name]) for line in lines if limits and line.name in limits]
            drawn = [(name, lower / size, upper / size) for name, lower, upper in stated]
            panels.append(Panel(title, unit, lines, limits=drawn))
    return panels


def sigma(dataset: xr.Dataset, index: int) -> Array:
    """Return the standard uncertainty of one freedom over time, SI, (time,)."""
    variance = np.asarray(dataset["covariance"].isel(dof=index, dof_=index).values, float)
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def table(dataset: xr.Dataset, caption: str, reasons: Mapping[str, str] | None = None) -> Table:
    """Return the table of the six errors over time: range, largest value, last known value.

    ``reasons`` states why an error is unknown at all times.
    """
    time = np.asarray(dataset["time"].values, float)
    rows: list[list[Cell | str]] = []
    for i, name in enumerate(FREEDOMS):
        unit, size = UM if i < 3 else SECOND_OF_ARC
        values, expanded = np.asarray(dataset[name].values, float) / size, 2 * sigma(dataset, i) / size
        known = np.flatnonzero(np.isfinite(values))
        count = f"{integer(known.size)} of {integer(values.size)}"
        if not known.size:
            lost = Cell(DASH, reason=(reasons or {}).get(name, "not determined by this method"))
            rows.append([name, unit, *[lost] * 5, count])
            continue
        most, last = dataset.em.largest(name), int(known[-1])
        spans = [fixed(finite(f, values), 2, signed=True) for f in (np.min, np.max)]
        largest, ending = estimate(most.value / size, most.expanded / size), estimate(values[last], expanded[last])
        rows.append([name, unit, *spans, largest, fixed(time[most.place] / 60, 1), ending, count])
    head = ["error", "unit", "lowest", "highest", "largest", "at / min", "last known", "known"]
    return Table(f"{caption} After ±: expanded uncertainty, k = 2.", head, rows)


def sensor_names(dataset: xr.Dataset) -> list[str]:
    """Return the names of the temperature sensors, or numbers; empty without temperatures."""
    if "temperature" not in dataset or set(dataset["temperature"].dims) != {"time", "sensor"}:
        return []
    if "sensor" in dataset.coords:
        return [str(name) for name in dataset["sensor"].values]
    return [f"sensor {i + 1}" for i in range(dataset.sizes["sensor"])]


def temperatures(names: Sequence[str], values: Array) -> list[Panel]:
    """Return the panel of temperatures (n, sensor); empty if all are unknown."""
    known = [i for i in range(len(names)) if np.isfinite(values[:, i]).any()]
    if not known:
        return []
    looks = [_LOOKS[k % len(_LOOKS)] for k in range(len(known))]
    lines = [Line(names[i], values[:, i], None, *look) for i, look in zip(known, looks, strict=True)]
    height = min(max(1.5, _LEGEND_ROW * len(known) + 0.1), 4.0)
    return [Panel("Temperatures", "°C", lines, height, legend=True)]


def working(dataset: xr.Dataset, *, held: bool, commanded: Array | None = None) -> list[Panel]:
    """Return spindle speed and feed as strips, if known; the feed only if it is not always 0.

    ``commanded`` (time,) in 1/min is drawn in place of the recorded speed, which is a mean over each interval if
    ``held``.
    """
    panels = []
    for name, quantity, unit, size in (
        ("spindle_speed", "spindle speed", "1/min", 1.0),
        ("feed", "feed", "m/min", 1 / 60),
    ):
        stated = commanded if name == "spindle_speed" else None
        if stated is None and (name not in dataset or dataset[name].dims != ("time",)):
            continue
        title = f"Commanded {quantity}" if stated is not None else f"Mean {quantity}" if held else quantity.capitalize()
        values = stated if stated is not None else np.asarray(dataset[name].values, float) / size
        if np.isfinite(values).any() and (name == "spindle_speed" or np.nanmax(np.abs(values)) > 0):
            panels.append(Panel(title, unit, [Line(title, values, None, "#bbbbbb")], 0.3, strip=True, held=held))
    return panels


def draw(
    seconds: Array,
    panels: Sequence[Panel],
    key: str,
    done: Sequence[Event] = (),
    shaded: Array | None = None,
) -> Markup:
    """Return the drawing of stacked panels.

    Parameters
    ----------
    seconds : (n,)
        The instants of all curves.
    panels : sequence of Panel
    key : str
        Makes identifiers unique.
    done : sequence of Event
        Drawn as numbered dashed lines.
    shaded : (n,) of bool, optional
        Instants with coloured background.
    """
    time = clock(seconds)
    names = [len(line.name) for panel in panels if panel.legend for line in panel.lines]
    right = min(0.5 + 0.068 * max(names), 0.3 * canvas.WIDTH) if names else canvas.RIGHT
    heights = [panel.height for panel in panels]
    scaled = [replace(event, minute=60 * event.minute / time.size) for event in done]

    def paint(figure: Canvas) -> None:
        made = canvas.stack(figure, heights, right)
        for axes, panel in zip(made, panels, strict=True):
            _panel(axes, panel, time.values)
            if shaded is not None:
                shade(axes, time.values, shaded)
        time_axis(made[-1], time)
        for i, (axes, panel) in enumerate(zip(made, panels, strict=True)):
            mark(axes, scaled, named=i == 0)
            if not panel.strip and not panel.legend:
                canvas.label_ends(axes, [(line.last, line.name, line.colour) for line in panel.lines])

    return canvas.draw(paint, key, canvas.stack_height(heights))


def _panel(axes: Axes, panel: Panel, time: Array) -> None:
    axes.set_title(panel.heading)
    if panel.strip:
        _strip(axes, panel, time)
        return
    for line in panel.lines:
        canvas.curve(axes, time, line.values, line.expanded, colour=line.colour, dash=line.dash, name=line.name)
        if time.size <= DOTTED and not panel.legend:
            _dots(axes, time, line.values, line.colour, 2.2)
        elif alone(line.values).any():
            single = alone(line.values)
            _dots(axes, time[single], line.values[single], line.colour, 1.8)
    axes.margins(y=0.08)
    if panel.empty and not any(np.isfinite(line.values).any() for line in panel.lines):
        axes.text(0.5, 0.5, panel.empty, transform=axes.transAxes, ha="center", va="center", color="#555555")
    if panel.legend:
        low, high = axes.get_ylim()
        if high - low < _MIN_SPAN:
            axes.set_ylim((low + high - _MIN_SPAN) / 2, (low + high + _MIN_SPAN) / 2)
        curves = [drawn for drawn in axes.get_lines() if drawn.get_linestyle() != "None"]
        axes.legend(
            curves, [" " + line.name for line in panel.lines], loc="center left", bbox_to_anchor=(1.005, 0.5),
            labelspacing=0.25, handlelength=1.8,
        )  # fmt: skip
    else:
        if panel.zero:
            axes.axhline(0, color="#888888", linewidth=0.6)
        canvas.limit_lines(axes, panel.limits)


def _dots(axes: Axes, time: Array, values: Array, colour: str, size: float) -> None:
    axes.plot(time, values, "o", color=colour, markersize=size, markeredgewidth=0, label="_nolegend_")


def alone(values: Array) -> NDArray[np.bool_]:
    """Return known values without a known neighbour, which no line connects."""
    known = np.concatenate([[False], np.isfinite(values), [False]])
    return np.asarray(known[1:-1] & ~known[:-2] & ~known[2:])


def _strip(axes: Axes, panel: Panel, time: Array) -> None:
    top = 0.0
    for line in panel.lines:
        x, y = canvas.decimate(time, line.values, 300)
        axes.fill_between(x, 0, np.abs(y), color=line.colour, linewidth=0, step="pre" if panel.held else "post")
        top = max(top, finite(np.max, np.abs(line.values)))
    axes.set_ylim(0, 1.15 * (top or 1.0))
    labels = ["0", f"{top:.3g}" if top < 1e3 else f"{top:.0f}"] if panel.unit else ["", ""]
    axes.set_yticks([0, top][: 1 + (top > 0)], labels[: 1 + (top > 0)])
    axes.grid(visible=False)


def shade(axes: Axes, time: Array, where: Array) -> None:
    """Colour the background at these instants, up to the middle of their neighbours."""
    if not np.any(where):
        return
    half = np.diff(time) / 2
    low = time - np.concatenate([half[:1], half]) if time.size > 1 else time
    high = time + np.concatenate([half, half[-1:]]) if time.size > 1 else time
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.asarray(where, bool), [False]]).astype(np.int8)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        axes.axvspan(max(low[start], time[0]), min(high[stop - 1], time[-1]), color=_SHADE, alpha=0.45, linewidth=0)


def time_axis(axes: Axes, time: Clock) -> None:
    """Label the time axis and limit it to the record."""
    axes.set_xlabel(f"time / {time.unit}")
    if time.values.size > 1:
        margin = 0.008 * float(np.ptp(time.values)) if time.values.size <= DOTTED else 0.0  # for the last dot
        axes.set_xlim(time.values[0] - margin, time.values[-1] + margin)


def mark(axes: Axes, done: Sequence[Event], *, named: bool) -> None:
    """Draw a dashed line at each event within the axis, with its number above if ``named``."""
    low, high = axes.get_xlim()
    inside = [event for event in done if low + 0.005 * (high - low) < event.minute < high]
    for event in inside:
        axes.axvline(event.minute, color="#999999", linewidth=0.6, linestyle=(0, (2, 2)), zorder=0.5)
    if named:
        for minute, name in _labels(inside, 0.03 * (high - low)):
            axes.annotate(
                name, (minute, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2), textcoords="offset points",
                ha="center", fontsize=7,
            )  # fmt: skip


def _labels(inside: Sequence[Event], near: float) -> list[tuple[float, str]]:
    """Return position and label of events by number; those closer than ``near`` share one label."""
    groups: list[list[int]] = []
    for i, event in enumerate(inside):
        if groups and event.minute - inside[groups[-1][-1]].minute < near:
            groups[-1].append(i)
        else:
            groups.append([i])
    return [
        (float(np.mean([inside[i].minute for i in group])), ", ".join(str(i + 1) for i in group)) for group in groups
    ]


def events_in_words(done: Sequence[Event]) -> str:
    """Return the meaning of the numbered lines; empty if there are none."""
    later = [event for event in done if event.minute > 0]
    if not later:
        return ""
    words = "; ".join(f"({i + 1}) {fixed(event.minute, 1)} min: {event.what}" for i, event in enumerate(later))
    return f" Dashed lines: {words}."
