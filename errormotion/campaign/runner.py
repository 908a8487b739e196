"""The runner: test by test acquire, identify and report, and go on after an interruption.

Everything is on disk before it is used: the settings before the first sample, the raw data before the identification,
the errors before the report. Whatever ends a run, its folder says how far it came, and :func:`resume` goes on there.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

import xarray as xr

from errormotion import datasets
from errormotion.campaign.bench import OpenBench
from errormotion.campaign.files import CampaignPlan, TestPlan, parse_bench, parse_campaign
from errormotion.campaign.folder import RunFolder, list_runs, now
from errormotion.campaign.journal import journal
from errormotion.campaign.recorder import DiskFullError, Recorder
from errormotion.campaign.store import committed_length
from errormotion.datasets import provenance
from errormotion.datasets.folders import looking_beside
from errormotion.errors import ErrormotionError, RunError

log = logging.getLogger(__name__)


class Progress(Protocol):
    """What the runner tells a person while it works."""

    def test(self, name: str, folder: Path, number: int, total: int) -> None:
        """Begin a test, or step over one that is finished."""

    def stage(self, name: str, total: float | None = None) -> None:
        """Begin a part of a test; ``total`` in the unit of :meth:`advance`, None where it is not known."""

    def advance(self, done: float) -> None:
        """Say how much of the part is done: seconds of evenly spaced samples, else items."""

    @property
    def shown(self) -> bool:
        """Whether anybody sees it: what costs time to find out is told only then."""

    def note(self, text: str) -> None:
        """Say what the measurement shows so far."""


class Quiet:
    """Tells nothing."""

    def test(self, name: str, folder: Path, number: int, total: int) -> None:
        """Tell nothing."""

    def stage(self, name: str, total: float | None = None) -> None:
        """Tell nothing."""

    def advance(self, done: float) -> None:
        """Tell nothing."""

    @property
    def shown(self) -> bool:
        """Nobody sees it."""
        return False

    def note(self, text: str) -> None:
        """Tell nothing."""


def run(
    campaign: CampaignPlan,
    *,
    runs: Path | None = None,
    progress: Progress | None = None,
    ask: Callable[[str], None] | None = None,
    report: Callable[[Path], Path] | None = None,
) -> list[RunFolder]:
    """Make every test of a campaign.

    Parameters
    ----------
    campaign : CampaignPlan
        What to do.
    runs : Path, optional
        Where run folders go, a local folder; by default what the campaign file says.
    progress : Progress, optional
        Whom to tell.
    ask : callable, optional
        How to ask the operator; see :class:`~errormotion.campaign.bench.OpenBench`.
    report : callable, optional
        Writes the report of a run folder, and returns where it is.

    Returns
    -------
    list of RunFolder
        One for each test.

    Raises
    ------
    BenchError
        The instruments did not come up. Nothing was measured.
    RunError
        A test failed. Its message says which and why, where the data is, and how to go on.
    KeyboardInterrupt
        The operator stopped the run; the folder is whole and can be resumed.
    """
    session = _Session(campaign, runs or campaign.runs, uuid4().hex[:8], progress, ask, report)
    return session.work({})


def resume(
    campaign: CampaignPlan | None = None,
    *,
    runs: Path | None = None,
    progress: Progress | None = None,
    ask: Callable[[str], None] | None = None,
    report: Callable[[Path], Path] | None = None,
) -> list[RunFolder]:
    """Go on with the newest unfinished campaign of a runs folder; finished tests are stepped over.

    Parameters
    ----------
    campaign : CampaignPlan, optional
        Go on with this one only. Its files must be as they were when it was started.
    runs, progress, ask, report
        As for :func:`run`.

    Raises
    ------
    RunError
        Nothing there is unfinished, or the campaign's files have changed; and as for :func:`run`.
    """
    runs = runs or (campaign.runs if campaign else Path("runs"))
    groups: dict[str, list[RunFolder]] = {}
    for folder in list_runs(runs):
        if "campaign" not in folder.data:  # the log of a monitor
            continue
        groups.setdefault(str(folder.data["id"]), []).append(folder)
    changed = ""
    for run_id, folders in reversed(groups.items()):
        if all(folder.finished for folder in folders) and len(folders) == len(folders[0].data["campaign"]["tests"]):
            continue
        if campaign and campaign.sha256 != folders[0].data["campaign"]["sha256"]:
            if campaign.name == folders[0].data["campaign"]["name"]:
                changed = changed or folders[-1].path.name
            continue
        plan = _stored_plan(folders[0])
        session = _Session(plan, runs, run_id, progress, ask, report)
        return session.work({str(folder.data["test"]): folder for folder in folders})
    if changed and campaign:
        raise RunError(
            f"{campaign.source} or its bench file has changed since {runs / changed} was measured. Go on with the "
            "files as they were: 'errormotion run --resume' without the campaign. Or start anew: without --resume."
        )
    raise RunError(f"Nothing to resume in {runs}: {len(groups)} campaigns there, all of them finished.")


class _Session:
    """One campaign from here to its end."""

    def __init__(
        self,
        campaign: CampaignPlan,
        runs: Path,
        run_id: str,
        progress: Progress | None,
        ask: Callable[[str], None] | None,
        report: Callable[[Path], Path] | None,
    ) -> None:
        self.campaign, self.runs, self.run_id = campaign, runs, run_id
        self.progress = progress or Quiet()
        self.bench = OpenBench(campaign.bench, ask)
        self.report = report

    def work(self, folders: dict[str, RunFolder]) -> list[RunFolder]:
        """Do what is not finished."""
        with ExitStack() as opened:
            for number, test in enumerate(self.campaign.tests):
                folder = folders.get(test.name)
                if folder is not None and folder.finished:
                    self.progress.test(test.name, folder.path, number, len(self.campaign.tests))
                    continue
                if (folder is None or not folder.data["acquired"]) and not self.bench.answers:
                    self.progress.stage("opening the bench")
                    opened.enter_context(self.bench)
                if folder is None:
                    folder = folders[test.name] = self._new_folder(test)
                self.progress.test(test.name, folder.path, number, len(self.campaign.tests))
                with folder.locked(), journal(folder.log), looking_beside(self.campaign.folder), _failures(folder):
                    self._test(folder, test, folders)
        return [folders[test.name] for test in self.campaign.tests]

    def _new_folder(self, test: TestPlan) -> RunFolder:
        plan = self.campaign
        info = test.method.info
        settings = provenance.plain(test.settings.model_dump(mode="json"))
        return RunFolder.create(
            self.runs,
            test.name,
            self.run_id,
            {
                "status": "running",
                "reason": "",
                "acquired": False,
                "campaign": {
                    "name": plan.name,
                    "file": plan.source.name,
                    "folder": str(plan.folder),
                    "sha256": plan.sha256,
                    "tests": [entry.name for entry in plan.tests],
                    "text": plan.text,
                },
                "bench": {
                    "name": plan.bench.name,
                    "machine": plan.bench.machine,
                    "file": plan.bench.source.name,
                    "text": plan.bench.text,
                },
                "method": {"id": info.id, "version": info.version, "status": info.status},
                "settings": settings,
                "settings_hash": settings_hash(settings, info.id, info.version),
                "inputs": {},
                "instruments": [answer.record() for answer in self.bench.chosen(test.instruments).answers],
                "software": provenance.make({}, None, None)["software"],
                "samples": {},
                "raw": "raw.zarr",
                "errors": None,
                "report": None,
                "log": "log.jsonl",
                "steps": [],
            },
        )

    def _test(self, folder: RunFolder, test: TestPlan, folders: Mapping[str, RunFolder]) -> None:
        inputs = {}
        for key, name in test.inputs.items():
            source = folders[name]
            if source.errors is None:
                raise RunError(f"{source.path}: expected the errors that test '{test.name}' needs; found none")
            inputs[key] = datasets.load(source.errors)
            folder.data["inputs"][key] = f"../{source.path.name}/{source.data['errors']}"
        folder.save(status="running", reason="")
        if not folder.data["acquired"]:
            self._acquire(folder, test, inputs)
        if folder.errors is None:
            self._identify(folder, test)
        self._report(folder)
        folder.save(status="finished")

    def _acquire(self, folder: RunFolder, test: TestPlan, inputs: Mapping[str, xr.Dataset]) -> None:
        method, bench = test.method(), self.bench.chosen(test.instruments)
        dim, expected = method.append_dim(test.settings), float(method.progress(test.settings))
        if folder.raw.exists() and committed_length(folder.raw, dim) == 0:  # made, and cut off before its first samples
            shutil.rmtree(folder.raw)
        done = datasets.load(folder.raw) if folder.raw.exists() else None
        before = int(done.sizes[dim]) if done is not None else 0
        folder.data["instruments"] = [answer.record() for answer in bench.answers]
        folder.step("acquire", "started", samples=before)
        folder.save()
        folder.take_reserve()
        log.info("acquire", extra={"data": {"test": test.name, "method": method.info.id, "samples": before}})
        self.progress.stage("measuring", expected)
        attrs = {"instruments": json.dumps(provenance.plain(folder.data["instruments"])), "start": now()}
        recorder = Recorder(folder.raw, dim, expected, attrs)
        taken = before
        follow = getattr(method, "follow", None) if self.progress.shown else None
        tell = follow(test.settings) if follow else None
        try:
            with (
                _in_order(),
                recorder,
                closing(_Chunks(method.acquire(bench, test.settings, inputs=inputs, done=done))) as chunks,
            ):
                for chunk in chunks:
                    recorder.put(chunk)
                    taken += chunk.sizes.get(dim, 0)
                    rate = chunk.attrs.get("sample_rate")
                    self.progress.advance(taken / rate if rate else taken)
                    if tell:
                        self.progress.note(tell(chunk))
        finally:
            if recorder.committed == 0 and folder.raw.exists():  # made, and not one sample came to it
                shutil.rmtree(folder.raw)
            folder.give_reserve()
            folder.data["samples"] = {
                "dim": dim,
                "count": recorder.committed,
                "dropped": recorder.attrs.get("dropped", 0),
                "invalid": json.loads(recorder.attrs.get("invalid", "{}")),
            }
        if recorder.committed == 0:
            raise RunError(f"The method '{method.info.id}' yielded no data.")
        folder.step("acquire", "done", samples=recorder.committed)
        folder.save(acquired=True)

    def _identify(self, folder: RunFolder, test: TestPlan) -> None:
        self.progress.stage("identifying")
        method = test.method()
        place = f"errors/{method.info.id}-{folder.data['settings_hash']}/errors.nc"
        if not (folder.path / place).exists():  # else: computed, but the process ended before run.json said so
            with datasets.load(folder.raw) as raw:
                errors = method.identify(raw, test.settings)
            datasets.validate(errors)
            (folder.path / place).parent.mkdir(parents=True, exist_ok=True)
            datasets.save(errors, folder.path / place)
        folder.step("identify", "done")
        folder.save(errors=place)
        log.info("identified", extra={"data": {"errors": place}})

    def _report(self, folder: RunFolder) -> None:
        """Write the report; the measurement is good without, so a report that fails is noted and no more."""
        if self.report is None:
            return
        self.progress.stage("writing the report")
        try:
            path = self.report(folder.path)
        except Exception as error:
            log.exception("the report failed")
            folder.step("report", "failed", reason=f"{type(error).__name__}: {error}")
        else:
            folder.step("report", "done")
            folder.data["report"] = path.relative_to(folder.path).as_posix()


class _Chunks:
    """The method's datasets, with a ``close`` whatever kind of iterator it returns."""

    def __init__(self, chunks: Iterator[xr.Dataset]) -> None:
        self._chunks = chunks

    def __iter__(self) -> Iterator[xr.Dataset]:
        return iter(self._chunks)

    def close(self) -> None:
        """End the acquisition: what the method does on its way out happens now."""
        close = getattr(self._chunks, "close", None)
        if close is not None:
            close()


@contextmanager
def _failures(folder: RunFolder) -> Iterator[None]:
    """Bring what ended a test into its ``run.json`` and its log, and say where the data is."""
    try:
        yield
    except KeyboardInterrupt as error:
        log.warning("interrupted by the operator")
        folder.step("stop", "interrupted")
        _mark(folder, "interrupted", "stopped by the operator")
        raise KeyboardInterrupt(f"{_kept(folder)} in {folder.path}.\n{_go_on(folder)}") from error
    except Exception as error:
        reason = str(error) if isinstance(error, ErrormotionError) else f"{type(error).__name__}: {error}"
        log.exception("failed")
        marked = f"disk full: {reason}" if isinstance(error, DiskFullError) else reason
        folder.step("stop", "failed", reason=marked)
        _mark(folder, "failed", marked)
        raise RunError(
            f"Test '{folder.data['test']}' failed: {reason}\n"
            f"{_kept(folder)} in {folder.path}; the log is {folder.log}.\n"
            f"When the cause is mended: {_go_on(folder)}"
        ) from error


def _mark(folder: RunFolder, status: str, reason: str) -> None:
    """Write how a run ended; where even that cannot be written it stays 'running', which can be resumed as well."""
    try:
        folder.save(status=status, reason=reason)
    except OSError:
        log.exception("run.json cannot be written")


def _kept(folder: RunFolder) -> str:
    if folder.data["acquired"]:
        return "The raw data is complete and kept"
    return f"{folder.data['samples'].get('count', 0)} samples are kept"


def _go_on(folder: RunFolder) -> str:
    return f"'errormotion run --resume --runs {folder.path.parent}' goes on."


@contextmanager
def _in_order() -> Iterator[None]:
    """Let the first Ctrl-C stop the measurement; further ones must not disturb the writing of the last samples."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)

    def stop(*_: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def settings_hash(settings: Mapping[str, Any], method: str, method_version: str) -> str:
    """Return twelve hexadecimal digits that stand for effective settings, method and version."""
    text = json.dumps([method, method_version, settings], sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _stored_plan(folder: RunFolder) -> CampaignPlan:
    """Return the plan of a run as it was when it was started."""
    campaign, bench = folder.data["campaign"], folder.data["bench"]
    plan = parse_bench(bench["text"], folder.path / f"run.json ({bench['file']})")
    found = parse_campaign(campaign["text"], folder.path / f"run.json ({campaign['file']})", plan)
    return replace(found, folder=Path(campaign["folder"])) if "folder" in campaign else found
