"""``errormotion compensate run``: offsets that follow the temperatures of a machine, shown live in the terminal."""

from __future__ import annotations

import json
import math
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from errormotion.campaign.compensation.compensating import Compensation, Moment
from errormotion.campaign.files import load_bench
from errormotion.campaign.folder import RunFolder
from errormotion.cli import options
from errormotion.cli.output import show
from errormotion.cli.terminal import Terminal
from errormotion.compensation.online.follower import State
from errormotion.datasets import load

COLOURS = {State.FOLLOWING: "green", State.HOLDING: "yellow", State.RAMPING: "yellow", State.FAULT: "bold red"}


def run(
    file: Path,
    model: Path,
    runs: Path,
    *,
    arm: str | None,
    since: Path | None,
    functional_point: tuple[float, float, float] | None,
    duration: str | None,
    as_json: bool,
) -> int:
    """Compensate until Ctrl-C or for a duration, then ramp to zero, and print the summary. Return the exit code."""
    length = math.inf if duration is None else options.duration("--duration", duration)
    compensation = Compensation(
        load_bench(file),
        load(model),
        runs,
        arm=arm,
        functional_point=None if functional_point is None else np.array(functional_point),
        since=None if since is None else load(RunFolder.open(since).raw if since.is_dir() else since),
    )
    console = Terminal()
    shown = sys.stderr.isatty() and not as_json
    states: Counter[str] = Counter()
    last: Moment | None = None
    if not as_json:
        console.print(announcement(compensation))
    with (
        compensation,
        Live(console=console, auto_refresh=False, transient=True) as live,
        _ramping_when_stopped(compensation, console),
    ):
        if compensation.note and not as_json:
            console.print(compensation.note, markup=False)
        for last in compensation.follow(length):
            states[str(last.step.state)] += 1
            if as_json:
                sys.stdout.write(json.dumps(_plain(last)) + "\n")
                sys.stdout.flush()
            elif shown:
                live.update(page(compensation, last), refresh=True)
    if not as_json:
        show(summary(compensation, last, states))
    return 1 if last is not None and last.step.state is State.FAULT else 0


@contextmanager
def _ramping_when_stopped(compensation: Compensation, console: Terminal) -> Iterator[None]:
    """Handle Ctrl-C and SIGTERM: the first one ramps to zero, the second one ends the command at once."""
    stopping = False

    def stop(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        nonlocal stopping
        if stopping or compensation.state in (State.FAULT, State.OFF):
            raise KeyboardInterrupt
        stopping = True
        compensation.stop()
        console.print("Ramping to zero. Ctrl-C again ends at once; the watchdog of the machine then ramps to zero.")

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with suppress(KeyboardInterrupt):
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def announcement(compensation: Compensation) -> str:
    """Return a line that states the machine, the mode and the limits."""
    limits, plan = compensation.limits, compensation.plan
    bounds = f"at most {limits.limit * 1e6:g} um for each axis, {limits.slew * 1e6:g} um/s"
    if not compensation.armed:
        return (
            f"Shadow mode: offsets of '{plan.machine}' are computed and logged; nothing is written. Limits: {bounds}."
        )
    driver = plan.compensator.driver.info.id if plan.compensator else ""
    return f"Armed: offsets of '{plan.machine}' are written by {driver}: {bounds}. Ctrl-C ramps to zero."


def page(compensation: Compensation, moment: Moment) -> Group:
    """Return the live view of the terminal."""
    step = moment.step
    head = Text.assemble(
        (compensation.plan.machine, "bold"), "  ", (str(step.state), COLOURS.get(step.state, "")), f"  {step.cause}"
    )
    if not compensation.armed:
        head.append("  shadow mode, nothing is written", style="dim")
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("axis", "predicted error/um", "U (k=2)/um", "offset/um", "in effect/um"):
        table.add_column(name, justify="right")
    for k, axis in enumerate("XYZ"):
        applied = math.nan if moment.applied is None else moment.applied[k]
        row = (moment.prediction.errors[k], 2 * moment.prediction.uncertainty[k], step.offset[k], applied)
        table.add_row(axis + (" limited" if k in step.limited else ""), *(_um(value) for value in row))
    return Group(head, table, Text(f"logging to {compensation.folder.path}   Ctrl-C ramps to zero", style="dim"))


def summary(compensation: Compensation, last: Moment | None, states: Counter[str]) -> str:
    """Return the summary that is printed at the end."""
    if last is None:
        return f"Nothing was computed; the log is in {compensation.folder.path}."
    total = sum(states.values())
    shares = ", ".join(f"{name} {100 * count / total:.0f} %" for name, count in states.most_common())
    lines = [f"{total} intervals in {compensation.folder.path}: {shares}."]
    if compensation.armed:
        final = ", ".join(f"{axis} {_um(value)} um" for axis, value in zip("XYZ", last.step.offset, strict=True))
        lines.append(f"Last state: {last.step.state}; last offset written: {final}.")
    if last.step.state is State.FAULT:
        lines.append(
            f"Fault: {last.step.cause}. The watchdog of the machine ramps its offset to zero; check the machine."
        )
    return "\n".join(lines)


def _um(value: float) -> str:
    return "-" if math.isnan(value) else f"{value * 1e6:+.2f}"


def _plain(moment: Moment) -> dict[str, object]:
    def known(values: np.ndarray) -> list[float | None]:
        return [float(v) if math.isfinite(v) else None for v in values]

    return {
        "time": moment.snapshot.time,
        "state": str(moment.step.state),
        "cause": moment.step.cause,
        "offset": known(moment.step.offset),
        "predicted": known(moment.prediction.errors),
        "uncertainty": known(moment.prediction.uncertainty),
        "applied": None if moment.applied is None else known(np.array(moment.applied)),
    }
