"""Tolerances of a campaign: decided by ``run``, ``report`` and ``runs``, with exit codes for scripts."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import CliRunner, Result
from undrawn import undrawn  # noqa: F401 - a fixture

from errormotion.campaign import runner
from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.cli.app import app
from errormotion.errors import BenchError, RunError

pytestmark = pytest.mark.usefixtures("undrawn")

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
    found = call("run", write(TEST.format(limit)), "--no-report", code=code).stdout
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
    call("run", write(TEST.format("11 um")), "--tolerances", strict, "--no-report", "--json", code=4)
    ((path),) = (tmp_path / "runs").glob("2*")
    assert "nonconformity proved" in call("runs", tmp_path / "runs").stdout
    strict.write_text(strict.read_text().replace("1 um", "1 mm"))
    assert "conformity proved" in call("report", path, "--tolerances", strict).stdout
    assert RunFolder.open(path).data["conformity"]["decision"] == 1
    call("report", RunFolder.open(path).errors, "--tolerances", strict, "--out", tmp_path / "page.html")
    call("run", "--resume", "--tolerances", strict, code=2)


def test_an_unused_limit_is_reported(lab: None, write: Callable[..., Path]) -> None:
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
    assert "Tolerances" not in call("run", write('name = "a"'), "--no-report").stdout
    (run,) = json.loads(call("runs", tmp_path / "runs", "--json").stdout)["runs"]
    assert run["verdict"] == ""


def limits(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "limits.toml"
    file.write_text(f'schema = "errormotion.tolerances/1"\n[tolerances]\n{text}\n')
    return file


CASES = [
    ('freedoms = { EX = "10.1 um" }', "neither proved", 5),
    ('rule = "simple"\nfreedoms = { EX = "10.1 um" }', "within limits", 0),
    ('rule = "simple"\nfreedoms = { EX = "9.9 um" }', "outside limits", 4),
    ('rule = "shared risk"\nfreedoms = { EX = "10.1 um" }', "within limits", 0),
    ('rule = "shared risk"\nlargest_ratio = 0.01\nfreedoms = { EX = "10.1 um" }', "not decided", 5),
    ('figures = { "EX after*" = "9 um" }', "nonconformity proved", 4),
    ('figures = { "EX after*" = "9 um", "d(Z)" = "1 um" }', "nonconformity proved", 4),
    ('figures = { "EX after*" = "11 um", "d(Z)" = "1 um" }', "conformity proved", 5),
]


def test_identify_and_runs_apply_a_file_of_limits(lab: None, write: Callable[..., Path], tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    call("run", write('name = "a"\nsettings = { count = 11 }\n'), "--no-report")
    (path,) = runs.glob("2*")
    before = (path / "run.json").read_bytes()
    for number, (text, verdict, code) in enumerate(CASES):
        file = limits(tmp_path, text)
        single = ["identify", path, "--out", tmp_path / f"{number}.nc", "--tolerances", file]
        assert f"Tolerances: {verdict}" in call(*single, code=code).stdout.splitlines()[1]
        (run,) = json.loads(call("runs", runs, "--tolerances", file, "--json", code=code).stdout)["runs"]
        assert (run["verdict"], run["conformity"]["verdict"]) == (verdict, verdict)
    assert verdict in call("runs", runs, "--tolerances", file, code=code).stdout
    assert (path / "run.json").read_bytes() == before
    (run,) = json.loads(call("runs", runs, "--json").stdout)["runs"]
    assert run["verdict"] == ""


def test_each_of_many_results_is_decided(lab: None, write: Callable[..., Path], tmp_path: Path) -> None:
    call("run", write('name = "a"\nsettings = { count = 11 }\n'), "--no-report")
    several = ["identify", tmp_path / "runs", "--method", "ramp", "--out", tmp_path / "all", "--scheduler", "sync"]
    for text, verdict, code in CASES[:3]:
        several_with = [*several, "--tolerances", limits(tmp_path, text)]
        (run,) = json.loads(call(*several_with, "--json", code=code).stdout)["runs"]
        assert run["conformity"]["verdict"] == verdict
        assert f"Tolerances: {verdict}" in call(*several_with, code=code).stdout


def test_runs_without_decision_are_reported(lab: None, write: Callable[..., Path], tmp_path: Path) -> None:
    call("run", write('name = "a"\nsettings = { count = 11 }\n'), "--no-report")
    (path,) = (tmp_path / "runs").glob("2*")
    next(path.glob("errors/*/errors.nc")).write_bytes(b"damaged")
    file = limits(tmp_path, 'freedoms = { EX = "11 um" }')
    assert "not decided: " in call("runs", tmp_path / "runs", "--tolerances", file, code=5).stdout
    assert "mistake" in call("runs", tmp_path / "runs", "--tolerances", limits(tmp_path, ""), code=1).stderr
