"""``errormotion history``: one figure of one machine over months."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from errormotion.cli.output import show, show_json, table
from errormotion.cli.summary import as_printed, digits_of
from errormotion.errors import RunError
from errormotion.plugins import FigureOfMerit
from errormotion.record.history import Change, Value, step, trend, values_of
from errormotion.record.listing import list_runs


def history(paths: list[Path], machine: str, figure: str, method: str | None, as_json: bool) -> None:
    """Print a figure of a machine over time, its trend, and a step.

    Raises
    ------
    RunError
        No run of the machine states the figure.
    """
    found = list_runs(paths or [Path("runs")], machine=machine, method=method)
    values = values_of((entry for _, entry in found.runs), figure)
    if not values:
        names = sorted({each.name for _, entry in found.runs for each in entry.figures or ()})[:20]
        known = ", ".join(names) or "none"
        raise RunError(f"No value of '{figure}' in {len(found.runs)} runs of '{machine}'. Figures there: {known}")
    if len({value.unit for value in values}) > 1:
        raise RunError(f"'{figure}' matches figures of several units; give a name that matches one")
    slope, jump = trend(values), step(values)
    if as_json:
        changes = {"trend": slope and asdict(slope), "step": jump and asdict(jump)}
        left_out = {"figures_not_read": found.waiting, "skipped": list(found.skipped)}
        show_json({"ok": True, "values": [asdict(value) for value in values], **changes, **left_out})
        return
    rows = [
        [_date(each.time), each.name, *_printed(each.value, each.expanded_uncertainty, each.unit)] for each in values
    ]
    show(table(["started (UTC)", "figure", "value", "U (k=2)", "unit"], rows))
    show(f"trend: {_text(slope, values[0])} per year" if slope else "trend: unknown; it needs three times or more")
    show(
        f"step: {_text(jump, values[0])} about {_date(jump.time)}, p = {jump.p:.2g}"
        if jump
        else "step: none significant"
    )
    if found.waiting:
        show(f"{found.waiting} runs without figures: not yet read from the error datasets; repeat the command")
    for reason in found.skipped:
        show(f"could not be read: {reason}")


def _date(time: float) -> str:
    return f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M}"


def _printed(value: float, U: float, unit: str) -> list[str]:
    printed: dict[str, Any] = as_printed(FigureOfMerit("", value, U, unit))
    return [*digits_of(printed), printed["unit"]]


def _text(change: Change, first: Value) -> str:
    value, U, unit = _printed(change.size, change.expanded_uncertainty, first.unit)
    return f"{value} {unit}, U = {U} {unit} (95 %)"
