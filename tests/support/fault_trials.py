"""Runs that are ended by a fault: the command line in a process of its own, killed at an instant, and continued.

The child writes a line for each dataset that a method delivers to the recorder; what was delivered and is not on disk
after the kill is the loss.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion import datasets
from errormotion.campaign.folder import RunFolder, list_runs
from errormotion.campaign.storage.store import committed_length

if TYPE_CHECKING:
    pass

Process = "subprocess.Popen[str] | Forked"
POLL_INTERVAL = 0.02
"""Between two looks at the state of a run, s."""
LONGEST = 240.0
"""Time limit of one process, s."""
INTERNAL_ERROR = 70
STAGES = ("acquisition", "identification", "report")


@dataclass
class Ended:
    """How a process ended, and what a run folder then contained.

    Attributes
    ----------
    code : int
        Exit status; -9 after a kill.
    message : str
        Standard error.
    lost : float
        Age of the oldest samples that are not on disk, s; 0 where all are.
    samples : int
        Samples that are not on disk.
    faults : list of str
        What must not be: files that are not whole, more than a second lost.
    """

    code: int
    message: str = ""
    lost: float = 0.0
    samples: int = 0
    stage: str = ""
    faults: list[str] = field(default_factory=list)


def finish(process: Process) -> Ended:
    """Wait for the end of a process."""
    try:
        _, message = process.communicate(timeout=LONGEST)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        _, message = process.communicate()
        return Ended(process.returncode, message, faults=[f"did not end within {LONGEST:.0f} s"])
    faults = []
    if process.returncode == INTERNAL_ERROR or "Traceback" in message:
        faults.append(f"ended as an internal error: {message[-300:]}")
    return Ended(process.returncode, message, faults=faults)


def kill_when(process: Process, ready: Callable[[], bool], delay: float) -> float:
    """Send SIGKILL a delay after a state is reached; return the instant on the monotonic clock, NaN if it had ended."""
    until = time.monotonic() + LONGEST
    while process.poll() is None and time.monotonic() < until and not ready():
        time.sleep(POLL_INTERVAL)
    time.sleep(delay)
    running = process.poll() is None
    instant = time.monotonic()
    process.kill()
    process.communicate()
    return instant if running else np.nan


def ends(group: int, within: float = 30.0) -> bool:
    """Return whether all processes of a group end within a time, s; those that do not are killed."""
    until = time.monotonic() + within
    try:
        while time.monotonic() < until:
            os.killpg(group, 0)
            time.sleep(0.05)
        os.killpg(group, signal.SIGKILL)
    except ProcessLookupError:
        return True
    return False


def stage_of(runs: Path, test: str) -> str:
    """Return the stage that a test of the only campaign in a folder has reached; empty before its first."""
    for folder in list_runs(runs):
        if folder.data["test"] == test and folder.data["steps"]:
            if not folder.data["acquired"]:
                return STAGES[0]
            if folder.data["errors"] is None:
                return STAGES[1]
            return "" if folder.finished else STAGES[2]
    return ""


def _delivered(folder: RunFolder, journal: Path) -> list[tuple[str, float, int]]:
    """Return dimension, time on the monotonic clock (s) and samples of each dataset delivered for a run folder."""
    found = []
    for line in journal.read_text().splitlines() if journal.exists() else []:
        path, dim, at, count = line.rsplit(" ", 3)
        if Path(path).parent == folder.path:
            found.append((dim, float(at), int(count)))
    return found


def kept(folder: RunFolder, journal: Path) -> int:
    """Return the number of samples of a run on disk."""
    own = _delivered(folder, journal)
    return committed_length(folder.raw, own[0][0]) if own and (folder.raw / "zarr.json").exists() else 0


def examined(runs: Path, journal: Path, instant: float) -> Ended:
    """Return what a kill at an instant left in the run folders."""
    ended = Ended(-signal.SIGKILL, faults=half_files(runs))
    for folder in list_runs(runs):
        if folder.finished:
            continue
        ended.stage = stage_of(runs, folder.data["test"])
        own = _delivered(folder, journal)
        if not own:
            continue
        there, total = kept(folder, journal), np.cumsum([count for _, _, count in own])
        late = total > there
        if late.any():
            ended.samples = int(total[-1] - there)
            ended.lost = instant - own[int(np.argmax(late))][1]
    return ended


def half_files(runs: Path) -> list[str]:
    """Return the results in a folder that are not whole."""
    faults = []
    for path in sorted(runs.rglob("*.nc")):
        try:
            with datasets.load(path) as errors:
                datasets.validate(errors.load())
        except Exception as error:  # noqa: BLE001 - whatever a half file raises
            faults.append(f"{path}: {error}")
    for path in runs.rglob("report.html"):
        if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
            faults.append(f"{path}: is cut off")
    for path in runs.glob("*/run.json"):
        if not path.parent.name.startswith("."):
            RunFolder.open(path.parent)
    return faults


def differences(runs: Path, undisturbed: Path) -> list[str]:
    """Return in which tests and variables the raw data of two campaigns differ, and from which row on."""
    found = {folder.data["test"]: folder for folder in list_runs(runs)}
    texts = []
    for folder in list_runs(undisturbed):
        test = folder.data["test"]
        if test not in found or not found[test].finished:
            texts.append(f"{test}: not finished")
            continue
        with datasets.load(folder.raw) as expected, datasets.load(found[test].raw) as raw:
            if dict(raw.sizes) != dict(expected.sizes):
                texts.append(f"{test}: {dict(raw.sizes)} in place of {dict(expected.sizes)}")
                continue
            for name, variable in expected.variables.items():
                other, values = raw[name].values, variable.values
                same = (other == values) | ((other != other) & (values != values))
                if not np.all(same):
                    first = [int(axis.min()) for axis in np.nonzero(~same)]
                    texts.append(f"{test}.{name}: {np.sum(~same)} of {same.size} values, from {first}")
    return texts


def command(journal: str, limit: int, arguments: list[str]) -> None:
    """Run the command line; note what is delivered to the recorder, before it is."""
    from errormotion.campaign.storage.recorder import Recorder
    from errormotion.cli import main

    if limit:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    file = os.open(journal, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    put = Recorder.put

    def noted(self: Recorder, chunk: Any) -> None:
        count = chunk.sizes.get(self._dim, 0)
        if not limit:
            os.write(file, f"{self._path} {self._dim} {time.monotonic()} {count}\n".encode())
        put(self, chunk)

    Recorder.put = noted  # type: ignore[method-assign]
    sys.argv = ["errormotion", *arguments]
    main()


def summary(runs: Path) -> dict[str, list[tuple[str, float]]]:
    """Return the duration of the stages of each test in a folder of finished runs, s."""
    table = {}
    for folder in list_runs(runs):
        times = [datetime.fromisoformat(step["time"]).timestamp() for step in folder.data["steps"]]
        table[str(folder.data["test"])] = list(zip(STAGES, np.diff(times).tolist(), strict=False))
    return table
