"""Several tests of one virtual machine on one clock, and the truth behind them."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.truth import truth_of
from errormotion.compare import compare
from errormotion.datasets.timing import between
from errormotion.errors import BenchError, RunError
from errormotion.instruments.simulators import reset

ROOT = Path(__file__).parents[2]
BENCH = """
schema = "errormotion.bench/1"
name = "Virtual C-frame"
machine = "C-frame (virtual)"
[instruments.frame]
driver = "five_sensor_frame"
address = "sim://cframe?seed=3"
rate = "1.5 kHz"
{control}
"""
CONTROL = """
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=3"
"""
HEAD = """
schema = "errormotion.campaign/1"
name = "One clock"
bench = "bench.toml"
"""
TIMELINE = """
[timeline]
start = "2026-03-02T07:00:00+01:00"
schedule = [{ at = "10 min", spindle_speed = "15000 /min" }]
"""
DRIFT = """
[[test]]
name = "{name}"
method = "spindle_drift"
{at}
[test.settings]
duration = "20 s"
schedule = [{speed}]
"""
FROM_REST = '{ at = "0 s", spindle_speed = "15000 /min" }'

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Iterator[Write]:
    """Write a bench and a campaign."""

    def files(*tests: str, timeline: str = TIMELINE, control: str = CONTROL) -> Path:
        (tmp_path / "bench.toml").write_text(BENCH.format(control=control))
        campaign = tmp_path / "campaign.toml"
        campaign.write_text(HEAD + timeline + "".join(tests))
        return campaign

    yield files
    reset()


def drift(name: str, at: str = "", speed: str = "") -> str:
    return DRIFT.format(name=name, at=f'at = "{at}"' if at else "", speed=speed)


def run(campaign: Path) -> list[RunFolder]:
    return runner.run(load_campaign(campaign), runs=campaign.parent / "runs")


def test_simultaneous_tests_share_one_machine_and_others_are_sequential(write: Write) -> None:
    folders = run(write(drift("first", "10 min", FROM_REST), drift("again", "10 min", FROM_REST), drift("next")))
    first, again, after = (datasets.load(folder.raw) for folder in folders)
    assert first.attrs["start"] == again.attrs["start"] == "2026-03-02T06:10:00+00:00"
    np.testing.assert_array_equal(first["distance"].values, again["distance"].values)
    # the clock is where the frame's reader is, which may have asked for some more blocks of samples
    assert between(again.attrs["start"], after.attrs["start"]) >= 20.0
    assert folders[2].data["clock"]["time"] == pytest.approx(between("2026-03-02T06:00:00+00:00", after.attrs["start"]))


def test_the_truth_of_a_run_agrees_with_its_errors(write: Write) -> None:
    folder, later = run(write(drift("warming", "10 min", FROM_REST), drift("warm", "30 min")))
    truth = truth_of(folder)
    with datasets.load(folder.errors or "") as errors:
        found = compare({"errors": errors, "truth": truth}, freedoms=("EA", "EB"))
    assert truth.attrs["machine"] == "C-frame (virtual)"
    assert float(found["p"].min()) > 1e-3
    # one clock: relative to the cold state at its time 0, the later one has warmed up for longer
    assert abs(float(truth_of(later)["EA"][0])) > 5 * abs(float(truth["EA"][-1]))


def test_a_schedule_that_contradicts_the_timeline_is_refused(write: Write) -> None:
    campaign = write(drift("drift", "12 min", FROM_REST))
    with pytest.raises(
        RunError, match=r"expected Event\(time=0.0, spindle_speed=15000.0.* at 720 s in it; found nothing"
    ):
        run(campaign)


def test_a_run_without_timeline_states_no_truth(write: Write) -> None:
    (folder,) = run(write(drift("drift"), timeline=""))
    with raises("truth.no_timeline"):
        truth_of(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"timeline": ""}, r"test\[0\].at: needs a table \[timeline\]; found none"),
        ({"control": ""}, r"\[timeline\]: expected a controller of a virtual machine"),
        ({"timeline": TIMELINE.replace("+01:00", "")}, "expected an instant such as"),
        (
            {"timeline": TIMELINE.replace("[{", '[{ at = "20 min", spindle_speed = "0 /min" }, {')},
            "times in ascending order",
        ),
    ],
)
def test_mistakes_of_a_timeline_are_found_when_the_campaign_is_read(
    write: Write, change: dict[str, str], message: str
) -> None:
    with pytest.raises(BenchError, match=message):
        load_campaign(write(drift("drift", "10 min"), **change))


class Interrupting(runner.Quiet):
    """Interrupts a measurement after its first chunk."""

    def advance(self, done: float) -> None:
        """Interrupt."""
        raise KeyboardInterrupt


def test_an_interrupted_test_continues_at_its_time(write: Write) -> None:
    longer = drift("drift", "10 min", FROM_REST).replace('"20 s"', '"4 min"')
    plan = load_campaign(write(longer))
    runs = plan.source.parent / "runs"
    with pytest.raises(KeyboardInterrupt):
        runner.run(plan, runs=runs, progress=Interrupting())
    (stored,) = runs.glob("*/raw.zarr")
    with datasets.load(stored) as part:
        assert 0 < part.sizes["time"] < 240 * 1500
    reset()  # the next process finds a machine that is at time 0
    (folder,) = runner.resume(plan, runs=runs)
    with datasets.load(folder.errors or "") as errors, datasets.load(folder.raw) as raw:
        assert raw.sizes["time"] == 240 * 1500
        found = compare({"errors": errors, "truth": truth_of(folder)}, freedoms=("EA", "EB"))
    assert float(found["p"].min()) > 1e-3
