"""Every test leaves as it came: no simulated world, no thread, no socket."""

import os
import threading
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
    assert _open() <= descriptors
