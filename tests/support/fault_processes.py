"""Processes of a programme of faults: forked from one that has imported the package, on a disk and clocks that fail.

A process takes the time of its work, and not that of the imports. Disk and clocks are those of `fault_shim.c`, where
the computer has a C compiler; they are a process's own.
"""

from __future__ import annotations

import ctypes
import math
import multiprocessing
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
POLL_INTERVAL = 0.02
"""Between two looks at a process, s."""
_context = multiprocessing.get_context("forkserver")
_one_at_a_time = threading.Lock()
"""The state of a process is not to be asked for by two threads at once."""


@dataclass(frozen=True)
class Disk:
    """Writes below a folder fail from the n-th on (0: none does) with an error of the system."""

    folder: Path
    first: int
    code: int


class Clock:
    """The clocks of a process and of those that continue its work; they differ from those of the computer.

    Attributes
    ----------
    wall, boot : float
        What is added to the wall clock, and to the time since the start of the computer, s.
    started : str
        Identity of the start of the computer; empty for the true one.
    """

    def __init__(self, file: Path) -> None:
        self.file, self.started = file, ""
        self.wall = self.boot = 0.0
        self.set()

    def set(self, wall: float | None = None, boot: float | None = None) -> None:
        """Set the clocks, also of running processes."""
        self.wall, self.boot = self.wall if wall is None else wall, self.boot if boot is None else boot
        self.file.touch()
        with self.file.open("r+b") as file:
            file.write(struct.pack("2d", self.wall, self.boot))


def shim(folder: Path) -> Path | None:
    """Compile the shim into a folder; None where the computer has no C compiler, or not this C library."""
    compiler = shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        return None
    library = folder / "fault_shim.so"
    words = [compiler, "-shared", "-fPIC", "-O1", "-o", library, HERE / "fault_shim.c", "-ldl", "-lm"]
    return None if subprocess.run(words, capture_output=True, check=False).returncode else library


def prepare(library: Path | None) -> None:
    """Start the process that all others are forked from."""
    changed = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(HERE)}
    changed |= {"LD_PRELOAD": str(library)} if library else {}
    before = {name: os.environ.get(name) for name in changed}
    os.environ.update(changed)
    try:
        _context.set_forkserver_preload(["fault_preload"])
        forkserver.ensure_running()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def processor_seconds() -> float:
    """Return the processor time of all processes that have ended, s; NaN where the system does not state it."""
    pid = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
    stat = Path(f"/proc/{pid}/stat")
    if not stat.exists():
        return math.nan
    own_and_children = stat.read_text().rpartition(")")[2].split()[11:15]
    return sum(map(int, own_and_children)) / os.sysconf("SC_CLK_TCK")


class Forked:
    """A command in a process group of its own, with the interface of `subprocess.Popen` as far as trials need it.

    Parameters
    ----------
    arguments : list
        Of ``errormotion``.
    journal : Path
        File of what is delivered to the recorder; beside it the standard output and error are kept.
    file_limit : int
        No file may exceed this size, bytes; 0 for no limit.
    disk : Disk, optional
    clock : Clock, optional
    environment : dict of str to str, optional
        Further variables of its environment.
    """

    def __init__(
        self,
        arguments: list[Any],
        journal: Path,
        file_limit: int = 0,
        disk: Disk | None = None,
        clock: Clock | None = None,
        environment: dict[str, str] | None = None,
    ) -> None:
        self._output = journal.with_name(f"{journal.name}.{os.urandom(4).hex()}")
        words = [str(word) for word in arguments]
        clocks = (str(clock.file), clock.started) if clock else None
        keywords = {"file_limit": file_limit, "disk": disk, "clocks": clocks, "environment": environment or {}}
        self._process = _context.Process(target=_work, args=(words, str(journal), str(self._output)), kwargs=keywords)
        with _one_at_a_time:
            self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        """Exit status; None while it runs, -9 after a kill."""
        with _one_at_a_time:
            return self._process.exitcode

    def poll(self) -> int | None:
        """Return the exit status; None while it runs."""
        return self.returncode

    def kill(self) -> None:
        """Send SIGKILL."""
        self._process.kill()

    def signal(self, number: int) -> None:
        """Send a signal to the process."""
        if self.returncode is None:
            os.kill(self.pid, number)

    @property
    def writes(self) -> int:
        """Number of writes below the folder of its disk; 0 without one."""
        file = self._output.with_name(f"{self._output.name}.writes")
        return int(file.read_text()) if file.exists() else 0

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Wait for the end; return standard output and error."""
        until = time.monotonic() + (math.inf if timeout is None else timeout)
        while self.returncode is None:
            if time.monotonic() > until:
                raise subprocess.TimeoutExpired("errormotion", timeout or 0.0)
            time.sleep(POLL_INTERVAL)
        files = [self._output.with_name(self._output.name + end) for end in (".out", ".err")]
        out, error = (each.read_text(errors="replace") if each.exists() else "" for each in files)
        return out, error


def _work(
    words: list[str],
    journal: str,
    output: str,
    *,
    file_limit: int,
    disk: Disk | None,
    clocks: tuple[str, str] | None,
    environment: dict[str, str],
) -> None:
    """Run the command line in this process."""
    os.setsid()
    os.environ.update(environment)
    for number, end in ((1, ".out"), (2, ".err")):
        os.dup2(os.open(output + end, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    library = ctypes.CDLL(None)
    if clocks:
        from errormotion.datasets import clock

        library.fault_clock(clocks[0].encode())
        if clocks[1]:
            clock._boot = lambda: clocks[1]  # type: ignore[assignment]
    import fault_trials

    if disk:
        library.fault_disk(str(disk.folder).encode(), ctypes.c_long(disk.first), disk.code)
    try:
        fault_trials.command(journal, file_limit, words)
    finally:
        if disk:
            library.fault_writes.restype = ctypes.c_long
            Path(output + ".writes").write_text(str(library.fault_writes()))
