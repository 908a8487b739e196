"""One session with an instrument under test, and resources left open after it."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from errormotion.plugins import InstrumentSubject, Samples
from errormotion.testing.kit import require


@dataclass
class Session:
    """Results of one session with an instrument: identity, readings, stream."""

    error: Exception | None = None
    seconds: float = 0.0
    identity: Any = None
    read: np.ndarray = field(default_factory=lambda: np.empty(0))
    stream: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    dropped: int = 0
    lost: int = 0
    unexplained: int = 0

    @property
    def unread(self) -> int:
        """Number of unknown values of the readings."""
        return int(np.isnan(self.read).sum())

    @property
    def summary(self) -> str:
        """The result in words."""
        if self.error is not None:
            return f"{type(self.error).__name__} after {self.seconds:.2f} s"
        if self.lost:
            return f"{self.lost} lost and counted"
        return f"{self.unread} values unknown" if self.unread else f"no loss, {self.seconds:.2f} s"


def run_session(
    subject: InstrumentSubject, *, address: str = "", fault: str = "", record: Path | None = None
) -> Session:
    """Run one session; return its results, with the error that ended it."""
    session = Session()
    start = time.perf_counter()
    blocks: list[Samples] = []
    instrument = subject.build(address=address, fault=fault, record=record)
    try:
        with instrument:
            session.identity = instrument.identify()
            if subject.streams:  # first: a virtual clock then starts at the same instant in each session
                for block in islice(instrument.stream(), subject.blocks):
                    blocks.append(block)
            session.read = np.array([value for _ in range(3) for value in numbers(instrument.read())])
    except Exception as error:  # noqa: BLE001 - the checks judge it
        session.error = error
    finally:
        instrument.close()
    session.seconds = time.perf_counter() - start
    if blocks:
        session.stream = np.concatenate([block.values for block in blocks], axis=1)
    for block in blocks:
        counted = block.dropped + sum(block.invalid.values())
        session.dropped += block.dropped
        session.lost += counted
        session.unexplained += int(np.isnan(block.values).sum()) if counted == 0 else 0
    return session


def first_blocks(instrument: Any, n: int) -> list[Samples]:
    """Return the first blocks of a stream."""
    return list(islice(instrument.stream(), n))


def numbers(reading: Any) -> list[float]:
    """Return all numbers of a reading, in order; None counts as NaN, and texts (states, names) are ignored."""
    return [
        math.nan if leaf is None else float(leaf)
        for leaf in leaves(reading)
        if leaf is None or (isinstance(leaf, int | float | np.number) and not isinstance(leaf, bool))
    ]


def leaves(reading: Any) -> Iterator[Any]:
    """Return the single values of a reading, in order."""
    if isinstance(reading, Mapping):
        for value in reading.values():
            yield from leaves(value)
    elif isinstance(reading, Samples):
        yield from reading.values.ravel()
    elif isinstance(reading, np.ndarray) and reading.dtype.kind in "biuf":
        yield from reading.ravel().tolist()
    elif isinstance(reading, np.ndarray | list | tuple):
        for value in np.ravel(reading) if isinstance(reading, np.ndarray) else reading:
            yield from leaves(value)
    else:
        yield reading


def require_same(one: np.ndarray, other: np.ndarray, message: str) -> None:
    """Fail unless two arrays contain the same values; NaN equals NaN."""
    require(one.shape == other.shape, f"{message}: {one.shape} values became {other.shape}")
    differ = ~((one == other) | (np.isnan(one) & np.isnan(other)))
    if differ.any():
        a, b = one[differ][0], other[differ][0]
        require(False, f"{message}: {differ.sum()} of {differ.size} values differ, the first {a:.9g} and {b:.9g}")


def open_things() -> set[str]:
    """Return the names of all threads, sockets and terminals of this process."""
    things = {f"thread {thread.name} ({thread.ident})" for thread in threading.enumerate()}
    descriptors = Path("/proc/self/fd")
    if descriptors.is_dir():
        for entry in os.listdir(descriptors):
            try:
                target = os.readlink(descriptors / entry)
            except OSError:  # closed meanwhile
                continue
            if target.startswith(("socket:", "/dev/pts", "/dev/ptmx", "pipe:")):
                things.add(f"{target} as descriptor {entry}")
    return things
