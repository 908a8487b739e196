"""Present readings of a bench, and their history in memory."""

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from errormotion.campaign.background.recorded import Value
from errormotion.campaign.claims import claimed, uses
from errormotion.campaign.files import load_bench
from errormotion.campaign.monitor.watch import Monitor, Snapshot
from errormotion.dashboard.watch import Present, Watch
from errormotion.errors import BenchError

MODULES = """\
schema = "errormotion.bench/1"
name = "Shop <script>"
machine = "Mill <b>5</b>"
[instruments.modules]
driver = "dcon_temperature"
address = "sim://cframe/t?seed=21&sensors=spindle_front,column&open=1"
channels = ["spindle <i>", "column"]
places.column = ["-100 mm", "0 mm", "250 mm"]
"""
SILENT = """\
[instruments.absent]
driver = "dcon_temperature"
address = "tcp://127.0.0.1:9"
channels = ["hall"]
"""


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Watch]]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    made: list[Watch] = []

    def build(text: str = MODULES, start: bool = True, interval: float = 0.2) -> Watch:
        file = tmp_path / "bench.toml"
        file.write_text(text)
        made.append(Watch(load_bench(file), tmp_path / "runs", interval))
        if start:
            made[-1].start()
        return made[-1]

    yield build
    for watch in made:
        if watch.present().running:
            watch.stop()


def wait(watch: Watch, wanted: Callable[[Present], bool]) -> Present:
    end = time.monotonic() + 15
    while not wanted(present := watch.present()):
        assert time.monotonic() < end, present
        time.sleep(0.05)
    return present


def test_values_states_and_gaps_of_a_bench(make: Callable[..., Watch], tmp_path: Path) -> None:
    watch = make(MODULES + SILENT)
    present = wait(watch, lambda now: now.rows >= 3)
    states = {each.name: each for each in present.instruments}
    assert (states["modules"].state, states["modules"].model) == ("answers", "DCON 7018")
    assert states["absent"].state == "silent"
    assert "127.0.0.1:9" in states["absent"].why
    values = {each.name: each for each in present.temperatures}
    assert 15 < values["spindle <i>"].value < 25
    assert (math.isnan(values["column"].value), values["column"].flag) == (True, "open")
    assert math.isnan(values["hall"].value)
    assert values["column"].place == pytest.approx((-0.1, 0.0, 0.25))
    assert values["hall"].place is None
    times, curve = watch.history(["spindle <i>", "hall", "other"], 600)["spindle <i>"]
    assert (np.diff(times) > 0).all()
    assert abs(times[-1] - time.time()) < 5
    assert np.isfinite(curve).all()
    watch.stop()
    (run,) = (tmp_path / "runs").glob("*-monitor-*")
    assert '"status": "finished"' in (run / "run.json").read_text()
    assert watch.present().running is False


def test_an_emergency_stop_is_an_alarm(make: Callable[..., Watch]) -> None:
    watch = make(start=False)
    watch._take(Snapshot(0.0, {}, {}, {"estop": True, "alarms": ["door <b>open</b>"]}, {}, 1))
    assert watch.present().alarms == ("emergency stop", "door <b>open</b>")
    watch._take(Snapshot(1.0, {}, {}, {"estop": True, "alarms": ["emergency stop"]}, {}, 2))
    assert watch.present().alarms == ("emergency stop",)


def test_a_monitor_reports_the_reason_of_its_end(make: Callable[..., Watch], tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file, where the folder of runs should be")
    present = wait(make(), lambda now: not now.running)
    assert present.error
    assert present.rows == 0


def test_memory_is_a_ring_and_reduction_keeps_a_peak(make: Callable[..., Watch]) -> None:
    watch = make(start=False, interval=1.0)
    for k in range(40_000):  # more than eight hours
        value = 50.0 if k == 35_000 else math.nan if 36_000 <= k < 36_500 else 20.0
        temperatures = {"spindle <i>": value, "column": 20.0}
        watch._history.put(float(k), [temperatures[name] for name in watch.units])
    watch._take(Snapshot(40_000.0, {"spindle <i>": 20.0, "column": 20.0}, {}, {}, {}, 1))
    times, values = watch.history(["spindle <i>"], 8 * 3600)["spindle <i>"]
    assert len(watch._history.times) == 28_800
    assert len(values) <= 2000
    assert np.nanmax(values) == 50.0
    assert np.isnan(values).any()
    assert times[-1] - times[0] == pytest.approx(28_799)


def test_a_bench_without_readable_instruments_is_an_error(make: Callable[..., Watch]) -> None:
    with pytest.raises(BenchError, match="expected thermometers, a controller, or both"):
        make(
            MODULES.partition("[instruments")[0]
            + '[instruments.lds]\ndriver = "keyence_lk"\naddress = "sim://cframe"\n'
        )


def test_instruments_are_released_for_a_measurement_and_opened_again(
    make: Callable[..., Watch], tmp_path: Path
) -> None:
    watch = make()
    wait(watch, lambda now: now.rows >= 2)
    other = Monitor(watch.plan, tmp_path / "others", 0.1)
    with claimed(uses(watch.plan), "a run <i>") as held:
        # The claim is given once the instruments are closed here: nobody else has them now.
        assert [source._driver for source in watch._monitor.sources] == [None]
        present = wait(watch, lambda now: now.lent.startswith("A run <i>"))
        assert "recorded no samples yet" in present.lent
        assert [each.state for each in present.instruments] == ["lent"]
        with other:
            held.records(other.folder.path)
            for snapshot in other.watch():
                present = watch.present()
                value = present.temperatures[0].value
                if "its record" in present.lent and math.isfinite(value):
                    break
                assert snapshot.time < 30
        assert (present.run, present.rows > 0) == (other.folder.path.name, True)
    present = wait(watch, lambda now: now.lent == "" and now.rows >= 2)
    assert [each.state for each in present.instruments] == ["answers"]
    times, _ = watch.history(["spindle <i>"], 600)["spindle <i>"]
    assert (np.diff(times) > 0).all()


CONTROL = """\
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=3"
"""


def test_a_record_of_a_run_is_shown_in_the_units_of_the_page(make: Callable[..., Watch]) -> None:
    watch = make(MODULES + CONTROL, start=False)
    values = [
        Value("distance", "Z", 2e-4, "m"),
        Value("position", "z", 0.3, "m"),
        Value("spindle_speed", "", 1500.0, "1/min"),
        Value("temperature", "column", 21.5, "degC"),
        Value("temperature", "other", 22.0, "degC"),
        Value("gap", "modules", 0.0, "1"),
    ]
    row, others = watch._split(values)
    known = {name: value for name, value in zip(watch.units, row, strict=True) if math.isfinite(value)}
    assert known == pytest.approx({"column": 21.5, "Z": 300.0, "spindle speed": 1500.0})
    assert [(each.name, each.value, each.unit) for each in others] == [
        ("distance Z", pytest.approx(0.2), "mm"),
        ("temperature other", 22.0, "°C"),
    ]
