"""Commands of errormotion in processes of their own, which outlive the one that started them."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

LONGEST_OUTPUT = 4000
"""Bytes at the end of the output that are shown."""


def spawn(arguments: Sequence[str], output: Path, *, inherited: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """Start ``errormotion ARGUMENTS`` in a session of its own; it is waited for, so that no zombie stays.

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
        The process or its file cannot be made.
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
    """Return the end of what a process has printed; empty where it cannot be read."""
    with suppress(OSError), output.open("rb") as file:
        file.seek(max(0, file.seek(0, 2) - LONGEST_OUTPUT))
        return file.read(LONGEST_OUTPUT).decode("utf-8", "replace").strip()
    return ""
