"""Identification of many runs as a graph of small tasks: in local threads or processes, or on a Dask cluster.

A task receives paths and settings and writes a file; no dataset is transferred. The same tasks therefore run on any
machine that sees the same paths, a run that fails does not affect the others, and an interrupted batch is continued:
existing results are skipped.
"""

from __future__ import annotations

import json
import logging
import platform
import sys
import threading
import time
import traceback as tracebacks
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from errormotion import __version__, datasets, plugins
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.runner import Progress, Quiet, settings_hash
from errormotion.campaign.storage.raw_paths import is_runs_folder, raw_of
from errormotion.datasets import provenance
from errormotion.datasets.clock import noted
from errormotion.datasets.files.hashing import has_hash
from errormotion.datasets.files.reading import visible
from errormotion.datasets.storage.disk import reading
from errormotion.datasets.validation import explained
from errormotion.errors import DatasetError, ErrormotionError, RunError
from errormotion.parallel import CPU_COUNT, SCHEDULERS, Workers, checked_scheduler, one_thread_at_a_time
from errormotion.plugins import PluginSettings

log = logging.getLogger(__name__)
_lock = threading.Lock()

MARK = "identified_from"
"""Attribute of a result: hashes of the raw dataset and of the settings, by which a batch identifies its results."""


@dataclass(frozen=True)
class Outcome:
    """Result of one run.

    Attributes
    ----------
    raw : Path
        The raw dataset, or the run folder that contains it.
    errors : Path or None
        The error dataset; None after a failure.
    reason : str
        Cause of the failure; empty without one.
    code : str
        Code of the error; empty without one.
    seconds : float
        Duration, s.
    stepped_over : bool
        Whether the error dataset existed already.
    traceback : str
        Of a defect in errormotion or in a plugin; empty for errors that the user can correct.
    """

    raw: Path
    errors: Path | None = None
    reason: str = ""
    seconds: float = 0.0
    stepped_over: bool = False
    traceback: str = field(default="", repr=False)
    code: str = ""


class Task(NamedTuple):
    """Arguments of one task; valid on any machine that sees the same paths."""

    raw: str
    out: str
    method_id: str
    method_version: str
    settings: str
    version: str


def identify_runs(
    raws: Sequence[str | Path],
    method_id: str,
    settings: PluginSettings,
    out: str | Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> list[Outcome]:
    """Identify many runs; write one NetCDF file for each, named after it, into one folder.

    Parameters
    ----------
    raws : sequence of path
        Raw datasets and run folders; a folder of run folders means all of its runs of the method.
    method_id : str
        The method plugin.
    settings : PluginSettings
        Settings of the method, for all runs.
    out : path
        The folder; it is created if missing. An existing result of the same raw data, settings and method is skipped;
        any other is never overwritten.
    scheduler : str, optional
        ``threads``, ``processes``, ``sync`` (one after another), or the address of a Dask scheduler, such as
        ``tcp://host:8786``. Default: see :func:`choose_scheduler`.
    workers : int, optional
        Number of threads or processes; default one for each processor. Not for a cluster.
    progress : Progress, optional
        Receives the progress.

    Returns
    -------
    list of Outcome
        In the order of the runs.

    Raises
    ------
    RunError
        The batch cannot be executed: no runs, an unknown scheduler, no answer from the scheduler, workers with another
        version of errormotion, or Dask is missing.
    PluginError
        The method is unknown.
    KeyboardInterrupt
        The operator stopped the batch; finished results are kept.
    """
    name, note = choose_scheduler(scheduler)
    if workers is not None and (workers < 1 or name not in SCHEDULERS):
        raise RunError(
            f"--workers: expected 1 or more, and no number for a cluster; found {workers}",
            code="scheduler.workers.count",
        )
    if note:
        log.warning("%s", note)
    method = plugins.get("methods", method_id)
    selected = list(_selected([Path(raw) for raw in raws], method_id))
    wanted = [raw for raw, reason in selected if not reason]
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(
            f"{out}: expected a folder that exists or can be created; {error.strerror}", code="folder.not_created"
        ) from error
    common = (method.info.id, method.info.version, settings.model_dump_json(), __version__)
    tasks = [
        Task(str(raw_of(raw).resolve()), str(out.resolve() / f"{name}.nc"), *common)
        for raw, name in zip(wanted, _names(wanted), strict=True)
    ]
    outcomes = {raw: Outcome(raw, reason=reason) for raw, reason in selected if reason}
    paths = {task.raw: raw for task, raw in zip(tasks, wanted, strict=True)}
    progress = progress or Quiet()

    def done(outcome: Outcome) -> None:
        raw = paths[str(outcome.raw)]
        reason = outcome.reason.replace(str(outcome.raw), str(raw_of(raw))).replace(str(out.resolve()), str(out))
        errors = out / outcome.errors.name if outcome.errors else None
        outcomes[raw] = replace(outcome, raw=raw, errors=errors, reason=reason)
        if outcome.reason:
            log.error("%s: %s\n%s", raw, outcome.reason, outcome.traceback)
        progress.advance(len(outcomes))
        if failed := sum(bool(other.reason) for other in outcomes.values()):
            progress.note(f"{failed} failed")

    progress.stage("identifying", len(selected))
    try:
        _work(tasks, name, workers, done)
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(f"{len(outcomes)} of {len(selected)} runs are done; repeat the command") from error
    return [outcomes[raw] for raw, _ in selected]


def choose_scheduler(wanted: str | None) -> tuple[str, str]:
    """Return the scheduler to use, and a note on it (empty if there is none).

    Processes are the default: much of an identification is Python and HDF5, which only one thread at a time can
    execute, and its kernels use all processors in any case. Starting a process takes some seconds, as long as a few
    small runs.

    Raises
    ------
    RunError
        The scheduler is unknown.
    """
    if wanted is not None:
        checked_scheduler(wanted)
    if wanted == "threads" and one_thread_at_a_time():
        return wanted, (
            "The threads identify one run at a time: numba has only its 'workqueue' layer, which ends the process "
            "when two threads use it simultaneously. Use processes, or install OpenMP (libgomp, libomp) or TBB."
        )
    return wanted or ("processes" if CPU_COUNT > 1 else "sync"), ""


def _selected(raws: Sequence[Path], method_id: str) -> Iterator[tuple[Path, str]]:
    """Yield each path to be identified once, with the reason if it cannot be identified."""
    seen: set[Path] = set()
    for raw in raws:
        for path, reason in _runs(raw, method_id) if is_runs_folder(raw) else [(raw, "")]:
            path = path.parent if path.name == "raw.zarr" and (path.parent / "run.json").exists() else path
            if path.resolve() not in seen:
                seen.add(path.resolve())
                yield path, reason
    if not seen:
        raise RunError(
            "Expected at least one raw dataset, run folder or folder of run folders; found none",
            code="batch.no_datasets",
        )


def _runs(folder: Path, method_id: str) -> list[tuple[Path, str]]:
    """Return the runs of a method in a folder, with the reason for those that cannot be identified."""
    runs: list[tuple[Path, str]] = []
    others: set[str] = set()
    for path in [file.parent for file in visible(folder, "*/run.json")]:
        try:
            data = RunFolder.open(path).data
        except RunError as error:
            runs.append((path, str(error)))
            continue
        if (other := data["method"]["id"]) != method_id:
            others.add(str(other))
        elif data["acquired"]:
            runs.append((path, ""))
        else:
            resume = f"continue it with 'errormotion run --resume --runs {folder}'"
            runs.append((path, f"{path}: the measurement is not complete ({data['status']}); {resume}"))
    if not runs:
        raise RunError(
            f"{folder}: expected runs of the method '{method_id}'; found {', '.join(sorted(others))}",
            code="batch.method.other",
        )
    return runs


def _names(raws: Sequence[Path]) -> list[str]:
    """Return a name for each path: its own without suffix, preceded by those of its folders if names are equal."""
    parts = [(*raw.resolve().parts[1:-1], raw.resolve().name if raw_of(raw) != raw else raw.stem) for raw in raws]
    depth = [1] * len(parts)
    while True:
        names = ["-".join(part[-deep:]) for part, deep in zip(parts, depth, strict=True)]
        alike = [k for k, count in enumerate(map(Counter(names).get, names)) if count != 1]
        if not alike:
            return names
        if all(depth[k] >= len(parts[k]) for k in alike):
            same = " and ".join(str(raws[k]) for k in alike if names[k] == names[alike[0]])
            raise RunError(
                f"{same}: both results would be named {names[alike[0]]}.nc; identify them into two folders",
                code="batch.names.alike",
            )
        for k in alike:
            depth[k] += 1


def _work(tasks: Sequence[Task], scheduler: str, workers: int | None, done: Callable[[Outcome], None]) -> None:
    """Execute all tasks, and call ``done`` with each outcome."""
    local = scheduler in SCHEDULERS
    count = max(1, min(workers or CPU_COUNT, len(tasks))) if local else None

    def lost(number: int, reason: str) -> None:
        done(Outcome(Path(tasks[number].raw), reason=reason, code="batch.task.lost"))

    with Workers(scheduler, count, __version__) as pool:
        pool.run(_identify, tasks, lambda _, outcome: done(outcome), lost)


def _identify(raw: str, out: str, method_id: str, method_version: str, settings: str, version: str) -> Outcome:
    """Execute one task; every error becomes an outcome."""
    start = time.perf_counter()
    reason = trace = code = ""
    stepped_over = False
    try:
        stepped_over = _identify_or_raise(Task(raw, out, method_id, method_version, settings, version))
    except ErrormotionError as error:
        reason, code = str(error), error.code
    except Exception as error:  # noqa: BLE001 - a plugin that fails on one run must not affect the others
        code = "error.internal"
        reason, trace = f"{type(error).__name__}: {error}", tracebacks.format_exc()
    errors = None if reason else Path(out)
    return Outcome(Path(raw), errors, reason, time.perf_counter() - start, stepped_over, trace, code)


def _identify_or_raise(task: Task) -> bool:
    """Write the errors of one raw dataset; return whether they existed already."""
    method = plugins.get("methods", task.method_id)
    for what, wanted, found in (
        ("errormotion", task.version, __version__),
        (f"the method {task.method_id}", task.method_version, method.info.version),
    ):
        if wanted != found:
            raise RunError(
                f"{platform.node()}: expected {what} in version {wanted}; found {found}. Install it there.",
                code="package.version.differs",
            )
    settings = method.Settings.model_validate_json(task.settings)
    plain = provenance.plain(settings.model_dump(mode="json"))
    path = Path(task.out)
    with reading(task.raw), datasets.load(task.raw) as dataset:
        settings_mark = settings_hash(plain, task.method_id, task.method_version)
        if path.exists():
            found = json.loads(datasets.load(path).attrs.get(MARK, "{}"))
            if found.get("settings") == settings_mark and has_hash(dataset, str(found.get("raw"))):
                return True
            raise DatasetError(
                f"{path}: already exists, from other raw data, other settings or another version of the method, and "
                "a result is never overwritten; specify another folder with --out",
                code="result.exists",
            )
        with _lock if one_thread_at_a_time() else nullcontext(), explained(task.raw, dataset):
            errors = noted(method().identify(dataset, settings), dataset)
        mark = {"raw": datasets.hash_dataset(dataset), "settings": settings_mark}
    datasets.validate(errors)
    with _local_locks():
        datasets.save(errors.assign_attrs({MARK: json.dumps(mark)}), path)
    return False


@contextmanager
def _local_locks() -> Iterator[None]:
    """Prevent xarray on a worker from requesting a lock of the cluster, which a file in memory does not have."""
    if "distributed" not in sys.modules:
        yield
        return
    from dask import config

    with _lock, config.set(scheduler="synchronous"):
        yield
