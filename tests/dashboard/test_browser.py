"""The dashboard in Chromium: what a person sees, without a request to others or an error in the console."""

import os
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from errormotion.campaign.background import processes
from errormotion.errors import InstrumentTimeoutError, RunError
from errormotion.instruments.thermometer.dcon import DconTemperature

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
AXE = Path(__file__).parents[1] / "peers" / "node_modules" / "axe-core" / "axe.min.js"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="apt-get install chromium"),
    pytest.mark.skipif(not AXE.is_file(), reason="npm ci --prefix tests/peers"),
]

BENCH = """\
schema = "errormotion.bench/1"
name = "Virtual C-frame"
machine = "C-frame (virtual) {markup}"
[instruments.modules]
driver = "dcon_temperature"
address = "sim://cframe/thermometer?seed=3&sensors=spindle_front,column,ambient"
channels = ['spindle front{markup}', "column", "ambient"]
places.column = ["0 mm", "280 mm", "300 mm"]
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=3&clock=60"
"""
MEASURING = """\
schema = "errormotion.bench/1"
name = "Virtual C-frame"
machine = "C-frame (virtual) {markup}"
[instruments.frame]
driver = "five_sensor_frame"
address = "sim://cframe?seed=3&pace=4"
rate = "1.5 kHz"
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=3"
"""
CAMPAIGN = """\
schema = "errormotion.campaign/1"
name = '{markup}'
bench = "bench.toml"
[[test]]
name = "drift"
method = "spindle_drift"
[test.settings]
duration = "40 s"   # of the record
schedule = [{ at = "0 s", spindle_speed = "15000 /min" }]
"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    sync_api.expect.set_options(timeout=30_000)
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """Return an empty page; at the end nobody else was asked, and nothing failed in it."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, accept_downloads=True)
    context.set_default_timeout(30_000)
    found = context.new_page()
    asked: list[str] = []
    wrong: list[str] = []
    found.on("request", lambda request: asked.append(request.url))
    found.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    found.on("pageerror", lambda error: wrong.append(str(error)))
    found.expected_errors = ()
    yield found
    left = [text for text in wrong if not any(part in text for part in found.expected_errors)]
    foreign = [url for url in asked if not re.match(r"(https?://127\.0\.0\.1:\d+/|data:|blob:)", url)]
    context.close()
    assert (foreign, left) == ([], [])
    assert asked


def accessible(page: Any) -> None:
    """Refuse what axe-core finds wrong by WCAG 2.2 AA."""
    page.evaluate(AXE.read_text())
    options = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]}
    found = page.evaluate("options => axe.run(document, options)", options)
    assert [(each["id"], each["nodes"][0]["html"]) for each in found["violations"]] == []


def test_results_and_a_run_at_another_functional_point(page: Any, open_to_this_computer: Any) -> None:
    page.goto(open_to_this_computer.address + "results")
    assert "Mill <script>" in page.inner_text("table")
    accessible(page)
    page.select_option("#status", "finished")
    page.keyboard.press("Tab")
    page.click("button[type=submit]")
    assert page.inner_text(".count").startswith("1 of 2 runs")
    page.click("tbody a")
    page.wait_for_selector("#figure[data-drawn='1'] canvas")
    accessible(page)
    with page.expect_download() as download:
        page.click("text=NetCDF")
    assert download.value.suggested_filename.endswith("errors.nc")
    page.fill("input[name=z]", "-200")
    page.wait_for_selector("#figure[data-drawn='2']")
    assert page.inner_text("#figure-note") == "At the functional point X 0, Y 0, Z -200 mm."
    page.fill("input[name=z]", "1e9")
    page.expected_errors = ("400",)
    sync_api.expect(page.locator("#figure-note")).to_contain_text("expected three numbers in mm")
    report = page.frame_locator("iframe")
    page.locator("iframe").scroll_into_view_if_needed()
    assert report.locator("#written").inner_text() == "Report"
    assert page.evaluate("window.taken") is None


def test_the_token_is_asked_for(page: Any, open_to_the_network: Any) -> None:
    page.expected_errors = ("403",)
    page.goto(open_to_the_network.address + "results")
    accessible(page)
    page.keyboard.type("wrong")
    page.keyboard.press("Enter")
    page.wait_for_selector("text=This is not the token")
    page.fill("#token", open_to_the_network.access.token)
    page.keyboard.press("Enter")
    page.wait_for_selector("h1:text('Results')")
    assert open_to_the_network.access.session not in page.evaluate("document.cookie")


def test_values_live_and_a_sensor_that_is_unplugged(
    page: Any, serving: Callable[..., Any], tmp_path: Path, markup: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(BENCH.replace("{markup}", markup.replace("'", "").replace('"', "")))
    served = serving(tmp_path / "runs", bench=bench, interval=0.5)
    page.goto(served.address)
    page.wait_for_selector("#curves[data-drawn] canvas")
    page.wait_for_selector(".tiles li.answers >> nth=1")
    assert "spindle front<script>" in page.inner_text("#temperatures")
    assert page.locator("#map svg").count() == 2
    before = page.inner_text("#clock")
    sync_api.expect(page.locator("#clock")).not_to_have_text(before)
    accessible(page)

    def unplugged(self: Any) -> Any:
        raise InstrumentTimeoutError("no answer within 0.5 s")

    monkeypatch.setattr(DconTemperature, "read", unplugged)
    start = time.monotonic()
    page.wait_for_selector(".tiles li.silent:has-text('modules')")
    assert time.monotonic() - start < 3.0
    monkeypatch.undo()
    page.wait_for_selector(".tiles li.answers:has-text('modules')", timeout=20_000)
    page.reload()
    page.wait_for_selector("#temperatures tr >> nth=2")
    assert page.evaluate("window.taken") is None
    served.stop()
    page.expected_errors = ("ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_EMPTY_RESPONSE")
    page.wait_for_selector("body.lost")
    served = serving(
        tmp_path / "runs", bench=bench, interval=0.5, port=int(served.address.rstrip("/").rpartition(":")[2])
    )
    page.wait_for_selector("body:not(.lost) .tiles li.answers >> nth=1")


def test_two_results_are_compared(page: Any, serving: Callable[..., Any], pair_of_runs: tuple[Path, list[str]]) -> None:
    page.goto(serving(pair_of_runs[0]).address + "compare")
    for box in page.locator("input[name=run]").all():
        box.check()
    page.click("button:has-text('Compare')")
    page.wait_for_selector("#figure[data-drawn] canvas")
    assert "contradict each other" in page.inner_text("h2.bad")
    accessible(page)
    assert page.evaluate("window.taken") is None


@pytest.fixture
def mortal(tmp_path: Path) -> Iterator[tuple[Any, str]]:
    """Return the process of a dashboard that can be killed, and its address; at the end nothing runs."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    options = ["--campaigns", str(tmp_path), "--allow-control", "--port", str(port), "--no-browser"]
    process = subprocess.Popen(
        [sys.executable, "-m", "errormotion", "dashboard", str(tmp_path / "runs"), *options],
        env=os.environ | {"XDG_STATE_HOME": str(tmp_path / "state")},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    address = re.search(r"http://\S+", process.stdout.readline())
    assert address
    yield process, address[0]
    process.kill()
    process.communicate()
    end = time.monotonic() + 30.0
    while alive := [each.name for each in processes.found(tmp_path / "runs") if each.alive]:
        with suppress(RunError):  # it has ended meanwhile
            processes.stop(tmp_path / "runs", alive[0])
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.timeout(400)  # three programs start, slowly on a busy computer
def test_a_campaign_is_corrected_planned_run_stopped_resumed_and_outlives_the_dashboard(
    page: Any, mortal: tuple[Any, str], serving: Callable[..., Any], tmp_path: Path, markup: str
) -> None:
    expect, name = sync_api.expect, markup.replace("'", "")
    (tmp_path / "bench.toml").write_text(MEASURING.replace("{markup}", markup.replace("'", "").replace('"', "")))
    (tmp_path / "drift.toml").write_text(CAMPAIGN.replace("{markup}", name))
    dashboard, address = mortal
    page.goto(address + "measure")
    duration = page.locator("""[data-place='["test",0,"settings","duration"]']""")
    expect(duration).to_have_value("40 s")
    duration.fill("2")
    page.keyboard.press("Tab")
    expect(page.locator("p.wrong:visible")).to_have_text("expected a time with its unit, such as '104 min'; found '2'")
    assert 'duration = "2"   # of the record' in page.input_value("#text")
    assert page.is_disabled("#start")
    assert page.is_disabled("#plan")
    accessible(page)
    page.fill("#text", page.input_value("#text").replace('"2"', '"40 s"'))
    expect(duration).to_have_value("40 s")
    expect(page.locator("#count")).to_have_text("The campaign has no mistakes.")
    page.click("#plan")
    page.wait_for_selector(".planned img")
    expect(page.locator(".planned")).to_contain_text("0 min 40 s")
    accessible(page)

    page.click("#start")
    page.wait_for_selector(".process.alive progress[value]")
    page.wait_for_selector("#live[data-drawn] canvas")
    accessible(page)
    page.click(".process button:text-is('Stop')")
    page.click("#ended .process:has(.interrupted) button:text-is('Resume')")
    page.wait_for_selector(".process.alive")
    page.expected_errors = ("ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_EMPTY_RESPONSE")
    dashboard.kill()
    dashboard.wait()
    page.wait_for_selector("body.lost")
    assert processes.found(tmp_path / "runs")[0].alive
    port = int(address.rstrip("/").rpartition(":")[2])
    serving(tmp_path / "runs", campaigns=tmp_path, control=True, port=port)
    page.wait_for_selector("body:not(.lost) .process:has(.finished)", timeout=90_000)
    page.click("#ended .process:has(.finished) >> text=Report of drift")
    page.locator("iframe").scroll_into_view_if_needed()
    expect(page.frame_locator("iframe").locator("h1")).to_have_text("Thermal drift of the spindle")
    assert page.evaluate("window.taken") is None
