"""``errormotion monitor``: temperatures and working parameters live in the terminal, and into a run folder."""

from __future__ import annotations

import json
import math
import sys
from collections import deque
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from errormotion.campaign.files import load_bench
from errormotion.campaign.monitor.watch import Monitor, Snapshot
from errormotion.campaign.turns import claimed
from errormotion.cli.curves import bars
from errormotion.cli.output import show
from errormotion.datasets.units import TIME
from errormotion.errors import BenchError

TREND = 30
"""Characters of the course of a temperature."""

LEAST_SPAN = 0.1
"""Height of the course of a temperature at least, K: a tenth of a kelvin is no mountain."""

SPAN = 1800.0
"""Time that the course and the rate of change look back, s."""


def run(file: Path, runs: Path, interval: str, duration: str | None, as_json: bool) -> None:
    """Watch a bench until Ctrl-C, or for a time; print where the log is."""
    step = _time("interval", interval)
    length = math.inf if duration is None else _time("duration", duration)
    monitor = Monitor(load_bench(file), runs, step)
    screen = Screen(monitor.sensors)
    console = Console(stderr=True, highlight=False)
    shown = sys.stderr.isatty() and not as_json
    last: Snapshot | None = None
    place: Path | None = None
    try:
        with (
            claimed(monitor.plan.machine, "a monitor") as records,
            monitor,
            Live(console=console, auto_refresh=False, transient=True, screen=False) as live,
        ):
            place = monitor.folder.path
            records(place)
            for last in monitor.watch(length):
                screen.take(last)
                if as_json:
                    sys.stdout.write(json.dumps(_plain(last), ensure_ascii=False) + "\n")
                    sys.stdout.flush()
                elif shown:
                    live.update(screen.page(monitor.plan.machine, last, monitor.folder.path), refresh=True)
    except KeyboardInterrupt:  # the way to end it
        if place is None:  # before there was a log
            raise
    if not as_json:
        show(summary(last, monitor.folder.path))


def _time(name: str, text: str) -> float:
    try:
        value = TIME.parse(text)
    except ValueError as error:
        raise BenchError(f"--{name}: {error}") from None
    if not value > 0:
        raise BenchError(f"--{name}: expected more than 0 s; found '{text}'")
    return value


class Screen:
    """The live page: remembers as much of the past as it shows, and no more.

    Parameters
    ----------
    sensors : sequence of str
        Names of the temperatures.
    """

    def __init__(self, sensors: tuple[str, ...]) -> None:
        self._first: dict[str, float] = {}
        self._extremes: dict[str, tuple[float, float]] = {}
        self._course: dict[str, deque[tuple[float, float]]] = {name: deque(maxlen=TREND) for name in sensors}

    def take(self, snapshot: Snapshot) -> None:
        """Remember what the page needs of a snapshot."""
        for name, value in snapshot.temperatures.items():
            course = self._course[name]
            if not course or snapshot.time - course[-1][0] >= SPAN / TREND:
                course.append((snapshot.time, value))
            if math.isnan(value):
                continue
            self._first.setdefault(name, value)
            low, high = self._extremes.get(name, (value, value))
            self._extremes[name] = min(low, value), max(high, value)

    def rate(self, name: str, snapshot: Snapshot) -> float:
        """Return by how much a temperature rises, K/h; NaN while that cannot be said."""
        known = [(t, value) for t, value in self._course[name] if not math.isnan(value)]
        value = snapshot.temperatures[name]
        if not known or math.isnan(value) or snapshot.time <= known[0][0]:
            return math.nan
        return (value - known[0][1]) / (snapshot.time - known[0][0]) * 3600

    def page(self, machine: str, snapshot: Snapshot, folder: Path) -> Group:
        """Return what the terminal shows."""
        parts: list[Any] = [Text.assemble((machine, "bold"), f"  {clock(snapshot.time)}  {snapshot.logged} rows")]
        if snapshot.temperatures:
            parts.append(self._temperatures(snapshot))
        if snapshot.state:
            parts.append(_parameters(snapshot.state))
        for name, why in snapshot.silent.items():
            parts.append(Text(f"{name} is silent: {why}", style="red"))
        lost = [f"{name} {count}" for name, count in snapshot.gaps.items()]
        if lost:
            parts.append(Text("rows without an answer: " + ", ".join(lost), style="yellow"))
        parts.append(Text(f"logging to {folder}   Ctrl-C ends", style="dim"))
        return Group(*parts)

    def _temperatures(self, snapshot: Snapshot) -> Table:
        table = Table(box=None, pad_edge=False, header_style="dim")
        table.add_column("sensor")
        for head in ("degC", "since start/K", "K/h", "min", "max"):
            table.add_column(head, justify="right")
        table.add_column(f"last {SPAN / 60:.0f} min")
        for name, value in snapshot.temperatures.items():
            low, high = self._extremes.get(name, (math.nan, math.nan))
            flag = snapshot.flags.get(name, "")
            table.add_row(
                name,
                Text(flag, style="red") if flag else f"{value:.2f}",
                _number(value - self._first.get(name, math.nan), "+.2f"),
                _number(self.rate(name, snapshot), "+.2f"),
                _number(low, ".2f"),
                _number(high, ".2f"),
                bars([value for _, value in self._course[name]], LEAST_SPAN),
            )
        return table


def _parameters(state: dict[str, Any] | Any) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column("", style="dim")
    table.add_column("")
    place = state.get("position") or []
    rows = [
        ("position", "  ".join(f"{axis} {1e3 * x:.3f}" for axis, x in zip("XYZ", place, strict=False)) + " mm"),
        ("spindle", f"{_number(state.get('spindle_speed'), '.0f')} /min"),
        ("load", f"{_number(_times(100, state.get('spindle_load')), '.0f')} %"),
        ("feed", f"{_number(_times(60e3, state.get('feed')), '.0f')} mm/min"),
        ("mode", f"{state.get('mode') or '-'}  {state.get('program') or ''}"),
    ]
    for name, text in rows:
        table.add_row(name, text)
    for alarm in state.get("alarms") or ():
        table.add_row("alarm", Text(str(alarm), style="bold red"))
    return table


def clock(seconds: float) -> str:
    """Return a time as days, hours, minutes and seconds."""
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    days, hour = divmod(hours, 24)
    return (f"{days} d " if days else "") + f"{hour:02d}:{minute:02d}:{second:02d}"


def summary(last: Snapshot | None, folder: Path) -> str:
    """Return what a person reads when the monitor has ended."""
    if last is None:
        return f"Nothing was logged in {folder}."
    lines = [f"{last.logged} rows over {clock(last.time)} in {folder}."]
    lines += [f"{name}: no answer in {count} of them, marked as gaps." for name, count in last.gaps.items()]
    return "\n".join(lines)


def _times(factor: float, value: Any) -> float:
    return math.nan if value is None else factor * float(value)


def _number(value: Any, form: str) -> str:
    return "-" if value is None or math.isnan(value) else format(value, form)


def _plain(snapshot: Snapshot) -> dict[str, Any]:
    known = {k: None if math.isnan(v) else v for k, v in snapshot.temperatures.items()}
    state = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in snapshot.state.items()}
    flags = {k: v for k, v in snapshot.flags.items() if v}
    return {
        "time": snapshot.time,
        "temperatures": known,
        "flags": flags,
        "state": state,
        "silent": dict(snapshot.silent),
    }
