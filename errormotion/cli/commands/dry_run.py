"""``errormotion run --dry-run``: path and duration of a campaign; nothing moves."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.limits import AXES, NO_MOTIONS, Extent, Limits, extent, steps_of
from errormotion.cli.output import show, show_json, table
from errormotion.errors import BenchError
from errormotion.plugins import Step

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MM, MINUTE = 1e3, 60.0
WIDTH, HEIGHT = 9.0, 7.0  # inches


def run(campaign: Path, out: Path | None, as_json: bool) -> None:
    """Print path and duration of every test, and draw them into a folder.

    Raises
    ------
    BenchError
        The campaign cannot be read, leaves the limits of its bench, or a method does not state what moves.
    """
    plan = load_campaign(campaign)
    found_tests: list[dict[str, Any]] = []
    for test in plan.tests:
        steps = steps_of(test.method, test.settings, plan.bench.chosen(test.instruments).settings_by_kind)
        if steps is None:
            raise BenchError(f"{campaign}: {test.name}: {NO_MOTIONS.format(test.method.info.id)}. Nothing has moved.")
        found = extent(steps)
        picture = None if out is None else _picture(plan, test.name, steps, out)
        found_tests.append(
            {"test": test.name, "motions": found.__dict__, "picture": None if picture is None else str(picture)}
        )
        if not as_json:
            show(_text(test.name, found, plan.bench.limits))
            if picture is not None:
                show(f"  drawn in {picture}")
    if as_json:
        show_json({"ok": True, "tests": found_tests})
        return
    show("Nothing has moved.")


def _text(name: str, found: Extent, limits: Limits) -> str:
    """Return the motions of a test compared with the limits."""
    rows = []
    for k, axis in enumerate(AXES):
        span = getattr(limits, axis)
        bounds = "-" if span is None else f"{span[0] * MM:.1f} to {span[1] * MM:.1f}"
        known = not math.isnan(found.low[k])
        planned = f"{found.low[k] * MM:.1f} to {found.high[k] * MM:.1f}" if known else "stays"
        rows.append([f"{axis}/mm", planned, bounds])
    feed = "-" if limits.feed is None else f"{limits.feed * MM * MINUTE:.0f}"
    speed = "-" if limits.spindle_speed is None else f"{limits.spindle_speed:.0f}"
    rapid = f"rapid in {found.rapid} moves" if found.rapid else ""
    stated = f"up to {found.feed * MM * MINUTE:.0f}" if found.feed or not rapid else ""
    rows.append(["feed/(mm/min)", ", ".join(filter(None, [stated, rapid])), feed])
    rows.append(["spindle/(1/min)", f"up to {found.spindle_speed:.0f}", speed])
    untimed = f" and {found.untimed} steps of unknown duration" if found.untimed else ""
    motions = f"{found.moves} moves over {found.path:.1f} m, {found.touches} touches"
    head = f"{name}: {_duration(found.seconds)}{untimed}, {motions}"
    return "\n".join([head, table(["", "planned", "limits"], rows)])


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def _picture(plan: CampaignPlan, name: str, steps: list[Step], out: Path) -> Path:
    """Draw the path from above and from the front, and the spindle speed over time; return the file."""
    path = out / f"{name}-dry-run.png"
    if path.exists():
        raise BenchError(f"{path} exists already: choose another folder, or remove the file.")
    out.mkdir(parents=True, exist_ok=True)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    above, front, side, time = figure.subplots(2, 2).ravel()
    for axes, (first, second) in zip((above, front, side), ((0, 1), (0, 2), (1, 2)), strict=True):
        _view(axes, steps, plan.bench.limits, first, second)
    _speeds(time, steps)
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(f"{plan.name}: {name}, {_duration(extent(steps).seconds)}")
    figure.savefig(path, dpi=110)
    return path


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
