"""Time of ``errormotion runs`` over many run folders, without and with the index, and of a long history."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from errormotion.datasets.files import events
from errormotion.record.runs.listing import list_runs
from errormotion.record.series import YEAR, Series
from errormotion.record.steps import model_of

RUNS = 10_000
LONG_AGO = 1_700_000_000
"""Modification time of files that no longer change, s."""


def made(root: Path, count: int) -> None:
    """Write run folders with typical contents: texts of campaign and bench, 12 figures, 1 note in 100 runs."""
    figures = [{"name": f"EZ {k}", "value": k * 1e-6, "expanded_uncertainty": 4e-7, "unit": "m"} for k in range(12)]
    for number in range(count):
        folder = root / f"20260101T000000Z-drift-{number:08x}"
        folder.mkdir()
        state = {
            "schema": "errormotion.run/1",
            "test": "drift",
            "created": f"20{10 + number // 672:02}-{1 + number // 56 % 12:02}-{1 + number // 2 % 28:02}T08:00:00+00:00",
            "status": "finished",
            "campaign": {"name": "Monday", "text": "x" * 2000},
            "bench": {"machine": f"machine {number % 4}", "text": "y" * 4000},
            "method": {"id": "spindle_drift", "version": "1"},
            "results": figures,
            "steps": [{"step": "acquire", "outcome": "done", "time": "2026-01-01T00:00:00+00:00"}] * 5,
        }
        (folder / "run.json").write_text(json.dumps(state, indent=1))
        os.utime(folder / "run.json", (LONG_AGO, LONG_AGO))
        if number % 100 == 0:
            events.append(folder, events.event("coolant exchanged"))
            os.utime(folder / events.FILE, (LONG_AGO, LONG_AGO))


def timed(call: object) -> str:
    """Return the duration of a call, and its processor time including that of child processes."""
    begin, used = time.perf_counter(), sum(os.times()[:4])
    call()
    return f"{time.perf_counter() - begin:.2f} s (processor {sum(os.times()[:4]) - used:.2f} s)"


def main() -> None:
    command = [sys.executable, "-m", "errormotion", "runs"]
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        made(root, RUNS)
        for label in ("without index", "with index"):
            print(f"list_runs of {RUNS} runs, {label}: {timed(lambda: list_runs([root]))}")
        size = (root / ".errormotion-index.json").stat().st_size
        print(f"index: {size / 2**20:.1f} MiB")
        for options in ([], ["--machine", "machine 1"], ["--json"]):
            words = [*command, str(root), *options]
            seconds = timed(lambda: subprocess.run(words, check=True, stdout=subprocess.DEVNULL))  # noqa: B023
            print(f"errormotion runs {' '.join(options)}, the whole command with index: {seconds}")
    rng = np.random.default_rng(0)
    for count in (24, 120, 1000):
        t, u = np.sort(rng.uniform(0, 5 * YEAR, count)), rng.uniform(0.5e-6, 1.5e-6, count)
        y = u * rng.normal(size=count) + 6e-6 * (np.arange(count) >= count // 2)
        found = []
        seconds = timed(lambda: found.append(model_of(Series(t, y, u))))  # noqa: B023
        print(f"trend and steps of {count} values: {seconds}, {len(found[0].steps)} step found")


if __name__ == "__main__":
    main()
