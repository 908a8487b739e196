"""A folder of runs with markup in every name, and a dashboard that serves it in this process."""

import asyncio
import http.client
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.dashboard.access import CONTROL_HEADER, Access
from errormotion.datasets import provenance
from errormotion.datasets.results.build import build_errors

AXE = Path(__file__).parents[1] / "peers" / "node_modules" / "axe-core" / "axe.min.js"
SCREENS = ((768, 1024), (3840, 2160))
"""A tablet and 4K, px; all pages are tested at 1280 x 800 as well."""
MARKUP = "<script>window.taken='yes'</script>&amp;\"'"
"""What stands in each name that comes from a file."""


@dataclass
class Served:
    """A dashboard at an address."""

    address: str
    access: Access
    stop: Callable[[], None]
    cookie: str = ""
    """Session of a client that has presented the token; empty: `ask` is one that has not."""

    @property
    def control(self) -> str:
        """Token for control that a page of this address has."""
        return self.access.control_for(urlsplit(self.address).netloc)

    def enter(self, page: Any, path: str) -> None:
        """Open a page in a browser that has presented the token."""
        name, _, value = self.cookie.partition("=")
        stored = f"localStorage.setItem('errormotion-control', '{self.control}')"
        page.add_init_script(f"try {{ {stored}; }} catch {{}}")  # a sandboxed report has no storage
        page.context.add_cookies([{"name": name, "value": value, "url": self.address}])
        page.goto(self.address + path)

    def ask(self, path: str, method: str = "GET", body: str = "", **headers: str) -> tuple[int, dict[str, str], str]:
        """Return status, headers and text of an answer."""
        where = urlsplit(self.address)
        connection = http.client.HTTPConnection(str(where.hostname), where.port, timeout=20)
        try:
            own = {"Accept": "text/html"}
            if self.cookie:
                own |= {"Cookie": self.cookie, CONTROL_HEADER: self.control}
            connection.request(method, path, body or None, {**own, **headers})
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read().decode()
        finally:
            connection.close()


@pytest.fixture(scope="session")
def markup() -> str:
    """Return the markup in each name."""
    return MARKUP


@pytest.fixture(scope="session")
def pictures(pytestconfig: pytest.Config) -> Path | None:
    """Return the folder for pictures of the documentation; None: no pictures."""
    folder = pytestconfig.getoption("--pictures")
    return Path(folder).resolve() if folder else None


@pytest.fixture
def picture(pictures: Path | None) -> Callable[..., None]:
    """Return a function that writes a page as a picture, after some seconds; without a folder it does nothing."""

    def take(page: Any, name: str, height: int, seconds: float = 0.5) -> None:
        if pictures is not None:
            page.wait_for_timeout(1000 * seconds)
            page.mouse.move(0, 0)
            clip = {"x": 0, "y": 0, "width": 1280, "height": height}
            page.screenshot(path=pictures / f"dashboard_{name}.png", clip=clip, full_page=True)

    return take


def finished(root: Path, number: str, bias: float = 0.0, points: int = 5000) -> RunFolder:
    """Write a finished run whose names contain markup: an hour of drift, larger by ``bias`` along Z at the end, m."""
    base = {"bench": {"machine": f"Mill {MARKUP}"}, "method": {"id": "spindle_drift"}, "steps": []}
    folder = RunFolder.create(root, "drift", number, {**base, "status": "finished", "errors": "errors.nc"})
    t = np.linspace(0.0, 3600.0, points)
    twist = np.zeros((t.size, 6))
    warm = 1 - np.exp(-t / 900)
    twist[:, 2], twist[:, 4] = (20e-6 + bias) * warm, 5e-5 * warm
    covariance = np.broadcast_to(np.diag([1e-7] * 3 + [1e-6] * 3) ** 2, (t.size, 6, 6)).copy()
    ds = build_errors(
        twist, covariance, dims=("time",), coords={"time": t}, machine=f"Mill {MARKUP}", component="spindle",
        frame=f"machine {MARKUP}", functional_point=np.zeros(3), method="spindle_drift", method_version="1",
        reference="mean of the first second", notes=[f"a note {MARKUP}"], provenance=provenance.make({}, None, None),
        start="2026-01-01T08:00:00+00:00",
    )  # fmt: skip
    datasets.save(ds, folder.path / "errors.nc")
    return folder


@pytest.fixture(scope="session")
def pair_of_runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Return a folder with two runs that contradict each other, and their keys."""
    root = tmp_path_factory.mktemp("pair")
    numbers = {"00000003": 0.0, "00000004": 5e-6}
    return root, [finished(root, number, bias, points=200).path.name for number, bias in numbers.items()]


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a finished run, whose names and report contain markup, and a failed one."""
    root = tmp_path_factory.mktemp("runs")
    folder = finished(root, "00000001")
    (folder.path / "report.html").write_text(f"<!DOCTYPE html><p id=written>Report</p><p>{MARKUP}</p>")
    (folder.path / "log.jsonl").write_text("{}\n")
    folder.save(test=f"drift {MARKUP}", campaign={"name": MARKUP})
    base = {"bench": {"machine": f"Mill {MARKUP}"}, "method": {"id": MARKUP}, "steps": []}
    RunFolder.create(root, "broken", "00000002", {**base, "status": "failed"})
    return root


@pytest.fixture(scope="session")
def key(runs: Path) -> str:
    """Return the key of the finished run."""
    return next(path.name for path in runs.iterdir() if "drift" in path.name)


@pytest.fixture(scope="module")
def serving() -> Iterator[Callable[..., Served]]:
    """Return a function that serves a folder of runs in a thread until the tests of a module end.

    Where control is allowed on this computer, its client has presented the token.
    """
    from errormotion.dashboard.server import Options, serve

    stops: list[Callable[[], None]] = []

    def start(runs: Path, **options: Any) -> Served:
        found: list[Served] = []
        ready = threading.Event()

        async def work() -> None:
            loop, end = asyncio.get_running_loop(), asyncio.Event()

            def stop() -> None:
                if thread.is_alive():
                    loop.call_soon_threadsafe(end.set)
                    thread.join(20)

            def started(address: str, access: Access) -> None:
                known = access.token and "host" not in options
                port = urlsplit(address).port
                found.append(Served(address, access, stop, f"errormotion-{port}={access.session}" if known else ""))
                stops.append(stop)
                ready.set()

            await serve(Options(runs, **{"port": 0, **options}), started, end)

        thread = threading.Thread(target=lambda: asyncio.run(work()), daemon=True)
        thread.start()
        assert ready.wait(20)
        return found[0]

    yield start
    for stop in stops:
        stop()


@pytest.fixture(scope="module")
def open_to_this_computer(serving: Callable[..., Served], runs: Path) -> Served:
    """Return a dashboard without a token."""
    return serving(runs)


@pytest.fixture(scope="module")
def open_to_the_network(serving: Callable[..., Served], runs: Path) -> Served:
    """Return a dashboard that listens on every address, and requires a token."""
    served = serving(runs, host="0.0.0.0")
    served.address = served.address.replace("0.0.0.0", "127.0.0.1")
    return served


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Return Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    names = ("chromium", "chromium-browser", "google-chrome")
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip("apt-get install chromium")
    if not AXE.is_file():
        pytest.skip("npm ci --prefix tests/peers")
    sync_api.expect.set_options(timeout=30_000)
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """Return an empty page; at the end check that it made no external requests and had no errors."""
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


@pytest.fixture
def accessible(page: Any) -> Callable[[], None]:
    """Return a function that checks a page by axe-core against WCAG 2.2 AA, and for clipped content."""

    def check() -> None:
        page.evaluate(AXE.read_text())
        options = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]}
        found = page.evaluate("options => axe.run(document, options)", options)
        assert [(each["id"], each["nodes"][0]["html"]) for each in found["violations"]] == []
        for wide, high in (*SCREENS, (1280, 800)):
            page.set_viewport_size({"width": wide, "height": high})
            page.wait_for_timeout(100)
            beyond = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
            assert beyond <= 0, f"{page.url} is {beyond} px wider than a screen of {wide} x {high}"

    return check
