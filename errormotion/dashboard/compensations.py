"""Compensations for the dashboard: choice of benches and models, starts, and the state of each compensation.

A compensation runs in a separate process. It is found by its run folder, independent of the program that started it.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from errormotion import datasets
from errormotion.campaign.background.detached import printed, spawn
from errormotion.campaign.compensation.following import AUDIT, STATUS, Status, compensations, is_working, read_status
from errormotion.campaign.files import BenchPlan, load_bench
from errormotion.compensation.online.audit import AuditReader
from errormotion.compensation.online.prediction import predictor, predicts
from errormotion.dashboard.cache import Cache, stamp
from errormotion.datasets.files.containers import stated_schema
from errormotion.datasets.files.reading import visible
from errormotion.datasets.storage.disk import reading
from errormotion.errors import CompensationError, ErrormotionError

SHOWN = 20
"""Number of ended compensations in the list, from the newest on; running ones are always listed."""
ENTRIES = 200
"""Number of last entries of an audit log on the page: those that change state or cause."""
POINTS = 20_000
"""Number of last entries of an audit log in the curves."""
ENTRIES_PER_READ = 20_000
"""Number of entries of an audit log that are checked in one request."""
MAX_FILES = 300
"""Number of files of a folder that are listed."""
MAX_MODEL = 64 << 20
"""Largest size of a model file, bytes."""
MAX_NAME = 255
"""Longest name of a folder, bytes."""


@dataclass(frozen=True)
class Bench:
    """A bench file that can be chosen; ``plan`` is None if it has mistakes, which ``wrong`` states."""

    name: str
    path: Path
    plan: BenchPlan | None
    wrong: str = ""


@dataclass(frozen=True)
class Model:
    """A model that predicts errors from readings."""

    name: str
    path: Path
    machine: str
    inputs: tuple[str, ...]


@dataclass
class Following:
    """One compensation, updated at each request: state, entries of the audit log, curves."""

    folder: Path
    reader: AuditReader = field(init=False)
    first: dict[str, Any] = field(default_factory=dict)
    entries: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=ENTRIES))
    points: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=POINTS))
    broken: str = ""
    complete: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)
    _last: tuple[Any, Any] = ("", "")

    def __post_init__(self) -> None:
        self.reader = AuditReader(self.folder / AUDIT)

    def read(self) -> None:
        """Check and take new entries of the audit log, at most `ENTRIES_PER_READ`."""
        with self.lock:
            try:
                new = self.reader.read(ENTRIES_PER_READ)
            except CompensationError as error:
                self.broken, self.complete = str(error), True
                return
            self.complete = len(new) < ENTRIES_PER_READ
            for entry in new:
                self.first = self.first or entry
                if "offset" in entry and "elapsed" in entry:
                    self.points.append(entry)
                now = (entry.get("state"), entry.get("cause"))
                if "event" in entry or now != self._last:
                    self.entries.append(entry)
                self._last = now


@dataclass
class Start:
    """A command that this dashboard started; ``code`` is None while it runs."""

    bench: str
    model: str
    armed: bool
    time: datetime
    process: subprocess.Popen[bytes]
    output: Path

    @property
    def code(self) -> int | None:
        """Exit code; None while it runs."""
        return self.process.poll()

    def printed(self) -> str:
        """Return the end of its output."""
        return printed(self.output)


class Compensations:
    """Compensations of one folder of runs.

    Parameters
    ----------
    runs : Path
    folder : Path
        Folder of bench files and models.
    bench : Path, optional
        A further bench file.
    """

    def __init__(self, runs: Path, folder: Path, bench: Path | None = None) -> None:
        self.runs, self.folder, self.bench = runs, folder, bench
        self.starts: deque[Start] = deque(maxlen=10)
        self._following: Cache[Following] = Cache(SHOWN)
        self._models: Cache[Model | None] = Cache(MAX_FILES)
        self._benches: Cache[Bench] = Cache(MAX_FILES)

    def following(self, key: str) -> Following:
        """Return a compensation by the name of its run folder.

        Raises
        ------
        CompensationError
            The compensation does not exist.
        """
        folder = self.folder_of(key)
        return self._following.get(key, lambda: Following(folder))

    def folder_of(self, key: str) -> Path:
        """Return the run folder of a compensation by its name.

        Raises
        ------
        CompensationError
            The compensation does not exist.
        """
        fits = 0 < len(key.encode("utf-8", "surrogatepass")) <= MAX_NAME and key == Path(key).name
        if not fits or not (self.runs / key / AUDIT).is_file():
            raise CompensationError(f"No compensation {key[:100]!r} in {self.runs}.", code="compensation.not_found")
        return self.runs / key

    def listed(self) -> list[tuple[str, bool, Status | None, str]]:
        """Return name, whether it is running, state and mistake of each; running ones first, then the newest."""
        found: list[tuple[str, bool, Status | None, str]] = []
        for folder in compensations(self.runs):
            working = is_working(folder)
            if not working and len(found) >= SHOWN:
                continue
            try:
                found.append((folder.name, working, read_status(folder), ""))
            except CompensationError as error:
                found.append((folder.name, working, None, str(error) if (folder / STATUS).exists() else ""))
        return sorted(found, key=lambda each: not each[1])

    def benches(self) -> list[Bench]:
        """Return the bench files of the folder."""
        found = {path.name: path for path in _files(self.folder, ".toml") if _states(path, "errormotion.bench/1")}
        if self.bench is not None:
            found[str(self.bench)] = self.bench
            if (self.folder / self.bench.name).resolve() == self.bench.resolve():
                found.pop(self.bench.name, None)
        return [self._benches.get((name, *stamp(path)), partial(_bench, name, path)) for name, path in found.items()]

    def models(self) -> list[Model]:
        """Return the models of the folder and of the folder of runs."""
        paths = {path.name: path for path in _files(self.folder, ".nc")}
        paths |= {f"{self.runs.name}/{path.name}": path for path in _files(self.runs, ".nc")}
        found = [self._models.get((name, *stamp(path)), partial(_model, name, path)) for name, path in paths.items()]
        return [each for each in found if each is not None]

    def start(self, bench: str, model: str, arm: str | None) -> Start:
        """Start ``errormotion compensate run`` in a separate process, which continues when the dashboard ends.

        Parameters
        ----------
        bench, model : str
            Names of a listed bench and a listed model.
        arm : str, optional
            Name of the machine, as typed by the user; without it the compensation runs in shadow mode.

        Raises
        ------
        CompensationError
            Bench or model are not listed, or the name of the machine is wrong. Nothing is started.
        """
        benches = {each.name: each for each in self.benches()}
        models = {each.name: each for each in self.models()}
        if bench not in benches or model not in models:
            raise CompensationError("Choose a bench and a model from the lists.", code="compensation.choice.missing")
        plan = benches[bench].plan
        if plan is None:
            raise CompensationError(benches[bench].wrong, code="compensation.bench.wrong")
        if arm is not None and arm != plan.machine:
            raise CompensationError(
                f"'{arm[:100]}' is not the name of the machine of {bench}. Nothing was started, nothing was written.",
                code="compensation.arm.other_machine",
            )
        command = ["compensate", "run", str(benches[bench].path), "--model", str(models[model].path)]
        command += ["--runs", str(self.runs), *([] if arm is None else ["--arm", arm])]
        descriptor, name = tempfile.mkstemp(prefix="errormotion-compensate-", suffix=".log")
        os.close(descriptor)
        process = spawn(command, Path(name))
        started = Start(bench, model, arm is not None, datetime.now(UTC), process, Path(name))
        self.starts.appendleft(started)
        return started


def _files(folder: Path, ending: str) -> Sequence[Path]:
    """Return the first `MAX_FILES` files of a folder by name."""
    if not folder.is_dir():
        return ()
    return [path for path in visible(folder, f"*{ending}") if path.is_file()][:MAX_FILES]


def _states(path: Path, schema: str) -> bool:
    """Return whether a text file states a schema in its first lines."""
    try:
        with path.open("rb") as file:
            return schema.encode() in file.read(4096)
    except OSError:
        return False


def _bench(name: str, path: Path) -> Bench:
    try:
        return Bench(name, path, load_bench(path))
    except ErrormotionError as error:
        return Bench(name, path, None, str(error))


def _model(name: str, path: Path) -> Model | None:
    try:
        if path.stat().st_size > MAX_MODEL or not predicts(stated_schema(path)):
            return None  # results, and whatever else lies there, are not read
        with reading(path), datasets.load(path) as found:
            inputs = predictor(found)
            machine = str(found.attrs.get("machine", "unknown"))
            return Model(name, path, machine, (*inputs.temperatures, *inputs.parameters))
    except (ErrormotionError, OSError, RuntimeError):
        return None


def rows(entries: Sequence[dict[str, Any]]) -> Iterator[dict[str, str]]:
    """Yield entries of an audit log as text for a table, the newest first."""
    for entry in reversed(entries):
        event, state = str(entry.get("event") or ""), str(entry.get("state") or "")
        yield {
            "time": str(entry.get("time") or "")[:40],
            "what": (event or state)[:40],
            "offset": ", ".join(_um(each) for each in _three(entry.get("offset"))),
            "cause": str(entry.get("cause") or "")[:300],
        }


def _three(values: Any) -> list[Any]:
    return list(values)[:3] if isinstance(values, list) else []


def _um(value: Any) -> str:
    return f"{round(1e6 * value, 2) + 0.0:+.2f}" if isinstance(value, int | float) else "unknown"
