"""What must be readable after a power cut: a program for each kind of file, and the check of a disk after a cut."""

from __future__ import annotations

import json
import logging
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import xarray as xr
from power_cuts import Cut, Recording, recorded

from errormotion import datasets
from errormotion.campaign import folder as run_folder
from errormotion.campaign.files import parse_bench
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.monitor.watch import Monitor
from errormotion.campaign.storage.journal import journal
from errormotion.campaign.storage.store import RawStore, committed_length
from errormotion.compensation.online.audit import AuditLog, AuditReader
from errormotion.datasets.files import events
from errormotion.montecarlo.store import Store
from errormotion.record.runs.listing import list_runs

RATE = 1000.0  # Hz
LSB = 3.1e-8  # m
PULSE = 17
"""Samples from pulse to pulse."""

Commit = Callable[[Any], None]


def samples(first: int, n: int) -> xr.Dataset:
    """Return samples of five channels, two temperatures and a text, all different, and pulses among them."""
    index = np.arange(first, first + n)
    pulse = index[index % PULSE == 0]
    raw = xr.Dataset(
        {
            "distance": (("channel", "time"), (np.arange(5)[:, None] * 1000 + index % 60000) * LSB, {"units": "m"}),
            "temperature": (("time", "sensor"), np.column_stack([20 + index / 7, index / 3]), {"units": "degC"}),
            "state": ("time", np.array([f"state {k}" for k in index])),
            "pulse_time": ("pulse", pulse / RATE, {"units": "s"}),
            "level": ("height", [0.01, 0.05]),
        },
        coords={"channel": ["X1", "X2", "Y1", "Y2", "Z"], "sensor": ["frame", "column"]},
        attrs={"schema": "test", "sample_rate": RATE, "time_start": first / RATE},
    )
    raw["distance"].encoding = {"dtype": "uint16", "scale_factor": LSB, "add_offset": 0.0, "_FillValue": 65535}
    return raw


def _expect(found: xr.Dataset, wanted: xr.Dataset) -> list[str]:
    return [
        f"{name}: differs"
        for name in wanted.variables
        if name not in found or not np.array_equal(found[name].values, wanted[name].values)
    ]


# ---------------------------------------------------------------------- raw stores


def write_raw(folder: Path, commit: Commit) -> None:
    """Append to a store, close it, and continue it."""
    path, first = folder / "raw.zarr", 0
    for lengths in ([40, 40, 1, 60, 200], [30, 128, 5]):
        store = (
            RawStore(path, "time", ("pulse",))
            if first
            else RawStore.create(path, samples(0, 40), "time", 64 / RATE, ("pulse",))
        )
        for n in lengths:
            store.append(samples(first, n))
            first += n
            store.commit()
            commit(first)
        getattr(store, "close", store.commit)()


def check_raw(folder: Path, committed: list[int]) -> list[str]:
    """The committed samples are read, and the store is continued."""
    path, least = folder / "raw.zarr", max(committed, default=0)
    if not path.exists():
        return [f"{least} samples committed, no store"] if least else []
    kept = committed_length(path, "time")
    if kept < least:
        return [f"{least} samples committed, {kept} found"]
    if kept:
        with datasets.load(path) as found:
            if faults := _expect(found, samples(0, kept)):
                return faults
    store = RawStore(path, "time", ("pulse",))
    store.append(samples(kept, 100))
    getattr(store, "close", store.commit)()
    with datasets.load(path) as found:
        return _expect(found, samples(0, kept + 100))


# ---------------------------------------------------------------------- results


def _write_result(suffix: str) -> Callable[[Path, Commit], None]:
    def write(folder: Path, commit: Commit) -> None:
        for number in range(3):
            datasets.save(samples(number, 50), folder / f"{number}{suffix}")
            commit((f"{number}{suffix}", number, number))
        if suffix == ".nc":
            datasets.save(samples(7, 50), folder / "0.nc", overwrite=True)
            commit(("0.nc", 7, 7))

    return write


def check_results(folder: Path, committed: list[tuple[str, int, int]]) -> list[str]:
    """A committed result is read; one that was being replaced is the old or the new one."""
    last = {name: first for name, first, _ in committed}
    faults = []
    for path in sorted(each for each in folder.iterdir() if not each.name.startswith(".")):
        with datasets.load(path) as found:
            possible = {last.get(path.name, int(path.stem)), 7 if path.name == "0.nc" else int(path.stem)}
            if not any(_expect(found, samples(each, 50)) == [] for each in possible):
                faults.append(f"{path.name}: has other values")
    return faults + [f"{name}: is missing" for name in last if not (folder / name).exists()]


# ---------------------------------------------------------------------- run folders, notes, logs


def write_run(folder: Path, commit: Commit) -> None:
    """Write run.json in all states, in a folder of runs that does not exist yet."""
    run = RunFolder.create(folder / "lab" / "runs", "drift", "0a1b2c3d", {"status": "running", "number": 0})
    commit((run.path.name, 0))
    for number in range(1, 6):
        run.save(number=number, text="x" * 300 * number)
        commit((run.path.name, number))


def check_run(folder: Path, committed: list[tuple[str, int]]) -> list[str]:
    """The last committed run.json, or a later one, is read."""
    runs = folder / "lab" / "runs"
    faults = [] if not committed or (runs / committed[-1][0]).exists() else ["the run folder is missing"]
    for run in run_folder.list_runs(runs, skipped := []):
        if run.data["number"] < (committed[-1][1] if committed else 0):
            faults.append(f"run.json: {committed[-1][1]} committed, {run.data['number']} found")
    return faults + skipped


def write_index(folder: Path, commit: Commit) -> None:
    """List runs, which writes the index, while runs are added."""
    for number in range(4):
        run = RunFolder.create(
            folder, f"test{number}", f"0a1b2c3{number}", {"status": "finished", "method": {"id": "m"}}
        )
        commit(run.path.name)
        list_runs([folder])


def check_index(folder: Path, committed: list[str]) -> list[str]:
    """All runs are listed, whatever is in the index."""
    found = {path.name for path, _ in list_runs([folder]).runs}
    return [f"{name}: is not listed" for name in committed if name not in found]


def write_notes(folder: Path, commit: Commit) -> None:
    """Add notes."""
    for number in range(5):
        events.append(folder, events.event(f"note {number} {'x' * 200 * number}"))
        commit(number)


def check_notes(folder: Path, committed: list[int]) -> list[str]:
    """The committed notes are read, and another one is added."""
    events.append(folder, events.event("the last one"))
    found = [each.text.split(" ")[1] for each in events.read(folder)[0]]
    return [f"note {number}: is missing" for number in committed if str(number) not in found] + (
        [] if found[-1:] == ["last"] else ["the new note is missing"]
    )


def write_audit(folder: Path, commit: Commit) -> None:
    """Write entries, every other one flushed."""
    with AuditLog(folder / "audit.jsonl") as log:
        for number in range(12):
            log.write({"number": number, "text": "x" * 100 * number}, sync=number % 2 == 1)
            if number % 2:
                commit(number)


def check_audit(folder: Path, committed: list[int]) -> list[str]:
    """The flushed entries are read."""
    path = folder / "audit.jsonl"
    if not committed:
        return []
    found = [entry.get("number") for entry in AuditReader(path).read(committed[-1] + 1)]
    return [f"entry {number}: is missing" for number in committed if number not in found]


def write_log(folder: Path, commit: Commit) -> None:
    """Log, and log an error."""
    log = logging.getLogger("errormotion.power")
    with journal(folder / "log.jsonl"):
        log.info("one")
        log.info("two")
        with mock.patch.object(log, "propagate", True):
            log.error("three")
        commit(3)
        log.info("four")
    commit(4)


def check_log(folder: Path, committed: list[int]) -> list[str]:
    """The lines up to the last error are whole."""
    path, wanted = folder / "log.jsonl", ["one", "two", "three", "four"][: max(committed, default=0)]
    lines = path.read_bytes().split(b"\n")[: len(wanted)] if path.exists() else []
    found = [json.loads(line)["message"] for line in lines]
    return [] if found == wanted else [f"expected the messages {wanted}; found {found}"]


def write_trials(folder: Path, commit: Commit) -> None:
    """Keep and join trials of a Monte Carlo evaluation."""
    with Store(folder / "trials", {"seed": 1}) as store:
        for start in (0, 2, 4):
            store.keep(0, range(start, start + 2), np.full((2, 30), start))
            commit(start + 2)
        store.join(0, 6)


def check_trials(folder: Path, committed: list[int]) -> list[str]:
    """The committed trials are used."""
    with Store(folder / "trials", {"seed": 1}) as store:
        whole = store.block(0, 6)
        found = 6 if whole is not None else len({k for part in store.chunks(0, 6) for k in part})
        least = max(committed, default=0)
        return [] if found >= least else [f"{least} trials committed, {found} found"]


# ---------------------------------------------------------------------- a monitor

BENCH = """\
schema = "errormotion.bench/1"
name = "Shop"
machine = "Mill"

[instruments.column]
driver = "dcon_temperature"
address = "sim://cframe/thermometer?seed=1"
"""


def write_monitor(folder: Path, commit: Commit) -> None:
    """Watch a thermometer; each commit of the log counts."""
    monitor = Monitor(parse_bench(BENCH, Path("bench.toml")), folder / "runs", interval=0.02)
    original = RawStore.commit

    def commit_rows(store: RawStore) -> None:
        original(store)
        commit(store.committed)

    with mock.patch.object(RawStore, "commit", commit_rows), monitor:
        for _ in monitor.watch(1.6):
            pass


def check_monitor(folder: Path, committed: list[int]) -> list[str]:
    """The committed rows are read."""
    least = max(committed, default=0)
    found = [path for path in (folder / "runs").glob("*/raw.zarr") if not path.parent.name.startswith(".")]
    if not least:
        return []
    if not found:
        return [f"{least} rows committed, no log"]
    with datasets.load(found[0]) as log:
        rows = log.sizes["time"]
        known = bool((np.isnan(log["temperature"].values) == (log["temperature_flag"].values != 0)).all())
    faults = [] if rows >= least else [f"{least} rows committed, {rows} found"]
    return faults if known else [*faults, "temperatures are missing"]


@dataclass(frozen=True)
class Kind:
    """What is written, and its check."""

    title: str
    write: Callable[[Path, Commit], None]
    check: Callable[[Path, list[Any]], list[str]]
    share: float = 1.0


KINDS = {
    "raw": Kind("raw store", write_raw, check_raw, 4.0),
    "netcdf": Kind("results, NetCDF", _write_result(".nc"), check_results),
    "zarr": Kind("results, Zarr", _write_result(".zarr"), check_results),
    "run": Kind("run folder, `run.json`", write_run, check_run),
    "index": Kind("index of runs", write_index, check_index),
    "notes": Kind("notes", write_notes, check_notes),
    "audit": Kind("audit log", write_audit, check_audit),
    "log": Kind("`log.jsonl`", write_log, check_log, 0.5),
    "trials": Kind("Monte Carlo trials", write_trials, check_trials),
    "monitor": Kind("log of a monitor", write_monitor, check_monitor),
}


@dataclass
class Trials:
    """The cuts of one kind.

    Attributes
    ----------
    operations : int
        Recorded: a cut follows one of them.
    cuts, lossy, old : int
        Cuts; cuts after which something unflushed was missing or damaged; cuts after a commit.
    faults : list of str
    """

    operations: int
    cuts: int = 0
    lossy: int = 0
    committed: int = 0
    faults: list[str] = field(default_factory=list)


def recording_of(kind: str, place: Path) -> Recording:
    """Record the program of a kind in a new folder."""
    place.mkdir(parents=True)
    with recorded(place) as recording:
        KINDS[kind].write(place, recording.committed)
    return recording


def try_cuts(kind: str, place: Path, count: int, seed: int = 1) -> Trials:
    """Cut the power at random instants of the program of a kind, and check each disk.

    Parameters
    ----------
    kind : str
        Of `KINDS`.
    place : Path
        A folder for the trials.
    count : int
        Cuts.
    seed : int
        Of the instants, and of what is on the disk.
    """
    recording = recording_of(kind, place / "recorded")
    made = Trials(len(recording.operations))
    for number in range(count):
        chance = random.Random(f"{seed} {kind} {number}")
        cut = Cut(recording, chance.randint(0, len(recording.operations)), chance)
        disk = place / f"disk{number}"
        cut.write(disk)
        try:
            faults = KINDS[kind].check(disk, cut.committed)
        except Exception as error:  # noqa: BLE001 - what cannot be read is a fault
            faults = [f"{type(error).__name__}: {error}"]
        made.cuts += 1
        made.lossy += cut.kind != "all"
        made.committed += bool(cut.committed)
        made.faults += [f"{kind} {number} ({cut.kind}): {text}" for text in faults]
        shutil.rmtree(disk)
    return made
