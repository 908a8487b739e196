"""Progress bars with the remaining time on a terminal, no output elsewhere."""

import io
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from errormotion.cli.curves import MAX_CURVES, MAX_POINTS, Curves
from errormotion.cli.progress import Bars


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Callable[[], Terminal]:
    """Make stderr a terminal; to be called in the test, because pytest replaces stderr at the start of each test."""

    def make() -> Terminal:
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "120")
        stream = Terminal()
        monkeypatch.setattr(sys, "stderr", stream)
        return stream

    return make


def work(quiet: bool = False) -> None:
    with Bars(quiet) as bars:
        bars.stage("opening the bench")
        bars.test("drift", Path("runs/x-drift-y"), 1, 2)
        bars.stage("measuring", 100.0)
        bars.advance(40.0)
        bars.advance(100.0)
        bars.stage("identifying")


def test_the_terminal_shows_test_part_fraction_and_remaining_time(terminal: Callable[[], Terminal]) -> None:
    stderr = terminal()
    work()
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", stderr.getvalue())
    assert "test 2 of 2, drift: runs/x-drift-y" in text
    assert re.search(r"2/2 drift: measuring .*100% +0:00:0\d left 0:00:00", text)
    assert "2/2 drift: identifying" in text


def test_progress_is_not_shown_without_a_terminal(
    terminal: Callable[[], Terminal], monkeypatch: pytest.MonkeyPatch
) -> None:
    stderr = terminal()
    work(quiet=True)
    assert stderr.getvalue() == ""
    pipe = io.StringIO()
    monkeypatch.setattr(sys, "stderr", pipe)
    work()
    assert pipe.getvalue() == ""


def test_the_operator_is_prompted_between_the_bars(
    terminal: Callable[[], Terminal], monkeypatch: pytest.MonkeyPatch
) -> None:
    stderr = terminal()
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    with Bars() as bars:
        bars.stage("measuring", 10.0)
        bars.ask("Mount the bar [10 mm].")
        bars.advance(5.0)
    assert "Mount the bar [10 mm]." in stderr.getvalue()


def test_values_of_notes_become_curves_on_a_terminal_only(terminal: Callable[[], Terminal]) -> None:
    stderr = terminal()
    with Bars() as bars:
        bars.stage("measuring", 100.0)
        for k in range(9):
            bars.note(f"EX {k:+.2f} EZ {-k:+.2f} um, EA {0.5 * k:+.1f} arcsec")
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", stderr.getvalue())
    assert re.search(r"EX  ▁▂▃▄▄?▅▅?▆▇█  \+8 um  \(\+0 to \+8\)", text)
    assert re.search(r"EZ  █.*▁  -8 um  \(-8 to [+-]0\)", text)
    assert "+4 arcsec  (+0 to +4)" in text


def test_a_long_curve_keeps_its_shape_in_bounded_memory() -> None:
    curves = Curves()
    for k in range(100_000):
        curves.add(f"EX {k:+} um")
    (line,) = curves.lines(80)
    assert len(line.plain) <= 80
    assert re.search(r"▁▁?▂.*▇▇*█", line.plain)
    assert len(curves._curves["EX"].points) < MAX_POINTS
    for k in range(100):
        curves.add(f"name{k} +1 um")
    assert len(list(curves.lines(80))) == MAX_CURVES
    plain = Curves()
    plain.add("12 of 300 values undecided, v1.2.3")
    assert not plain.shown
