"""``errormotion demo --compensate``: a virtual machine is probed, its model fitted, and two warm-ups compensated."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path

from errormotion import datasets
from errormotion.cli.commands.compensation.effect import plain
from errormotion.cli.demo.closed_loop import Duty, Loop, Speeds, WarmUp, close
from errormotion.cli.output import show, show_json, table
from errormotion.compensation.effect.report import write
from errormotion.compensation.effect.text import HEAD, percent, rows, verdict
from errormotion.twin import VirtualMachine

SEED = 3
TRAINING: Speeds = ((0.0, 15000.0), (6600.0, 4000.0), (8400.0, 10000.0), (9600.0, 0.0))
"""Speeds of the warm-up to which the model is fitted: up to the highest temperature of the machine, then cooler."""
FURTHER: tuple[Speeds, ...] = (
    ((0.0, 12000.0), (3600.0, 3000.0), (6000.0, 14000.0)),
    ((0.0, 6000.0), (2400.0, 15000.0), (7200.0, 0.0), (9000.0, 9000.0)),
)
"""Speeds of the compensated warm-ups."""


def run(runs: Path, as_json: bool, duty: Duty | None = None) -> None:
    """Run the closed loop, and print the effect of the compensation and the truth."""
    start = time.monotonic()
    duty = duty or Duty()
    machine = VirtualMachine("cframe", seed=SEED)
    loop = close(machine, TRAINING, FURTHER, duty)
    folder = _save(loop, runs)
    seconds = time.monotonic() - start
    if as_json:
        show_json({"ok": True, "seconds": seconds, "warm_ups": [_plain(each) for each in loop.warm_ups]})
        return
    minutes = f"{duty.duration / 60:.0f} simulated minutes"
    show(f"{machine.name}: probed {len(duty.cycles)} times in {minutes} of warm-up, and a model fitted;")
    show(
        f"then {len(loop.warm_ups)} warm-ups with other speeds, each without and with compensation, in {seconds:.0f} s."
    )
    for number, each in enumerate(loop.warm_ups, start=2):
        show(f"\nWarm-up {number}, as probed; the true displacement is {percent(1 - each.remaining)} smaller.")
        found = each.effect
        show("\n".join([*verdict(found), "", table(HEAD, rows(found))]))
    show(f"\nerrors, model and pages: {folder}")


def _plain(each: WarmUp) -> dict[str, object]:
    return {"true_reduction": 1 - each.remaining, "effect": plain(each.effect)}


def _save(loop: Loop, runs: Path) -> Path:
    """Write model, errors and pages into a new folder."""
    folder = runs / f"closed-loop-{datetime.now(UTC):%Y%m%dT%H%M%S%f}"
    folder.mkdir(parents=True)
    loop.model.save(folder / "model.nc")
    for number, each in enumerate(loop.warm_ups, start=2):
        datasets.save(each.before, folder / f"before-{number}.nc")
        datasets.save(each.after, folder / f"after-{number}.nc")
        write(each.effect, each.after, folder / f"effect-{number}.html")
    return folder
