"""Tolerances of a campaign: decided by ``run``, ``report`` and ``runs``, with exit codes for scripts."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from errormotion.campaign import runner
from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.cli.app import app
from errormotion.errors import BenchError, RunError

TEST = 'name = "a"\nsettings = {{ count = 11 }}\n[tolerances]\nfreedoms = {{ EX = "{}" }}\n'
"""The last of 11 samples is EX = 10 um with U = 0.2 um."""


def call(*arguments: Any, code: int = 0) -> Result:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    return result


@pytest.mark.parametrize(
    ("limit", "verdict", "code"),
    [("11 um", "conformity proved", 0), ("9 um", "nonconformity proved", 4), ("10.1 um", "neither proved", 5)],
)
def test_run_report_and_runs_state_the_decision(
    lab: None, write: Callable[..., Path], tmp_path: Path, limit: str, verdict: str, code: int
) -> None:
    found = call("run", write(TEST.format(limit)), code=code).stdout
    assert found.splitlines()[2].startswith(f"  Tolerances: {verdict} (ISO 14253-1, guard band 1 U (k = 2))")
    (run,) = json.loads(call("runs", tmp_path / "runs", "--json").stdout)["runs"]
    assert run["verdict"] == verdict
    assert run["figures"][0]["value"] == pytest.approx(10.0)
    answer = json.loads(call("report", run["folder"], "--json", code=code).stdout)
    assert answer["conformity"]["verdict"] == verdict
    assert answer["conformity"]["limits"][0]["guard"] == pytest.approx(2e-7)
    assert f"Tolerances: {verdict}" in (Path(run["folder"]) / "report.html").read_text()


def test_a_file_of_limits_replaces_those_of_the_campaign(lab: None, write: Callable[..., Path], tmp_path: Path) -> None:
    strict = tmp_path / "strict.toml"
    strict.write_text('schema = "errormotion.tolerances/1"\n[tolerances]\nfreedoms = { EX = "1 um" }\n')
    assert "valid" in call("validate", strict).stdout
    call("run", write(TEST.format("11 um")), "--tolerances", strict, "--json", code=4)
    ((path),) = (tmp_path / "runs").glob("2*")
    assert "nonconformity proved" in call("runs", tmp_path / "runs").stdout
    strict.write_text(strict.read_text().replace("1 um", "1 mm"))
    assert "conformity proved" in call("report", path, "--tolerances", strict).stdout
    assert RunFolder.open(path).data["conformity"]["decision"] == 1
    call("report", RunFolder.open(path).errors, "--tolerances", strict, "--out", tmp_path / "page.html")
    call("run", "--resume", "--tolerances", strict, code=2)


def test_a_limit_that_applies_to_nothing_is_reported(lab: None, write: Callable[..., Path]) -> None:
    campaign = write('name = "a"\n[tolerances]\nfigures = { "d(Z)*" = "1 um" }\nfreedoms = { EX = "1 m" }\n')
    found = call("run", campaign, "--no-report", code=5).stdout
    assert "the limit 'd(Z)*' applies to no figure and no freedom" in found


def test_mistakes_are_reported_with_their_keys(lab: None, write: Callable[..., Path]) -> None:
    with pytest.raises(BenchError, match=r"campaign\.toml: 1 mistake\n  - tolerances\.freedoms\.EX: expected a limit"):
        load_campaign(write(TEST.format("10 bananas")))


def test_a_resumed_run_keeps_its_limits(plan: Callable[..., CampaignPlan], tmp_path: Path) -> None:
    needed = tmp_path / "needed"
    settings = f'settings = {{ count = 11, needs_file = "{needed}" }}'
    test = f'name = "a"\n{settings}\n[tolerances]\nfreedoms = {{ EX = "9 um" }}\n'
    with pytest.raises(RunError):
        runner.run(plan(test))
    needed.touch()
    (folder,) = runner.resume(runs=tmp_path / "runs")
    assert folder.data["conformity"]["verdict"] == "nonconformity proved"


def test_without_tolerances_nothing_is_decided(lab: None, write: Callable[..., Path], tmp_path: Path) -> None:
    assert "Tolerances" not in call("run", write('name = "a"')).stdout
    (run,) = json.loads(call("runs", tmp_path / "runs", "--json").stdout)["runs"]
    assert run["verdict"] == ""
