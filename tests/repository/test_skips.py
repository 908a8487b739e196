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


def _listed(suite: pytest.Pytester, *groups: tuple[str, str]) -> str:
    text = "".join(f'[[skipped]]\nreason = "{reason}"\ntests = ["{test}"]\n' for test, reason in groups)
    return str(suite.makefile(".toml", skipped=text))


FILE = "test_a_skip_is_compared_with_the_list.py"
AS_LISTED = [(f"{FILE}::test_skips", "no such instrument"), (f"{FILE}::test_marked", "never")]


@pytest.mark.parametrize(
    ("listed", "difference"),
    [
        (AS_LISTED, None),
        (AS_LISTED[:1], f"skipped, but not listed with this reason: {FILE}::test_marked: never"),
        ([(FILE, "")], None),
        ([*AS_LISTED, (f"{FILE}::test_passes", "late")], f"not skipped, but listed: {FILE}::test_passes"),
        ([AS_LISTED[0], (f"{FILE}::test_marked", "another reason")], f"*{FILE}::test_marked: never"),
    ],
)
def test_skips_must_be_those_of_the_list(
    suite: pytest.Pytester,
    monkeypatch: pytest.MonkeyPatch,
    listed: list[tuple[str, str]],
    difference: str | None,
) -> None:
    monkeypatch.delenv("CI", raising=False)
    suite.makepyfile(**{FILE.removesuffix(".py"): SKIPPED})
    result = suite.runpytest(*WITHOUT, "--skips", _listed(suite, *listed), FILE)
    result.assert_outcomes(passed=1, skipped=2, xfailed=1)
    assert (result.ret == 0) == (difference is None)
    if difference:
        result.stdout.fnmatch_lines([difference])


def test_beyond_the_list_only_slow_tests_run(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", "true")
    suite.makeini("[pytest]\nmarkers = slow")
    suite.makepyfile(
        test_listed="def test_one(): pass\ndef test_two(): pass",
        test_mixed="import pytest\n@pytest.mark.slow\ndef test_slow(): pass\n"
        "def test_named(): pass\ndef test_left(): 1 / 0",
        test_neither="raise RuntimeError('imported')",
    )
    listed = _listed(suite, ("test_listed.py", "a module"), ("test_mixed.py::test_named", "a test"))
    result = suite.runpytest(*WITHOUT, "--beyond", listed, "-k", "listed or mixed or neither")
    result.assert_outcomes(passed=4, deselected=1)


def test_slow_tests_are_marked_where_beyond_looks(suite: pytest.Pytester) -> None:
    suite.makeini("[pytest]\nmarkers = slow")
    suite.makepyfile(test_ours="def test_one(): pass")
    folder = suite.mkpydir("marked")
    (folder / "test_theirs.py").write_text("def test_two(): pass")
    mark = "import pytest\ndef pytest_collection_modifyitems(items):\n    for item in items: item.add_marker('slow')\n"
    (folder / "conftest.py").write_text(mark)
    result = suite.runpytest(*WITHOUT, "marked")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*test_theirs.py: expected 'mark.slow' there*"])
