"""Runs under faults: ``make faults`` ends and disturbs real processes, and writes a section of ``docs/reliability.md``.

Each trial starts a short campaign on a virtual machine, an identification, a report, a batch, a monitor, a compensation
or the fit of a model, and kills it at a random instant, lets a random write fail, sets the clocks, suspends it, or
starts it twice. Then it is continued or repeated, and the raw data are compared with those of an undisturbed run.
``ARGS="--kills 30 --seed 5"`` changes the number of trials and the instants; ``--only disk`` selects kinds by name.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

import fault_processes  # noqa: E402
from fault_kinds import Kinds, Result  # noqa: E402
from fuzz import PAGE, write_section  # noqa: E402

TITLE = "Runs that are disturbed"
SHARES = {
    "kill_acquisition": 0.80,
    "kill_later": 0.08,
    "kill_command": 0.04,
    "kill_batch": 0.04,
    "kill_monitor": 0.04,
    "kill_compensation": 0.08,
    "kill_fit": 0.02,
    "disk": 0.20,
    "disk_command": 0.08,
    "disk_monitor": 0.04,
    "size_limit": 0.05,
    "file_system": 0.05,
    "clock_running": 0.06,
    "clock_between": 0.12,
    "suspend": 0.05,
    "suspend_monitor": 0.02,
    "two_at_once": 0.05,
    "moved": 0.06,
}
"""Trials of each kind, relative to kills."""
FOLLOWING = "errormotion compensate run"
SHIMMED = ("disk", "disk_command", "disk_monitor", "clock_running", "clock_between", "suspend", "suspend_monitor")
"""Kinds that need a C compiler."""


@dataclass
class Row:
    """The trials of one fault with one method or command."""

    trials: int = 0
    survived: int = 0
    sentences: int = 0
    compared: int = 0
    identical: int = 0
    lost: float = 0.0
    samples: int = 0

    def add(self, result: Result) -> None:
        """Add a trial."""
        self.trials += 1
        self.survived += not result.faults
        self.sentences += result.sentence
        self.compared += result.different is not None
        self.identical += result.different == []
        self.lost, self.samples = max(self.lost, result.lost), max(self.samples, result.samples)


@dataclass
class Programme:
    """The completed trials."""

    kinds: Kinds
    seed: int
    rows: dict[tuple[str, str], Row] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    seconds: float = 0.0
    """Of the processors."""
    load: float = 0.0
    """Largest number of processes that required a processor, for each processor."""

    def one(self, kind: str, number: int) -> None:
        """Make a trial."""
        trial: Callable[[int], Result] = getattr(self.kinds, kind)
        self.load = max(self.load, os.getloadavg()[0] / (os.cpu_count() or 1))
        try:
            result = trial(number)
        except Exception as error:  # noqa: BLE001 - a trial that breaks is a failure, and the others go on
            result = Result(kind, "the trial itself", [f"{type(error).__name__}: {error}"])
        self.rows.setdefault((result.fault, result.what), Row()).add(result)
        place = str(self.kinds.folder)
        self.failures += [f"{kind} {number}: {text}".replace(place, "") for text in result.faults]
        state = "; ".join(result.faults) or ("identical" if result.different == [] else "survived")
        print(f"{kind} {number}: {result.fault}, {result.what}: {state}", flush=True)
        if not result.faults:
            shutil.rmtree(self.kinds.folder / f"{kind}{number}", ignore_errors=True)

    def section(self) -> str:
        """Return the section of the page."""
        total = sum(row.trials for row in self.rows.values())
        kills = sum(row.trials for (fault, _), row in self.rows.items() if fault.startswith("kill"))
        inside = sum(row.trials for (fault, _), row in self.rows.items() if fault == "kill -9, acquisition")
        following = sum(row.trials for (_, what), row in self.rows.items() if what == FOLLOWING)
        lines = [
            TEXT.format(total=total, kills=kills, inside=inside, following=following, load=self.load),
            "",
            "| fault | target | trials | passed | largest loss | identical raw data | ended with a message |",
            "|---|---|---|---|---|---|---|",
        ]
        for (fault, what), row in sorted(self.rows.items()):
            loss = f"{row.lost:.2f} s, {row.samples} samples" if fault.startswith("kill -9, acq") else "-"
            logged = fault.startswith("kill") and what in ("errormotion monitor", FOLLOWING)
            loss = f"{row.lost:.2f} s, {row.samples} rows" if logged else loss
            same = f"{row.identical} of {row.compared}" if row.compared else "-"
            lines.append(
                f"| {fault} | {what} | {row.trials} | {row.survived} | {loss} | {same} | {row.sentences or '-'} |"
            )
        failures = (
            ["Failures:", "", *(f"* {text[:400]}" for text in self.failures)] if self.failures else ["No failure."]
        )
        lines += ["", *failures]
        without = "" if self.kinds.shimmed else " Without a C compiler: the faults of disks and clocks were omitted."
        return "\n".join([*lines, "", f"`make faults`, seed {self.seed}, {self.seconds:.0f} s of processors.{without}"])


TEXT = """\
{total} trials with short campaigns on virtual machines, each in separate processes; {kills} of them are kills at random
instants, {inside} in an acquisition, {following} in a compensation that writes to a simulated PLC over TCP. After the
fault the run is continued, in every third trial of an acquisition by two processes at once, of which one must complete
it and the other must be refused; a command is repeated. A trial is passed if

* no data that were delivered to the recorder more than a second before a kill are lost (longer only if more processes
  require a processor than the computer has; here {load:.1f} on each);
* no result file is incomplete, no message is an internal error, and a command that fails states the cause;
* the continuation completes the run, and all its raw values are those of an undisturbed run. (Attributes state the
  clock of the computer, and differ.) Every method repeats its values on a virtual machine; exceptions are stated in
  [Run and resume a campaign](how-to/run-and-resume.md#on-a-virtual-machine);
* the interruptions stated in the raw data (`joins`) agree with the clocks that were set: the duration is correct if
  the computer was not restarted, and unknown if the clocks contradict each other;
* every offset that reached the PLC is in the audit log of the compensation, whose chain of hashes is valid up to its
  last entry; without new offsets the offset in the PLC becomes zero; and the next compensation continues from the
  offset that the PLC then has, within the slew limit.

A method delivers complete units: samples of a drift, the scans of a beam detection and lines of a crossbeam at least
every 0.4 s, a face of the gauge (`beam_direction`), a set-up of the tracker (`multilateration`), a cycle of touches
(`normal_vector`). Data of an incomplete unit are not part of the loss below; they are measured again."""


def can_mount() -> bool:
    """Whether this process may mount a file system."""
    with tempfile.TemporaryDirectory() as place:
        command = ["mount", "-t", "tmpfs", "-o", "size=64k", "errormotion", place]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            return False
        subprocess.run(["umount", place], check=True)
        return True


def main() -> None:
    """Try the faults up to the number of trials or the time limit, print each, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100, help="number of kills; other faults in proportion")
    parser.add_argument("--minutes", type=float, default=9.0, help="no trial starts later")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="kinds whose name this regular expression finds")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=None, help="folder for the trials that failed")
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="faults") as temporary, ThreadPoolExecutor(options.processes) as pool:
        folder = (options.folder or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        os.environ["XDG_STATE_HOME"] = str(folder / "state")
        library = fault_processes.shim(folder)
        fault_processes.prepare(library)
        programme = Programme(Kinds(folder, options.seed, shimmed=library is not None), options.seed)
        list(pool.map(programme.kinds.undisturbed, programme.kinds.methods))
        chosen = [kind for kind in SHARES if re.search(options.only, kind) and (library or kind not in SHIMMED)]
        chosen = [kind for kind in chosen if kind != "file_system" or can_mount()]
        work = [(kind, k) for kind in chosen for k in range(max(round(options.kills * SHARES[kind]), 1))]
        random.Random(options.seed).shuffle(work)

        def one(task: tuple[str, int]) -> None:
            if time.monotonic() < start + 60 * options.minutes:
                programme.one(*task)

        list(pool.map(one, work))
        programme.seconds = fault_processes.processor_seconds()
    write_section(options.out, TITLE, programme.section())
    print(f"{programme.seconds:.0f} s of processors; written to {options.out}")
    sys.exit(bool(programme.failures))


if __name__ == "__main__":
    main()
