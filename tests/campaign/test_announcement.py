"""The motions of a test are stated on one line, before any connection."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from coded import raises
from command_line import CliRunner

from errormotion.campaign import runner
from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.sections.limits import Limits, announcement
from errormotion.cli.app import app
from errormotion.plugins import Step

STEPS = (
    Step("move", (0.1, math.nan, 0.0), 0.02, 5.0, 1500.0),
    Step("move", (-0.2, math.nan, 0.003), math.nan, math.nan),
    Step("rest", None, math.nan, 60.0, -6000.0),
)
LIMITED = Limits(X=("-1 m", "1 m"), feed="2 m/min", spindle_speed="8000 /min")


def test_positions_feed_and_spindle_speed_are_shown_with_their_limits() -> None:
    assert announcement("a", STEPS, LIMITED) == (
        "a: the machine will move: X -200 mm to 100 mm (limits -1000 mm and 1000 mm), Z 0 mm to 3 mm (no limits), "
        "feed up to 1200 mm/min (limit 2000 mm/min), rapid moves: 1 (limited to 2000 mm/min), "
        "spindle up to 6000 /min (limit 8000 /min)."
    )
    assert announcement("a", STEPS, Limits()).count("no limit") == 4
    assert "rapid moves: 1 (not limited)" in announcement("a", STEPS, Limits())


def test_a_test_without_motions_states_it_and_an_unstated_motion_is_rejected() -> None:
    assert announcement("a", STEPS[:0], LIMITED) == "a: nothing will move."
    assert announcement("a", None, LIMITED) == "a: the method states no motions; no command to the machine is allowed."


class Record(runner.Quiet):
    """Keeps reports in order; stops before the bench is opened."""

    def __init__(self) -> None:
        self.reported: list[str] = []

    def announce(self, text: str) -> None:
        """Keep."""
        self.reported.append(text)

    def stage(self, name: str, total: float | None = None) -> None:
        """Stop."""
        self.reported.append(name)
        raise KeyboardInterrupt


def test_every_test_is_announced_before_the_bench_is_opened(plan: Callable[..., CampaignPlan], tmp_path: Path) -> None:
    record = Record()
    with pytest.raises(KeyboardInterrupt):
        runner.run(plan('name = "a"', 'name = "b"'), progress=record)
    stated = "the method states no motions; no command to the machine is allowed."
    assert record.reported == [f"a: {stated}", f"b: {stated}", "opening the bench"]


def test_a_resumed_campaign_announces_the_remaining_tests(
    plan: Callable[..., CampaignPlan], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = plan('name = "a"', 'name = "b"\nsettings = {asks = "turn the key"}')
    monkeypatch.setattr("errormotion.campaign.bench.OpenBench.virtual", False)
    with raises("operator.request.not_shown"):
        runner.run(campaign)
    record = Record()
    with pytest.raises(KeyboardInterrupt):
        runner.resume(campaign, progress=record)
    assert [text.partition(":")[0] for text in record.reported] == ["b", "opening the bench"]


def test_the_command_prints_it_without_a_terminal(lab: None, write: Callable[..., Path]) -> None:
    result = CliRunner().invoke(app, ["run", str(write('name = "a"')), "--no-report", "--json"])
    assert result.exit_code == 0, result.output
    assert result.stderr == "a: the method states no motions; no command to the machine is allowed.\n"


def test_the_probing_example_announces_its_path() -> None:
    campaign = load_campaign(Path(__file__).parents[2] / "examples" / "virtual_probing" / "monday.toml")
    record = Record()
    with pytest.raises(KeyboardInterrupt):
        runner.run(campaign, progress=record)
    (line, _) = record.reported
    assert "\n" not in line
    assert all(axis in line for axis in (" X ", " Y ", " Z "))
    assert "spindle up to" in line
