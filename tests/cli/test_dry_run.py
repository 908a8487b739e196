"""A dry run states and draws the motions, and opens no instrument."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import CliRunner

from errormotion.cli.app import app

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for name in ("virtual_probing", "virtual_beam"):
        shutil.copytree(EXAMPLES / name, tmp_path / name)
    return tmp_path


def test_path_duration_and_limits_are_reported_and_drawn(folder: Path) -> None:
    result = CliRunner().invoke(app, ["run", "virtual_probing/monday.toml", "--dry-run", "--out", "pictures"])
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("monday: 3 h 0")
    assert "380 touches" in result.stdout  # 19 cycles of 5 touches of 4 balls
    assert "0.0 to 4000.0" in result.stdout
    assert result.stdout.endswith("Nothing has moved.\n")
    assert (folder / "pictures" / "monday-dry-run.png").read_bytes().startswith(b"\x89PNG")
    assert not (folder / "runs").exists()
    again = CliRunner().invoke(app, ["run", "virtual_probing/monday.toml", "--dry-run", "--out", "pictures"])
    assert again.exit_code == 1
    assert "already exists" in again.stderr


def test_the_json_output_has_the_same_content(folder: Path) -> None:
    result = CliRunner().invoke(app, ["run", "virtual_probing/monday.toml", "--dry-run", "--json"])
    motions = json.loads(result.stdout)["tests"][0]["motions"]
    assert motions["touches"] == 380
    assert motions["spindle_speed"] == 12000.0


def test_moves_without_feed_and_duration_are_counted(folder: Path) -> None:
    result = CliRunner().invoke(app, ["run", "virtual_beam/campaign.toml", "--dry-run", "--out", "pictures"])
    assert result.exit_code == 0, result.output
    assert "rapid in 366 moves" in result.stdout
    assert "366 steps of unknown duration" in result.stdout
    found = CliRunner().invoke(app, ["run", "virtual_beam/campaign.toml", "--dry-run", "--json"])
    motions = json.loads(found.stdout)["tests"][0]["motions"]
    assert (motions["rapid"], motions["untimed"], motions["seconds"]) == (366, 366, 0.0)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--dry-run"],
        ["virtual_beam", "--dry-run"],
        ["virtual_beam/campaign.toml", "--dry-run", "--resume"],
        ["virtual_beam/campaign.toml", "--out", "x"],
    ],
)
def test_contradictory_options_are_an_error(folder: Path, arguments: list[str]) -> None:
    result = CliRunner().invoke(app, ["run", *arguments])
    assert result.exit_code == 2
    assert not (folder / "runs").exists()
