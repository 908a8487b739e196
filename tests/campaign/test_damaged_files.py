"""Damaged bench and campaign files: every mutant is read, or an error of the project is raised, in bounded time."""

import json
from pathlib import Path

import mutants
import pytest
from coded import raises

from errormotion.campaign.files import load_bench, load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.errors import RunError

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize("name", ["virtual_cframe", "virtual_tracker", "virtual_gantry", "virtual_probing"])
def test_damaged_benches(tmp_path: Path, name: str) -> None:
    def read(data: bytes) -> None:
        (tmp_path / "bench.toml").write_bytes(data)
        load_bench(tmp_path / "bench.toml")

    refused = mutants.check(read, (EXAMPLES / name / "bench.toml").read_bytes(), seed=1, number=mutants.count(100))
    assert refused > 20


@pytest.mark.parametrize("name", ["virtual_cframe", "virtual_tracker", "virtual_gantry"])
def test_damaged_campaigns(tmp_path: Path, name: str) -> None:
    (tmp_path / "bench.toml").write_bytes((EXAMPLES / name / "bench.toml").read_bytes())

    def read(data: bytes) -> None:
        (tmp_path / "campaign.toml").write_bytes(data)
        load_campaign(tmp_path / "campaign.toml")

    refused = mutants.check(read, (EXAMPLES / name / "campaign.toml").read_bytes(), seed=2, number=mutants.count(100))
    assert refused > 20


def test_a_run_json_that_is_nested_too_deep_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"schema": "errormotion.run/1", "a": ' + "[" * 5000)
    with raises("run.file.no_json"):
        RunFolder.open(tmp_path)


@pytest.mark.parametrize(
    "event", [{"time": [1]}, {"time": "1"}, {"time": -1}, {}, {"time": 1, "speed": 1}, {"time": 1, "spindle_speed": []}]
)
def test_an_invalid_schedule_is_named(tmp_path: Path, event: dict[str, object]) -> None:
    content = {"schema": "errormotion.run/1", "clock": {"start": "", "time": 0, "schedule": [event]}}
    (tmp_path / "run.json").write_text(json.dumps(content))
    with pytest.raises(RunError, match=r"run\.json: [\s\S]*clock\.schedule"):
        RunFolder.open(tmp_path)
