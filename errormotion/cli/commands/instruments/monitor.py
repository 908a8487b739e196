"""``errormotion monitor``: shows temperatures and working parameters live, and logs them into a run folder."""

from __future__ import annotations

import json
import math
import sys
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from errormotion.campaign.claims import claimed, uses
from errormotion.campaign.files import load_bench
from errormotion.campaign.monitor.watch import Monitor, Snapshot
from errormotion.cli import options
from errormotion.cli.curves import bars
from errormotion.cli.output import show
from errormotion.cli.terminal import Terminal

TREND = 30
"""Points of the curve of a temperature."""

MIN_SPAN = 0.1
"""Smallest full scale of the curve of a temperature, K."""

SPAN = 1800.0
"""Period of the curve and of the rate of change, s."""


def run(file: Path, runs: Path, interval: str, duration: str | None, as_json: bool) -> None:
    """Monitor a bench until Ctrl-C or for a duration, and print the folder of the log."""
    step = options.duration("--interval", interval)
    length = math.inf if duration is None else options.duration("--duration", duration)
    monitor = Monitor(load_bench(file), runs, step)
    screen = Screen(monitor.sensors)
    console = Terminal()
    shown = sys.stderr.isatty() and not as_json
    last: Snapshot | None = None
    folder: Path | None = None
    try:
        with (
            claimed(uses(monitor.plan), "a monitor") as held,
            monitor,
            Live(console=console, auto_refresh=False, transient=True, screen=False) as live,
        ):
            folder = monitor.folder.path
            held.records(folder)
            if held.note:
                console.print(held.note, markup=False)
            for last in monitor.watch(length):
                screen.take(last)
                if as_json:
                    sys.stdout.write(json.dumps(_plain(last), ensure_ascii=False) + "\n")
                    sys.stdout.flush()
                elif shown:
                    live.update(screen.page(monitor.plan.machine, last, folder), refresh=True)
    except KeyboardInterrupt:  # Ctrl-C ends the command
        if folder is None:  # before the log was created
            raise
    if not as_json:
        show(summary(last, monitor.folder.path, monitor.doubted))


class Screen:
    """The live view; its memory is bounded.

    Parameters
    ----------
    sensors : sequence of str
        Names of the temperatures.
    """

    def __init__(self, sensors: tuple[str, ...]) -> None:
        self._first: dict[str, float] = {}
        self._extremes: dict[str, tuple[float, float]] = {}
        self._history: dict[str, deque[tuple[float, float]]] = {name: deque(maxlen=TREND) for name in sensors}

    def take(self, snapshot: Snapshot) -> None:
        """Add the temperatures of a snapshot."""
        for name, value in snapshot.temperatures.items():
            history = self._history[name]
            if not history or snapshot.time - history[-1][0] >= SPAN / TREND:
                history.append((snapshot.time, value))
            if math.isnan(value):
                continue
            self._first.setdefault(name, value)
            low, high = self._extremes.get(name, (value, value))
            self._extremes[name] = min(low, value), max(high, value)

    def rate(self, name: str, snapshot: Snapshot) -> float:
        """Return the rate of change of a temperature, K/h; NaN while it is unknown."""
        known = [(t, value) for t, value in self._history[name] if not math.isnan(value)]
        value = snapshot.temperatures[name]
        if not known or math.isnan(value) or snapshot.time <= known[0][0]:
            return math.nan
        return (value - known[0][1]) / (snapshot.time - known[0][0]) * 3600

    def page(self, machine: str, snapshot: Snapshot, folder: Path) -> Group:
        """Return the live view of the terminal."""
        parts: list[Any] = [Text.assemble((machine, "bold"), f"  {clock(snapshot.time)}  {snapshot.logged} rows")]
        if snapshot.temperatures:
            parts.append(self._temperatures(snapshot))
        if snapshot.state:
            parts.append(_parameters(snapshot.state))
        for name, why in snapshot.silent.items():
            parts.append(Text(f"{name} is silent: {why}", style="red"))
        for name, why in snapshot.doubtful.items():
            parts.append(Text(f"{name} {why}", style="red"))
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
                bars([value for _, value in self._history[name]], MIN_SPAN),
            )
        return table


def _parameters(state: dict[str, Any] | Any) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column("", style="dim")
    table.add_column("")
    position = state.get("position") or []
    rows = [
        ("position", "  ".join(f"{axis} {1e3 * x:.3f}" for axis, x in zip("XYZ", position, strict=False)) + " mm"),
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


def summary(last: Snapshot | None, folder: Path, doubted: Mapping[str, str] | None = None) -> str:
    """Return the summary that is printed at the end."""
    if last is None:
        return f"Nothing was logged in {folder}."
    lines = [f"{last.logged} rows over {clock(last.time)} in {folder}."]
    lines += [
        f"{name}: no answer in {count} of the rows; they are marked as gaps." for name, count in last.gaps.items()
    ]
    lines += [
        f"{name} {why}: its values may be wrong. The time is in log.jsonl." for name, why in (doubted or {}).items()
    ]
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
        "doubtful": dict(snapshot.doubtful),
    }
