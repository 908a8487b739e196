"""The command line in this process, and a small record to work on."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from command_line import CliRunner, Result

from errormotion import datasets
from errormotion.cli.app import app
from errormotion.methods.spindle_drift import simulation
from errormotion.twin import Event, VirtualMachine

Run = Callable[..., Result]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a command in an empty folder; ``code`` is the required exit code."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def call(*arguments: Any, code: int = 0) -> Result:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert result.exit_code == code, result.output
        return result

    return call


@pytest.fixture
def answer(run: Run) -> Callable[..., Any]:
    """Run a command with --json and return its output."""
    return lambda *arguments, code=0: json.loads(run(*arguments, "--json", code=code).stdout)


@pytest.fixture(scope="session")
def record() -> xr.Dataset:
    """Two minutes of a warming spindle."""
    machine = VirtualMachine("cframe", seed=1)
    machine.start([Event(0.0, 15000.0, None)])
    return simulation.raw_drift(machine, np.arange(0.25, 120.0, 0.5), beams="true", seed=1)


@pytest.fixture
def raw(record: xr.Dataset, tmp_path: Path) -> Path:
    """The record on disk."""
    return datasets.save(record, tmp_path / "raw.nc")
