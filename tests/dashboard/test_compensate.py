"""The page Compensate: authorisation, display of a compensation, and its end at zero."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlencode

import pytest
from compensated_machine import MACHINE, SENSOR, Place, machine

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion.campaign.compensation.compensating import Compensation
from errormotion.campaign.compensation.following import compensations, is_working, read_status, request_stop
from errormotion.campaign.files import load_bench
from errormotion.datasets import load

FORM = "application/x-www-form-urlencoded"
START = {"bench": "bench.toml", "model": "model.nc", "mode": "armed", "machine": MACHINE}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("compensate")
    before = os.environ.get("XDG_STATE_HOME")
    os.environ["XDG_STATE_HOME"] = str(folder / "state")  # of the commands that the dashboard starts
    with machine(folder) as found:
        yield found
        for run in compensations(found.runs):
            if is_working(run):
                request_stop(run)
        until(lambda: not any(map(is_working, compensations(found.runs))))
    os.environ.pop("XDG_STATE_HOME")
    if before is not None:
        os.environ["XDG_STATE_HOME"] = before


@pytest.fixture(scope="module")
def served(serving: Callable[..., Any], place: Place) -> Any:
    return serving(place.runs, control=True, campaigns=place.folder)


@pytest.fixture(scope="module")
def shown_only(serving: Callable[..., Any], place: Place) -> Any:
    return serving(place.runs, campaigns=place.folder)


def until(condition: Callable[[], object], most: float = 60.0) -> None:
    """Wait for a condition."""
    end = time.monotonic() + most
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)


def post(served: Any, path: str, origin: str | None = None, **form: str) -> int:
    """Send a form; return the status of the answer."""
    head = {"Content-Type": FORM, "Origin": origin if origin is not None else served.address.rstrip("/")}
    return int(served.ask(path, "POST", urlencode(form), **head)[0])


def test_without_control_nothing_starts_and_nothing_stops(shown_only: Any, place: Place) -> None:
    text = shown_only.ask("/compensate")[2]
    assert "--allow-control" in text
    assert 'action="/compensate/start"' not in text
    assert post(shown_only, "/compensate/start", **START) == 403
    assert post(shown_only, "/compensate/stop", run="any") == 403
    assert not list(compensations(place.runs))


def test_forged_and_invalid_requests_start_nothing(
    served: Any, serving: Callable[..., Any], place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("subprocess.Popen", None)
    assert post(served, "/compensate/start", "https://evil.example", **START) == 403
    assert post(served, "/compensate/start", "", **START) == 403
    assert served.ask("/compensate/start?" + urlencode(START))[0] == 405
    other = serving(place.runs, control=True, campaigns=place.folder, host="0.0.0.0")
    other.address = other.address.replace("0.0.0.0", "127.0.0.1")
    assert post(other, "/compensate/start", **START) == 403  # without the token
    for wrong in (
        {"machine": "Mill 6"},
        {"machine": f" {MACHINE}"},
        {"machine": ""},
        {"mode": "both"},
        {"bench": "../bench.toml"},
        {"bench": str(place.folder / "bench.toml")},
        {"model": "bench.toml"},
    ):
        assert post(served, "/compensate/start", **{**START, **wrong}) == 400, wrong
    for run in ("", "..", "../runs", "nowhere", "a/b", 200 * "é"):
        assert post(served, "/compensate/stop", run=run) == 400


@pytest.mark.slow
def test_shadow_operation_then_armed_then_zero(
    page: Any, accessible: Callable[[], None], served: Any, shown_only: Any, serving: Callable[..., Any], place: Place
) -> None:
    from playwright.sync_api import expect

    page.expected_errors = ("400",)
    served.enter(page, "compensate")
    assert page.locator("#none").inner_text() == "No compensation is running."

    # A shadow writes nothing.
    page.click("button:has-text('Start')")
    page.wait_for_selector(".at-work:has-text('shadow mode: nothing is written')")
    page.wait_for_selector(".states li.here.following")
    assert page.inner_text("#inputs tr th") == SENSOR
    page.wait_for_selector("#curves[data-drawn] canvas")
    expect(page.locator("#chain")).to_contain_text("the chain of hashes is unbroken")
    accessible()
    page.click("button.stop")
    page.wait_for_selector("#none:visible")
    assert place.plc.machine.orders == 0

    # Another name arms nothing.
    page.check("input[value=armed]")
    page.fill("#machine", "Mill 6")
    page.click("button:has-text('Start')")
    page.wait_for_selector("#refused:has-text('is not the name of the machine')")
    assert place.plc.machine.orders == 0

    # The name of the machine arms. The dashboard that started it ends; another one finds it, and without control it
    # shows the same without a button.
    second = serving(place.runs, control=True, campaigns=place.folder)
    second.enter(page, "compensate")
    page.check("input[value=armed]")
    page.fill("#machine", MACHINE)
    page.click("button:has-text('Start')")
    page.wait_for_selector(".at-work.armed:has-text('following')")
    page.goto("about:blank")  # a page that is shown continues to ask its dashboard
    second.stop()
    served.enter(page, "compensate")
    page.wait_for_selector(".at-work.armed:has-text('following')")
    until(lambda: place.plc.machine.offset[0] != 0.0)
    run = next(folder for folder in compensations(place.runs) if is_working(folder))
    other = page.context.new_page()
    other.goto(shown_only.address + "compensate")
    other.wait_for_selector(".at-work.armed:has-text('following')")
    assert other.locator("button.stop").count() == 0
    assert other.inner_text("#list tr >> nth=0") == page.inner_text("#list tr >> nth=0")
    other.close()
    page.locator("footer").scroll_into_view_if_needed()
    assert page.locator("button.stop").is_visible()
    page.click("button.stop")
    page.wait_for_selector("#zero:has-text('The machine reports an offset of zero')")
    page.wait_for_selector("#none:visible")
    assert place.plc.machine.offset == (0.0, 0.0, 0.0)
    assert read_status(run).at_zero


@pytest.mark.slow
def test_the_stop_of_the_machine_and_an_altered_log_are_shown(
    page: Any, served: Any, serving: Callable[..., Any], place: Place
) -> None:
    def follow() -> None:
        with Compensation(
            load_bench(place.folder / "bench.toml"), load(model), place.runs, arm=MACHINE
        ) as compensation:
            for _ in compensation.follow():
                pass

    model = place.folder / "model.nc"
    thread = threading.Thread(target=follow)
    thread.start()
    served.enter(page, "compensate")
    page.wait_for_selector(".at-work.armed:has-text('following')")
    place.plc.machine.fault = "emergency stop"
    page.wait_for_selector("#alarms li:has-text('the PLC states stop')")
    assert page.inner_text(".states .here") == "fault"
    until(lambda: place.plc.machine.offset == (0.0, 0.0, 0.0))
    run = next(folder for folder in compensations(place.runs) if is_working(folder))
    page.click("button.stop")
    page.wait_for_selector("#none:visible")
    thread.join(60)
    place.plc.machine.fault = ""
    audit = run / "audit.jsonl"
    audit.write_text(audit.read_text().replace('"following"', '"folloving"', 1))
    page.goto(serving(place.runs).address + "compensate?" + urlencode({"run": run.name}))
    page.wait_for_selector("#chain.bad:has-text('broken')")
    page.wait_for_selector("#alarms li:has-text('does not follow from the lines before it')")
