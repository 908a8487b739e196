"""Campaigns in separate processes: their state, and the interface by which they are answered and stopped."""

import json
import math
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from coded import raises
from command_line import CliRunner

from errormotion.campaign import runner
from errormotion.campaign.background import processes, signals
from errormotion.campaign.background.preliminary import preliminary, samples
from errormotion.campaign.background.publishing import Published
from errormotion.campaign.files import CampaignPlan
from errormotion.campaign.folder import RunFolder, list_runs
from errormotion.campaign.planning.release import released
from errormotion.cli.app import app
from errormotion.errors import RunError

fcntl = pytest.importorskip("fcntl", reason="file locks")

NAME = "20260101T000000Z-00000000"


def wait(condition: Callable[[], object]) -> None:
    """Wait until a condition is true."""
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@contextmanager
def living(runs: Path) -> Iterator[Path]:
    """Hold the lock of a process, as it does while it lives."""
    folder = runs / processes.FOLDER / NAME
    folder.mkdir(parents=True, mode=0o700)
    state = {"campaign": "Ramps", "machine": "lab machine", "started": "2026-01-01T00:00:00Z", "pid": 0}
    (folder / "process.json").write_text(json.dumps(state))
    lock = os.open(folder / "lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        yield folder
    finally:
        os.close(lock)


def test_a_request_waits_for_its_answer(tmp_path: Path) -> None:
    with living(tmp_path) as folder, Published(folder) as published:
        published.test("ramp", tmp_path / "20260101T000000Z-ramp-x", 0, 2)
        published.stage("measuring", 60.0)
        asking = threading.Thread(target=published.ask, args=["Mount <b>the bar</b>."], daemon=True)
        asking.start()
        wait(lambda: processes.found(tmp_path)[0].request)
        (found,) = processes.found(tmp_path)
        assert (found.alive, found.request, found.expected) == (
            True,
            processes.Request(1, "Mount <b>the bar</b>."),
            60.0,
        )
        with raises("process.request.closed"):
            processes.answer(tmp_path, NAME, 2)
        assert asking.is_alive()
        listed = CliRunner().invoke(app, ["background", "list", str(tmp_path)])
        assert "request 1: Mount <b>the bar</b>." in listed.output
        answered = CliRunner().invoke(app, ["background", "answer", str(tmp_path)])
        assert (answered.exit_code, answered.output) == (0, "Done: Mount <b>the bar</b>.\n")
        asking.join(30)
        assert not asking.is_alive()
        assert processes.found(tmp_path)[0].request is None
        again = threading.Thread(target=published.ask, args=["Turn it."], daemon=True)
        again.start()
        wait(lambda: processes.found(tmp_path)[0].request)
        assert again.is_alive()  # the answer to the first request is none to the second
        processes.answer(tmp_path, NAME, 2)
        again.join(30)
        assert not again.is_alive()


def test_the_end_states_the_message_of_the_process_or_its_absence(tmp_path: Path) -> None:
    with living(tmp_path) as folder:
        published = Published(folder)
        published.advance(math.pi)
        published.__exit__(KeyboardInterrupt, KeyboardInterrupt("12 samples are stored"), None)
        assert (processes.found(tmp_path)[0].alive, processes.found(tmp_path)[0].ended) == (True, "")
    (found,) = processes.found(tmp_path)
    assert (found.alive, found.ended, found.message) == (False, "interrupted", "12 samples are stored")
    (folder / "status.json").unlink()
    (folder / "output.txt").write_text("Segmentation fault")
    (found,) = processes.found(tmp_path)
    assert (found.ended, found.message) == ("killed", "Segmentation fault")
    for order in (lambda: processes.stop(tmp_path, NAME), lambda: processes.answer(tmp_path, NAME, 1)):
        with pytest.raises(RunError):
            order()


def test_pipes_and_links_in_a_foreign_folder_neither_block_nor_are_written_through(
    plan: Callable[..., CampaignPlan], tmp_path: Path
) -> None:
    folder, target = tmp_path / ".background" / NAME, tmp_path / "target"
    folder.mkdir(parents=True)
    (folder / "process.json").write_text('{"campaign": "c", "machine": "m"}')
    os.mkfifo(folder / "lock")
    os.mkfifo(folder / "output.txt")
    (found,) = processes.found(tmp_path)
    assert (found.alive, found.ended, found.message) == (False, "killed", "")
    shutil.rmtree(tmp_path / ".background")
    (tmp_path / ".background").symlink_to(target)
    with pytest.raises(RunError):
        processes._start(tmp_path, plan('name = "a"'), [], [], released)
    assert not target.exists()
    target.mkdir()
    with raises("runs.folder.link"):
        processes._start(tmp_path, plan('name = "a"'), [], [], released)
    assert list(target.iterdir()) == []


@contextmanager
def bystander(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program that has nothing to do with a folder of runs, with words in its command."""
    process = subprocess.Popen([sys.executable, "-c", "input()", *words], stdin=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("began", ["own", "another", None, 7, ""])
@pytest.mark.parametrize("words", [(), ("-m", "errormotion", "run", "--publish", "elsewhere"), ("--publish", "FOLDER")])
def test_a_forged_state_stops_no_other_program(tmp_path: Path, began: object, words: tuple[str, ...]) -> None:
    with living(tmp_path) as folder:
        named = [word.replace("FOLDER", str(folder.resolve())) for word in words]
        with bystander(*named) as process:
            start = signals.started(process.pid) if began == "own" else began
            forged = {"campaign": "a", "machine": "m", "started": "", "pid": process.pid, "began": start}
            (folder / "process.json").write_text(json.dumps(forged))
            with raises("process.record.unreadable"):
                processes.stop(tmp_path, NAME)
            assert process.poll() is None
        assert not (folder / "stop").exists()


@pytest.mark.parametrize("pid", [0, -1, -7, 1, True, 1.5, "1", None, [1], 1 << 31, 1 << 80])
def test_a_number_of_no_such_process_gets_no_signal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pid: object
) -> None:
    sent: list[object] = []
    for module, name in ((os, "kill"), (os, "killpg"), (signal, "pidfd_send_signal")):
        monkeypatch.setattr(module, name, lambda *values: sent.append(values), raising=False)
    with living(tmp_path) as folder:
        forged = {"campaign": "a", "machine": "m", "started": "", "pid": pid, "began": signals.started(1)}
        (folder / "process.json").write_text(json.dumps(forged))
        with raises("process.record.unreadable"):
            processes.stop(tmp_path, NAME)
    assert not sent


def test_the_process_of_the_folder_is_stopped_and_not_one_that_has_its_number_later(tmp_path: Path) -> None:
    with living(tmp_path) as folder:
        words = [*processes.COMMAND, "--publish", str(folder.resolve()), "campaign.toml"]
        with bystander(*words) as process:
            state = {"campaign": "a", "machine": "m", "started": "", "pid": process.pid}
            began = signals.started(process.pid)
            (folder / "process.json").write_text(json.dumps({**state, "began": f"{began[:-1]}x"}))
            with raises("process.record.unreadable"):
                processes.stop(tmp_path, NAME)
            (folder / "process.json").write_text(json.dumps({**state, "began": began}))
            processes.stop(tmp_path, NAME)
            assert process.wait(20) == -signal.SIGTERM


def test_the_command_of_a_started_process_is_the_one_that_a_stop_looks_for(
    tmp_path: Path, write: Callable[..., Path], lab: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = tmp_path / "waiting"
    waiting.write_text(f"#!{sys.executable}\nimport time\ntime.sleep(60)\n")
    waiting.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(waiting))
    runs = tmp_path / "runs"
    name = processes.start(write('name = "a"'), runs)
    processes.stop(runs, name)
    wait(lambda: not processes.found(runs)[0].alive)


@pytest.mark.parametrize("name", ["", "..", "../..", "20260101T000000Z-0000000g", "20260101T000000Z-00000001"])
def test_an_invalid_name_is_an_error(tmp_path: Path, name: str) -> None:
    with raises("process.not_found"):
        processes.stop(tmp_path, name)


@pytest.mark.parametrize(
    "text", ["", "[]", "{" * 10_000, '{"tests": 3, "request": {"number": "x"}, "done": "x"}', "\0"]
)
def test_the_valid_part_of_a_damaged_state_is_shown(tmp_path: Path, text: str) -> None:
    with living(tmp_path) as folder:
        (folder / "status.json").write_text(text)
        (found,) = processes.found(tmp_path)
        assert (found.alive, found.tests, found.request) == (True, {}, None)
        assert math.isnan(found.done)


def test_one_machine_is_measured_by_one_process(tmp_path: Path, write: Callable[..., Path], lab: None) -> None:
    campaign = write('name = "a"')
    with living(tmp_path / "runs"), raises("process.machine.used"):
        processes.start(campaign, tmp_path / "runs")


def test_the_folder_of_a_process_is_accessible_to_its_user_only(
    tmp_path: Path, write: Callable[..., Path], lab: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.executable", "/bin/false")
    name = processes.start(write('name = "a"'), tmp_path / "runs")
    root = tmp_path / "runs" / processes.FOLDER
    assert [stat.S_IMODE(path.stat().st_mode) for path in (root, root / name)] == [0o700, 0o700]
    wait(lambda: not processes.found(tmp_path / "runs")[0].alive)
    assert processes.found(tmp_path / "runs")[0].ended == "killed"


def test_the_command_line_starts_and_stops_as_the_dashboard_does(
    tmp_path: Path, write: Callable[..., Path], lab: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.executable", "/bin/false")
    campaign, runs = write('name = "a"'), tmp_path / "runs"
    found = CliRunner().invoke(app, ["run", str(campaign), "--detach", "--json"])
    assert json.loads(found.output)["process"] == processes.found(runs)[0].name
    wait(lambda: not processes.found(runs)[0].alive)
    found = CliRunner().invoke(app, ["background", "stop", str(runs)])
    assert (found.exit_code, "expected one process that runs; found none" in found.output) == (1, True)
    assert CliRunner().invoke(app, ["run", "--detach"]).exit_code == 2


def test_errors_so_far_and_the_older_of_two_broken_campaigns_continues(
    plan: Callable[..., CampaignPlan], tmp_path: Path
) -> None:
    (tmp_path / "broken").touch()
    for number in range(2):
        settings = f'settings = {{count = 5000, needs_file = "{tmp_path / "needed"}"}}'
        broken = plan(f'name = "a{number}"\n{settings}', bench=f'breaks = "{tmp_path / "broken"}"')
        with raises("instrument.other"):
            runner.run(broken)
    older, newer = list_runs(tmp_path / "runs")
    assert samples(older) == 1000
    with raises("method.other"):
        preliminary(older)
    (tmp_path / "needed").touch()
    assert preliminary(older).sizes["time"] == 2
    (tmp_path / "broken").unlink()
    found = CliRunner().invoke(app, ["run", "--resume", str(older.path), "--no-report"])
    assert found.exit_code == 0, found.output
    assert [RunFolder.open(each.path).data["status"] for each in (older, newer)] == ["finished", "failed"]
