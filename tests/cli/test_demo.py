"""A short demonstration: beams and two minutes of drift, compared with the truth."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import Result
from short_demonstration import measure

from errormotion.campaign.folder import RunFolder
from errormotion.cli.demo import spindle as demonstration
from errormotion.report.document import estimate

pytestmark = pytest.mark.slow  # all use one run of the campaign


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[RunFolder]]:
    """Run the short campaign once; return the campaign and its run folders."""
    return measure(tmp_path_factory.mktemp("demo"))


@pytest.fixture
def short_campaign(measured: tuple[Path, list[RunFolder]], monkeypatch: pytest.MonkeyPatch) -> None:
    campaign, folders = measured
    run = demonstration.run
    monkeypatch.setattr(demonstration, "run", lambda runs, as_json: run(runs, as_json, campaign))
    monkeypatch.setattr(demonstration, "work", lambda *_, **__: folders)


@pytest.mark.usefixtures("short_campaign")
def test_the_demo_prints_results_and_true_values(run: Callable[..., Result], tmp_path: Path) -> None:
    found = json.loads(run("demo", "--json").stdout)
    assert [test["status"] for test in found["tests"]] == ["finished", "finished", "finished"]
    for test in found["tests"]:
        assert "<html" in (tmp_path / test["report"]).read_text()
    assert [pair["pair"] for pair in found["comparison"]["pairs"]] == [
        "drift - balls",
        "drift - truth",
        "balls - truth",
    ]
    assert all(pair["p"] > 1e-3 for pair in found["comparison"]["pairs"])
    numbers = {number["name"]: number for number in found["numbers"]}
    step = numbers["EZ step, compensation of Z switched off"]
    # a cold machine has nothing to compensate yet: the step is small, and its stated uncertainty holds (k = 4)
    assert abs(step["measured"] - step["truth"]) < 2 * step["expanded_uncertainty"]
    found_beams = numbers["beam detection: directions off by (rms)"]["measured"]
    assert found_beams < numbers["nominal beams: directions off by (rms)"]["measured"]


@pytest.mark.usefixtures("short_campaign")
def test_the_table_and_the_report_state_the_same_step(run: Callable[..., Result], tmp_path: Path) -> None:
    found = json.loads(run("demo", "--json").stdout)
    [report] = [tmp_path / test["report"] for test in found["tests"] if "-drift-" in test["report"]]
    [step] = [number for number in found["numbers"] if number["name"].startswith("EZ step")]
    stated = estimate(step["measured"], step["expanded_uncertainty"])
    assert f"Z at the functional point stepped by {stated.text} ± {stated.uncertainty} µm" in report.read_text()


@pytest.mark.usefixtures("short_campaign")
def test_the_demo_prints_the_path_of_the_report(run: Callable[..., Result]) -> None:
    text = run("demo").stdout
    assert ["measured", "U", "(k=2)", "truth"] in [line.split() for line in text.splitlines()]
    assert "Do the five sensors and the probing of four balls agree?" in text
    assert "report on drift: " in text
