"""Signals to a process that a file names: never to another process that has its number now, or by a forged file."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

PROC = Path("/proc")
LARGEST = (1 << 31) - 1
"""Largest number of a process."""
ANSWER_TIMEOUT = 5.0
"""Longest time for ``ps`` on systems without ``/proc``, s."""


class OtherProcessError(Exception):
    """The number is not that of the expected process."""


def started(pid: int) -> str:
    """Return when a process was started, in the words of the system; empty if it does not exist."""
    if PROC.is_dir():
        try:
            boot = (PROC / "sys/kernel/random/boot_id").read_text().strip()
            fields = (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
            return f"{boot} {fields[19]}"  # in clock ticks since the start of the computer
        except (OSError, IndexError):
            return ""
    return _of_ps(pid, "lstart=")


def terminate(pid: Any, start: Any, words: Sequence[str]) -> None:
    """Send SIGTERM to a process, if it was started at the stated time by a command with these successive words.

    Parameters
    ----------
    pid, start
        Number and start of the process, as a file states them; of any type.
    words : sequence of str

    Raises
    ------
    OtherProcessError
        The number is not that of such a process; nothing was sent.
    OSError
        The signal cannot be sent.
    """
    if type(pid) is not int or not 0 < pid <= LARGEST:
        raise OtherProcessError(f"expected the number of a process; found {str(pid)[:40]}")
    if not isinstance(start, str) or not start:
        raise OtherProcessError(f"expected the start of process {pid}; found none")
    handle = os.pidfd_open(pid) if hasattr(os, "pidfd_open") else None
    try:
        # With the handle, a process that gets the number after these checks receives nothing.
        if started(pid) != start:
            raise OtherProcessError(f"process {pid} was started at another time")
        if not _has(pid, words):
            raise OtherProcessError(f"process {pid} is another program")
        if handle is None:
            os.kill(pid, signal.SIGTERM)
        else:
            signal.pidfd_send_signal(handle, signal.SIGTERM)
    finally:
        if handle is not None:
            os.close(handle)


def _has(pid: int, words: Sequence[str]) -> bool:
    """Return whether the command of a process contains these successive words."""
    if not PROC.is_dir():
        return " ".join(words) in _of_ps(pid, "command=")
    try:
        command = (PROC / str(pid) / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return False
    wanted = [os.fsencode(word) for word in words]
    return any(command[k : k + len(wanted)] == wanted for k in range(len(command)))


def _of_ps(pid: int, column: str) -> str:
    command = ["ps", "-ww", "-o", column, "-p", str(pid)]
    try:
        found = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=ANSWER_TIMEOUT,
            check=False,
            env={**os.environ, "LC_ALL": "C"},
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return found.stdout.strip()
