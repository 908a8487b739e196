"""A process is killed, stopped and interrupted during an acquisition; another process continues the run."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.folder import RunFolder, list_runs
from errormotion.campaign.storage.store import committed_length
from errormotion.datasets.clock import joins
from errormotion.datasets.provenance import of

RATE = 1000
COUNT = 40_000
"""Samples of the run that is ended: 40 s of them, so that none is over before a slow machine ends it."""
Start = Callable[..., "subprocess.Popen[str]"]


def wait_for(tmp_path: Path, process: "subprocess.Popen[str]", samples: int) -> RunFolder:
    """Return the run folder once that many samples are on disk."""
    for _ in range(1200):
        for folder in list_runs(tmp_path / "runs"):
            if (folder.raw / "zarr.json").exists() and committed_length(folder.raw, "time") >= samples:
                return folder
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    raise AssertionError(f"{samples} samples did not come")


@pytest.fixture
def pace(tmp_path: Path) -> Path:
    """While this file exists, samples arrive in real time; a continued run reads the remaining ones at once."""
    file = tmp_path / "pace"
    file.touch()
    return file


@pytest.fixture
def bench(pace: Path) -> str:
    return f'real_time = "{pace}"\nrate = "1 kHz"\nblock = 50\n'


def held(folder: RunFolder) -> int:
    """Return the number of samples on disk, and check their values."""
    with datasets.load(folder.raw) as raw:
        count = int(raw.sizes["time"])
        np.testing.assert_array_equal(raw["distance"].values[0], np.arange(count) * 1e-6)
    return count


@pytest.mark.slow
@pytest.mark.timeout(300)  # two processes start: a minute each where six others want the processors
def test_kill_9_loses_at_most_the_last_second_and_resume_continues(
    tmp_path: Path, write: Callable[..., Path], command: Start, lab: None, pace: Path, bench: str
) -> None:
    long = f'name = "long"\nsettings = {{count = {COUNT}}}'
    campaign = write('name = "first"\nsettings = {count = 100}', long, bench=bench)
    process = command("run", campaign, "--no-report")
    folder = wait_for(tmp_path, process, 1500)
    before = committed_length(folder.raw, "time")
    time.sleep(1.0)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    pace.unlink()
    kept = held(folder)
    # a second later at most a second is missing: what was there a second before the end is there
    assert kept >= before
    assert kept >= before + 0.1 * RATE, "nothing came to the disk within a second"
    assert RunFolder.open(folder.path).data["status"] == "running"
    assert folder.data["test"] == "long"
    process = command("run", "--resume", "--runs", tmp_path / "runs", "--no-report", "--json")
    out, err = process.communicate(timeout=100)
    assert process.returncode == 0, err
    found = json.loads(out)
    assert [test["status"] for test in found["tests"]] == ["finished", "finished"]
    assert found["tests"][1]["folder"] == str(folder.path)
    assert held(folder) == COUNT
    assert of(datasets.load(Path(found["tests"][1]["errors"])))["settings"]["count"] == COUNT
    starts = [step["samples"] for step in RunFolder.open(folder.path).data["steps"] if step["outcome"] == "started"]
    assert starts == [0, kept]
    with datasets.load(folder.raw) as raw:
        (join,) = joins(raw.attrs)
    assert join.index == kept
    assert join.seconds is not None
    assert join.seconds > 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_has_a_complete_folder_and_can_be_resumed(
    tmp_path: Path,
    write: Callable[..., Path],
    command: Start,
    lab: None,
    pace: Path,
    bench: str,
    number: signal.Signals,
) -> None:
    process = command("run", write(f'name = "long"\nsettings = {{count = {COUNT}}}', bench=bench))
    folder = wait_for(tmp_path, process, 700)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    pace.unlink()
    assert process.returncode == 130
    assert "Interrupted" in err
    assert "Traceback" not in err
    folder = RunFolder.open(folder.path)
    assert folder.data["status"] == "interrupted"
    assert folder.data["samples"]["count"] == held(folder) >= 700
    (folder,) = runner.resume(runs=tmp_path / "runs")
    assert folder.finished
    assert held(folder) == COUNT
