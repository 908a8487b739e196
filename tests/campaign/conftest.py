"""A laboratory with its own plugins, and files that use them."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from errormotion import plugins
from errormotion.campaign.files import CampaignPlan, load_campaign

LAB = Path(__file__).parent / "lab"

BENCH = """\
schema = "errormotion.bench/1"
name = "Table"
machine = "lab machine"
[instruments.counter]
driver = "counter"
address = "sim://counter"
"""

CAMPAIGN = """\
schema = "errormotion.campaign/1"
name = "Ramps"
bench = "bench.toml"
runs = "{runs}"
"""


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """The lab's plugins are installed."""
    monkeypatch.syspath_prepend(str(LAB))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    plugins.refresh()
    yield
    plugins.refresh()


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write a bench and a campaign; each test is a TOML table."""

    def files(*tests: str, bench: str = "") -> Path:
        (tmp_path / "bench.toml").write_text(BENCH + bench)
        campaign = tmp_path / "campaign.toml"
        head = CAMPAIGN.format(runs=tmp_path / "runs")
        campaign.write_text(head + "".join(f'[[test]]\nmethod = "ramp"\n{test}\n' for test in tests))
        return campaign

    return files


@pytest.fixture
def plan(lab: None, write: Callable[..., Path]) -> Callable[..., CampaignPlan]:
    """Write and read a bench and a campaign."""
    return lambda *tests, **keywords: load_campaign(write(*tests, **keywords))


@pytest.fixture
def command(tmp_path: Path) -> Callable[..., "subprocess.Popen[str]"]:
    """Start the command line in a separate process, with the plugins of the laboratory."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: Any) -> "subprocess.Popen[str]":
        environment = os.environ | {"PYTHONPATH": str(LAB), "XDG_STATE_HOME": str(tmp_path / "state")}
        process = subprocess.Popen(
            [sys.executable, "-m", "errormotion", *map(str, arguments)],
            cwd=tmp_path,
            env=environment,
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        started.append(process)
        return process

    yield start  # type: ignore[misc]
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()
