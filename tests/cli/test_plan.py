"""``errormotion plan``."""

from pathlib import Path

import pytest

from errormotion import datasets
from errormotion.methods.beam_direction.planning import design

ROOT = Path(__file__).parents[2]
BEAM = ROOT / "examples" / "virtual_beam" / "campaign.toml"
GANTRY = ROOT / "examples" / "virtual_gantry" / "campaign.toml"


@pytest.mark.slow
def test_a_plan_states_expected_uncertainties_and_possible_improvements(run, tmp_path, monkeypatch):
    monkeypatch.setattr(design, "_MAX_EVALUATIONS", design._MAX_EVALUATIONS // 10)  # an improvement, not the best one
    shown = run("plan", BEAM, "--out", tmp_path / "plan.nc").stdout
    assert "beam (beam_direction):" in shown
    assert "U (k=2)" in shown
    assert "smaller than with the published ones by the factor" in shown
    ds = datasets.load(tmp_path / "plan.nc")
    datasets.validate(ds)
    assert f"smaller by the factor {float(ds['gain']):.3g}" in shown


def test_every_test_of_a_campaign_is_planned_for_a_program_too(answer):
    said = answer("plan", GANTRY)["plans"]
    assert [part["test"] for part in said] == ["pose", "scan"]
    rows = {row["name"]: row for row in said[1]["expected"]}
    assert rows["EA"]["unit"] == "arcsec"
    # A profiler of 1 um sees the carriage turn to a few seconds of arc.
    assert 0.01 < rows["EA"]["expanded_uncertainty"] < 20


def test_wrong_calls_report_the_expected_arguments(run, tmp_path):
    assert "expected one of the tests beam; found 'bean'" in run("plan", BEAM, "--test", "bean", code=1).stderr
    assert "choose it with --test" in run("plan", GANTRY, "--out", tmp_path / "plan.nc", code=1).stderr
