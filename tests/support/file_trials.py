"""One command on altered files: in a forked process, with limits of time and memory, and what it did.

The parent imports the commands once; each trial is a fork of it, so that a crash, a memory limit or a command that does
not end concerns this trial only.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from errormotion.datasets.units import convert

INTERNAL_ERROR = 70
REFUSED = (1, 2, 3)
READ = (0, 4, 5)
"""Exit codes; 4 and 5 are decisions on tolerances."""
MARKUP = "<script>alert("
"""Start of the markup that alterations put into names and attributes."""
LONGEST = 30.0
"""Processor time of a command, s."""
MAX_WAIT = 300.0
"""Time until a command is ended, s; other processes may use the processors meanwhile."""
ADDRESS_SPACE = 3 << 30
"""What a command may reserve beyond its parent, bytes; it must not occupy so much."""
MEMORY = 384 << 20
"""What a command may occupy beyond its parent, bytes."""
MEMORY_PER_BYTE = 64
"""And for each byte of what it reads."""
COPIES = 5
"""And for each byte of the values that a dataset states, where it may state them."""


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes
    ----------
    code : int
        Exit status; the negative number of a signal.
    seconds : float
        Processor time.
    memory : int
        Memory beyond that of the parent, bytes.
    text, message : str
        Standard output and standard error.
    log : str
        The log of the commands: a traceback.
    """

    code: int
    seconds: float
    memory: int
    text: str
    message: str
    log: str

    @property
    def answer(self) -> str:
        """All that was printed."""
        return f"{self.text}\n{self.message}"


def preload(words: Sequence[str], folder: Path, place: Path) -> None:
    """Import here what a command imports, so that its forks need not."""
    run(words, folder, place, imports=place / "imports")
    for name in _read(place / "imports").split():
        with suppress(Exception):
            import_module(name)
    convert(1.0, "hPa", "Pa")  # the registry of units


def run(words: Sequence[str], folder: Path, place: Path, imports: Path | None = None) -> Ended:
    """Run a command in a folder; what it prints goes to files in ``place``."""
    place.mkdir(parents=True, exist_ok=True)
    log = place / "errormotion" / "errormotion.log"
    log.unlink(missing_ok=True)
    before = _resident()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        _child(list(words), folder, place, imports)
    until = time.monotonic() + MAX_WAIT
    while True:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            break
        if time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
            break
        time.sleep(0.005)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what it has left behind
    return Ended(
        os.waitstatus_to_exitcode(status),
        usage.ru_utime + usage.ru_stime,
        max(0, usage.ru_maxrss * 1024 - before),
        _read(place / "out"),
        _read(place / "err"),
        _read(log),
    )


def faults(ended: Ended, names: Sequence[str], size: int, stated: int = 0) -> list[str]:
    """Return what must not be: one of ``names`` (of the altered file) is in the message of a refusal.

    The files have ``size`` bytes, and state ``stated`` bytes of values.
    """
    found = []
    if ended.code == INTERNAL_ERROR:
        found.append(f"internal error: {_last(ended)}")
    elif ended.code < 0:
        found.append(f"ended by signal {signal.Signals(-ended.code).name}: {ended.message[-300:]}")
    elif "Traceback (most recent call last)" in ended.answer or "Warning: " in ended.message:
        found.append(f"a traceback or a warning of Python: {ended.message[-400:]}")
    elif ended.code in REFUSED and not any(name in ended.answer for name in names):
        found.append(f"exit code {ended.code} without the name of the file: {ended.answer[:400]}")
    if ended.seconds > LONGEST:
        found.append(f"{ended.seconds:.0f} s of processor time")
    if ended.memory > MEMORY + MEMORY_PER_BYTE * size + COPIES * stated:
        found.append(f"{ended.memory >> 20} MiB of memory for {size} bytes that state {stated}")
    return found


def harm(folder: Path) -> list[str]:
    """Return the pages in a folder in which text of a file became markup, and what a pickle has done."""
    return ["an object was unpickled"] * (folder / "unpickled").exists() + [
        f"{page.name} contains markup of the file"
        for page in folder.rglob("*.html")
        if page.is_file() and MARKUP in page.read_text(encoding="utf-8", errors="replace")
    ]


def _child(words: list[str], folder: Path, place: Path, imports: Path | None) -> None:
    code = INTERNAL_ERROR
    try:
        os.setpgid(0, 0)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(place / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), number)
        sys.stdout, sys.stderr = (os.fdopen(number, "w", encoding="utf-8", closefd=False) for number in (1, 2))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (int(2 * LONGEST), int(2 * LONGEST) + 5))
        limit = _pages(0) + ADDRESS_SPACE
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        os.environ["XDG_STATE_HOME"] = str(place)
        os.chdir(folder)
        from errormotion.cli import main

        main(words)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # noqa: BLE001 - the end of a process
        traceback.print_exc()
    finally:
        if imports is not None:
            imports.write_text("\n".join(sorted(sys.modules)))
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _pages(column: int) -> int:
    """Return a column of the kernel's account of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[column]) * resource.getpagesize()


def _resident() -> int:
    return _pages(1)


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")[-100_000:] if path.exists() else ""


def _last(ended: Ended) -> str:
    """Return the error and the place of the last lines of a traceback."""
    lines = [line.strip() for line in ended.log.splitlines() if line.strip()]
    places = [line for line in lines if line.startswith("File ") and "errormotion/" in line][-1:]
    return " | ".join([ended.message.splitlines()[0][:200] if ended.message else "", *places])
