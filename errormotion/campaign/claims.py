"""Exclusive use of the instruments of a machine: many instruments accept one connection only.

A program that measures or compensates claims the instruments before it opens them, and states its run folder. A
program that only displays readings then closes the instruments, and reads the run folder instead. A claim is a locked
file in the user's state folder, named after the machine; the operating system releases it when its process ends.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

from errormotion.campaign.folder import is_locked
from errormotion.datasets.files.reading import read_bytes

try:
    import fcntl
except ImportError:  # Windows: no locks, and no claims
    fcntl = None  # type: ignore[assignment]

RELEASE_TIMEOUT = 15.0
"""Longest time for which a claim waits until programs that display readings have closed the instruments, s."""
POLL_INTERVAL = 0.05
MAX_CLAIM = 1 << 14
"""Largest size of a claim, bytes."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Claim:
    """The program that uses the instruments: ``what`` it does, and its run folder as soon as it has one."""

    what: str
    run: Path | None = None


@contextmanager
def claimed(machine: str, what: str) -> Iterator[Callable[[Path], None]]:
    """Claim the instruments of a machine, and wait until programs that display readings have closed them.

    Parameters
    ----------
    machine : str
        Name of the machine of the bench.
    what : str
        Activity of the program, such as ``a run``.

    Yields
    ------
    callable
        States the run folder of the program.
    """
    descriptor, path = -1, _folder() / f"{_key(machine)}-{uuid4().hex}.claim"
    if fcntl is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError as error:  # a measurement does not depend on a claim
            log.warning("%s: the instruments are not claimed: %s", path, error)

    def state(run: Path | None) -> None:
        if descriptor >= 0:
            text = json.dumps({"what": what, "run": str(run.resolve()) if run is not None else ""}).encode()
            with suppress(OSError):
                os.pwrite(descriptor, text.ljust(len(text) + 1, b"\n"), 0)
                os.ftruncate(descriptor, len(text) + 1)

    try:
        state(None)
        if descriptor >= 0:
            _wait(machine)
        yield state
    finally:
        if descriptor >= 0:
            path.unlink(missing_ok=True)
            os.close(descriptor)


def holder(machine: str) -> Claim | None:
    """Return the newest claim of the instruments of a machine, or None."""
    if fcntl is None:
        return None
    found = []
    for path in _folder().glob(f"{_key(machine)}-*.claim"):
        with suppress(OSError):
            if is_locked(path):
                found.append((path.stat().st_mtime_ns, _read(path)))
            elif time.time() - path.stat().st_mtime > 1.0:  # of a killed process, not one that is being created
                path.unlink(missing_ok=True)
    return max(found, key=lambda each: each[0])[1] if found else None


@contextmanager
def watching(machine: str) -> Iterator[bool]:
    """Register a program that displays readings; the context returns whether the instruments are free of claims."""
    if fcntl is None:
        yield True
        return
    path = _folder() / f"{_key(machine)}.watched"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        log.warning("%s: cannot be locked: %s", path, error)
        yield True
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH)
        yield holder(machine) is None  # tested under the lock: a later claim waits until the lock is released
    finally:
        os.close(descriptor)


def _wait(machine: str) -> None:
    end = time.monotonic() + RELEASE_TIMEOUT
    while _watched(machine):
        if time.monotonic() > end:
            log.warning("another program still reads the instruments of %s", machine)
            return
        time.sleep(POLL_INTERVAL)


def _watched(machine: str) -> bool:
    try:
        descriptor = os.open(_folder() / f"{_key(machine)}.watched", os.O_RDWR)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def _read(path: Path) -> Claim:
    try:
        content: Any = json.loads(read_bytes(path, MAX_CLAIM))
        return Claim(str(content["what"]), Path(content["run"]) if content["run"] else None)
    except (OSError, ValueError, LookupError, TypeError, RecursionError):  # it is being written
        return Claim("another program")


def _folder() -> Path:
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "errormotion" / "turns"


def _key(machine: str) -> str:
    return hashlib.sha256(machine.encode("utf-8", "surrogatepass")).hexdigest()[:16]
