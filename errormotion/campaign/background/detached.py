"""Commands of errormotion in separate processes, which continue after the process that started them has ended."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from errormotion.datasets.files.reading import require_regular

MAX_OUTPUT = 4000
"""Size of the end of the output that is shown, bytes."""


def spawn(arguments: Sequence[str], output: Path, *, inherited: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """Start ``errormotion ARGUMENTS`` in a new session; a thread waits for it, so that it does not become a zombie.

    Parameters
    ----------
    arguments : sequence of str
    output : Path
        File to which standard output and errors are written.
    inherited : sequence of int, optional
        File descriptors that the process keeps open.

    Raises
    ------
    OSError
        The process cannot be started, or its file cannot be created.
    """
    with output.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "errormotion", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            pass_fds=list(inherited),
        )
    threading.Thread(target=process.wait, daemon=True).start()
    return process


def printed(output: Path) -> str:
    """Return the end of the output of a process; empty if it cannot be read."""
    with suppress(OSError):
        require_regular(output)
        with output.open("rb") as file:
            file.seek(max(0, file.seek(0, 2) - MAX_OUTPUT))
            return file.read(MAX_OUTPUT).decode("utf-8", "replace").strip()
    return ""
