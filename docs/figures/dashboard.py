"""Draw docs/figures/dashboard_*.png: the pages of the dashboard in Chromium.

Argument: a folder of runs, as ``errormotion demo`` makes it.
"""

import asyncio
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright

from errormotion.campaign.compensation.compensating import Compensation
from errormotion.campaign.files import load_bench
from errormotion.compensation.thermal_model import Settings, fit
from errormotion.dashboard.server import Options, serve
from errormotion.datasets import load
from errormotion.twin import Event, VirtualMachine

BENCH = """\
schema = "errormotion.bench/1"
name = "Virtual C-frame"
[machine]
name = "C-frame (virtual)"
chain = "workpiece-X-Y-bed-Z-spindle-tool"
travel = {X = ["-300 mm", "300 mm"], Y = ["-200 mm", "200 mm"], Z = ["0 mm", "400 mm"]}
[instruments.modules]
driver = "dcon_temperature"
address = "sim://cframe/thermometer?seed=3&sensors=spindle_front,column,ambient"
channels = ["spindle front", "column", "ambient"]
places."spindle front" = ["0 mm", "0 mm", "120 mm"]
places.column = ["0 mm", "280 mm", "300 mm"]
places.ambient = ["-400 mm", "-300 mm", "500 mm"]
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=3&clock=60"
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
address = "sim://cframe/thermometer?seed=3&sensors=head,motor,column,column_rear,column_front"
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
OFF = {"X": False, "Y": False, "Z": False}
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
COMPARED = ("drift", "balls")
"""Tests of the demonstration that state the same errors."""
SECONDS = 40
"""Time that the bench is watched before the picture is taken, s: as many minutes of the virtual machine."""


def start(page: Any, runs: Path, bench: Path | None, **more: Any) -> str:
    """Serve in a thread that ends with this program, to a page that knows the token; return the address."""
    found: list[tuple[str, str]] = []
    ready = threading.Event()

    def started(address: str, access: Any) -> None:
        found.append((address, access.session))
        ready.set()

    options = Options(runs, port=0, bench=bench, interval=0.5, **more)
    threading.Thread(target=lambda: asyncio.run(serve(options, started)), daemon=True).start()
    ready.wait()
    ((address, session),) = found
    name = f"errormotion-{address.rstrip('/').rpartition(':')[2]}"
    page.context.add_cookies([{"name": name, "value": session, "url": address}])
    return address


def model(path: Path) -> None:
    """Fit a model to two warm-ups of the virtual machine."""
    machine, warm_ups = VirtualMachine("cframe", seed=3), []
    for speeds in ([(0, 6000), (3600, 12000), (7200, 0)], [(0, 15000), (2400, 3000), (6000, 9000)]):
        machine.start([Event(at, speed, OFF if at == 0 else None) for at, speed in speeds])
        warm_ups.append(machine.truth_spindle(np.arange(0.0, 10801.0, 360.0)))
    fit(warm_ups, Settings(variant="lagged")).save(path)


@contextmanager
def compensating(runs: Path) -> Iterator[None]:
    """Compensate the virtual machine, which is in this process, while its spindle warms it up."""
    Path("plc.toml").write_text(COMPENSATED)
    model(Path("model.nc"))
    compensation = Compensation(load_bench("plc.toml"), load("model.nc"), runs, arm="C-frame 610")

    def work() -> None:
        with compensation:
            for _ in compensation.follow():
                pass

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        compensation.stop()
        thread.join()


def compensate(browser: Any, pictures: Path, runs: Path, seconds: float) -> None:
    """Take the picture of the page Compensate while a compensation is armed."""
    with compensating(runs):
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(start(page, runs, None, control=True) + "compensate")
        page.wait_for_selector(".at-work.armed")
        page.wait_for_timeout(1000 * seconds)
        clip = {"x": 0, "y": 0, "width": 1280, "height": 1450}
        page.screenshot(path=pictures / "dashboard_compensate.png", clip=clip, full_page=True)


def main(made: Path) -> None:
    """Take the pictures."""
    with tempfile.TemporaryDirectory() as place, sync_playwright() as playwright:
        runs, bench, pictures = Path("runs"), Path("bench.toml"), Path(__file__).resolve().parent
        shutil.copytree(made, Path(place) / runs)
        os.chdir(place)
        bench.write_text(BENCH)
        control = next(each for each in load_bench(bench).instruments if each.name == "control")
        with control.driver(control.address, control.settings) as machine:
            machine.spindle(15000)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        address = start(page, runs, bench, control=True)
        page.goto(address + "now")
        page.wait_for_timeout(1000 * SECONDS)
        page.screenshot(path=pictures / "dashboard_now.png", full_page=True)
        page.goto(address + "results")
        page.screenshot(path=pictures / "dashboard_results.png")
        page.click("tbody a:text-is('drift')")
        page.wait_for_selector("#figure[data-drawn] canvas")
        page.wait_for_timeout(500)
        clip = {"x": 0, "y": 0, "width": 1280, "height": 1090}
        page.screenshot(path=pictures / "dashboard_run.png", clip=clip, full_page=True)
        page.goto(address + "compare")
        for test in COMPARED:
            page.check(f"tr:has(label:text-is('{test}')) >> nth=0 >> input")
        for freedom in ("EX", "EY", "EZ"):
            page.check(f"input[name=freedom][value={freedom}]")
        page.click("button:has-text('Compare')")
        page.wait_for_selector("#figure[data-drawn] canvas")
        page.wait_for_timeout(500)
        page.screenshot(path=pictures / "dashboard_compare.png", clip=clip, full_page=True)
        compensate(browser, pictures, Path("compensated"), SECONDS)
        _measure(page, address, pictures)
        browser.close()


def _measure(page: Any, address: str, pictures: Path) -> None:
    """Take the pictures of a campaign before and while it runs."""
    Path("measuring.toml").write_text(MEASURING)
    for name, text in (("balls", BALLS), ("drift", DRIFT)):
        Path(f"{name}.toml").write_text(text)
        page.goto(f"{address}measure?file={name}.toml")
        page.wait_for_selector(".count.good")
        page.click("#plan")
        page.wait_for_selector(".planned img")
        page.wait_for_timeout(500)
        if name == "balls":
            clip = {"x": 0, "y": 0, "width": 1280, "height": 1500}
            page.screenshot(path=pictures / "dashboard_measure.png", clip=clip, full_page=True)
    page.click("#start")
    page.wait_for_selector("#live[data-drawn] canvas")
    page.wait_for_timeout(8000)
    page.screenshot(path=pictures / "dashboard_measuring.png")
    page.click(".process button:text-is('Stop')")
    page.wait_for_selector("#ended .interrupted", timeout=60_000)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
