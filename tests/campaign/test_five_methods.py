"""The example of five methods on one machine, in a shorter form."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.compare import compare
from errormotion.instruments.simulators import reset

EXAMPLE = Path(__file__).parents[2] / "examples" / "one_machine"
SHORTER = {
    'procedure = "beam_detection"': 'procedure = "beam_detection"\nsteps = 21\nscan_length = "1.6 mm"\ndwell = "0.7 s"',
    'duration = "181 min"': 'duration = "8 min"',
    'duration = "183 min"\ninterval = "7 min"': 'duration = "10 min"\ninterval = "4 min"',
    'warm_up = ["7 min", "30 min", "60 min", "120 min", "180 min"]': 'warm_up = ["6 min"]',
    'positions = ["-600 mm", "-200 mm", "200 mm", "600 mm"]': (
        'positions = ["-200 mm", "200 mm"]\nline_pitch = "140 um"\ncold_repeats = 0'
    ),
    "count = [4, 3, 3]": "count = [3, 3, 3]",
}
POINTS = "points=800&pitch=25e-6", "points=400&pitch=50e-6"
"""Of a line of the profiler, in the example and here."""


def test_the_example_is_a_valid_campaign_on_one_machine() -> None:
    plan = load_campaign(EXAMPLE / "campaign.toml")
    assert len({each.address.partition("seed=")[2].split("&")[0] for each in plan.bench.instruments}) == 1
    assert plan.timeline is not None
    speeds = [event.spindle_speed for event in plan.timeline.schedule]
    assert {test.settings.schedule[0].spindle_speed for test in plan.tests if test.name in ("bar", "balls")} == {
        *speeds
    }


@pytest.mark.slow
def test_all_methods_agree_with_each_other_and_with_the_truth(tmp_path: Path) -> None:
    text = (EXAMPLE / "campaign.toml").read_text()
    for long, short in SHORTER.items():
        assert long in text
        text = text.replace(long, short)
    (tmp_path / "campaign.toml").write_text(text)
    bench = (EXAMPLE / "bench.toml").read_text()
    assert POINTS[0] in bench
    (tmp_path / "bench.toml").write_text(bench.replace(*POINTS))
    try:
        runner.run(load_campaign(tmp_path / "campaign.toml"), runs=tmp_path / "runs")
    finally:
        reset()
    script = runpy.run_path(str(EXAMPLE / "agreement.py"))
    compared = list(script["questions"](script["newest"](tmp_path / "runs")))
    assert [title for title, *_ in compared][::3] == ["the tool", "the volume"]
    for title, results, freedoms in compared:
        found = compare(results, freedoms=freedoms)
        assert float(found["p"].min()) > 1e-4, title
        en = np.abs(found["en"].values)
        assert np.mean(en[np.isfinite(en)] <= 1) > 0.8, title
