"""Path, duration and limits of the tests of a campaign as numbers, text and drawing; nothing moves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.campaign.files import CampaignPlan, TestPlan
from errormotion.campaign.sections.limits import AXES, NO_MOTIONS, Extent, Limits, extent, steps_of
from errormotion.errors import BenchError
from errormotion.plugins import Step

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MM, MINUTE = 1e3, 60.0
WIDTH, HEIGHT = 9.0, 7.0  # inches


@dataclass(frozen=True)
class Motions:
    """Steps of the machine in one test, and their requirements."""

    test: str
    steps: list[Step]
    extent: Extent


def motions(plan: CampaignPlan, test: TestPlan) -> Motions:
    """Return the motions of the machine in a test.

    Raises
    ------
    BenchError
        The method does not state its motions.
    """
    steps = steps_of(test.method, test.settings, plan.bench.chosen(test.instruments).settings_by_kind)
    if steps is None:
        raise BenchError(
            f"{plan.source}: {test.name}: {NO_MOTIONS.format(test.method.info.id)}. Nothing has moved.",
            code="motions.none",
        )
    return Motions(test.name, steps, extent(steps))


def headline(found: Motions) -> str:
    """Return duration and moves in one line."""
    own = found.extent
    untimed = f" and {own.untimed} steps of unknown duration" if own.untimed else ""
    return f"{duration(own.seconds)}{untimed}, {own.moves} moves over {own.path:.1f} m, {own.touches} touches"


def beside_limits(reached: Extent, limits: Limits) -> list[list[str]]:
    """Return rows of quantity, planned value and limits, as text."""
    rows = []
    for k, axis in enumerate(AXES):
        span = getattr(limits, axis)
        bounds = "-" if span is None else f"{span[0] * MM:.1f} to {span[1] * MM:.1f}"
        known = not math.isnan(reached.low[k])
        planned = f"{reached.low[k] * MM:.1f} to {reached.high[k] * MM:.1f}" if known else "stays"
        rows.append([f"{axis}/mm", planned, bounds])
    feed = "-" if limits.feed is None else f"{limits.feed * MM * MINUTE:.0f}"
    speed = "-" if limits.spindle_speed is None else f"{limits.spindle_speed:.0f}"
    rapid = f"rapid in {reached.rapid} moves" if reached.rapid else ""
    stated = f"up to {reached.feed * MM * MINUTE:.0f}" if reached.feed or not rapid else ""
    rows.append(["feed/(mm/min)", ", ".join(filter(None, [stated, rapid])), feed])
    rows.append(["spindle/(1/min)", f"up to {reached.spindle_speed:.0f}", speed])
    return rows


def duration(seconds: float) -> str:
    """Return a duration as text."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def picture(plan: CampaignPlan, found: Motions) -> Figure:
    """Return a drawing of the path in top, front and side view, and of the spindle speed over time.

    If no axis moves, only the spindle speed is drawn.
    """
    from matplotlib.figure import Figure

    title = f"{plan.name}: {found.test}, {duration(found.extent.seconds)}"
    if all(step.place is None for step in found.steps):
        figure = Figure(figsize=(WIDTH, HEIGHT / 2), layout="constrained")
        _speeds(figure.subplots(), found.steps)
        figure.suptitle(title)
        return figure
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    above, front, side, time = figure.subplots(2, 2).ravel()
    for axes, (first, second) in zip((above, front, side), ((0, 1), (0, 2), (1, 2)), strict=True):
        _view(axes, found.steps, plan.bench.limits, first, second)
    _speeds(time, found.steps)
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(title)
    return figure


def _view(axes: Axes, steps: list[Step], limits: Limits, first: int, second: int) -> None:
    places = np.array([step.place for step in steps if step.place is not None]) * MM
    touched = np.array([step.place for step in steps if step.what == "touch"]).reshape(-1, 3) * MM
    if places.size:
        axes.plot(places[:, first], places[:, second], color="tab:blue", lw=0.8, label="path")
    axes.plot(touched[:, first], touched[:, second], "o", ms=3, color="tab:red", label="touch")
    spans = [getattr(limits, AXES[k]) for k in (first, second)]
    if all(span is not None for span in spans):
        (left, right), (low, high) = (np.array(span) * MM for span in spans)
        axes.plot(
            [left, right, right, left, left], [low, low, high, high, low], color="0.5", ls="--", lw=1, label="limits"
        )
    axes.set(xlabel=f"{AXES[first]}/mm", ylabel=f"{AXES[second]}/mm", aspect="equal")


def _speeds(axes: Axes, steps: list[Step]) -> None:
    ends = np.nancumsum([step.seconds for step in steps]) / MINUTE
    speeds = np.array([step.spindle_speed for step in steps])
    times = np.concatenate([[0.0], ends])
    axes.stairs(speeds, times, color="tab:blue")
    touches = [end for end, step in zip(ends, steps, strict=True) if step.what == "touch"]
    axes.plot(touches, np.zeros(len(touches)), "|", color="tab:red", ms=8)
    top = max(float(speeds.max(initial=0.0)), 1.0)
    axes.set(xlabel="time/min", ylabel="spindle speed/(1/min)", ylim=(-0.05 * top, 1.1 * top))
    axes.set_xlim(0.0, math.ceil(times[-1]) or 1)
