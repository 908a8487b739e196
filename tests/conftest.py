"""What holds for every test: in CI (environment variable CI set) a skipped test is a failed test.

`skipped.toml` lists the tests that are skipped where only git, make and Python are installed, with the reasons. With
`--skips FILE`, any other skip, and a listed one that does not occur, is a failure (`tools/bare`). With `--beyond FILE`,
only those tests and the slow ones run, which is what such a computer leaves to be tested (`.ci/run`).

Property tests have no time limit an example, since machines differ. Where a change is judged (CI, `--skips`) their
examples are the same each time; elsewhere they are drawn anew, and so find more.

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

CONFTEST = Path(__file__)
PACKAGE = CONFTEST.parents[1] / "errormotion"
IN_CI = os.environ.get("CI", "").lower() not in ("", "0", "false")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the folder of pictures, and the uses of the list of skipped tests."""
    parser.addoption("--pictures", metavar="FOLDER", help="write the pictures of the documentation that tests make")
    parser.addoption(
        "--skips", metavar="FILE", help="fail unless exactly the tests in FILE are skipped, each with its reason"
    )
    parser.addoption("--beyond", metavar="FILE", help="run only slow tests and the tests in FILE")


def pytest_configure(config: pytest.Config) -> None:
    """Set the examples of property tests; compare the skips with the list, in the process that receives all reports."""
    hypothesis.settings.register_profile(
        "errormotion",
        deadline=None,
        derandomize=IN_CI or bool(config.getoption("--skips")),
        suppress_health_check=[hypothesis.HealthCheck.too_slow],
    )
    hypothesis.settings.load_profile("errormotion")
    if (file := config.getoption("--skips")) and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Skips(_listed(file)))


def _listed(file: str) -> dict[str, str]:
    """Return the beginning of the reason for every listed file or test."""
    groups = tomllib.loads(Path(file).read_text(encoding="utf-8"))["skipped"]
    return {test: group["reason"] for group in groups for test in group["tests"]}


def _entry(nodeid: str, listed: dict[str, str]) -> str | None:
    """Return the entry of a test: itself, itself without parameters, or its file."""
    names = nodeid, nodeid.partition("[")[0], nodeid.partition("::")[0]
    return next((name for name in names if name in listed), None)


class _Skips:
    """The skips of a run, against those that are listed."""

    def __init__(self, listed: dict[str, str]) -> None:
        self.listed, self.found = listed, dict[str, str]()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._add(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        self._add(report)

    def _add(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.skipped and not hasattr(report, "wasxfail"):
            reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
            self.found[report.nodeid] = reason.removeprefix("Skipped: ")

    def _differences(self) -> list[str]:
        entries = {test: _entry(test, self.listed) for test in self.found}
        missing = [f"not skipped, but listed: {entry}" for entry in self.listed.keys() - set(entries.values())]
        return sorted(missing) + [
            f"skipped, but not listed with this reason: {test}: {self.found[test]}"
            for test, entry in sorted(entries.items())
            if entry is None or not self.found[test].startswith(self.listed[entry])
        ]

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        differences = self._differences()
        if session.config.cache is not None:
            session.config.cache.set("errormotion/skips", differences)  # read by tools/repeat_failed
        if differences and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for line in self._differences():
            terminalreporter.write_line(line, red=True)


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


def _may_be_slow(file: Path, root: Path) -> bool:
    """Return whether a file of tests, or a conftest.py that names it, marks slow tests."""
    above = [folder / "conftest.py" for folder in file.parents if root in folder.parents and folder != CONFTEST.parent]
    texts = [each.read_text(encoding="utf-8") for each in above if each.exists()]
    own = file.read_text(encoding="utf-8")
    return any("mark.slow" in text for text in (own, *(text for text in texts if file.stem in text)))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With ``--beyond``, leave out files without such tests: each worker would take seconds to import them."""
    if not (file := config.getoption("--beyond")) or collection_path.suffix != ".py":
        return None
    named = {name.partition("::")[0] for name in _listed(file)}
    where = collection_path.relative_to(config.rootpath).as_posix()
    return None if where in named or _may_be_slow(collection_path, config.rootpath) else True


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the longest of the files that wait, and with slow tests: no worker has a long file at the end."""
    for path in {item.path for item in items if item.get_closest_marker("slow")}:
        if not _may_be_slow(path, config.rootpath):
            raise pytest.UsageError(
                f"{path}: expected 'mark.slow' there, or in a conftest.py that names it; '--beyond' looks there"
            )
    if file := config.getoption("--beyond"):
        listed = _listed(file)
        beyond = [bool(item.get_closest_marker("slow") or _entry(item.nodeid, listed)) for item in items]
        config.hook.pytest_deselected(items=[item for item, runs in zip(items, beyond, strict=True) if not runs])
        items[:] = [item for item, runs in zip(items, beyond, strict=True) if runs]
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
