"""`errormotion model check --report` and `errormotion report` of a monitor: pages from the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import CliRunner

from errormotion import datasets
from errormotion.cli.app import app
from errormotion.compensation.thermal_model import ThermalModelSettings, fit
from errormotion.twin import Event, VirtualMachine

pytestmark = pytest.mark.usefixtures("translated")

OFF = {"X": False, "Y": False, "Z": False}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A model of two warm-ups, and a third one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    machine, found = VirtualMachine("cframe", 5), []
    for early, late in ((6000.0, 12000.0), (15000.0, 4000.0), (10000.0, 14000.0)):
        machine.start((Event(0.0, early, OFF), Event(3600.0, late)))
        found.append(machine.truth_spindle(np.arange(0.0, 7201.0, 300.0)).load())
    fit(found[:2], ThermalModelSettings(variant="lagged", sensors=("spindle_front",), lags=())).save(tmp_path / "m.nc")
    datasets.save(found[2], tmp_path / "third.nc")
    return tmp_path


def run(*arguments: str):
    return CliRunner().invoke(app, list(arguments))


@pytest.mark.slow
def test_a_check_writes_its_page_and_prints_the_path(folder: Path) -> None:
    reported = run("model", "check", "m.nc", "third.nc", "--report", "page.html")
    assert reported.exit_code == 0, reported.output
    assert reported.stdout.splitlines()[-1] == "page.html"
    assert "Thermal model compared with measurement" in (folder / "page.html").read_text(encoding="utf-8")
    answer = json.loads(run("model", "check", "m.nc", "third.nc", "--report", "page.html", "--json").stdout)
    assert answer["report"] == "page.html"
    assert answer["removed"]["EZ"] > 0


def test_a_page_does_not_overwrite_another_file(folder: Path) -> None:
    reported = run("model", "check", "m.nc", "third.nc", "--report", "third.nc")
    assert reported.exit_code == 1
    assert "third.nc: expected a name that ends in .html" in reported.output


def test_without_the_option_there_is_no_page(folder: Path) -> None:
    assert run("model", "check", "m.nc", "third.nc").exit_code == 0
    assert not list(folder.glob("*.html"))


def test_a_page_of_a_monitor_is_written_on_request(folder: Path) -> None:
    address = "sim://cframe/t?seed=21&sensors=spindle_front,column"
    bench = f"""\
schema = "errormotion.bench/1"
name = "Shop"
machine = "Mill 5"
[instruments.modules]
driver = "dcon_temperature"
address = "{address}"
channels = ["spindle", "column"]
places = {{ spindle = ["0 mm", "0 mm", "400 mm"] }}
"""
    (folder / "bench.toml").write_text(bench)
    watched = run("monitor", "bench.toml", "--interval", "500 ms", "--duration", "2 s", "--json")
    assert watched.exit_code == 0, watched.output
    log = next((folder / "runs").glob("*monitor*"))
    reported = run("report", str(log), "--out", "log.html")
    assert reported.exit_code == 0, reported.output
    text = (folder / "log.html").read_text(encoding="utf-8")
    assert "Log of a monitor" in text
    assert "SIMULATED DATA" in text
    assert "0, 0, 400" in text
    assert run("report", str(log)).exit_code == 0
    assert json.loads((log / "run.json").read_text())["report"] == "report.html"
