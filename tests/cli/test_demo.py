"""The demo in small: beams and two minutes of drift through the wire, beside the truth."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

from errormotion.cli.demo import spindle as demonstration

SHORTER = {
    'procedure = "beam_detection"': 'procedure = "beam_detection"\nsteps = 21\nscan_length = "1.6 mm"',
    '"104 min"': '"130 s"',
    '"101 min"': '"60 s"',
    '"102 min"': '"90 s"',
}


@pytest.fixture
def short_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = demonstration.CAMPAIGN.read_text()
    for long, short in SHORTER.items():
        assert long in text
        text = text.replace(long, short)
    (tmp_path / "campaign.toml").write_text(text)
    (tmp_path / "bench.toml").write_text((demonstration.CAMPAIGN.parent / "bench.toml").read_text())
    run = demonstration.run
    monkeypatch.setattr(demonstration, "run", lambda runs, as_json: run(runs, as_json, tmp_path / "campaign.toml"))


@pytest.mark.usefixtures("short_campaign")
def test_demo_prints_numbers_beside_the_truth(run: Callable[..., Result], tmp_path: Path) -> None:
    found = json.loads(run("demo", "--json").stdout)
    assert [test["status"] for test in found["tests"]] == ["finished", "finished"]
    for test in found["tests"]:
        assert "<html" in (tmp_path / test["report"]).read_text()
    numbers = {number["name"]: number for number in found["numbers"]}
    step = numbers["EZ step, compensation of Z switched off"]
    # a cold machine has nothing to compensate yet: the step is small, and its stated uncertainty holds (k = 4)
    assert abs(step["measured"] - step["truth"]) < 2 * step["expanded_uncertainty"]
    found_beams = numbers["beam detection: directions off by (rms)"]["measured"]
    assert found_beams < numbers["nominal beams: directions off by (rms)"]["measured"]


@pytest.mark.usefixtures("short_campaign")
def test_demo_says_where_the_report_is(run: Callable[..., Result]) -> None:
    text = run("demo").stdout
    assert ["measured", "U", "(k=2)", "truth"] in [line.split() for line in text.splitlines()]
    assert "report on drift: runs/" in text
