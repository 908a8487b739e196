"""Functions compiled at their first call, and the line on the terminal that says so."""

import subprocess
import sys

import numpy as np
import pytest

from errormotion import compiling
from errormotion.compiling import Compiler

MODULE = """
from errormotion.compiling import Compiler

compiled = Compiler("the loops of a test", seconds=3)


@compiled(inner=True)
def doubled(x):
    return 2.0 * x


@compiled(fastmath=True)
def doubled_and_raised(x):
    return doubled(x) + 1.0
"""
RUN = """
import sys
import loops

class Terminal:
    def __init__(self, stream): self.stream = stream
    def __getattr__(self, name): return getattr(self.stream, name)
    def isatty(self): return sys.argv[1] == "terminal"

sys.stderr = Terminal(sys.stderr)
assert "numba" not in sys.modules
print(loops.doubled_and_raised(3.0))
print(loops.doubled_and_raised(4.0))
"""


def run(folder, where):
    """Return what a new process writes on stdout and stderr that uses the loops for the first time."""
    (folder / "loops.py").write_text(MODULE, encoding="utf-8")
    command = [sys.executable, "-c", RUN, where]
    environment = {"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120, cwd=folder, env=environment)
    return done.stdout, done.stderr


@pytest.mark.slow
def test_the_terminal_shows_one_line_while_loops_are_compiled_and_none_once_they_are_cached(tmp_path):
    line = "Compiling the loops of a test, once: about 3 s\n"
    assert run(tmp_path, "terminal") == ("7.0\n9.0\n", line)
    assert run(tmp_path, "terminal") == ("7.0\n9.0\n", "")


def test_a_log_file_shows_no_line(tmp_path):
    assert run(tmp_path, "log") == ("7.0\n9.0\n", "")


def test_a_function_that_only_compiled_code_calls_refuses_a_call_from_python():
    @Compiler("nothing", seconds=0)(inner=True)
    def halved(x):
        return 0.5 * x

    with pytest.raises(TypeError, match=r"halved is declared with inner=True"):
        halved(1.0)


def test_what_fails_on_another_thread_is_raised(monkeypatch):
    monkeypatch.setattr(compiling, "threads", lambda: 3)
    done = np.zeros(30, bool)

    def work(first, last):
        if first == 20:
            raise MemoryError("no room")
        done[first:last] = True

    with pytest.raises(MemoryError, match="no room"):
        compiling.in_threads(work, 30, True)
    assert done.sum() == 20
    compiling.in_threads(lambda first, last: done.fill(last == 30), 30, False)  # one thread
    assert done.all()
