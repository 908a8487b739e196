"""No motion leaves the limits of its bench."""

from pathlib import Path

import pytest

from errormotion.campaign.files import load_campaign
from errormotion.campaign.sections.limits import Limits, extent, violations
from errormotion.errors import BenchError
from errormotion.plugins import Step

BENCH = """\
schema = "errormotion.bench/1"
name = "Gantry"
machine = "Gantry"
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://gantry/controller?seed=31"
[instruments.probe]
driver = "controller_probe"
arm = true
address = "sim://gantry/controller?seed=31"
"""

CAMPAIGN = """\
schema = "errormotion.campaign/1"
name = "Warm-up"
bench = "bench.toml"
[[test]]
name = "probing"
method = "normal_vector"
[test.settings]
balls = [
    { centre = ["400 mm", "-700 mm", "120 mm"] },
    { centre = ["3600 mm", "-700 mm", "500 mm"] },
    { centre = ["3500 mm", "700 mm", "200 mm"] },
]
duration = "20 min"
schedule = [{ at = "0 min", spindle_speed = "9000 /min" }]
"""


def campaign(folder: Path, limits: str) -> Path:
    (folder / "bench.toml").write_text(BENCH + "[limits]\n" + limits)
    path = folder / "campaign.toml"
    path.write_text(CAMPAIGN)
    return path


def test_a_test_within_the_limits_is_accepted(tmp_path: Path) -> None:
    wide = 'X = ["0 m", "4 m"]\nZ = ["0 m", "1 m"]\nfeed = "20 m/min"\nspindle_speed = "9000 /min"\n'
    plan = load_campaign(campaign(tmp_path, wide))
    assert plan.bench.limits.X == (0.0, 4.0)
    assert plan.bench.limits.Y is None


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ('X = ["0 m", "3 m"]', r"test\[0\]: X would move from .* mm to 36.* mm; its limits are 0 mm and 3000 mm"),
        ('Z = ["200 mm", "1 m"]', r"Z would move from 120 mm to .* mm; its limits are 200 mm and 1000 mm"),
        ('feed = "1 m/min"', r"the feed would be \d+ mm/min; its limit is 1000 mm/min"),
        ('spindle_speed = "8000 /min"', r"the spindle would turn at 9000 /min; its limit is 8000 /min"),
    ],
)
def test_a_test_beyond_the_limits_is_an_error_when_it_is_read(tmp_path: Path, limits: str, message: str) -> None:
    with pytest.raises(BenchError, match=message):
        load_campaign(campaign(tmp_path, limits))


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ('X = ["4 m", "0 m"]', "X: expected the lowest position, then the highest"),
        ("X = [0, 4]", r"limits\.X\[0\]: expected a length with its unit, such as '5 mm'; found 0"),
        ('Q = ["0 m", "4 m"]', r"limits\.Q: unknown key"),
    ],
)
def test_invalid_limits_are_reported(tmp_path: Path, limits: str, message: str) -> None:
    with pytest.raises(BenchError, match=message):
        load_campaign(campaign(tmp_path, limits))


def test_the_extent_follows_from_the_steps() -> None:
    steps = [
        Step("move", (0.0, 0.0, 0.0), 0.1, 0.0),
        Step("touch", (0.3, 0.4, 0.0), 0.01, 50.0, 0.0),
        Step("rest", None, float("nan"), 10.0, 6000.0),
        Step("move", (0.3, 0.4, -1.0), 0.2, 5.0),
    ]
    found = extent(steps)
    assert (found.seconds, found.path, found.touches, found.moves) == (65.0, 1.5, 1, 2)
    assert (found.low, found.high) == ((0.0, 0.0, -1.0), (0.3, 0.4, 0.0))
    assert (found.feed, found.spindle_speed) == (0.2, 6000.0)
    assert violations(found, Limits()) == []
    assert violations(extent([]), Limits(X=(0.0, 1.0))) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '    { centre = ["3500 mm", "700 mm", "200 mm"] },\n',
            "",
            r"test\[0\]\.settings\.balls: expected .* three or more balls",
        ),
        (
            'duration = "20 min"',
            'duration = "5 min"',
            r"test\[0\]\.settings\.interval: expected at most the duration",
        ),
        (
            'duration = "20 min"',
            'duration = "20 min"\ninterval = "1 min"',
            r"test\[0\]: interval: expected more than the duration of a cycle, \d",
        ),
    ],
    ids=["two balls", "no cycle", "no time to warm up"],
)
def test_an_impossible_campaign_is_an_error_when_it_is_read(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = campaign(tmp_path, "")
    assert old in CAMPAIGN
    path.write_text(CAMPAIGN.replace(old, new))
    with pytest.raises(BenchError, match=message):
        load_campaign(path)
