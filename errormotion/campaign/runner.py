"""The runner: acquisition, identification and report of each test, and continuation after an interruption.

Everything is stored before it is used: the settings before the first sample, the raw data before the identification,
the errors before the report. However a run ends, its folder states its progress, and :func:`resume` continues it.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

import xarray as xr

from errormotion import datasets
from errormotion.campaign.bench import OpenBench
from errormotion.campaign.claims import claimed, uses
from errormotion.campaign.files import CampaignPlan, TestPlan, parse_bench, parse_campaign
from errormotion.campaign.folder import FolderGoneError, RunFolder, Status, list_runs, new_entries, now
from errormotion.campaign.planning.ready import accept_overdue, cannot_continue, require_ready
from errormotion.campaign.planning.release import Release, announced, forbidden, refuse, to_release
from errormotion.campaign.sections import head
from errormotion.campaign.sections.timeline import follower
from errormotion.campaign.storage.journal import cause_of, journal
from errormotion.campaign.storage.recorder import DiskFullError, Recorder
from errormotion.campaign.storage.store import committed_length
from errormotion.datasets import provenance
from errormotion.datasets.certificates import ATTRIBUTE
from errormotion.datasets.clock import noted
from errormotion.datasets.files.folders import looking_beside
from errormotion.datasets.results.merit import figures_of, stored
from errormotion.datasets.timing import later
from errormotion.datasets.validation import explained
from errormotion.errors import ErrormotionError, RunError, code_of
from errormotion.plugins import Method
from errormotion.report.page import logo
from errormotion.tolerances.conformity import judge
from errormotion.tolerances.table import from_run

MAX_RESULTS = 200
"""Largest number of figures of merit in ``run.json``."""

MEASURING = "measuring"
"""Name of the stage in which the method measures."""

log = logging.getLogger(__name__)


class Progress(Protocol):
    """Receives the progress of a campaign."""

    def announce(self, text: str) -> None:
        """State what motions and spindle speeds a test will command, before the bench is opened."""

    def test(self, name: str, folder: Path, number: int, total: int) -> None:
        """Start a test, or skip a finished one."""

    def stage(self, name: str, total: float | None = None) -> None:
        """Start a stage of a test; ``total`` in the unit of :meth:`advance`, None if unknown."""

    def advance(self, done: float) -> None:
        """Report the completed part of the stage: seconds of evenly spaced samples, else items."""

    @property
    def shown(self) -> bool:
        """Return whether the progress is displayed; notes that take time to compute are omitted otherwise."""

    def note(self, text: str) -> None:
        """Report an intermediate result of the measurement."""


class Quiet:
    """Ignores the progress."""

    def announce(self, text: str) -> None:
        """Do nothing."""

    def test(self, name: str, folder: Path, number: int, total: int) -> None:
        """Do nothing."""

    def stage(self, name: str, total: float | None = None) -> None:
        """Do nothing."""

    def advance(self, done: float) -> None:
        """Do nothing."""

    @property
    def shown(self) -> bool:
        """Return False."""
        return False

    def note(self, text: str) -> None:
        """Do nothing."""


def run(
    campaign: CampaignPlan,
    *,
    runs: Path | None = None,
    progress: Progress | None = None,
    ask: Callable[[str], None] | None = None,
    report: Callable[[Path], Path] | None = None,
    release: Release = refuse,
) -> list[RunFolder]:
    """Execute every test of a campaign.

    Parameters
    ----------
    campaign : CampaignPlan
        The campaign.
    runs : Path, optional
        Local folder of the run folders; default that of the campaign file.
    progress : Progress, optional
        Receives the progress.
    ask : callable, optional
        Sends a request to the operator; see :class:`~errormotion.campaign.bench.OpenBench`.
    report : callable, optional
        Writes the report of a run folder, and returns its path.
    release : callable, optional
        Called with the motions of the tests before anything is opened or created, if they move a machine and not all
        devices are simulated; returns when a person has released them. Default: they are refused.

    Returns
    -------
    list of RunFolder
        One for each test.

    Raises
    ------
    BenchError
        An instrument could not be opened. Nothing was measured.
    RunError
        The motions were not released, or another program uses the instruments: nothing was created. Or a test failed:
        the message states the test, the cause, the location of the data, and how to continue.
    KeyboardInterrupt
        The operator stopped the run; the folder is complete and can be resumed.
    """
    session = _Session(campaign, runs or campaign.runs, uuid4().hex[:8], progress, ask, report, release)
    return session.work({})


def resume(
    campaign: CampaignPlan | None = None,
    *,
    run_id: str = "",
    runs: Path | None = None,
    progress: Progress | None = None,
    ask: Callable[[str], None] | None = None,
    report: Callable[[Path], Path] | None = None,
    release: Release = refuse,
) -> list[RunFolder]:
    """Continue the newest unfinished campaign of a runs folder; finished tests are skipped.

    Parameters
    ----------
    campaign : CampaignPlan, optional
        Continue only this one. Its files must not have changed since it was started.
    run_id : str, optional
        Continue only the campaign with this ``id`` in its ``run.json``.
    runs, progress, ask, report, release
        As for :func:`run`.

    Raises
    ------
    RunError
        No campaign is unfinished, or the campaign's files have changed; and as for :func:`run`.
    """
    runs = runs or (campaign.runs if campaign else Path("runs"))
    groups: dict[str, list[RunFolder]] = {}
    skipped: list[str] = []
    for folder in list_runs(runs, skipped):
        if "campaign" not in folder.data or (run_id and folder.data["id"] != run_id):  # a log, or another campaign
            continue
        groups.setdefault(str(folder.data["id"]), []).append(folder)
    changed = ""
    for run_id, folders in reversed(groups.items()):
        try:
            stated = folders[0].data["campaign"]
            if all(folder.finished for folder in folders) and len(folders) == len(stated["tests"]):
                continue
            if campaign and campaign.sha256 != stated["sha256"]:
                if campaign.name == stated["name"]:
                    changed = changed or folders[-1].path.name
                continue
            plan = stored_plan(folders[0])
        except (ErrormotionError, KeyError, TypeError, AttributeError) as error:
            if campaign and isinstance(error, ErrormotionError):  # the requested campaign
                raise
            skipped.append(f"{folders[0].path / 'run.json'}: is not a complete record of a run ({cause_of(error)})")
            log.warning("skipped: %s", skipped[-1])
            continue
        session = _Session(plan, runs, run_id, progress, ask, report, release)
        with folders[0].locked():  # one process at a time continues a campaign
            for reason in skipped:
                session.progress.announce(f"skipped: {reason}")
            return session.work(_folders_by_test(runs, run_id, folders, [test.name for test in plan.tests]))
    if changed and campaign:
        raise RunError(
            f"{campaign.source} or its bench file has changed since {runs / changed} was measured. Continue with the "
            "stored files: 'errormotion run --resume' without the campaign. Or start a new run, without --resume.",
            code="campaign.changed",
        )
    message = f"Nothing to resume in {runs}: found {len(groups)} campaigns, none of them unfinished."
    raise RunError(
        "\n  - ".join([message, *(f"skipped: {reason}" for reason in skipped)]), code="campaign.nothing_to_resume"
    )


def folders_of(folder: RunFolder, tests: Sequence[str]) -> dict[str, RunFolder]:
    """Return the run folders of the campaign of a run folder by test.

    Raises
    ------
    RunError
        The test of a run folder is unclear.
    """
    return _folders_by_test(folder.path.parent, str(folder.data["id"]), [folder], tests)


def _folders_by_test(runs: Path, run_id: str, known: Sequence[RunFolder], tests: Sequence[str]) -> dict[str, RunFolder]:
    """Return the run folders of a campaign by test, read again, since another process may have continued it.

    Raises
    ------
    RunError
        The test of a run folder is unclear, and would be measured again.
    """
    by_path = {folder.path: folder for folder in known}
    folders: dict[str, RunFolder] = {}
    unclear = []
    for path in sorted({*by_path, *(path for path in runs.iterdir() if _belongs(path, run_id))}):
        try:
            folder = by_path.get(path) or RunFolder.open(path)
            folder.read()
        except RunError as error:
            unclear.append(str(error))
            continue
        test = str(folder.data["test"])
        if test not in tests:
            unclear.append(f"{path / 'run.json'}: test: expected one of {', '.join(tests)}; found {test!a:.100}")
        elif test in folders:
            unclear.append(f"{path} and {folders[test].path} are of the same test, {test!r}")
        folders.setdefault(test, folder)
    if unclear:
        what = (
            "The campaign cannot be continued, because it is unclear which tests were measured. Restore run.json from "
            f"a copy, or move the folder out of {runs} to measure its test again:"
        )
        raise RunError("\n  - ".join([what, *unclear]), code="campaign.tests.unclear")
    return folders


def to_measure(campaign: CampaignPlan, folders: Mapping[str, RunFolder]) -> list[TestPlan]:
    """Return the tests whose raw data are not complete; ``folders`` are the run folders by test."""
    tests = [(test, folders.get(test.name)) for test in campaign.tests]
    return [test for test, folder in tests if folder is None or not (folder.finished or folder.data["acquired"])]


def _belongs(path: Path, run_id: str) -> bool:
    """Return whether a path has the name of a run folder of this campaign."""
    return bool(run_id) and path.name.endswith(f"-{run_id}") and not path.name.startswith(".") and path.is_dir()


class _Session:
    """Execution of one campaign."""

    def __init__(
        self,
        campaign: CampaignPlan,
        runs: Path,
        run_id: str,
        progress: Progress | None,
        ask: Callable[[str], None] | None,
        report: Callable[[Path], Path] | None,
        release: Release,
    ) -> None:
        self.campaign, self.runs, self.run_id = campaign, runs, run_id
        self.progress = progress or Quiet()
        self.bench = OpenBench(campaign.bench, ask)
        self.ask, self.report, self.release = ask, report, release
        self.records: Callable[[Path], None] = lambda run: None  # noqa: ARG005 - until the bench is opened

    def work(self, folders: dict[str, RunFolder]) -> list[RunFolder]:
        """Execute the unfinished tests."""
        unmeasured = to_measure(self.campaign, folders)
        begun = [each.name for each in unmeasured if each.name in folders and _begun(folders[each.name], each)]
        require_ready(self.campaign, unmeasured, stored=bool(folders), begun=begun)
        accept_overdue(self.campaign, unmeasured, date.today(), self.progress.announce, self.ask)
        for test in unmeasured:
            self.progress.announce(announced(self.campaign, test))
        if motions := to_release(self.campaign, unmeasured):
            self.release(motions)
        with ExitStack() as opened:
            for number, test in enumerate(self.campaign.tests):
                folder = folders.get(test.name)
                if folder is not None and folder.finished:
                    self.progress.test(test.name, folder.path, number, len(self.campaign.tests))
                    continue
                if (folder is None or not folder.data["acquired"]) and not self.bench.answers:
                    self.progress.stage("opening the bench")
                    held = opened.enter_context(claimed(uses(self.campaign.bench), "a run"))
                    self.records = held.records
                    if held.note:
                        self.progress.announce(held.note)
                    opened.enter_context(self.bench)
                if folder is None:
                    folder = folders[test.name] = self._new_folder(test)
                self.records(folder.path)
                self.progress.test(test.name, folder.path, number, len(self.campaign.tests))
                # Locked until the end: no other process continues the campaign between two tests.
                opened.enter_context(folder.locked())
                with journal(folder.log), looking_beside(self.campaign.folder), _failures(folder, test):
                    self._test(folder, test, folders)
        return [folders[test.name] for test in self.campaign.tests]

    def _new_folder(self, test: TestPlan) -> RunFolder:
        plan = self.campaign
        info = test.method.info
        settings = provenance.plain(test.settings.model_dump(mode="json"))
        data = new_entries(plan.bench) | {
            "campaign": {
                "name": plan.name,
                "file": plan.source.name,
                "folder": str(plan.folder),
                "sha256": plan.sha256,
                "tests": [entry.name for entry in plan.tests],
                "text": plan.text,
            },
            "method": {"id": info.id, "version": info.version, "status": info.status},
            "settings": settings,
            "settings_hash": settings_hash(settings, info.id, info.version),
            "tolerances": plan.tolerances.model_dump(mode="json") if plan.tolerances else None,
            "inputs": {},
            "operator": plan.operator,
            "head": head.stated(plan.bench.laboratory, plan.report, plan.bench.calibrated_until, test.certificates),
            "instruments": [answer.record() for answer in self.bench.chosen(test.instruments).answers],
        }
        folder = RunFolder.create(self.runs, test.name, self.run_id, data)
        if plan.bench.laboratory is not None and plan.bench.laboratory.logo:
            logo.copy(plan.bench.source.parent / plan.bench.laboratory.logo, folder.path)
        return folder

    def _test(self, folder: RunFolder, test: TestPlan, folders: Mapping[str, RunFolder]) -> None:
        inputs = {}
        for key, name in test.inputs.items():
            source = folders[name]
            if source.errors is None:
                raise RunError(
                    f"{source.path}: expected the errors that the test '{test.name}' needs; found none",
                    code="run.no_errors",
                )
            inputs[key] = datasets.load(source.errors)
            folder.data["inputs"][key] = f"../{source.path.name}/{source.data['errors']}"
        folder.save(status="running", reason="")
        if not folder.data["acquired"]:
            self._acquire(folder, test, inputs)
        if folder.errors is None:
            self._identify(folder, test)
        if test.monte_carlo is not None:
            self._evaluate(folder, test)
        self._report(folder)
        folder.save(status="finished")

    def _acquire(self, folder: RunFolder, test: TestPlan, inputs: Mapping[str, xr.Dataset]) -> None:
        method, bench = test.method(), self.bench.chosen(test.instruments)
        dim, expected = method.append_dim(test.settings), float(method.progress(test.settings))
        if folder.raw.exists() and committed_length(folder.raw, dim) == 0:
            shutil.rmtree(folder.raw)  # created, but interrupted before its first samples
        done = datasets.load(folder.raw) if folder.raw.exists() else None
        before = int(done.sizes[dim]) if done is not None else 0
        folder.data["instruments"] = [answer.record() for answer in bench.answers]
        folder.step("acquire", "started", samples=before)
        folder.save()
        folder.take_reserve()
        log.info("acquire", extra={"data": {"test": test.name, "method": method.info.id, "samples": before}})
        self.progress.stage(MEASURING, expected)
        attrs = {"instruments": json.dumps(provenance.plain(folder.data["instruments"])), "start": now()}
        if bench.description is not None:
            attrs["chain"] = bench.description.moving_chain
        if folder.data.get("operator"):
            attrs["operator"] = folder.data["operator"]
        if test.certificates:
            attrs[ATTRIBUTE] = json.dumps(dict(test.certificates))
        own = self._set_clock(folder, test)
        self._restore(folder)
        bench.set_limits(forbidden(self.campaign, test))
        recorder = Recorder(folder.raw, dim, expected, attrs, method.also_append(test.settings))
        taken = before
        note = method.follow(test.settings) if self.progress.shown else None
        try:
            with (
                _in_order(),
                recorder,
                closing(_Chunks(method.acquire(bench, test.settings, inputs=inputs, done=done))) as chunks,
            ):
                for chunk in chunks:
                    recorder.put(chunk.assign_attrs(own) if own else chunk)
                    taken += chunk.sizes.get(dim, 0)
                    rate = chunk.attrs.get("sample_rate")
                    self.progress.advance(taken / rate if rate else taken)
                    if note:
                        self.progress.note(note(chunk))
        finally:
            folder.data["samples"] = {
                "dim": dim,
                "count": recorder.committed,
                "dropped": recorder.attrs.get("dropped", 0),
                "invalid": json.loads(recorder.attrs.get("invalid", "{}")),
            }
            with suppress(OSError):  # of a disk that cannot be written; the recorder states the cause
                if recorder.committed == 0 and folder.raw.exists():  # created, but without samples
                    shutil.rmtree(folder.raw)
                folder.give_reserve()
        if recorder.committed == 0:
            raise RunError(f"The method '{method.info.id}' yielded no data.", code="method.no_data")
        folder.step("acquire", "done", samples=recorder.committed)
        folder.save(acquired=True)

    def _set_clock(self, folder: RunFolder, test: TestPlan) -> dict[str, str]:
        """Set the machine to the start of a test on the timeline; return the attributes that state it."""
        timeline = self.campaign.timeline
        if timeline is None:
            return {}
        control = follower(answer.driver for answer in self.bench.answers)
        if "clock" not in folder.data:
            time = float(control.state()["time"]) if test.at is None else test.at
            folder.save(clock={"start": timeline.start, "time": time, "schedule": timeline.events()})
        clock = folder.data["clock"]
        control.follow(clock["schedule"], clock["time"])
        return {"start": later(clock["start"], clock["time"])}

    def _restore(self, folder: RunFolder) -> None:
        """Set a virtual machine of another process to the state in which the test found it, which a new test stores."""
        drivers = [answer.driver for answer in self.bench.answers]
        found = [each for each in drivers if hasattr(each, "snapshot") and each.settings.arm]
        if self.campaign.timeline is not None or not found:
            return
        [control, *_] = found
        if "machine" not in folder.data:
            folder.save(machine=control.snapshot())
        elif float(control.state()["time"]) < float(folder.data["machine"]["time"]):
            control.restore(**folder.data["machine"])

    def _identify(self, folder: RunFolder, test: TestPlan) -> None:
        self.progress.stage("identifying")
        identify_run(folder, test.method(), test.settings)

    def _evaluate(self, folder: RunFolder, test: TestPlan) -> None:
        """Evaluate the result by the Monte Carlo method; a failure is only logged, as for the report."""
        from errormotion.montecarlo.saving import evaluate_and_save, evaluation_file

        file = folder.errors
        if file is None or evaluation_file(file).exists():
            return
        trials = None if test.monte_carlo == "auto" else test.monte_carlo
        try:
            evaluate_and_save(
                folder.raw, test.method.info.id, test.settings, datasets.load(file), file, trials=trials,
                progress=self.progress,
            )  # fmt: skip
        except Exception as error:
            log.exception("the Monte Carlo evaluation failed")
            folder.step("monte_carlo", "failed", reason=cause_of(error))
        else:
            folder.step("monte_carlo", "done")

    def _report(self, folder: RunFolder) -> None:
        if self.report is not None:
            self.progress.stage("writing the report")
            report_run(folder, self.report)


def identify_run(folder: RunFolder, method: Method, settings: Any) -> None:
    """Identify the raw data of a run into its folder, and state the result in its ``run.json``."""
    path = f"errors/{method.info.id}-{folder.data['settings_hash']}/errors.nc"
    file = folder.inside(path)
    if file.exists():  # computed, but the process ended before run.json was written
        errors = datasets.load(file)
    else:
        with datasets.load(folder.raw) as raw, explained(folder.raw, raw):
            errors = noted(method.identify(raw, settings), raw)
        datasets.validate(errors)
        file.parent.mkdir(parents=True, exist_ok=True)
        datasets.save(errors, file)
    folder.step("identify", "done")
    folder.save(errors=path, results=results_of(errors), conformity=conformity_of(folder, errors))
    log.info("identified", extra={"data": {"errors": path}})


def report_run(folder: RunFolder, report: Callable[[Path], Path]) -> None:
    """Write the report of a run; a failure is only logged, since the measurement is valid without it."""
    try:
        path = report(folder.path)
    except Exception as error:
        log.exception("the report failed")
        folder.step("report", "failed", reason=cause_of(error))
    else:
        folder.step("report", "done")
        folder.data["report"] = path.relative_to(folder.path).as_posix()


class _Chunks:
    """The datasets that the method yields, with a ``close`` for any kind of iterator."""

    def __init__(self, chunks: Iterator[xr.Dataset]) -> None:
        self._chunks = chunks

    def __iter__(self) -> Iterator[xr.Dataset]:
        return iter(self._chunks)

    def close(self) -> None:
        """End the acquisition, including the clean-up of the method."""
        close = getattr(self._chunks, "close", None)
        if close is not None:
            close()


@contextmanager
def _failures(folder: RunFolder, test: TestPlan) -> Iterator[None]:
    """Record the failure of a test in its ``run.json`` and its log, and state the location of the data."""
    try:
        yield
    except KeyboardInterrupt as error:
        log.warning("interrupted by the operator")
        folder.step("stop", "interrupted")
        _mark(folder, "interrupted", "stopped by the operator")
        raise KeyboardInterrupt(f"{_kept(folder)} in {folder.path}.\n{_continuation(folder, test)}") from error
    except Exception as error:
        reason = cause_of(error)
        log.exception("failed")
        if isinstance(error, FolderGoneError) or not folder.present:
            # Nothing is written to the former path: the new folder would look like a run.
            raise FolderGoneError(
                f"Test '{folder.data['test']}' ended: its folder {folder.path} is gone. It was moved or deleted "
                f"during the run. {_kept(folder)} in it. If it was moved, continue with 'errormotion run --resume "
                "--runs' and the folder that contains it now."
            ) from error
        marked = f"disk full: {reason}" if isinstance(error, DiskFullError) else reason
        folder.step("stop", "failed", reason=marked)
        _mark(folder, "failed", marked)
        raise RunError(
            f"Test '{folder.data['test']}' failed: {reason}\n"
            f"{_kept(folder)} in {folder.path}; the log is {folder.log}.\n"
            f"Remove the cause first. {_continuation(folder, test)}",
            code=code_of(error, "run.test.failed"),
        ) from error


def _mark(folder: RunFolder, status: Status, reason: str) -> None:
    """Write the status of a run; if this fails it remains 'running', which can be resumed as well."""
    try:
        folder.save(status=status, reason=reason)
    except (OSError, RunError):
        log.exception("run.json cannot be written")


def _kept(folder: RunFolder) -> str:
    if folder.data["acquired"]:
        return "The raw data are complete and stored"
    return f"{folder.data['samples'].get('count', 0)} samples are stored"


def _begun(folder: RunFolder, test: TestPlan) -> bool:
    """Return whether a run has samples, and lacks others."""
    if folder.data["acquired"] or not folder.raw.exists():
        return False
    return committed_length(folder.raw, test.method().append_dim(test.settings)) > 0


def _continuation(folder: RunFolder, test: TestPlan) -> str:
    with suppress(OSError, ErrormotionError):
        if _begun(folder, test) and (why := cannot_continue(test)):
            return why
    resume = f"Continue with 'errormotion run --resume --runs {folder.path.parent}'"
    if not folder.data["acquired"] or folder.errors is not None:
        return f"{resume}."
    return f"{resume}, which repeats the identification with the same settings; 'errormotion identify' takes others."


@contextmanager
def _in_order() -> Iterator[None]:
    """Stop the measurement at the first Ctrl-C or SIGTERM, and ignore others until the last samples are written."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(*_: Any) -> None:
        for number in before:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in before:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def results_of(errors: xr.Dataset) -> list[dict[str, Any]] | None:
    """Return the figures of merit for ``run.json``, SI, at most MAX_RESULTS; None if the method fails to state them.

    A failure is only logged, since the measurement is valid without them.
    """
    try:
        return [stored(figure) for figure in figures_of(errors)[:MAX_RESULTS]]
    except Exception:
        log.exception("the figures of merit failed")
        return None


def conformity_of(folder: RunFolder, errors: xr.Dataset) -> dict[str, Any] | None:
    """Return the decision on the tolerances of a run for its ``run.json``; None without tolerances."""
    table = from_run(folder.data)
    return None if table is None else judge(errors, table).plain()


def settings_hash(settings: Mapping[str, Any], method: str, method_version: str) -> str:
    """Return twelve hexadecimal digits of the hash of effective settings, method and version."""
    text = json.dumps([method, method_version, settings], sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def stored_plan(folder: RunFolder) -> CampaignPlan:
    """Return the plan of a run as of its start."""
    campaign, bench = folder.data["campaign"], folder.data["bench"]
    plan = parse_bench(bench["text"], folder.path / f"run.json ({bench['file']})")
    found = parse_campaign(campaign["text"], folder.path / f"run.json ({campaign['file']})", plan)
    found = replace(found, tolerances=from_run(folder.data) or found.tolerances)
    return replace(found, folder=Path(campaign["folder"])) if "folder" in campaign else found
