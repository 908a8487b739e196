"""Figures of a spindle test over time: displacements, tilts, temperatures, residuals, readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.report import canvas
from errormotion.report.canvas import BLUE, DASHES
from errormotion.report.document import Figure
from errormotion.report.drawings.series import LOOK, Curve, Event, curves, last_known, minutes_of, running
from errormotion.report.drawings.timeline import events_in_words, mark
from errormotion.report.text import UM, fixed

Limits = Mapping[str, tuple[float, float]]
"""Lower and upper limits of errors by name, SI."""


def overview(errors: xr.Dataset, done: Sequence[Event], key: str) -> Figure | None:
    """Return all displacements in one panel, for the summary; None where all are unknown."""
    found = [line for name, line in curves(errors).items() if name not in ("A", "B")]
    found = [line for line in found if np.isfinite(line.values).any()]
    if not found:
        return None
    svg = _stack(errors, [found], ["µm"], done, key, titles=["Displacement"], height=1.6)
    caption = f"All displacements in one scale.{events_in_words(done)}"
    return Figure(svg, caption, _alt_text("All displacements over time", [found], minutes_of(errors)))


def displacements(errors: xr.Dataset, done: Sequence[Event], key: str, limits: Limits) -> Figure | None:
    """Return the displacement curves with their bands in panels for X, Y and Z; None where all are unknown."""
    found = curves(errors)
    rows = [[found[name] for name in names] for names in (("X1", "X2"), ("Y1", "Y2"), ("Z",))]
    rows = [row for row in rows if any(np.isfinite(curve.values).any() for curve in row)]
    if not rows:
        return None
    labels = ["µm"] * len(rows)
    titles = [f"Displacement in {row[0].name[0]}" for row in rows]
    svg = _stack(errors, rows, labels, done, key, speed=True, titles=titles, limits=limits)
    caption = (
        "Displacement of the spindle side relative to the workpiece side since the reference state. L1 and L2 are the "
        "two levels of measurement. Bands: expanded uncertainty, k = 2."
    )
    return Figure(svg, caption + events_in_words(done), _alt_text("Displacement over time", rows, minutes_of(errors)))


def tilts(errors: xr.Dataset, done: Sequence[Event], key: str, limits: Limits) -> Figure | None:
    """Return the two tilt curves with their bands; None where both are unknown."""
    found = curves(errors)
    rows = [[found["A"], found["B"]]]
    if not any(np.isfinite(curve.values).any() for curve in rows[0]):
        return None
    titles = ["Tilt about X (A) and about Y (B)"]
    svg = _stack(errors, rows, ["arcsec"], done, key, height=1.5, titles=titles, limits=limits)
    caption = (
        "Tilt of the spindle axis about X (A, inclination in the YZ plane) and about Y (B, inclination in the XZ "
        "plane), right-handed. Bands: expanded uncertainty, k = 2."
    )
    return Figure(svg, caption, _alt_text("Tilt over time", rows, minutes_of(errors)))


def temperatures(errors: xr.Dataset, done: Sequence[Event], key: str) -> Figure | None:
    """Return the temperatures over time, one curve a sensor; None where none is known."""
    if "temperature" not in errors or errors["temperature"].sizes.get("sensor", 0) == 0:
        return None
    values = errors["temperature"].transpose("time", "sensor").values
    names = [str(name) for name in errors["sensor"].values] if "sensor" in errors.coords else None
    names = names or [f"sensor {i + 1}" for i in range(values.shape[1])]
    known = [i for i in range(len(names)) if np.isfinite(values[:, i]).any()]
    if not known:
        return None
    time = minutes_of(errors)
    right = min(0.5 + 0.065 * max(len(names[i]) for i in known), 0.4 * canvas.WIDTH)

    def paint(figure: Canvas) -> None:
        axes = canvas.stack(figure, [2.0], right)[0]
        for number, i in enumerate(known):
            colour = canvas.COLOURS[number % len(canvas.COLOURS)]
            dash = DASHES[number // len(canvas.COLOURS) % len(DASHES)]
            canvas.curve(axes, time, values[:, i], colour=colour, dash=dash, name=names[i])
        handles = list(axes.get_lines())
        axes.legend(handles, [" " + names[i] for i in known], loc="center left", bbox_to_anchor=(1.01, 0.5))
        axes.set_ylabel("temperature / °C")
        _time_axis(axes, time)
        mark(axes, done, named=False)

    words = ", ".join(
        f"{names[i]} from {fixed(values[np.isfinite(values[:, i]), i][0], 1)} to "
        f"{fixed(values[np.isfinite(values[:, i]), i][-1], 1)} °C"
        for i in known
    )
    missing = [names[i] for i in range(len(names)) if i not in known]
    note = f" No valid reading: {', '.join(missing)}." if missing else ""
    return Figure(
        canvas.draw(paint, key, canvas.stack_height([2.0])),
        f"Temperatures during the test.{note}",
        f"Temperatures over time: {words}.",
    )


def channels(errors: xr.Dataset, name: str, title: str, caption: str, key: str) -> Figure | None:
    """Return one panel for each sensor channel of a variable (channel, time), in micrometres; None where unknown."""
    if name not in errors:
        return None
    values = errors[name].transpose("channel", "time").values / UM[1]
    names = [str(label) for label in errors["channel"].values]
    if not np.isfinite(values).any():
        return None
    time, heights = minutes_of(errors), [0.42] * len(names)

    def paint(figure: Canvas) -> None:
        panels = canvas.stack(figure, heights)
        for axes, label, row in zip(panels, names, values, strict=True):
            canvas.curve(axes, time, row, colour=LOOK.get(label, (BLUE, None))[0], width=0.7, name=label)
            axes.set_ylabel("µm")
            axes.locator_params(axis="y", nbins=3)
            axes.margins(y=0.12)
            if not np.isfinite(row).any():
                axes.text(0.5, 0.5, "no valid value", transform=axes.transAxes, ha="center", va="center")
            axes.annotate(
                label,
                (1, 0.5),
                xycoords="axes fraction",
                xytext=(5, 0),
                textcoords="offset points",
                va="center",
                fontweight="bold",
                color=LOOK.get(label, (BLUE, None))[0],
            )
        panels[0].set_title(title)
        _time_axis(panels[-1], time)

    spans = ", ".join(
        f"{label} {fixed(np.nanmin(row), 2)} to {fixed(np.nanmax(row), 2)} µm"
        for label, row in zip(names, values, strict=True)
        if np.isfinite(row).any()
    )
    return Figure(canvas.draw(paint, key, canvas.stack_height(heights)), caption, f"{title} over time: {spans}.")


def _stack(
    errors: xr.Dataset,
    rows: list[list[Curve]],
    labels: list[str],
    done: Sequence[Event],
    key: str,
    *,
    titles: list[str],
    height: float = 1.4,
    speed: bool = False,
    limits: Limits | None = None,
) -> Markup:
    time = minutes_of(errors)
    turning = running(errors) if speed else None
    heights = [height] * len(rows) + ([0.24] if turning is not None else [])

    def paint(figure: Canvas) -> None:
        panels = canvas.stack(figure, heights)
        ends: list[list[tuple[float, str, str]]] = []
        for axes, row, label, title in zip(panels, rows, labels, titles, strict=False):
            ends.append([])
            for line in row:
                colour, dash = LOOK[line.name]
                size = line.unit[1]
                expanded = 2 * line.uncertainty / size
                canvas.curve(axes, time, line.values / size, expanded, colour=colour, dash=dash, name=line.name)
                last = last_known(line.values)
                ends[-1].append((np.nan if last is None else line.values[last] / size, line.name, colour))
            axes.axhline(0, color="#888888", linewidth=0.6)
            axes.set_ylabel(f"{label}")
            axes.set_title(title)
            axes.margins(y=0.1)
            canvas.limit_lines(axes, _limits_of(row, limits or {}))
        if turning is not None:
            _speed_strip(panels[-1], time, np.asarray(errors["spindle_speed"].values, float))
        _time_axis(panels[-1], time)
        for i, axes in enumerate(panels[: len(rows)]):
            mark(axes, done, named=i == 0)
        for axes, row_ends in zip(panels, ends, strict=False):
            canvas.label_ends(axes, row_ends)

    return canvas.draw(paint, key, canvas.stack_height(heights))


def _limits_of(row: Sequence[Curve], limits: Limits) -> list[tuple[str, float, float]]:
    """Return the limits of the curves that are errors at the functional point, in the unit of the page."""
    found = []
    for line in row:
        freedom = f"E{line.name}"
        if freedom in limits:
            lower, upper = (each / line.unit[1] for each in limits[freedom])
            found.append((freedom, lower, upper))
    return found


def _speed_strip(axes: Axes, time: np.ndarray, speed: np.ndarray) -> None:
    axes.fill_between(time[[0, -1]], [0, 0], [0, 0], color="none")
    t, y = canvas.decimate(time, speed, 300)
    axes.fill_between(t, 0, y, color="#bbbbbb", linewidth=0, step="post")
    top = np.nanmax(speed)
    axes.set_ylim(0, 1.15 * max(top, 1.0))
    axes.set_yticks([0, top] if top > 0 else [0])
    axes.set_yticklabels(["0", f"{top:.0f}"] if top > 0 else ["0"])
    axes.set_title("Spindle speed / (1/min)")
    axes.grid(visible=False)


def _time_axis(axes: Axes, time: np.ndarray) -> None:
    axes.set_xlabel("time / min")
    if time.size > 1:
        axes.set_xlim(time[0], time[-1])


def _alt_text(what: str, rows: list[list[Curve]], time: np.ndarray) -> str:
    """Return a text alternative of the curves: extremes and last value of each."""
    words = []
    for line in (line for row in rows for line in row):
        name, size = line.unit
        last = last_known(line.values)
        if last is None:
            words.append(f"{line.name} not determined")
            continue
        words.append(
            f"{line.name} between {fixed(np.nanmin(line.values) / size, 1)} and "
            f"{fixed(np.nanmax(line.values) / size, 1)} {name}, last {fixed(line.values[last] / size, 1)} {name}"
        )
    span = f" from {fixed(time[0], 1)} to {fixed(time[-1], 1)} min" if time.size else ""
    return f"{what}{span}: {'; '.join(words)}."
