"""A short demonstration on LinuxCNC: a cold cycle and a warm one, three balls, compared with the truth."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import Result

from errormotion.cli.demo import probing as probing_demonstration
from errormotion.instruments.simulators.controller import linuxcnc, linuxcnc_process

if reason := linuxcnc_process.why_not():
    pytest.skip(reason, allow_module_level=True)

SHORTER = {
    r'    { name = "B2".*\n': "",
    r'duration = "60 min"': 'duration = "10 min"\ntouches = 4',
    r'interval = "30 min"': 'interval = "10 min"',
}


@pytest.fixture
def short_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = probing_demonstration.CAMPAIGN.read_text()
    for long, short in SHORTER.items():
        text, count = re.subn(long, short, text)
        assert count == 1
    (tmp_path / "campaign.toml").write_text(text)
    bench = (probing_demonstration.CAMPAIGN.parent / "bench.toml").read_text()
    # a computer has room for one LinuxCNC: this one waits while other tests have theirs
    (tmp_path / "bench.toml").write_text(bench.replace("linuxcnc?seed=3", "linuxcnc?seed=3&wait=300"))
    run = probing_demonstration.run
    monkeypatch.setattr(
        probing_demonstration, "run", lambda runs, as_json: run(runs, as_json, tmp_path / "campaign.toml")
    )


@pytest.mark.slow
@pytest.mark.usefixtures("short_campaign")
@pytest.mark.timeout(500)
def test_linuxcnc_probes_the_balls_of_the_twin(run: Callable[..., Result], tmp_path: Path) -> None:
    try:
        found = json.loads(run("demo", "--controller", "linuxcnc", "--json").stdout)
    finally:
        linuxcnc.end()
    assert [test["status"] for test in found["tests"]] == ["finished"]
    assert "<html" in (tmp_path / found["tests"][0]["report"]).read_text()
    numbers = {number["name"]: number for number in found["numbers"]}
    assert set(numbers) == {"EX", "EY", "EZ", "EA", "EB"}  # a table that moves: EC is not seen
    for number in numbers.values():
        assert abs(number["measured"] - number["truth"]) < 2 * number["expanded_uncertainty"]  # k = 4
    assert abs(numbers["EY"]["truth"]) > 3 * numbers["EY"]["expanded_uncertainty"]  # there was something to see
