"""In CI a skip is a failure; elsewhere it is a skip with its reason."""

from pathlib import Path

import pytest

pytest_plugins = "pytester"

WITHOUT = ("-p", "no:dash", "-p", "no:zarr")  # plugins, as for all tests
CONFTEST = Path(__file__).parents[1] / "conftest.py"
SKIPPED = """
import pytest
def test_passes(): pass
def test_skips(): pytest.skip("no such instrument here")
@pytest.mark.skip(reason="never")
def test_marked(): pass
@pytest.mark.xfail(reason="known", strict=True)
def test_known(): assert False
"""


@pytest.fixture
def suite(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    pytester.makeconftest(CONFTEST.read_text())
    pytester.makepyfile(SKIPPED)
    return pytester


def test_a_skip_fails_in_ci(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", "true")
    result = suite.runpytest(*WITHOUT)
    result.assert_outcomes(passed=1, failed=1, errors=1, xfailed=1)
    result.stdout.fnmatch_lines(["*no such instrument here*", "*nothing is skipped*"])


def test_a_module_that_skips_itself_fails_in_ci(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", "true")
    suite.makepyfile(test_module="import pytest\npytest.importorskip('no_such_module')\n")
    result = suite.runpytest(*WITHOUT, "test_module.py")
    result.assert_outcomes(errors=1)


@pytest.mark.parametrize("value", ["", "false"])
def test_a_skip_stays_a_skip_elsewhere(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("CI", value)
    suite.runpytest(*WITHOUT).assert_outcomes(passed=1, skipped=2, xfailed=1)
