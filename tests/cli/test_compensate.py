"""`errormotion compensate`: from errors to the table of a control."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import CliRunner

from errormotion import datasets
from errormotion.cli.app import app
from errormotion.twin import Event, VirtualMachine


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Errors of an axis, of a volume and of a spindle."""
    path = tmp_path_factory.mktemp("errors")
    machine = VirtualMachine("cframe", 5)
    y = np.linspace(-0.25, 0.25, 21)
    datasets.save(machine.truth_axis("Y", y), path / "y.nc")
    nodes = np.stack(np.meshgrid([-0.3, 0.0, 0.3], y[::5], [0.0, 0.2, 0.4], indexing="ij"), axis=-1).reshape(-1, 3)
    datasets.save(machine.volumetric_truth(nodes), path / "volume.nc")
    machine.start((Event(0.0, 9000.0),))
    datasets.save(machine.truth_spindle(np.arange(0.0, 601.0, 60.0)), path / "spindle.nc")
    return path


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return lambda *arguments: CliRunner().invoke(app, ["compensate", "table", *map(str, arguments)])


def test_a_table_is_written_and_its_errors_are_printed(run, folder: Path) -> None:
    made = run(folder / "y.nc", "--for", "siemens", "--axis", "Y", "--step", "25mm", "--set", "machine_axis=MY1")
    assert made.exit_code == 0, made.output
    assert "C-frame-610-Y.INI\n  Siemens SINUMERIK, $AA_ENC_COMP or $AN_CEC: 21 points" in made.stdout
    assert "rounding in the file: 0.00" in made.stdout
    assert "format from: Siemens, Function Manual" in made.stdout
    text = Path("C-frame-610-Y.INI").read_text()
    assert "$AA_ENC_COMP_STEP[0,MY1]=25.000000" in text
    assert "run: y.nc" in text


def test_json_has_files_and_figures(run, folder: Path) -> None:
    reported = run(
        folder / "volume.nc", "--for", "linuxcnc", "--axis", "y", "--step", "0.1 m", "--at", "-100,0,300",
        "--functional-point", "0,0,-150", "-o", "tables", "--json",
    )  # fmt: skip
    answer = json.loads(reported.stdout)
    assert answer["ok"] is True
    assert answer["files"] == ["tables/C-frame-610-Y.comp"]
    assert Path(answer["files"][0]).exists()
    assert answer["points"] == 5
    assert answer["uncertainty"] is None or answer["uncertainty"] >= 0
    assert answer["interpolation"] >= answer["rounding"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("y.nc", "--for", "fagor", "--axis", "Y"), "Unknown table format 'fagor'; available: fanuc, generic"),
        (("y.nc", "--for", "siemen", "--axis", "Y"), "Did you mean 'siemens'"),
        (("y.nc", "--for", "generic", "--axis", "Q"), "axis: expected X, Y or Z; found 'Q'"),
        (("y.nc", "--for", "generic", "--axis", "X"), "y.nc: The errors have no positions of X"),
        (("y.nc", "--for", "generic", "--axis", "Y", "--step", "25"), "--step 25: expected a length with its unit"),
        (("y.nc", "--for", "generic", "--axis", "Y", "--step", "-5mm"), "a length above 0"),
        (("y.nc", "--for", "generic", "--axis", "Y", "--chain", "bed-X"), "expected a chain"),
        (("y.nc", "--for", "fanuc", "--axis", "Y", "--set", "axis_number=99"), "axis_number"),
        (("y.nc", "--for", "siemens", "--axis", "Y", "--set", "machine_axis=Y1]=9"), "machine_axis"),
        (("y.nc", "--for", "linuxcnc", "--axis", "Y", "--component", "Z"), "no table of Z over Y"),
        (("spindle.nc", "--for", "generic", "--axis", "Z"), "no positions of Z"),
        (("missing.nc", "--for", "generic", "--axis", "Y"), "missing.nc"),
    ],
)
def test_errors_without_table_are_reported_and_nothing_is_written(
    run, folder: Path, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    reported = run(folder / arguments[0], *arguments[1:], "--out", "tables")
    assert reported.exit_code == 1, reported.output
    assert message in reported.stderr
    assert not Path("tables").exists()


def test_invalid_positions_are_usage_errors(run, folder: Path) -> None:
    reported = run(folder / "y.nc", "--for", "generic", "--axis", "Y", "--at", "1,2")
    assert reported.exit_code == 2
    assert "--at 1,2: expected three numbers in mm" in reported.stderr


def test_a_file_that_exists_is_kept(run, folder: Path) -> None:
    arguments = (folder / "y.nc", "--for", "generic", "--axis", "Y")
    assert run(*arguments).exit_code == 0
    reported = run(*arguments)
    assert reported.exit_code == 1
    assert "C-frame-610-Y.csv already exists" in reported.stderr
