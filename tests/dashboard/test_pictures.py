"""The dashboard with the virtual machine: ``make pictures`` writes its pictures into the documentation."""

import re
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from errormotion.campaign.compensation.compensating import Compensation
from errormotion.campaign.files import load_bench, load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.cli.demo import spindle as demonstration
from errormotion.compensation.thermal_model import ThermalModelSettings, fit
from errormotion.datasets import load
from errormotion.twin import Event, VirtualMachine

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
pytestmark = pytest.mark.slow

BENCH = """\
schema = "errormotion.bench/1"
name = "Virtual C-frame"
[machine]
name = "C-frame (virtual)"
chain = "workpiece-X-Y-bed-Z-spindle-tool"
travel = {X = ["-300 mm", "300 mm"], Y = ["-200 mm", "200 mm"], Z = ["0 mm", "400 mm"]}
[instruments.modules]
driver = "dcon_temperature"
address = "sim://cframe/thermometer?seed=5&sensors=spindle_front,column,ambient"
channels = ["spindle front", "column", "ambient"]
places."spindle front" = ["0 mm", "0 mm", "120 mm"]
places.column = ["0 mm", "280 mm", "300 mm"]
places.ambient = ["-400 mm", "-300 mm", "500 mm"]
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=5&clock=60"
[instruments.hall]
driver = "dcon_temperature"
address = "tcp://127.0.0.1:9"
channels = ["hall north"]
"""
COMPENSATED = """\
schema = "errormotion.bench/1"
name = "Virtual C-frame with a PLC"
machine = "C-frame 610"
[instruments.thermometers]
driver = "dcon_temperature"
address = "sim://cframe/thermometer?seed=5&sensors=head,motor,column,column_rear,column_front"
channels = ["head", "motor", "column", "column_rear", "column_front"]
[compensator]
driver = "modbus_registers"
address = "sim://cframe/plc"
offset = [0, 2, 4]
heartbeat = 6
applied = [7, 9, 11]
stop = 13
busy = 14
[compensator.limits]
period = "0.5 s"
"""
SENSORS = ("head", "motor", "column", "column_rear", "column_front")
OWN_OFF = {"X": False, "Y": False, "Z": False}
"""The control's own compensation."""
MEASURING = """\
schema = "errormotion.bench/1"
name = "Virtual C-frame"
[machine]
name = "C-frame (virtual)"
chain = "workpiece-X-Y-bed-Z-spindle-tool"
travel.X = ["-305 mm", "305 mm"]
travel.Y = ["-255 mm", "255 mm"]
travel.Z = ["0 mm", "460 mm"]
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=3"
[instruments.frame]
driver = "five_sensor_frame"
address = "sim://cframe?seed=3&pace=30"
rate = "1.5 kHz"
[instruments.probe]
driver = "controller_probe"
arm = true
address = "sim://cframe/controller?seed=3"
tip_radius = "3 mm"
noise = "0.18 um"
approach_feed = "12 m/min"
"""
DRIFT = """\
schema = "errormotion.campaign/1"
name = "Spindle drift"
bench = "measuring.toml"
[[test]]
name = "drift"
method = "spindle_drift"
[test.settings]
duration = "10 min"
average = "4 s"
schedule = [{ at = "0 s", spindle_speed = "15000 /min" }]
"""
BALLS = """\
schema = "errormotion.campaign/1"
name = "Warm-up"
bench = "measuring.toml"
operator = "B. Keller"

[[test]]
name = "balls"
method = "normal_vector"
[test.settings]
balls = [
    { centre = ["-244 mm", "-204 mm", "55.2 mm"] },
    { centre = ["244 mm", "-191.25 mm", "230 mm"] },
    { centre = ["228.75 mm", "204 mm", "92 mm"] },
]
duration = "15 min"
interval = "5 min"
schedule = [{ at = "0 s", spindle_speed = "15000 /min" }]
functional_point = ["0 mm", "0 mm", "0 mm"]
"""
RESULTS = Path(__file__).parents[1] / "data" / "datasets"
SAVED = {"beams": "spindle_drift_beam_detection", "drift": "spindle_drift_drift", "balls": "normal_vector"}
"""Results of the tests of a demonstration, from one machine at one time."""
CROWD = 30
"""Sensors of a drawing that has hardly room for their names."""
NOISE = 0.02
"""Standard deviation of a temperature, K."""
SECONDS = 40.0
"""Time that a picture shows of a machine that warms up, s."""

BOXES = """
([machine, sensors]) => {
  Object.assign(MACHINE, machine);
  map(sensors, [10, -20, 150]);
  const box = (svg, each) => {
    const { x, y, width, height } = each.getBBox();
    return { box: [x, y, x + width, y + height], text: each.textContent, kind: each.tagName, svg };
  };
  const found = [...document.querySelectorAll("#map svg")].flatMap((svg, k) =>
    [...svg.querySelectorAll("text, circle")].map((each) => box(k, each)));
  return { found, note: document.querySelector("#map-note").textContent };
}
"""


@pytest.fixture
def warming(tmp_path: Path) -> Iterator[Path]:
    """Return a bench whose spindle warms the virtual machine up."""
    bench = tmp_path / "bench.toml"
    bench.write_text(BENCH)
    control = next(each for each in load_bench(bench).instruments if each.name == "control")
    with control.driver(control.address, control.settings) as machine:
        machine.spindle(15000)
        yield bench


def _apart(found: list[dict[str, Any]]) -> None:
    """Require that no text overlaps another one or a circle, or exceeds its drawing."""
    for k, one in enumerate(found):
        left, top, right, bottom = one["box"]
        if one["kind"] == "text":
            assert left >= 0, one
            assert right <= 521, one
        for other in found[k + 1 :]:
            if one["svg"] == other["svg"] and "text" in (one["kind"], other["kind"]):
                x0, y0, x1, y1 = other["box"]
                wide, high = min(right, x1) - max(left, x0), min(bottom, y1) - max(top, y0)
                assert wide < 1 or high < 2, (one, other)


def test_now_shows_a_warming_machine_and_a_missing_instrument(
    page: Any,
    accessible: Callable[[], None],
    serving: Callable[..., Any],
    picture: Callable[..., None],
    warming: Path,
) -> None:
    expect = sync_api.expect
    page.goto(serving(warming.parent / "runs", bench=warming, interval=0.5).address + "now")
    page.wait_for_selector("#curves[data-drawn] canvas")
    expect(page.locator(".tiles li.answers")).to_have_count(2)
    expect(page.locator(".tiles li.silent:has-text('hall')")).to_contain_text("is the device on?")
    expect(page.locator("#temperatures tr:has-text('hall north')")).to_contain_text("no answer")
    change = page.locator("#temperatures tr:has-text('spindle front') td >> nth=1")
    expect(change).to_have_text(re.compile(r"\+[1-9]"))
    assert page.locator("#map .sensor").count() == 6
    accessible()
    picture(page, "now", 1877, SECONDS)

    # The names find room on every machine, or are counted as missing.
    rng = np.random.default_rng(7)
    cases = [
        ({"spindle": 2, "table": ["X", "Y"], "head": ["Z"]}, [[0.0, 0.0, 0.12], [0.0, 0.28, 0.3]]),
        ({"spindle": 2, "table": [], "head": ["X", "Y", "Z"]}, 3 * [[0.01, -0.02, 0.15]]),
        ({"spindle": 1, "table": ["X"], "head": ["Y", "Z"]}, rng.uniform(-0.3, 0.3, (12, 3)).tolist()),
        ({"spindle": 0, "table": ["Y", "Z"], "head": ["X"]}, rng.normal(0.0, 0.03, (CROWD, 3)).tolist()),
    ]
    for machine, places in cases:
        sensors = [
            {"name": f"sensor {k} of the machine's head", "place": place, "value": 20.0 + k, "flag": ""}
            for k, place in enumerate(places)
        ]
        drawn = page.evaluate(BOXES, [machine, sensors])
        texts = [each["text"] for each in drawn["found"] if each["kind"] == "text"]
        named = sum(text.startswith("sensor ") for text in texts)
        values = named + sum(text.isascii() and text.replace(".", "").isdigit() for text in texts)
        _apart(drawn["found"])
        assert values == 2 * len(sensors) or len(sensors) == CROWD
        assert named == 2 * len(sensors) or len(sensors) > 10
        assert (named < 2 * len(sensors)) == ("Names without enough space" in drawn["note"])


def _saved(runs: Path) -> None:
    """Write the runs of a demonstration with saved results."""
    for number, (test, name) in enumerate(SAVED.items()):
        file = RESULTS / f"{name}.nc"
        state = {"bench": {"machine": "C-frame 610"}, "method": {"id": load(file).attrs["method"]}, "steps": []}
        state |= {"status": "finished", "errors": "errors.nc"}
        shutil.copy(file, RunFolder.create(runs, test, f"{number:08}", state).path / "errors.nc")


def test_results_of_the_demonstration(
    page: Any,
    accessible: Callable[[], None],
    serving: Callable[..., Any],
    picture: Callable[..., None],
    pictures: Path | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if pictures is None:
        _saved(tmp_path / "runs")
    else:
        demonstration.work(load_campaign(demonstration.CAMPAIGN), runs=tmp_path / "runs", quiet=True)
    monkeypatch.chdir(tmp_path)
    address = serving(Path("runs")).address
    page.goto(address + "results")
    sync_api.expect(page.locator(".runs tbody tr:has(.good)")).to_have_count(3)
    picture(page, "results", 460)
    page.click("tbody a:text-is('drift')")
    page.wait_for_selector("#figure[data-drawn] canvas")
    accessible()
    picture(page, "run", 1090)
    page.goto(address + "compare")
    for test in ("drift", "balls"):
        page.check(f"tr:has(label:text-is('{test}')) >> nth=0 >> input")
    for freedom in ("EX", "EY", "EZ"):
        page.check(f"input[name=freedom][value={freedom}]")
    page.click("button:has-text('Compare')")
    page.wait_for_selector("#figure[data-drawn] canvas")
    sync_api.expect(page.locator("#verdict-title")).to_contain_text("The 2 datasets")
    assert page.locator("th:text-is('balls - drift')").count() == 1
    picture(page, "compare", 1090)


@contextmanager
def _compensating(folder: Path) -> Iterator[Path]:
    """Compensate the virtual machine by a model of two other warm-ups; yield the runs."""
    rng = np.random.default_rng(5)
    machine, warm_ups = VirtualMachine("cframe", seed=5), []
    for speeds in ([(0, 6000), (3600, 12000), (7200, 0)], [(0, 15000), (2400, 3000), (6000, 9000)]):
        machine.start([Event(at, speed, OWN_OFF if at == 0 else None) for at, speed in speeds])
        warm_up = machine.truth_spindle(np.arange(0.0, 10801.0, 60.0))
        warm_ups.append(
            warm_up.assign(temperature=warm_up["temperature"] + rng.normal(0.0, NOISE, warm_up["temperature"].shape))
        )
    fit(warm_ups, ThermalModelSettings(variant="lagged", sensors=SENSORS)).save(folder / "model.nc")
    (folder / "plc.toml").write_text(COMPENSATED)
    bench, model = load_bench(folder / "plc.toml"), load(folder / "model.nc")
    compensation = Compensation(bench, model, folder / "runs", arm="C-frame 610")

    def work() -> None:
        with compensation:
            for _ in compensation.follow():
                pass

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield folder / "runs"
    finally:
        compensation.stop()
        thread.join(60)


def test_the_virtual_machine_is_compensated(
    page: Any,
    accessible: Callable[[], None],
    serving: Callable[..., Any],
    picture: Callable[..., None],
    warming: Path,
) -> None:
    with _compensating(warming.parent) as runs:
        serving(runs, control=True).enter(page, "compensate")
        page.wait_for_selector(".at-work.armed:has-text('following')")
        assert page.locator("#inputs tr").count() == len(SENSORS)
        page.wait_for_selector("#curves[data-drawn] canvas")
        accessible()
        picture(page, "compensate", 1450, SECONDS)


def test_a_campaign_is_planned(
    page: Any,
    accessible: Callable[[], None],
    serving: Callable[..., Any],
    picture: Callable[..., None],
    pictures: Path | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For a picture it measures as well, as in `test_browser_measure`."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for name, text in (("measuring", MEASURING), ("balls", BALLS), ("drift", DRIFT)):
        (tmp_path / f"{name}.toml").write_text(text)
    served = serving(tmp_path / "runs", campaigns=tmp_path, control=True)
    for name in ("balls",) if pictures is None else ("balls", "drift"):
        served.enter(page, f"measure?file={name}.toml")
        page.wait_for_selector(".count.good")
        page.click("#plan")
        page.wait_for_selector(".planned img")
        if name == "balls":
            sync_api.expect(page.locator(".planned")).to_contain_text("−263.5 to 263.5")
            accessible()
            picture(page, "measure", 1500)
    if pictures is not None:
        page.click("#start")
        page.wait_for_selector("#live[data-drawn] canvas")
        picture(page, "measuring", 800, 8.0)
        page.click(".process button:text-is('Stop')")
        page.wait_for_selector("#ended .interrupted", timeout=60_000)
