"""What holds for every test: in CI (environment variable CI set) a skipped test is a failed test.

Property tests have no time limit an example, since machines differ. In CI their examples are the same each time;
elsewhere they are drawn anew, and so find more.

Every worker keeps its linear algebra to one thread: there are more workers than processors.
"""

import gc
import os
import tomllib
from collections.abc import Generator
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from xdist.scheduler import LoadFileScheduling

gc.disable()  # while tests are collected: nothing of that is garbage
for _library in ("OPENBLAS", "OMP", "MKL"):  # before anything imports numpy
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

PACKAGE = Path(__file__).parents[1] / "errormotion"
IN_CI = os.environ.get("CI", "").lower() not in ("", "0", "false")

hypothesis.settings.register_profile(
    "errormotion", deadline=None, derandomize=IN_CI, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("errormotion")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the folder of pictures."""
    parser.addoption("--pictures", metavar="FOLDER", help="write the pictures of the documentation that tests make")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Use three workers for each processor: two that compute, and one for tests that wait for devices."""
    return 3 * (os.cpu_count() or 1)


WAITING = (
    *("linuxcnc", "test_builtin_instruments", "test_virtual_probing"),
    *("tests/instruments/", "test_wire_checks", "tests/faults/"),
)
"""Parts of the names of files whose tests mostly wait for a device that is late, silent or slow; the longest first."""


def _waiting(file: str) -> int:
    return next((k for k, name in enumerate(WAITING) if name in file), len(WAITING))


class _ByFile(LoadFileScheduling):  # type: ignore[misc]
    """Gives whole files to the workers, and all tests that start LinuxCNC to one: a computer runs one at a time.

    Every third worker takes files that wait, the others files that compute; a worker that has no more of its own takes
    any. The processors are busy, and no test waits long for one.
    """

    def _split_scope(self, nodeid: str) -> str:
        file: str = super()._split_scope(nodeid)
        return "linuxcnc" if "linuxcnc" in file or "[linuxcnc" in nodeid else file

    def _assign_work_unit(self, node: Any) -> None:
        waits = int(node.gateway.id.removeprefix("gw")) % 3 == 2
        own = next((file for file in self.workqueue if (_waiting(file) < len(WAITING)) == waits), None)
        if own is not None:
            self.workqueue.move_to_end(own, last=False)
        super()._assign_work_unit(node)


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> _ByFile:
    """Return the scheduler of all runs with several workers."""
    return _ByFile(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest of the files that wait, and with slow tests: no worker has a long file at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (_waiting(item.nodeid.partition("::")[0]), item.path not in slow))


def pytest_collection_finish() -> None:
    """Leave modules and tests out of every search for garbage: they stay, and a search through them takes 0.5 s."""
    gc.freeze()
    gc.enable()


def _refuse_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    if IN_CI and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"{reason}\nIn CI everything is installed, so nothing is skipped: see .ci/run."


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    _refuse_skip(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    _refuse_skip(report)
    return report


@pytest.fixture(scope="module")
def translated(request: pytest.FixtureRequest) -> Generator[None]:
    """Translate every page that a module's tests write into German too: none of its texts may be missing."""
    from errormotion.report import write
    from errormotion.report.page import annex
    from errormotion.report.untranslated import missing_of

    catalogues = [tomllib.loads(file.read_text(encoding="utf-8")) for file in PACKAGE.rglob("de.toml")]
    missing, page = [], write.page

    def translating(sources: Any, parts: Any, *rest: Any, **more: Any) -> Any:
        missing.extend(missing_of(parts, annex.values(sources), "de", catalogues))
        return page(sources, parts, *rest, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "page", translating)
        yield
    own = request.path.read_text(encoding="utf-8")  # what a test makes up has no translation
    assert [text for text in missing if text not in own and not text.startswith(FROM_ELSEWHERE)] == []


FROM_ELSEWHERE = ("Did you mean one of", "Searched: ")
"""Beginnings of texts that other packages write, or that are paths."""
