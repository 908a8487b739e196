"""Every test leaves no simulated world, no thread and no socket open."""

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from errormotion.instruments import simulators


def _open() -> set[str]:
    links = []
    for entry in Path("/proc/self/fd").iterdir() if Path("/proc/self/fd").is_dir() else ():
        try:
            links.append(os.readlink(entry))
        except OSError:  # closed meanwhile
            continue
    return {link for link in links if link.startswith(("socket:", "/dev/pt"))}


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    threads, descriptors = set(threading.enumerate()), _open()
    yield
    simulators.reset()
    assert set(threading.enumerate()) <= threads
    limit = time.monotonic() + 5.0  # a server that several tests share closes its end of a connection a little later
    while not _open() <= descriptors and time.monotonic() < limit:
        time.sleep(0.01)
    assert _open() <= descriptors
