"""Progress bars with the remaining time on a terminal, no output elsewhere."""

import io
import os
import pty
import re
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from errormotion.cli.curves import MAX_CURVES, MAX_POINTS, Curves
from errormotion.cli.progress import Bars
from errormotion.errors import RunError


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


ASKING = """
import time
from errormotion.cli.progress import Bars
from errormotion.errors import RunError
from errormotion.errors import RunError
print("ready", flush=True)
time.sleep(1.0)
with Bars(quiet=True) as bars:
    {work}
print("done", flush=True)
"""


@pytest.fixture
def at_terminal() -> Iterator[Callable[[str], tuple[subprocess.Popen[bytes], int]]]:
    """Return a function that runs statements with bars on a terminal."""
    started = []

    def start(work: str) -> tuple[subprocess.Popen[bytes], int]:
        own, theirs = pty.openpty()
        words = [sys.executable, "-c", ASKING.format(work=work)]
        process = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, env=os.environ | {"TERM": "dumb"})
        os.close(theirs)
        started.append((process, own))
        return process, own

    yield start
    for process, own in started:
        process.kill()
        process.wait()
        os.close(own)


def shown(own: int, text: str, seconds: float) -> str:
    """Return what a terminal shows until a text, or for a time."""
    found, end = "", time.monotonic() + seconds
    while text not in found and time.monotonic() < end:
        if select.select([own], [], [], 0.1)[0]:
            try:
                found += os.read(own, 65536).decode()
            except OSError:
                break
    return found


@pytest.mark.slow
@pytest.mark.parametrize("work", ['bars.ask("Mount the bar.")', 'bars.release(["X moves"])'])
@pytest.mark.parametrize("typed", [b"move\n", b"move\nmove\n\n\n", b"mo", b"\x04\x04"])
def test_only_what_is_typed_after_a_question_answers_it(
    at_terminal: Callable[[str], tuple[subprocess.Popen[bytes], int]], work: str, typed: bytes
) -> None:
    process, own = at_terminal(work)
    assert "ready" in shown(own, "ready", 60.0)
    os.write(own, typed)  # before the question
    assert ": " in shown(own, ": ", 60.0)
    time.sleep(1.0)
    assert process.poll() is None
    os.write(own, b"move\n")
    assert "done" in shown(own, "done", 60.0)


@pytest.mark.slow
def test_a_paste_that_arrives_during_the_question_releases_nothing(
    at_terminal: Callable[[str], tuple[subprocess.Popen[bytes], int]],
) -> None:
    process, own = at_terminal('bars.release(["X moves"])')
    assert "ready" in shown(own, "ready", 60.0)
    end = time.monotonic() + 3.0
    while time.monotonic() < end:  # over a slow connection
        os.write(own, b"move\n")
        time.sleep(0.05)
    time.sleep(1.0)
    assert process.poll() is None
    os.write(own, b"no\n")
    assert "expected the word" in " ".join(shown(own, "releases the motions; found", 60.0).split())


def test_without_a_terminal_no_word_releases(monkeypatch: pytest.MonkeyPatch, terminal: Callable[[], Terminal]) -> None:
    terminal()
    monkeypatch.setattr(sys, "stdin", io.StringIO("move\n"))
    with pytest.raises(RunError, match="not released"), Bars() as bars:
        bars.release(["X moves"])
