"""Whether a driver stands whatever comes from the wire: a recorded session is replayed with mutated frames."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from shutil import copy
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, ReplayError
from errormotion.instruments.transports.recording import ReplayTransport, parts_of, read_recording, rewrite
from errormotion.plugins import InstrumentSubject
from errormotion.testing.kit import require

Frames = list[tuple[str, bytes]]

LONGEST_WAIT = 0.02
"""Time limit of a missing answer in a replay, s."""
MOST_MEMORY = 512e6
"""Growth of the memory of this process, byte."""
MUTANTS = 300
BUDGET = 6.0
"""Time after which no further mutant is tried, for each `MUTANTS` of them that are asked for, s."""
MOST_BUDGET = 60.0
TIMEOUT = 0.5
"""Setting of an instrument that has one, s."""
SEED = 20250301


def no_mutants(subject: InstrumentSubject) -> str:
    """Return why the check of mutants does not apply; empty where it does."""
    if not subject.mutants:
        return "the subject asks for no mutants"
    return "" if subject.simulated else "no session with a real device is recorded for it"


def mutants(subject: InstrumentSubject) -> str:
    """Whatever bytes arrive, the driver raises only the project's errors, within bounded time and memory."""
    budget = min(BUDGET * max(subject.mutants / MUTANTS, 1.0), MOST_BUDGET)
    if subject.make is None and "timeout" in subject.plugin.Settings.model_fields:
        subject = replace(subject, settings={**subject.settings, "timeout": TIMEOUT})
    rng = np.random.default_rng(SEED)
    with TemporaryDirectory() as folder, _hurried():
        original, mutant = Path(folder) / "original" / "a.rec", Path(folder) / "mutant" / "a.rec"
        for path in (original, mutant):
            path.parent.mkdir()
        failed = _outcome(subject, subject.address, record=original)
        require(failed is None, f"the session without a mutation failed: {failed!r}")
        sessions = _sessions(original)
        if not sessions:
            return "its recording has no received frames"
        _copy(original, mutant)
        _outcome(subject, f"replay://{mutant}")  # compiles what is compiled at its first use
        start, before, tried, refused, slowest = time.monotonic(), _memory(reset=True), 0, 0, 0.0
        while tried < subject.mutants and time.monotonic() < start + budget:
            part = list(sessions)[rng.integers(len(sessions))]
            frames, what = _mutated(sessions[part], rng)
            _copy(original, mutant)
            rewrite(mutant.parent / part.name, frames)
            begun = time.perf_counter()
            error = _outcome(subject, f"replay://{mutant}")
            seconds = time.perf_counter() - begun
            what = f"mutant {tried} ({what})"
            typed = error is None or isinstance(error, InstrumentError)
            require(typed, f"{what}: expected an InstrumentError, found {error!r}")
            require(seconds < subject.time_limit, f"{what} took {seconds:.1f} s, limit {subject.time_limit:g} s")
            grown = _memory() - before
            require(grown < MOST_MEMORY, f"{what}: the memory has grown by {grown / 1e6:.0f} MB")
            tried, refused, slowest = tried + 1, refused + (error is not None), max(slowest, seconds)
    return f"{tried} mutants, {refused} of them refused, {1e3 * slowest:.0f} ms at most"


def _sessions(path: Path) -> dict[Path, Frames]:
    """Return the files of a recording that have received frames; none for a copy of files that were read."""
    try:
        found = {part: read_recording(part)[1] for part in parts_of(path)}
    except ReplayError:
        return {}
    return {part: frames for part, frames in found.items() if _received(frames)}


def _mutated(frames: Frames, rng: np.random.Generator) -> tuple[Frames, str]:
    """Return frames of which one received one is changed, and what was changed."""
    received = _received(frames)
    number = received[rng.integers(len(received))]
    data = bytearray(frames[number][1])
    at = int(rng.integers(len(data)))
    length = int(rng.integers(1, 9))
    how = ("flip", "extreme", "delete", "repeat", "insert", "cut", "digits", "text", "other")[rng.integers(9)]
    match how:
        case "flip":
            data[at] ^= 1 << int(rng.integers(8))
        case "extreme":
            data[at : at + length] = bytes([(0, 0xFF, 0x7F, 0x80)[rng.integers(4)]]) * len(data[at : at + length])
        case "delete":
            del data[at : at + length]
        case "repeat":
            data[at:at] = data[at : at + length] * int(rng.integers(1, 40))
        case "insert":
            data[at:at] = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
        case "cut":
            del data[at:]
        case "digits":
            data[at:at] = b"9" * 400
        case "text":
            data[at] = b"\r\n ,;:.+-eEnN<>{}[]\"'|/*#"[rng.integers(25)]
        case "other":
            data = bytearray(frames[received[rng.integers(len(received))]][1])
    changed = [*frames]
    changed[number] = ("R", bytes(data) or b"\0")
    return changed, f"{how} at byte {at} of frame {number}: {bytes(data[max(0, at - 8) : at + 24])!r}"


def _received(frames: Frames) -> list[int]:
    return [number for number, (way, data) in enumerate(frames) if way == "R" and data]


def _outcome(subject: InstrumentSubject, address: str, record: Path | None = None) -> BaseException | None:
    """Go through a short session; return its error, or that of one of its threads."""
    of_threads: list[BaseException] = []
    before, threading.excepthook = threading.excepthook, lambda args: of_threads.append(args.exc_value or SystemError())
    error: BaseException | None = None
    instrument: Any = None
    try:
        instrument = subject.build(address=address, record=record)
        instrument.open()
        instrument.identify()
        instrument.read()
        if subject.streams:
            stream = iter(instrument.stream())
            for _ in islice(stream, 1):
                pass
            if hasattr(stream, "close"):
                stream.close()
        instrument.read()
        instrument.close()
    except Exception as found:  # noqa: BLE001 - judged by the check
        error = found
    finally:
        with suppress(InstrumentError):
            if instrument is not None:
                instrument.close()
        threading.excepthook = before
    return next((found for found in of_threads if not isinstance(found, InstrumentError)), error)


@contextmanager
def _hurried() -> Iterator[None]:
    before, ReplayTransport.longest_wait = ReplayTransport.longest_wait, LONGEST_WAIT
    try:
        yield
    finally:
        ReplayTransport.longest_wait = before


def _copy(original: Path, mutant: Path) -> None:
    for file in original.parent.iterdir():
        copy(file, mutant.parent / file.name)


def _memory(*, reset: bool = False) -> float:
    """Return the largest memory of this process since the last reset, or, where there is no reset, ever; byte."""
    own = Path("/proc/self")
    with suppress(OSError, ValueError, IndexError):
        if reset:
            (own / "clear_refs").write_text("5")
        (line,) = [line for line in (own / "status").read_text().splitlines() if line.startswith("VmHWM:")]
        return 1024.0 * int(line.split()[1])
    try:
        import resource
    except ImportError:  # not on this system
        return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)
