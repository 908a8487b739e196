"""`errormotion model`: from files to a model, to a prediction, to a check."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import CliRunner

from errormotion import datasets
from errormotion.cli.app import app
from errormotion.twin import Event, VirtualMachine

OFF = {"X": False, "Y": False, "Z": False}
SPEEDS = ((6000.0, 12000.0), (15000.0, 4000.0), (10000.0, 14000.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three warm-ups of a machine, with the exact errors of the virtual machine."""
    path = tmp_path_factory.mktemp("warm")
    machine = VirtualMachine("cframe", 5)
    for number, (early, late) in enumerate(SPEEDS):
        machine.start((Event(0.0, early, OFF), Event(3600.0, late)))
        datasets.save(machine.truth_spindle(np.arange(0.0, 7201.0, 300.0)), path / f"{number}.nc")
    return path


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return lambda *arguments: CliRunner().invoke(app, ["model", *map(str, arguments)])


def test_a_model_is_made_used_and_checked(run, folder: Path) -> None:
    few = ("--set", "variant=lagged", "--set", 'lags=["10 min"]')
    made = run("fit", folder / "0.nc", folder / "1.nc", "-o", "m.nc", *few)
    assert made.exit_code == 0, made.output
    assert "m.nc: lagged model of spindle from 2 campaigns" in made.stdout
    predicted = run("predict", "m.nc", folder / "2.nc", "-o", "p.nc")
    assert predicted.stdout.startswith("p.nc: errors of spindle at 25 times by thermal_model")
    assert datasets.load("p.nc").attrs["method"] == "thermal_model"
    reported = run("check", "m.nc", folder / "2.nc", "--json")
    answer = json.loads(reported.stdout)
    assert answer["removed"]["EZ"] > 0.9
    assert "removed/%" in run("check", "m.nc", folder / "2.nc").stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fit", "{0}/0.nc", "-o", "m.txt"), "m.txt: expected a name that ends in .nc"),
        (("fit", "{0}/0.nc", "-o", "{0}/1.nc"), "already exists"),
        (("fit", "{0}/0.nc", "-o", "m.nc", "--set", "variant=nice"), "variant"),
        (("fit", "{0}/0.nc", "-o", "m.nc", "--set", "lags=[5]"), "expected a time with its unit"),
        (("check", "{0}/0.nc", "{0}/1.nc"), "expected schema errormotion.model.thermal/1"),
    ],
)
def test_impossible_requests_are_reported(run, folder: Path, arguments: tuple[str, ...], message: str) -> None:
    result = run(*(text.format(folder) for text in arguments))
    assert result.exit_code == 1
    assert message in result.stderr
