"""Runs under faults: ``make faults`` ends and disturbs real processes, and writes a section of ``docs/reliability.md``.

Each trial starts a campaign of ``examples/`` on its virtual machine, ends it with ``kill -9`` at a random instant of
one stage or lets it meet a full disk, and continues it with ``run --resume``. The raw data are compared with those of
an undisturbed run. ``ARGS="--trials 30 --seed 5"`` tries other numbers of trials and other instants; ``--only`` one
fault.
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

import fault_trials as trials  # noqa: E402
from fault_trials import Ended  # noqa: E402
from fuzz import PAGE, sections  # noqa: E402

TITLE = "Runs that are disturbed"
EXAMPLES = (
    "virtual_beam/campaign.toml",
    "virtual_cframe/campaign.toml",
    "virtual_gantry/campaign.toml",
    "virtual_tracker/campaign.toml",
    "virtual_probing/monday.toml",
)
LONGEST_LOSS = 1.0
"""Samples older than this are on disk whatever happens, s."""
SHARE = (4, 1, 1)
"""How often a kill is in the acquisition, the identification and the report."""
BATCH = 3
"""Runs of a batch."""


@dataclass
class Row:
    """The trials of one fault."""

    trials: int = 0
    survived: int = 0
    compared: int = 0
    identical: int = 0
    lost: float = 0.0
    samples: int = 0
    notes: Counter[str] = field(default_factory=Counter)


class Programme:
    """The trials, each in a folder of its own."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self.seed = seed
        self.rows: dict[str, Row] = {}
        self.failures: list[str] = []
        self.durations: dict[str, dict[str, list[tuple[str, float]]]] = {}

    def undisturbed(self, example: str) -> Path:
        """Run an example without a fault."""
        place = self.folder / Path(example).parent
        place.mkdir()
        ended = trials.finish(trials.start(["run", ROOT / "examples" / example, "--runs", place], place / "journal"))
        if ended.code:
            raise SystemExit(f"{example} fails without a fault:\n{ended.message}")
        self.durations[example] = trials.summary(place)
        return place

    def add(self, name: str, ended: Ended, faults: list[str], different: list[str] | None, number: int) -> None:
        """Add a trial to its row."""
        row = self.rows.setdefault(name, Row())
        row.trials += 1
        row.survived += not faults
        row.lost, row.samples = max(row.lost, ended.lost), max(row.samples, ended.samples)
        row.compared += different is not None
        row.identical += different == []
        row.notes.update(text.partition(":")[0] for text in different or [])
        self.failures += [f"{name}, trial {number}: {text}".replace(str(self.folder), "") for text in faults]
        print(f"{name}, trial {number}: lost {ended.lost:.2f} s; {faults or different or 'identical'}", flush=True)

    def kill(self, number: int) -> None:
        """End a run in a random stage at a random instant, and continue it twice at once."""
        chance = random.Random(f"{self.seed} {number}")
        example = EXAMPLES[number % len(EXAMPLES)]
        test, stages = chance.choice(sorted(self.durations[example].items()))
        stage, duration = chance.choices(stages, SHARE[: len(stages)])[0]
        runs = self.folder / f"kill{number}"
        runs.mkdir()
        process = trials.start(["run", ROOT / "examples" / example, "--runs", runs], runs / "journal")
        instant = trials.kill_when(
            process, lambda: trials.stage_of(runs, test) == stage, chance.uniform(0.0, 1.2 * duration)
        )
        ended = trials.examined(runs, runs / "journal", instant)
        faults = list(ended.faults)
        if ended.lost > LONGEST_LOSS:
            faults.append(f"{ended.samples} samples of the last {ended.lost:.2f} s are lost")
        ended.stage = ended.stage or "between two tests, or after the last"
        faults += self._resume(runs)
        faults += trials.half_files(runs)
        different = trials.differences(runs, self.folder / Path(example).parent)
        faults += [text for text in different if "not finished" in text or "in place of" in text]
        method = Path(example).parent.name
        self.add(f"kill -9: {method}, {ended.stage}", ended, faults, different, number)
        shutil.rmtree(runs)

    def _resume(self, runs: Path) -> list[str]:
        """Continue a run; where there is nothing to continue this must be said."""
        again = [trials.start(["run", "--resume", "--runs", runs], runs / f"again{k}") for k in range(2)]
        ends = [trials.finish(process) for process in again]
        faults = [text for each in ends for text in each.faults]
        refusals = ("another process is working", "Nothing to resume", "has its result")
        done = [each for each in ends if each.code == 0]
        for each in ends:
            if each.code and not any(text in each.message for text in refusals):
                faults.append(f"two processes continue one run; one ended with {each.code}: {each.message[-300:]}")
        if not done and not all("Nothing to resume" in each.message for each in ends):
            faults.append(f"neither of two processes finished the run: {[each.message[-200:] for each in ends]}")
        return faults

    def full(self, number: int) -> None:
        """Let a run meet a limit of the size of a file at a random size, and continue it without."""
        chance = random.Random(f"{self.seed} full {number}")
        example = EXAMPLES[number % len(EXAMPLES)]
        runs = self.folder / f"full{number}"
        runs.mkdir()
        limit = int(10 ** chance.uniform(3.0, 6.0))
        words = ["run", ROOT / "examples" / example, "--runs", runs]
        ended = trials.finish(trials.start(words, runs / "journal", limit))
        faults = [*ended.faults, *trials.half_files(runs)]
        after = trials.finish(trials.start(["run", "--resume", "--runs", runs], runs / "journal"))
        faults += after.faults
        if after.code and "Nothing to resume" in after.message:  # nothing had begun, or all was finished
            faults += [] if ended.code else trials.differences(runs, self.folder / Path(example).parent)
            different: list[str] | None = None
        else:
            different = trials.differences(runs, self.folder / Path(example).parent)
            faults += [text for text in different if "not finished" in text or "in place of" in text]
        self.add("no file grows beyond 1 kB to 1 MB", ended, faults, different, number)
        shutil.rmtree(runs)

    def disk(self, number: int) -> None:
        """Let a run meet a full disk of its own, and continue it when the disk is larger; needs root."""
        chance = random.Random(f"{self.seed} disk {number}")
        example = EXAMPLES[number % len(EXAMPLES)]
        runs = self.folder / f"disk{number}"
        runs.mkdir()
        size = int(10 ** chance.uniform(5.0, 6.7))
        journal = self.folder / f"disk{number}.journal"
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "errormotion", runs], check=True)
        try:
            ended = trials.finish(trials.start(["run", ROOT / "examples" / example, "--runs", runs], journal))
            faults = [*ended.faults, *trials.half_files(runs)]
            different: list[str] | None = None
            subprocess.run(["mount", "-o", "remount,ro", runs], check=True)
            locked = trials.finish(trials.start(["run", "--resume", "--runs", runs], journal))
            faults += [f"on a read-only disk: {text}" for text in locked.faults]
            subprocess.run(["mount", "-o", "remount,rw,size=1G", runs], check=True)
            after = trials.finish(trials.start(["run", "--resume", "--runs", runs], journal))
            faults += after.faults
            if "Nothing to resume" not in after.message:
                different = trials.differences(runs, self.folder / Path(example).parent)
                faults += [text for text in different if "not finished" in text or "in place of" in text]
        finally:
            subprocess.run(["umount", runs], check=False)
        self.add("full disk of 0.1 to 5 MB, then read-only, then with space", ended, faults, different, number)

    def batch(self, number: int) -> None:
        """End the identification of several runs at a random instant, and repeat it."""
        chance = random.Random(f"{self.seed} batch {number}")
        example = EXAMPLES[0]
        (raw,) = (self.folder / Path(example).parent).glob("*/raw.zarr")
        place = self.folder / f"batch{number}"
        for k in range(BATCH):
            shutil.copytree(raw, place / f"raw{k}.zarr")
        words = ["identify", *(place / f"raw{k}.zarr" for k in range(BATCH)), "--out", place / "out"]
        words += ["--scheduler", chance.choice(["sync", "processes"]), "--workers", 2]
        out = place / "out"
        process = trials.start(words, place / "journal")
        trials.kill_when(process, out.is_dir, chance.uniform(0.0, 6.0))
        faults = [] if trials.ends(process.pid) else ["workers go on after the kill"]
        faults += trials.half_files(place)
        ended = trials.finish(trials.start(words, place / "journal"))
        faults += [*ended.faults, *trials.half_files(place)]
        found = len(list(out.glob("*.nc")))
        if ended.code or found != BATCH:
            faults.append(f"{found} of {BATCH} results after the repetition: {ended.message[-300:]}")
        self.add("kill -9: identification of three runs", ended, faults, None, number)
        shutil.rmtree(place)

    def section(self) -> str:
        """Return the section of the page."""
        total = sum(row.trials for row in self.rows.values())
        lines = [
            f"{total} trials with the examples on virtual machines, each in processes of its own. A kill is at a "
            "random instant of a random stage; then two processes continue the run at once, of which one must finish "
            "it and the other must be refused. A trial is survived when nothing that was delivered to the recorder "
            f"more than {LONGEST_LOSS:.0f} s before the kill is lost, no result is half a file, no message is an "
            "internal error, and the run finishes with as many samples as an undisturbed one. Identical: so are all "
            "raw values; attributes state the clock of the computer, and differ. Where values differ, they were "
            "measured after the resume: noise and instants of a simulated reading are not always repeated there.",
            "",
            "| fault | trials | survived | worst loss | identical raw data | differs in |",
            "|---|---|---|---|---|---|",
        ]
        for name, row in sorted(self.rows.items()):
            notes = ", ".join(f"{text} {count}" for text, count in sorted(row.notes.items())) or "-"
            loss = f"{row.lost:.2f} s, {row.samples} samples" if name.startswith("kill -9: virtual") else "-"
            same = f"{row.identical} of {row.compared}" if row.compared else "-"
            lines.append(f"| {name} | {row.trials} | {row.survived} | {loss} | {same} | {notes} |")
        failures = ["Failures:", "", *(f"* {text}" for text in self.failures)] if self.failures else ["No failure."]
        lines += ["", *failures]
        return "\n".join([*lines, "", f"`make faults`, seed {self.seed}."])


def write(page: Path, body: str) -> None:
    """Replace this programme's section of the page; the others stay."""
    head, found = sections(page)
    found[TITLE] = body
    text = "".join(f"\n## {name}\n\n{part}\n" for name, part in found.items())
    page.write_text(head.rstrip("\n") + "\n" + text, encoding="utf-8")


def can_mount() -> bool:
    """Whether this process may mount a file system."""
    with tempfile.TemporaryDirectory() as place:
        command = ["mount", "-t", "tmpfs", "-o", "size=64k", "errormotion", place]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            return False
        subprocess.run(["umount", place], check=True)
        return True


def main() -> None:
    """Try the faults until the trials are done or the time is over, print each, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=40, help="kills of runs; an eighth as many of every other fault")
    parser.add_argument("--minutes", type=float, default=9.0, help="no trial starts later")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", choices=["", "kill", "full", "disk", "batch"])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    until = time.monotonic() + 60 * options.minutes
    with tempfile.TemporaryDirectory(prefix="faults") as folder, ThreadPoolExecutor(options.processes) as pool:
        programme = Programme(Path(folder), options.seed)
        list(pool.map(programme.undisturbed, EXAMPLES))
        others = max(options.trials // 8, 1)
        work = [(programme.batch, k) for k in range(others)] + [(programme.full, k) for k in range(others)]
        work += [(programme.disk, k) for k in range(others)] if can_mount() else []
        work += [(programme.kill, k) for k in range(options.trials)]
        work = [each for each in work if not options.only or each[0].__name__ == options.only]
        random.Random(options.seed).shuffle(work)

        def one(task: tuple[object, int]) -> None:
            trial, number = task
            if time.monotonic() < until:
                trial(number)  # type: ignore[operator]

        list(pool.map(one, work))
    write(options.out, programme.section())
    print(f"written to {options.out}")
    sys.exit(bool(programme.failures))


if __name__ == "__main__":
    main()
