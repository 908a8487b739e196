"""Campaigns in separate processes, on the side of the operator: start, list, answer requests, stop.

A process continues when the one that started it ends. It holds a lock on a file of its folder
``RUNS/.background/TIME-NUMBER``. The operating system releases the lock when the process ends for any reason: a free
lock means that the process has ended. Only the user who started the process has access to the folder, and thus can
answer or stop it.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args
from uuid import uuid4

from errormotion.campaign.background import signals
from errormotion.campaign.background.detached import printed, spawn
from errormotion.campaign.background.publishing import ANSWER, STATUS, store_released
from errormotion.campaign.claims import require_free, uses
from errormotion.campaign.files import CampaignPlan, TestPlan, load_campaign
from errormotion.campaign.folder import RunFolder, is_locked, now
from errormotion.campaign.planning.ready import require_ready
from errormotion.campaign.planning.release import Release, refuse, to_release
from errormotion.campaign.runner import folders_of, stored_plan, to_measure
from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.files.writing import open_to_append, replace_text
from errormotion.errors import RunError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

FOLDER = ".background"
"""Folder of the processes, in the folder of runs."""
OUTPUT = "output.txt"
"""File of the output of a process."""
MAX_PROCESSES = 50
"""Number of processes whose state is kept."""
MAX_STATE = 1 << 20
"""Largest size of a state, bytes."""
STOP_INTERVAL = 30.0
"""Shortest interval between two stop signals to a process, s."""
COMMAND = ("-m", "errormotion", "run")
"""First words of the command of a process, after the interpreter and its options; its folder follows."""
_NAME = re.compile(r"\d{8}T\d{6}Z-[0-9a-f]{8}")


Ended = Literal["", "finished", "interrupted", "failed", "killed"]
"""End of a process; empty while it is running."""


@dataclass(frozen=True)
class Request:
    """An open request to the operator."""

    number: int
    text: str


@dataclass(frozen=True)
class Background:
    """The present state of a campaign in a separate process.

    Attributes
    ----------
    name : str
        Name of its folder.
    campaign, machine, started : str
    alive : bool
        Whether the process is running.
    ended : str
        ``finished``, ``interrupted``, ``failed``, ``killed``; empty while it is running.
    message : str
        Cause of its end, or the end of its output.
    test, stage, note : str
        Present test and stage, and the last intermediate result.
    number, total : int
        Number of the test, counted from 0, and the number of tests.
    done, expected : float
        Completed and total amount of the stage, in the same unit; NaN if unknown.
    tests : dict of str to str
        Names of run folders by test.
    request : Request, optional
    stopping : bool
        Whether a stop was requested.
    """

    name: str
    campaign: str
    machine: str
    started: str
    alive: bool
    ended: Ended = ""
    message: str = ""
    test: str = ""
    stage: str = ""
    note: str = ""
    number: int = 0
    total: int = 0
    done: float = math.nan
    expected: float = math.nan
    tests: dict[str, str] = field(default_factory=dict)
    announcements: tuple[str, ...] = ()
    request: Request | None = None
    stopping: bool = False


def start(campaign: Path, runs: Path, release: Release = refuse) -> str:
    """Start a campaign in a separate process, and return the name of the process.

    Parameters
    ----------
    campaign, runs : Path
        The campaign file, and the folder of runs.
    release : callable, optional
        As for `errormotion.campaign.runner.run`; called in this process, since the other one has no terminal.

    Raises
    ------
    BenchError
        The campaign or its bench file is invalid.
    RunError
        The motions were not released, another process measures on the same machine, or the process cannot be started.
    """
    plan = load_campaign(campaign)
    return _start(runs, plan, plan.tests, [str(campaign.resolve())], release)


def resume(folder: Path, release: Release = refuse) -> str:
    """Continue the campaign of a run folder in a separate process, and return the name of the process.

    Raises
    ------
    RunError
        The folder is not the run folder of a campaign; or as for `start`.
    """
    first = RunFolder.open(folder)
    try:
        plan = stored_plan(first)
    except (KeyError, TypeError, AttributeError):
        raise RunError(
            f"{folder}: expected the run folder of a campaign; found another folder", code="run.folder.other"
        ) from None
    tests = to_measure(plan, folders_of(first, [test.name for test in plan.tests]))
    return _start(folder.parent, plan, tests, ["--resume", str(folder.resolve())], release)


def found(runs: Path) -> list[Background]:
    """Return the processes of a folder of runs, the newest first."""
    root = runs / FOLDER
    names = sorted((path.name for path in root.iterdir()), reverse=True) if root.is_dir() else []
    return [each for each in (_read(root / name) for name in names if _NAME.fullmatch(name)) if each is not None]


def answer(runs: Path, name: str, number: int) -> None:
    """State that a request is done.

    Raises
    ------
    RunError
        The request is not open: it was answered, or the process has ended.
    """
    process = _one(runs, name)
    if not process.alive or process.request is None or process.request.number != number:
        raise RunError(f"{process.campaign}: request {number} is no longer open", code="process.request.closed")
    replace_text(runs / FOLDER / name / ANSWER, f"{number}\n")


def stop(runs: Path, name: str) -> None:
    """Stop a process, as Ctrl-C does in a terminal; its run folder is complete and can be resumed.

    Raises
    ------
    RunError
        The process has ended, or belongs to another user; or the process with the stated number was not started to
        measure in this folder: a state that was copied or forged must not end another program.
    """
    process = _one(runs, name)
    folder = runs / FOLDER / name
    state = _state(folder / "process.json")
    if not process.alive:
        raise RunError(f"{process.campaign}: the process has already ended", code="process.ended")
    requested = folder / "stop"
    if requested.exists() and time.time() - requested.stat().st_mtime < STOP_INTERVAL:
        return  # a second signal would end it while it closes its instruments
    try:
        signals.terminate(state.get("pid"), state.get("began"), [*COMMAND, *_publishing(folder)])
    except ProcessLookupError:
        raise RunError(f"{process.campaign}: the process has already ended", code="process.ended") from None
    except signals.OtherProcessError as error:
        raise RunError(
            f"{folder / 'process.json'}: expected the process that measures in this folder; {error}. Nothing was "
            "stopped. If the campaign is running, end it by Ctrl-C in its terminal, or by 'kill' with its number",
            code="process.record.unreadable",
        ) from None
    except OSError as error:
        raise RunError(
            f"{process.campaign}: cannot be stopped: {error.strerror}", code="process.not_stopped"
        ) from error
    replace_text(requested, "")


def _start(
    runs: Path, plan: CampaignPlan, tests: Sequence[TestPlan], arguments: Sequence[str], release: Release
) -> str:
    if fcntl is None:
        raise RunError(
            "A background process needs a system with file locks (Linux, macOS). Use 'errormotion run'.",
            code="process.no_locks",
        )
    machine = plan.bench.machine
    require_ready(plan, tests, stored="--resume" in arguments)
    if tests:
        require_free(uses(plan.bench))
    if motions := to_release(plan, tests):
        release(motions)
    try:
        runs.mkdir(parents=True, exist_ok=True)
        root = runs / FOLDER
        root.mkdir(mode=0o700, exist_ok=True)
        if root.is_symlink():
            raise RunError(
                f"{root}: expected a folder; found a link, and links are not written through. Remove it",
                code="runs.folder.link",
            )
        with _exclusive(root):
            for each in found(runs):
                if each.alive and each.machine == machine:
                    raise RunError(
                        f"'{each.campaign}' has used {machine} since {each.started}; stop it first",
                        code="process.machine.used",
                    )
            _tidy(root)
            name = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{uuid4().hex[:8]}"
            folder = root / name
            folder.mkdir(mode=0o700)
            store_released(folder, motions, "" if "--resume" in arguments else plan.sha256)
            _spawn(folder, runs, {"campaign": plan.name, "machine": machine, "started": now()}, arguments)
    except OSError as error:
        raise RunError(
            f"{runs}: the process cannot be started: {error.strerror}", code="process.not_started"
        ) from error
    return name


def _spawn(folder: Path, runs: Path, state: dict[str, Any], arguments: Sequence[str]) -> None:
    command = [*COMMAND[2:], *_publishing(folder), *arguments, "--runs", str(runs.resolve())]
    lock = open_to_append(folder / "lock", 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        child = spawn(command, folder / OUTPUT, inherited=[lock])
        replace_text(
            folder / "process.json", json.dumps({**state, "pid": child.pid, "began": signals.started(child.pid)})
        )
    finally:
        os.close(lock)  # the process keeps the lock


def _publishing(folder: Path) -> list[str]:
    """Return the words of a command by which its process publishes its state in a folder."""
    return ["--publish", str(folder.resolve())]


@contextmanager
def _exclusive(root: Path) -> Iterator[None]:
    """Serialize starts, so that two processes never start on the same machine."""
    lock = open_to_append(root / "lock", 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def _tidy(root: Path) -> None:
    """Remove the states of the oldest processes that have ended."""
    names = sorted(path.name for path in root.iterdir() if _NAME.fullmatch(path.name))
    for name in names[:-MAX_PROCESSES]:
        if not is_locked(root / name / "lock"):
            shutil.rmtree(root / name, ignore_errors=True)


def _one(runs: Path, name: str) -> Background:
    process = _read(runs / FOLDER / name) if _NAME.fullmatch(name) else None
    if process is None:
        raise RunError(f"{runs}: no process {name[:60]!r}", code="process.not_found")
    return process


def _read(folder: Path) -> Background | None:
    alive = is_locked(folder / "lock")  # read before the state, which is complete if the process has ended
    process, state = _state(folder / "process.json"), _state(folder / STATUS)
    if not process:
        return None
    ended: Ended = "" if alive else state["ended"] if state.get("ended") in get_args(Ended)[1:] else "killed"
    message = str(state.get("message", ""))
    if ended in ("failed", "killed"):
        message = printed(folder / OUTPUT) or message
    request = state.get("request")
    open_request = alive and isinstance(request, dict) and isinstance(request.get("number"), int)
    return Background(
        name=folder.name,
        campaign=str(process.get("campaign", "")),
        machine=str(process.get("machine", "")),
        started=str(process.get("started", "")),
        alive=alive,
        ended=ended,
        message=message,
        test=str(state.get("test", "")),
        stage=str(state.get("stage", "") or "starting"),
        note=str(state.get("note", "")),
        number=_whole(state.get("number")),
        total=_whole(state.get("total")),
        done=_number(state.get("done")),
        expected=_number(state.get("expected")),
        tests={str(k): str(v) for k, v in state["tests"].items()} if isinstance(state.get("tests"), dict) else {},
        announcements=tuple(map(str, state["announcements"])) if isinstance(state.get("announcements"), list) else (),
        request=Request(request["number"], str(request.get("text", ""))) if open_request and request else None,
        stopping=alive and (folder / "stop").exists(),
    )


def _state(path: Path) -> dict[str, Any]:
    """Return the content of a file; empty if it cannot be read."""
    with suppress(OSError, ValueError, RecursionError):
        content = json.loads(read_bytes(path, MAX_STATE))
        if isinstance(content, dict):
            return content
    return {}


def _whole(value: Any) -> int:
    return value if isinstance(value, int) else 0


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
