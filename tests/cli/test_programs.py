"""``errormotion program``."""

from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import Result

ROOT = Path(__file__).parents[2]
GANTRY = ROOT / "examples" / "virtual_gantry" / "campaign.toml"
CFRAME = ROOT / "examples" / "virtual_cframe" / "campaign.toml"


def test_programs_of_every_test_are_written_each_in_its_folder(run, answer, tmp_path):
    said = answer("program", GANTRY, "--out", tmp_path / "nc")
    files = sorted(path.relative_to(tmp_path).as_posix() for path in (tmp_path / "nc").rglob("*.nc"))
    assert files == [
        *(f"nc/pose/pocket_{k}.nc" for k in (1, 2)),
        "nc/scan/pass.nc",
        *(f"nc/scan/warm_up_{k}.nc" for k in range(1, 5)),
    ]
    assert sorted(Path(row["file"]).relative_to(tmp_path).as_posix() for row in said["programs"]) == files
    text = (tmp_path / "nc" / "scan" / "pass.nc").read_bytes()
    assert text.startswith(b"%\r\n(pass.nc: measuring pass over 4 artefacts)\r\n")


def test_a_single_test_is_written_into_the_folder_itself(run, tmp_path):
    shown = run("program", GANTRY, "--test", "pose", "--out", tmp_path)
    assert "spindle 182 mm above where it was cut" in shown.stdout
    assert shown.stderr.startswith("pose: the machine will move: ")
    assert shown.stderr.count("\n") == 1
    assert (tmp_path / "pocket_2.nc").exists()


def test_no_file_is_replaced(run, tmp_path):
    (tmp_path / "pocket_2.nc").write_text("mine")
    found = run("program", GANTRY, "--test", "pose", "--out", tmp_path, code=1)
    assert "pocket_2.nc already exists" in found.stderr
    assert (tmp_path / "pocket_2.nc").read_text() == "mine"
    assert not (tmp_path / "pocket_1.nc").exists()


def test_methods_without_programs_are_refused(run, tmp_path):
    found = run("program", CFRAME, "--out", tmp_path, code=1)
    assert "spindle_drift has no NC programs" in found.stderr


def test_an_unknown_test_is_reported_with_the_available_ones(run, tmp_path):
    assert (
        "expected one of the tests pose, scan; found 'scans'"
        in run("program", GANTRY, "--test", "scans", "--out", tmp_path, code=1).stderr
    )


def test_a_program_out_of_travel_writes_nothing(run, tmp_path):
    for name in ("bench.toml", "campaign.toml"):
        text = (GANTRY.parent / name).read_text().replace('travel.Y = ["-900 mm"', 'travel.Y = ["-620 mm"')
        (tmp_path / name).write_text(text)
    found = run("program", tmp_path / "campaign.toml", "--out", tmp_path / "nc", code=1)
    assert "would move from Y-633.000" in found.stderr
    assert not (tmp_path / "nc").exists()


def test_programs_of_probing_know_the_tip_of_the_bench(run: Callable[..., Result], tmp_path: Path) -> None:
    source = Path(__file__).parents[2] / "examples" / "virtual_probing"
    bench, campaign = ((source / name).read_text() for name in ("bench.toml", "monday.toml"))
    targets = []
    for radius in ("3 mm", "2 mm"):
        (tmp_path / "bench.toml").write_text(bench.replace('tip_radius = "3 mm"', f'tip_radius = "{radius}"'))
        (tmp_path / "campaign.toml").write_text(campaign)
        run("program", "campaign.toml", "--out", radius)
        lines = (tmp_path / radius / "cycle.nc").read_text().splitlines()
        targets.append(next(line for line in lines if line.startswith("G31")))
    first, second = (float(line.split()[1].removeprefix("X")) for line in targets)
    assert first - second == pytest.approx(1.0)  # mm: touched from +X
