"""``errormotion compensate program``, from errors to the new program and its page."""

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

PROGRAM = """%
N10 G21 G90 G17 G54
N20 G0 X0 Y0
N30 G0 Z5
N40 G1 Z0 F200
N50 X150 Y100 (side)
N60 G2 X150 Y20 J-40
M2
%
"""


@pytest.fixture(scope="session")
def volume(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return true errors of a virtual machine at targets."""
    points = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 5), np.linspace(-0.15, 0.15, 5), [0.05, 0.2, 0.4]), -1)
    path = tmp_path_factory.mktemp("errors") / "volume.nc"
    datasets.save(VirtualMachine("cframe", seed=3).volumetric_truth(points.reshape(-1, 3)), path)
    return path


@pytest.fixture
def part(tmp_path: Path) -> Path:
    path = tmp_path / "part.ngc"
    path.write_text(PROGRAM)
    return path


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["compensate", "program", *map(str, arguments)])
    return done.exit_code, done.output


def test_writes_a_program_and_a_page(part: Path, volume: Path) -> None:
    page = part.with_suffix(".html")
    code, text = run(part, "--with", volume, "--offset", "G54=0,0,100", "--report", page, "--json")
    assert code == 0, text
    found = json.loads(text)
    new = Path(found["program"])
    assert new == part.with_name("part.corrected.ngc")
    assert found["read"] == 9
    assert found["written"] + 5 == len(new.read_text().splitlines())  # with the comments at its head
    assert found["left"] == {"unknown": {"number": 1, "first_line": 3}}
    assert found["largest"] > 1e-6
    assert found["uncertainty"] > 0
    shown = page.read_text(encoding="utf-8")
    assert "Corrected program part.ngc" in shown
    assert shown.count("<svg") == 2


def test_the_result_is_printed(part: Path, volume: Path) -> None:
    code, text = run(part, "--with", volume, "--offset", "G54=0,0,100")
    assert code == 0, text
    for words in ("largest correction", "k = 2", "not corrected: 1 rapid moves", "in line 3"):
        assert words in text


def test_what_is_read_otherwise_than_it_looks_or_is_not_corrected_is_stated(part: Path, volume: Path) -> None:
    tools = part.with_name("tool.tbl")
    tools.write_text("T1 P1 Z50\nT1 P2 Z60\nT2P2Z3\n")
    part.write_text(PROGRAM.replace("M2\n", "M2\nG1 X5\n"))
    arguments = (part, "--with", volume, "--offset", "G54=0,0,100", "--tools", tools)
    code, text = run(*arguments)
    assert code == 0, text
    assert "not corrected: 1 lines after the end of the program, the first is line 9" in text
    assert "note: tool.tbl, line 2: not used, because line 1 states tool 1, as in LinuxCNC" in text
    code, text = run(*arguments, "--json", "--out", part.with_name("other.ngc"))
    found = json.loads(text)
    assert found["after_end"] == {"number": 1, "first_line": 9}
    assert any("LinuxCNC reads 'T2P2Z3' as T2" in note for note in found["notes"])


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ((), "part.ngc: "),
        ((), "G54 is unknown"),
        (("--offset", "G60=0,0,0"), "G60"),
        (("--offset", "G54=0,0,0", "--tolerance", "1"), "--tolerance"),
        (("--offset", "G54=0,0,0", "--unit", "km"), "--unit km"),
        (("--offset", "G54=0,0,0", "--reader", "fast"), "reader 'fast'"),
        (("--offset", "G54=0,0,0", "--report", "page.txt"), ".html"),
        (("--offset", "G54=0,0,0", "--block-delete", "maybe"), "--block-delete maybe"),
    ],
)
def test_an_impossible_request_is_an_error_and_nothing_is_written(
    part: Path, volume: Path, options: tuple[str, ...], why: str
) -> None:
    code, text = run(part, "--with", volume, *options)
    assert code == 1
    assert why in text
    assert [path.name for path in part.parent.iterdir()] == ["part.ngc"]


def test_an_existing_program_is_not_replaced(part: Path, volume: Path) -> None:
    code, text = run(part, "--with", volume, "--offset", "G54=0,0,0", "--out", part)
    assert code == 1
    assert "already exists" in text
    assert part.read_text() == PROGRAM


def test_a_thermal_model_requires_temperatures_and_uses_the_last(part: Path, tmp_path: Path) -> None:
    machine = VirtualMachine("cframe", 3)
    off = {"X": False, "Y": False, "Z": False}
    days = []
    for speeds in ((6000.0, 12000.0), (15000.0, 3000.0)):
        machine.start((Event(0.0, speeds[0], off), Event(3600.0, speeds[1])))
        days.append(machine.truth_spindle(np.arange(0.0, 7201.0, 900.0)).load())
    sensor = str(days[0]["sensor"].values[0])
    fit(days, ThermalModelSettings(variant="lagged", sensors=(sensor,), lags=(900.0,))).save(tmp_path / "model.nc")
    datasets.save(days[0], tmp_path / "log.nc")
    code, text = run(part, "--with", tmp_path / "model.nc", "--offset", "G54=0,0,100")
    assert code == 1
    assert "--temperatures" in text
    arguments = (part, "--with", tmp_path / "model.nc", "--temperatures", tmp_path / "log.nc", "--json")
    code, text = run(*arguments, "--offset", "G54=0,0,100")
    assert code == 0, text
    assert json.loads(text)["time"] == 7200.0
