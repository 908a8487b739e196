"""The page Measure in Chromium: a campaign from its form to its report, also after the end of the dashboard."""

import json
import os
import re
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
from errormotion.errors import RunError

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
pytestmark = pytest.mark.slow

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


@pytest.fixture
def mortal(tmp_path: Path) -> Iterator[tuple[Any, str, str]]:
    """Return the process of a dashboard that can be killed, its address and its token; it is ended after the test."""
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
    token = process.stdout.readline().rpartition(" ")[2].strip()
    yield process, address[0], token
    process.kill()
    process.communicate()
    end = time.monotonic() + 30.0
    while alive := [each.name for each in processes.found(tmp_path / "runs") if each.alive]:
        with suppress(RunError):  # it has ended meanwhile
            processes.stop(tmp_path / "runs", alive[0])
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.timeout(400)  # three programs start, slowly on a busy computer
def test_a_campaign_is_corrected_planned_run_stopped_resumed_and_continues_after_the_dashboard(
    page: Any,
    accessible: Callable[[], None],
    mortal: tuple[Any, str, str],
    serving: Callable[..., Any],
    tmp_path: Path,
    markup: str,
) -> None:
    expect, name = sync_api.expect, markup.replace("'", "")
    (tmp_path / "bench.toml").write_text(MEASURING.replace("{markup}", markup.replace("'", "").replace('"', "")))
    (tmp_path / "drift.toml").write_text(CAMPAIGN.replace("{markup}", name))
    dashboard, address, token = mortal
    page.expected_errors = ("403",)
    page.goto(address + "measure")
    page.fill("#token", token)
    page.keyboard.press("Enter")
    page.click("nav >> text=Measure")
    duration = page.locator("""[data-place='["test",0,"settings","duration"]']""")
    expect(duration).to_have_value("40 s")
    duration.fill("2")
    page.keyboard.press("Tab")
    expect(page.locator("p.wrong:visible")).to_have_text("expected a time with its unit, such as '104 min'; found '2'")
    assert 'duration = "2"   # of the record' in page.input_value("#text")
    assert page.is_disabled("#start")
    assert page.is_disabled("#plan")
    accessible()
    page.evaluate(  # two fields at once: none is lost
        """for (const [key, value] of [['"operator"', "A"], ['"average"', "4 s"]]) {
          const field = document.querySelector(`[data-place$='${key}]']`);
          field.value = value;
          field.dispatchEvent(new Event("change"));
        }"""
    )
    expect(page.locator("#text")).to_have_value(re.compile('operator = "A"(.|\n)*average = "4 s"'))
    page.click("#add")
    expect(page.locator("""[data-place='["test",1,"name"]']""")).to_have_value("test-2")
    expect(page.locator("#text")).to_have_value(re.compile('name = "test-2"'))
    accessible()
    page.click("text=Remove test 2")
    expect(page.locator("#text")).not_to_have_value(re.compile("test-2"))
    page.fill("#text", page.input_value("#text").replace('"2"', '"40 s"'))
    expect(duration).to_have_value("40 s")
    expect(page.locator("#count")).to_have_text("The campaign has no mistakes.")
    page.click("#plan")
    page.wait_for_selector(".planned img")
    expect(page.locator(".planned")).to_contain_text("0 min 40 s")
    accessible()

    page.click("#start")
    page.wait_for_selector(".process.alive progress[value]")
    page.wait_for_selector("#live[data-drawn] canvas")
    accessible()
    page.click(".process button:text-is('Stop')")
    page.wait_for_selector("#ended .process:has(.interrupted)")
    assert json.loads(next((tmp_path / "runs").glob("*/run.json")).read_text())["status"] == "interrupted"
    page.click("#ended .process:has(.interrupted) button:text-is('Resume')")
    page.wait_for_selector(".process.alive")
    page.expected_errors = ("403", "ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_EMPTY_RESPONSE")
    dashboard.kill()
    dashboard.wait()
    page.wait_for_selector("body.lost")
    assert processes.found(tmp_path / "runs")[0].alive
    port = int(address.rstrip("/").rpartition(":")[2])
    again = serving(tmp_path / "runs", campaigns=tmp_path, control=True, port=port)
    expect(page.locator("#lost")).to_have_text("The token is required")
    again.enter(page, "measure")
    page.wait_for_selector("body:not(.lost) .process:has(.finished)", timeout=90_000)
    page.click("#ended .process:has(.finished) >> text=Report of drift")
    page.locator("iframe").scroll_into_view_if_needed()
    expect(page.frame_locator("iframe").locator("h1")).to_have_text("Thermal drift of the spindle")
    assert page.evaluate("window.taken") is None


@pytest.mark.timeout(400)
def test_the_motions_of_a_real_machine_are_released_on_the_page(
    page: Any, accessible: Callable[[], None], mortal: tuple[Any, str, str], tmp_path: Path
) -> None:
    expect, runs = sync_api.expect, tmp_path / "runs"
    bench = MEASURING.replace("{markup}", "").replace("sim://cframe/controller?seed=3", "tcp://127.0.0.1:9")
    (tmp_path / "bench.toml").write_text(bench)
    (tmp_path / "drift.toml").write_text(CAMPAIGN.replace("{markup}", "Real"))
    _, address, token = mortal
    page.expected_errors = ("403", "400")
    page.goto(address + "measure")
    page.fill("#token", token)
    page.keyboard.press("Enter")
    page.click("nav >> text=Measure")
    expect(page.locator("#count")).to_have_text("The campaign has no mistakes.")
    page.click("#plan")
    page.wait_for_selector(".planned img", timeout=120_000)
    page.click("#start")
    expect(page.locator("#motions li")).to_contain_text("the machine will move: spindle up to 15000 /min (no limit)")
    accessible()
    page.fill("#typed", "yes")
    page.keyboard.press("Enter")
    expect(page.locator("#wrong")).to_contain_text("expected the word 'move'")
    assert page.locator("#release-card").is_hidden()
    page.click("#start")
    page.click("#unreleased")
    assert page.locator("#release-card").is_hidden()
    assert processes.found(runs) == []
    page.click("#start")
    page.fill("#typed", "move")
    page.keyboard.press("Enter")
    page.wait_for_selector("#ended .process:has(.failed)", timeout=120_000)  # nothing answers at the address
    assert page.locator("#release-card").is_hidden()
    assert len(processes.found(runs)) == 1
