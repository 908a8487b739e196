"""The kinds of fault that a run, an identification, a report, a batch and a monitor have to survive.

Each trial has a number, from which all that is random in it follows; it returns what it found.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fault_compensation
import fault_examples
import fault_trials as trials
import numpy as np
from fault_processes import Clock, Disk, Forked
from fault_trials import Ended
from warm_ups import warm_up

from errormotion import datasets
from errormotion.campaign.folder import list_runs
from errormotion.datasets.clock import joins

MAX_LOSS = 1.0
"""Samples older than this are on disk whatever happens, where the computer keeps up with the data, s."""
BATCH = 3
"""Runs of a batch."""
CODES = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)
"""Errors of a disk: full, beyond the quota, read-only, defective."""
HOUR, DAY = 3600.0, 86400.0
SHIFTS = {"an hour": HOUR, "a day": DAY, "50 years": 50 * 365.25 * DAY}
REFUSALS = ("another process is using", "Nothing to resume", "has its result")


@dataclass
class Result:
    """What a trial found.

    Attributes
    ----------
    fault, what : str
        Row and first words of the table: the fault, and the method or command that met it.
    faults : list of str
        What must not be; empty for a trial that was survived.
    lost : float
        Age of the oldest samples that were lost, s.
    samples : int
        Samples that were lost.
    different : list of str or None
        In what raw data differ from those of an undisturbed run; None where they are not compared.
    sentence : bool
        Whether a command ended with an error and said why.
    """

    fault: str
    what: str
    faults: list[str] = field(default_factory=list)
    lost: float = 0.0
    samples: int = 0
    different: list[str] | None = None
    sentence: bool = False


class Kinds:
    """Trials in a folder, each in a folder of its own.

    Parameters
    ----------
    folder : Path
    seed : int
    shimmed : bool
        Whether disk and clocks of the processes can be made to fail.
    methods : tuple of str
    """

    def __init__(
        self, folder: Path, seed: int, *, shimmed: bool, methods: tuple[str, ...] = tuple(fault_examples.SHORT)
    ) -> None:
        self.folder, self.seed, self.shimmed, self.methods = folder, seed, shimmed, methods
        self.campaigns = fault_examples.write(folder / "campaigns")
        self.durations: dict[str, dict[str, list[tuple[str, float]]]] = {}
        self.writes: dict[str, int] = {}

    def undisturbed(self, method: str) -> None:
        """Run the campaign of a method without a fault, and count its writes."""
        runs = self.folder / "undisturbed" / method
        runs.mkdir(parents=True)
        disk = Disk(runs, 0, 0) if self.shimmed else None
        process = Forked(self._run(method, runs), runs.parent / f"{method}.journal", disk=disk)
        ended = trials.finish(process)
        if ended.code:
            raise RuntimeError(f"{method} fails without a fault:\n{ended.message}")
        self.durations[method] = trials.summary(runs)
        self.writes[method] = process.writes

    def _run(self, method: str, runs: Path, *, report: bool = True) -> list[Any]:
        return ["run", self.campaigns[method], "--runs", runs, *([] if report else ["--no-report"])]

    def _place(self, kind: str, number: int) -> tuple[random.Random, str, Path, Path]:
        """Return what a trial begins with: its random numbers, its method, its runs folder and its journal."""
        place = self.folder / f"{kind}{number}"
        (place / "runs").mkdir(parents=True)
        method = self.methods[number % len(self.methods)]
        return random.Random(f"{self.seed} {kind} {number}"), method, place / "runs", place / "journal"

    def _different(self, method: str, runs: Path) -> list[str]:
        return trials.differences(runs, self.folder / "undisturbed" / method)

    def _instant(self, chance: random.Random, method: str, stage: str) -> tuple[str, float]:
        """Return a test, and a time in one of its stages, s."""
        table = {test: dict(stages) for test, stages in self.durations[method].items()}
        tests = sorted(table)
        test = chance.choices(tests, [table[each].get(stage, 0.0) for each in tests])[0]
        return test, chance.uniform(0.0, table[test].get(stage, 0.0))

    # ------------------------------------------------------------------ kills

    def kill_acquisition(self, number: int) -> Result:
        """End an acquisition at a random instant; every third one is continued by two processes at once."""
        chance, method, runs, journal = self._place("kill_acquisition", number)
        test, delay = self._instant(chance, method, "acquisition")
        process = Forked(self._run(method, runs, report=False), journal)
        reached = lambda: trials.stage_of(runs, test) == "acquisition"  # noqa: E731
        ended = trials.examined(runs, journal, trials.kill_when(process, reached, delay))
        result = Result(
            f"kill -9, {ended.stage or 'between two stages'}", method, ended.faults, ended.lost, ended.samples
        )
        if ended.lost > longest_loss():
            result.faults.append(f"{ended.samples} samples of the last {ended.lost:.2f} s are lost")
        processes = 2 if number // len(self.methods) % 3 == 0 else 1
        return self._continued(result, method, runs, journal, processes=processes)

    def kill_later(self, number: int) -> Result:
        """End the identification, or the report, of a run."""
        chance, method, runs, journal = self._place("kill_later", number)
        stage = chance.choice(trials.STAGES[1:])
        test, delay = self._instant(chance, method, stage)
        process = Forked(self._run(method, runs), journal)
        trials.kill_when(process, lambda: trials.stage_of(runs, test) == stage, delay)
        result = Result(f"kill -9, {stage}", method, trials.half_files(runs))
        return self._continued(result, method, runs, journal, report=True)

    def _continued(
        self, result: Result, method: str, runs: Path, journal: Path, *, processes: int = 1, report: bool = False
    ) -> Result:
        """Continue a run; where there is nothing to continue this must be said."""
        words = ["run", "--resume", "--runs", runs, *([] if report else ["--no-report"])]
        started = [Forked(words, journal.with_name(f"again{k}")) for k in range(processes)]
        ends = [trials.finish(process) for process in started]
        result.faults += [text for each in ends for text in each.faults]
        for each in ends:
            if each.code and not any(text in each.message for text in REFUSALS):
                result.faults.append(f"the continuation ended with {each.code}: {each.message[-300:]}")
        nothing = all("Nothing to resume" in each.message for each in ends)
        if nothing and not list_runs(runs):
            return result  # killed before it began
        if not nothing and all(each.code for each in ends):
            result.faults.append(f"the run was not finished: {[each.message[-200:] for each in ends]}")
        result.different = self._different(method, runs)
        result.faults += [*result.different, *trials.half_files(runs)]
        return result

    def kill_command(self, number: int) -> Result:
        """End ``identify`` or ``report`` of a finished run, and repeat it."""
        chance, method, runs, journal = self._place("kill_command", number)
        words, result_file, command = self._command(chance, method, runs)
        process = Forked(words, journal)
        trials.kill_when(process, lambda: True, chance.uniform(0.1, 2.0))
        result = Result("kill -9", f"errormotion {command}", trials.half_files(runs))
        ended = trials.finish(Forked(words, journal))
        if ended.code and "exists" not in ended.message:  # it had ended before the kill
            result.faults.append(f"the repetition ended with {ended.code}: {ended.message[-300:]}")
        if not result_file.exists():
            result.faults.append(f"{result_file.name} is missing after the repetition")
        result.faults += [*ended.faults, *trials.half_files(runs)]
        return result

    def _command(self, chance: random.Random, method: str, runs: Path) -> tuple[list[Any], Path, str]:
        """Return a command on a copy of a finished run, and the file that it writes."""
        shutil.copytree(self.folder / "undisturbed" / method, runs, dirs_exist_ok=True)
        folder = list_runs(runs)[-1]
        if chance.random() < 0.5:
            return ["report", folder.path], folder.path / "report.html", "report"
        out = runs / "again.nc"
        return ["identify", folder.raw, "--out", out], out, "identify"

    def kill_batch(self, number: int) -> Result:
        """End the identification of several runs, and repeat it."""
        chance, method, runs, journal = self._place("kill_batch", number)
        words, out = self._batch(chance, method, runs)
        process = Forked(words, journal)
        trials.kill_when(process, out.is_dir, chance.uniform(0.0, 6.0))
        result = Result("kill -9", "errormotion identify, three runs")
        result.faults += [] if trials.ends(process.pid) else ["workers go on after the kill"]
        result.faults += trials.half_files(runs)
        return self._batch_again(result, words, out, journal)

    def _batch(self, chance: random.Random, method: str, runs: Path) -> tuple[list[Any], Path]:
        raw = list_runs(self.folder / "undisturbed" / method)[-1].raw
        for k in range(BATCH):
            shutil.copytree(raw, runs / f"raw{k}.zarr")
        words = ["identify", *(runs / f"raw{k}.zarr" for k in range(BATCH)), "--out", runs / "out"]
        return [*words, "--scheduler", chance.choice(["sync", "processes"]), "--workers", 2], runs / "out"

    def _batch_again(self, result: Result, words: list[Any], out: Path, journal: Path) -> Result:
        ended = trials.finish(Forked(words, journal))
        found = len(list(out.glob("*.nc")))
        if ended.code or found != BATCH:
            result.faults.append(f"{found} of {BATCH} results after the repetition: {ended.message[-300:]}")
        result.faults += [*ended.faults, *trials.half_files(out.parent)]
        return result

    def kill_monitor(self, number: int) -> Result:
        """End a monitor."""
        chance, _, runs, journal = self._place("kill_monitor", number)
        process = Forked(self._monitor(runs, 60.0), journal)
        ready = lambda: any((each.raw / "zarr.json").exists() for each in list_runs(runs))  # noqa: E731
        ended = trials.examined(runs, journal, trials.kill_when(process, ready, chance.uniform(0.0, 3.0)))
        result = Result("kill -9", "errormotion monitor", ended.faults, ended.lost, ended.samples)
        if ended.lost > longest_loss():
            result.faults.append(f"{ended.samples} rows of the last {ended.lost:.2f} s are lost")
        for folder in list_runs(runs):
            if (folder.raw / "zarr.json").exists():
                result.faults += _rows(folder.raw)
        again = trials.finish(Forked(self._monitor(runs, 0.5), journal))
        result.faults += again.faults
        if again.code:
            result.faults.append(f"the next monitor ended with {again.code}: {again.message[-300:]}")
        return result

    def kill_compensation(self, number: int) -> Result:
        """End a compensation that writes to a simulated PLC, and start it again."""
        chance, _, runs, journal = self._place("kill_compensation", number)
        ended, faults = fault_compensation.kill(chance, runs.parent, runs, journal)
        result = Result("kill -9", "errormotion compensate run", faults, ended.lost, ended.samples)
        if ended.lost > longest_loss():
            result.faults.append(f"{ended.samples} rows of the last {ended.lost:.2f} s are lost")
        for folder in list_runs(runs):
            if (folder.raw / "zarr.json").exists():
                result.faults += _rows(folder.raw)
        return result

    def kill_fit(self, number: int) -> Result:
        """End ``model fit``, and repeat it."""
        chance, _, runs, journal = self._place("kill_fit", number)
        files, out = [runs / "warm1.nc", runs / "warm2.nc"], runs / "model.nc"
        for seed, file in enumerate(files, 1):
            datasets.save(warm_up(seed), file)
        words = ["model", "fit", *files, "--out", out]
        trials.kill_when(Forked(words, journal), lambda: True, chance.uniform(0.0, 3.0))
        result = Result("kill -9", "errormotion model fit", trials.half_files(runs))
        ended = trials.finish(Forked(words, journal))
        if ended.code and "exists" not in ended.message:  # it had ended before the kill
            result.faults.append(f"the repetition ended with {ended.code}: {ended.message[-300:]}")
        if not out.exists():
            result.faults.append(f"{out.name} is missing after the repetition")
        result.faults += [*ended.faults, *trials.half_files(runs)]
        return result

    def _monitor(self, runs: Path, duration: float) -> list[Any]:
        bench = self.campaigns["normal_vector"].with_name("bench.toml")
        return ["monitor", bench, "--runs", runs, "--interval", "0.1 s", "--duration", f"{duration} s"]

    # ------------------------------------------------------------------ disks

    def disk(self, number: int) -> Result:
        """Let a run meet a disk that fails at a random write and all after it; continue it on a good one."""
        chance, method, runs, journal = self._place("disk", number)
        code = CODES[number // len(self.methods) % len(CODES)]
        first = chance.randint(1, max(self.writes[method], 1))
        ended = trials.finish(Forked(self._run(method, runs), journal, disk=Disk(runs, first, code)))
        result = self._after_disk(Result(_named(code), method, ended.faults), ended, code, runs, method)
        return self._continued(result, method, runs, journal, report=True)

    def disk_command(self, number: int) -> Result:
        """Let ``identify`` or ``report`` meet such a disk; repeat it on a good one."""
        chance, method, runs, journal = self._place("disk_command", number)
        words, result_file, command = self._command(chance, method, runs)
        code = CODES[number % len(CODES)]
        result_file.unlink(missing_ok=True)
        ended = trials.finish(Forked(words, journal, disk=Disk(runs, chance.randint(1, 60), code)))
        result = Result(_named(code), f"errormotion {command}", [*ended.faults, *trials.half_files(runs)])
        result.sentence = ended.code != 0
        if ended.code and not _says(ended.message, code):
            result.faults.append(f"ended with {ended.code}, not with '{os.strerror(code)}': {ended.message[-300:]}")
        again = trials.finish(Forked(words, journal))
        if again.code and "exists" not in again.message:
            result.faults.append(f"the repetition ended with {again.code}: {again.message[-300:]}")
        result.faults += [*again.faults, *trials.half_files(runs)]
        if not result_file.exists():
            result.faults.append(f"{result_file.name} is missing after the repetition")
        return result

    def disk_monitor(self, number: int) -> Result:
        """Let a monitor meet such a disk."""
        chance, _, runs, journal = self._place("disk_monitor", number)
        code = CODES[number % len(CODES)]
        words = self._monitor(runs, 4.0)
        ended = trials.finish(Forked(words, journal, disk=Disk(runs, chance.randint(1, 200), code)))
        result = Result(_named(code), "errormotion monitor", ended.faults)
        result.sentence = ended.code != 0
        if ended.code and not _says(ended.message, code):
            result.faults.append(f"ended with {ended.code}, not with '{os.strerror(code)}': {ended.message[-300:]}")
        result.faults += [
            text for each in list_runs(runs) if (each.raw / "zarr.json").exists() for text in _rows(each.raw)
        ]
        return result

    def _after_disk(self, result: Result, ended: Ended, code: int, runs: Path, method: str) -> Result:
        """Add what is wrong with the end of a run on a bad disk."""
        result.faults += trials.half_files(runs)
        if ended.code:
            result.sentence = True
            if not _says(ended.message, code):
                result.faults.append(f"ended with {ended.code}, not with '{os.strerror(code)}': {ended.message[-300:]}")
        else:
            result.faults += [text for text in self._different(method, runs) if "not finished" in text]
            for folder in list_runs(runs):
                last = folder.data["steps"][-1]
                if not folder.data["report"] and (last["step"], last["outcome"]) != ("report", "failed"):
                    result.faults.append(f"{folder.path.name} has no report, and does not say why")
        return result

    def size_limit(self, number: int) -> Result:
        """Let a run meet a limit of the size of a file, 1 kB to 1 MB; continue it without."""
        chance, method, runs, journal = self._place("size_limit", number)
        ended = trials.finish(Forked(self._run(method, runs), journal, file_limit=int(10 ** chance.uniform(3.0, 6.0))))
        result = Result("no file grows beyond 1 kB to 1 MB", method, ended.faults)
        result = self._after_disk(result, ended, errno.EFBIG, runs, method)
        return self._continued(result, method, runs, journal, report=True)

    def file_system(self, number: int) -> Result:
        """Let a run meet a full disk of its own, then a read-only one; continue it when the disk is larger."""
        chance, method, runs, journal = self._place("file_system", number)
        size = int(10 ** chance.uniform(5.0, 6.7))
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "errormotion", runs], check=True)
        try:
            ended = trials.finish(Forked(self._run(method, runs), journal))
            result = Result("disk of 0.1 to 5 MB full, then read-only", method, ended.faults)
            result = self._after_disk(result, ended, errno.ENOSPC, runs, method)
            subprocess.run(["mount", "-o", "remount,ro", runs], check=True)
            locked = trials.finish(Forked(["run", "--resume", "--runs", runs], journal))
            result.faults += [f"on a read-only disk: {text}" for text in locked.faults]
            subprocess.run(["mount", "-o", "remount,rw,size=1G", runs], check=True)
            return self._continued(result, method, runs, journal, report=True)
        finally:
            subprocess.run(["umount", runs], check=False)

    # ------------------------------------------------------------------ clocks

    def clock_running(self, number: int) -> Result:
        """Set the wall clock during a run, several times, forth and back."""
        chance, method, runs, journal = self._place("clock_running", number)
        name, shift = chance.choice(list(SHIFTS.items()))
        clock = Clock(journal.with_name("clock"))
        process = Forked(self._run(method, runs), journal, clock=clock)
        done = threading.Event()

        def turn() -> None:
            while not done.wait(chance.uniform(0.1, 1.0)):
                clock.set(wall=chance.choice([-shift, 0.0, shift]))

        with While(turn, done):
            ended = trials.finish(process)
        result = Result(f"clock set by {name} while it runs", method, ended.faults)
        if ended.code:
            result.faults.append(f"ended with {ended.code}: {ended.message[-300:]}")
        result.different = self._different(method, runs)
        result.faults += [*result.different, *trials.half_files(runs)]
        return result

    def clock_between(self, number: int) -> Result:
        """Set the wall clock between a kill and the continuation, with a restart of the computer or without."""
        chance, method, runs, journal = self._place("clock_between", number)
        name, shift = chance.choice(list(SHIFTS.items()))
        sign, restarted = chance.choice([-1, 1]), chance.random() < 0.5
        clock = Clock(journal.with_name("clock"))
        test, delay = self._instant(chance, method, "acquisition")
        process = Forked(self._run(method, runs, report=False), journal, clock=clock)
        killed = trials.kill_when(process, lambda: trials.stage_of(runs, test) == "acquisition", delay)
        kept = {each.data["test"]: trials.kept(each, journal) for each in list_runs(runs)}
        clock.set(wall=sign * shift, boot=100.0 - time.clock_gettime(time.CLOCK_BOOTTIME) if restarted else 0.0)
        clock.started = "another start" if restarted else ""
        begun = time.monotonic()
        ended = trials.finish(Forked(["run", "--resume", "--runs", runs], journal, clock=clock))
        fault = f"clock set by {name} between kill and continuation" + (", with a restart" if restarted else "")
        result = Result(fault, method, ended.faults)
        if ended.code and "Nothing to resume" not in ended.message:
            result.faults.append(f"the continuation ended with {ended.code}: {ended.message[-300:]}")
        if ended.code == 0:
            result.different = self._different(method, runs)
            result.faults += result.different
        gap = begun - killed, time.monotonic() - killed + 2 * MAX_LOSS
        for folder in list_runs(runs):
            resumed = (
                kept.get(folder.data["test"], 0)
                and len(
                    [
                        each
                        for each in folder.data["steps"]
                        if each["step"] == "acquire" and each["outcome"] == "started"
                    ]
                )
                - 1
            )
            with datasets.load(folder.raw) as raw:
                found = joins(raw.attrs)
            result.faults += _wrong_joins(found, resumed, gap, sign * shift, restarted=restarted)
        return result

    def suspend(self, number: int) -> Result:
        """Suspend the computer for an hour during a run: all processes rest, and the clocks go on."""
        chance, method, runs, journal = self._place("suspend", number)
        clock = Clock(journal.with_name("clock"))
        test, delay = self._instant(chance, method, "acquisition")
        process = Forked(self._run(method, runs, report=False), journal, clock=clock)
        until = time.monotonic() + trials.LONGEST
        while process.poll() is None and trials.stage_of(runs, test) != "acquisition" and time.monotonic() < until:
            time.sleep(trials.POLL_INTERVAL)
        time.sleep(delay)
        process.signal(signal.SIGSTOP)
        clock.set(wall=HOUR, boot=HOUR)
        time.sleep(0.5)
        process.signal(signal.SIGCONT)
        ended = trials.finish(process)
        result = Result("computer suspended for an hour", method, ended.faults)
        if ended.code:
            result.faults.append(f"ended with {ended.code}: {ended.message[-300:]}")
        result.different = self._different(method, runs)
        result.faults += result.different
        return result

    def suspend_monitor(self, number: int) -> Result:
        """Suspend a monitor for an hour, and set the wall clock back afterwards: its time axis states both truly."""
        chance, _, runs, journal = self._place("suspend_monitor", number)
        clock = Clock(journal.with_name("clock"))
        process = Forked(self._monitor(runs, HOUR + 4.0), journal, clock=clock)
        until = time.monotonic() + trials.LONGEST
        while (
            process.poll() is None
            and not any(trials.kept(each, journal) for each in list_runs(runs))
            and time.monotonic() < until
        ):
            time.sleep(trials.POLL_INTERVAL)
        time.sleep(chance.uniform(0.2, 1.0))
        process.signal(signal.SIGSTOP)
        clock.set(wall=HOUR, boot=HOUR)
        process.signal(signal.SIGCONT)
        time.sleep(chance.uniform(0.2, 1.0))
        clock.set(wall=-chance.choice(list(SHIFTS.values())))
        ended = trials.finish(process)
        result = Result("computer suspended for an hour, then its clock set back", "errormotion monitor", ended.faults)
        if ended.code:
            result.faults.append(f"ended with {ended.code}: {ended.message[-300:]}")
        (folder,) = list_runs(runs)
        with datasets.load(folder.raw) as raw:
            steps = np.diff(raw["time"].values)
        if not (np.all(steps > 0) and np.sum(steps > HOUR - 1) == 1 and steps.max() < HOUR + 60):
            result.faults.append(f"its rows are {steps.min():.3g} to {steps.max():.6g} s apart")
        return result

    # ------------------------------------------------------------------ others

    def two_at_once(self, number: int) -> Result:
        """Start one campaign twice at the same time, into one folder."""
        _, method, runs, journal = self._place("two_at_once", number)
        started = [Forked(self._run(method, runs), journal.with_name(f"journal{k}")) for k in range(2)]
        ends = [trials.finish(process) for process in started]
        result = Result("two runs at once in one folder", method, [text for each in ends for text in each.faults])
        result.faults += [f"ended with {each.code}: {each.message[-300:]}" for each in ends if each.code]
        result.different = []
        for run in {each.data["id"] for each in list_runs(runs)}:
            own = runs.with_name(f"runs-{run}")
            own.mkdir()
            for folder in list_runs(runs):
                if folder.data["id"] == run:
                    folder.path.rename(own / folder.path.name)
            result.different += self._different(method, own)
            result.faults += trials.half_files(own)
        result.faults += result.different
        return result

    def moved(self, number: int) -> Result:
        """Move the runs folder, or delete it, during the acquisition; where it was moved the run is continued there."""
        chance, method, runs, journal = self._place("moved", number)
        test, delay = self._instant(chance, method, "acquisition")
        process = Forked(self._run(method, runs), journal)
        until = time.monotonic() + trials.LONGEST
        while process.poll() is None and trials.stage_of(runs, test) != "acquisition" and time.monotonic() < until:
            time.sleep(trials.POLL_INTERVAL)
        time.sleep(delay)
        elsewhere, deleted = runs.with_name("elsewhere"), chance.random() < 0.5
        runs.rename(elsewhere)
        ended = trials.finish(process)
        result = Result("runs folder deleted" if deleted else "runs folder moved", method, ended.faults)
        result.sentence = ended.code != 0
        if ended.code and "is gone" not in ended.message:
            result.faults.append(
                f"ended with {ended.code} and does not say that the folder is gone: {ended.message[-400:]}"
            )
        if deleted:
            return result
        return self._continued(result, method, elsewhere, journal)


def longest_loss() -> float:
    """Return the longest loss on the computer as it is: longer where more processes want a processor than it has."""
    return MAX_LOSS * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def _named(code: int) -> str:
    names = ("disk full", "quota exceeded", "disk read-only", "disk defective")
    return f"{dict(zip(CODES, names, strict=True))[code]} from a random write on"


def _says(message: str, code: int) -> bool:
    """Whether a message names the error of a disk."""
    ours = {
        errno.ENOSPC: ("disk is full",),
        errno.EDQUOT: ("disk is full", "quota is used up"),
        errno.EROFS: ("file system is read-only",),
        errno.EFBIG: ("larger than allowed",),
    }.get(code, ())
    return any(text in message for text in (os.strerror(code), *ours))


def _rows(raw: Path) -> list[str]:
    """Return what is wrong with the rows of a monitor that was ended; it may have none yet."""
    with datasets.load(raw) as found:
        if not found.sizes["time"]:
            return []
        datasets.validate(found.load())
        return [] if np.all(np.diff(found["time"].values) > 0) else ["its times do not rise"]


def _wrong_joins(found: Any, expected: int, gap: tuple[float, float], shift: float, *, restarted: bool) -> list[str]:
    """Return what is wrong with the interruptions that raw data state."""
    if len(found) != expected:
        return [f"states {len(found)} interruptions in place of {expected}"]
    if not found:
        return []
    (join,) = found
    known = not restarted or (0 < shift < SHIFTS["50 years"])
    if (join.seconds is not None) != known or bool(join.reason) != (not restarted or not known):
        return [f"states an interruption of {join.seconds} s, '{join.reason}', after a shift of {shift:g} s"]
    wall = shift if restarted else 0.0  # nothing but the wall clock is there to be believed
    if known and not gap[0] - 0.1 <= join.seconds - wall <= gap[1]:
        return [f"states an interruption of {join.seconds} s in place of {gap[0]:.2f} to {gap[1]:.2f} s"]
    return []


class While:
    """A thread that runs while the context lasts."""

    def __init__(self, work: Callable[[], None], done: threading.Event) -> None:
        self._thread, self._done = threading.Thread(target=work, daemon=True), done

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()
