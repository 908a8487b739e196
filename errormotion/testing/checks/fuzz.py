"""Check of a driver with arbitrary received bytes: a recorded session is replayed with mutated frames."""

from __future__ import annotations

import math
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
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

WAITS = (0.001, 0.02)
"""Time limits of a missing answer in a replay, s; the first one within which the unchanged recording is replayed."""
MUTANTS = 300
"""Up to this number, mutants are tried within `BUDGET`; a larger number is tried completely."""
BUDGET = 6.0
"""Time after which no further mutant is tried, s."""
LIMIT = 90.0
"""Time limit of the check within the budget, s; a longer check has a limit only for each mutant."""
MAX_TIME = 0.05
"""Processor time of a session with a mutated frame in addition to twice that of the recorded one, s.

A driver that reopens its device after an error works twice, and all work takes longer on a busy computer."""
REPEATS = 4
"""Number of repetitions of a session above a limit, because other work of the process may have caused it."""
MAX_MEMORY, MEMORY_PER_BYTE = 4 << 20, 64
"""Largest memory of a session with a mutated frame in addition to that of the recorded one: bytes, and bytes for each
byte of the frame."""
MEASURED = 20
"""Interval of the sessions whose memory is measured."""
MAX_GROWTH = 128e6
"""Growth of the memory of this process over all mutants, byte."""
TIMEOUT = 0.5
"""Value of the setting, if an instrument has it, s."""
SEED = 20250301


def no_mutants(subject: InstrumentSubject) -> str:
    """Return why the check of mutants does not apply; empty if it applies."""
    if not subject.mutants:
        return "the subject states no mutants"
    return "" if subject.simulated else "no session with a real device is recorded for this check"


def limit(subject: InstrumentSubject) -> float:
    """Return the time limit of the check, s."""
    return LIMIT if subject.mutants <= MUTANTS else math.inf


def mutants(subject: InstrumentSubject) -> str:
    """With any received bytes, the driver raises only errors of the package, within limits of time and memory."""
    if subject.make is None and "timeout" in subject.plugin.Settings.model_fields:
        subject = replace(subject, settings={**subject.settings, "timeout": TIMEOUT})
    rng = np.random.default_rng(SEED)
    with TemporaryDirectory() as folder:
        original, mutant = Path(folder) / "original" / "a.rec", Path(folder) / "mutant" / "a.rec"
        for path in (original, mutant):
            path.parent.mkdir()
        failed = _outcome(subject, subject.address, record=original)
        require(failed is None, f"the session without a mutation failed: {failed!r}")
        sessions = _sessions(original)
        if not sessions:
            return "its recording has no received frames"
        _copy(original, mutant)
        with _hurried():
            trial = Trial(subject, f"replay://{mutant}")
            until = time.monotonic() + (BUDGET if subject.mutants <= MUTANTS else math.inf)
            while trial.tried < subject.mutants and time.monotonic() < until:
                part = list(sessions)[rng.integers(len(sessions))]
                frames, size, what = _mutated(sessions[part], rng)
                rewrite(mutant.parent / part.name, frames)
                trial.try_one(size, what)
                copy(part, mutant.parent / part.name)
    return trial.summary


class Trial:
    """Replays of one recording, each with a mutated frame.

    Parameters
    ----------
    subject : InstrumentSubject
    address : str
        Of the recording. Two unchanged replays measure the time and memory for comparison.
    """

    def __init__(self, subject: InstrumentSubject, address: str) -> None:
        self.tried = self.refused = 0
        self._subject, self._address = subject, address
        self._longest = self._work = self._memory = 0.0
        for ReplayTransport.longest_wait in WAITS:  # the first replay includes compilations at first use
            if (failed := _outcome(subject, address)) is None:
                break
        require(failed is None, f"the replay without a mutation failed: {failed!r}")
        self._sound_work = max(self._replayed().work for _ in range(2))
        self._sound_memory = self._replayed(measured=True).memory
        self._before = _memory(reset=True)

    def try_one(self, size: int, what: str) -> None:
        """Replay the present recording, in which a frame of ``size`` bytes was changed as ``what`` states."""
        what = f"mutant {self.tried} ({what})"
        found = self._replayed(measured=self.tried % MEASURED == 0)
        typed = found.error is None or isinstance(found.error, InstrumentError)
        require(typed, f"{what}: expected an InstrumentError, found {found.error!r}")
        most = self._subject.time_limit
        require(found.seconds < most, f"{what} took {found.seconds:.1f} s, limit {most:g} s")
        for _ in range(REPEATS if found.work > 2.0 * self._sound_work + MAX_TIME else 0):
            found.work = min(found.work, self._replayed().work)
        more = max(found.work - self._sound_work, 0.0)
        limit = self._sound_work + MAX_TIME
        require(
            more <= limit,
            f"{what} took {1e3 * more:.0f} ms of processor time more than the recorded session, limit "
            f"{1e3 * limit:.0f} ms",
        )
        memory = max(found.memory - self._sound_memory, 0.0)
        most_memory = MAX_MEMORY + MEMORY_PER_BYTE * size
        require(memory <= most_memory, f"{what} took {memory / 1024:.0f} KiB, limit {most_memory / 1024:.0f} KiB")
        grown = _memory() - self._before
        require(grown < MAX_GROWTH, f"{what}: the memory has grown by {grown / 1e6:.0f} MB")
        self.tried, self.refused = self.tried + 1, self.refused + (found.error is not None)
        self._longest, self._work = max(self._longest, found.seconds), max(self._work, more)
        self._memory = max(self._memory, memory)

    @property
    def summary(self) -> str:
        """The result in words."""
        return (
            f"{self.tried} mutants, {self.refused} of them refused; at most {1e3 * self._longest:.0f} ms a session, "
            f"{1e3 * self._work:.1f} ms of processor time and {self._memory / 1024:.0f} KiB a frame"
        )

    def _replayed(self, *, measured: bool = False) -> _Replayed:
        """Replay the recording in a thread; a driver that hangs fails at the time limit of the subject."""
        found = _Replayed()
        worker = threading.Thread(target=lambda: self._replay(found), name="replayed-session", daemon=True)
        if measured:
            tracemalloc.start()
        try:
            start, work = time.perf_counter(), time.process_time()
            worker.start()
            worker.join(2.0 * self._subject.time_limit)
            found.seconds = time.perf_counter() - start
            if not measured:
                found.work = time.process_time() - work
            else:
                found.memory = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        return found

    def _replay(self, found: _Replayed) -> None:
        found.error = _outcome(self._subject, self._address)


@dataclass
class _Replayed:
    """A replayed session: its error, wall and processor time (s), and memory (bytes; 0 if not measured)."""

    error: BaseException | None = None
    seconds: float = 0.0
    work: float = 0.0
    memory: float = 0.0


def _sessions(path: Path) -> dict[Path, Frames]:
    """Return the files of a recording with received frames; none for copied input files."""
    try:
        found = {part: read_recording(part)[1] for part in parts_of(path)}
    except ReplayError:
        return {}
    return {part: frames for part, frames in found.items() if _received(frames)}


def _mutated(frames: Frames, rng: np.random.Generator) -> tuple[Frames, int, str]:
    """Return frames with one changed received frame, the length of this frame, and a description of the change."""
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
    return changed, len(data), f"{how} at byte {at} of frame {number}: {bytes(data[max(0, at - 8) : at + 24])!r}"


def _received(frames: Frames) -> list[int]:
    return [number for number, (way, data) in enumerate(frames) if way == "R" and data]


def _outcome(subject: InstrumentSubject, address: str, record: Path | None = None) -> BaseException | None:
    """Run a short session; return its error, or that of one of its threads."""
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
    """Restore the settings that a trial changes."""
    before = ReplayTransport.longest_wait
    try:
        yield
    finally:
        ReplayTransport.longest_wait = before


def _copy(original: Path, mutant: Path) -> None:
    for file in original.parent.iterdir():
        copy(file, mutant.parent / file.name)


def _memory(*, reset: bool = False) -> float:
    """Return the largest memory of this process since the last reset, or since its start without reset, byte."""
    own = Path("/proc/self")
    with suppress(OSError, ValueError, IndexError):
        if reset:
            (own / "clear_refs").write_text("5")
        (line,) = [line for line in (own / "status").read_text().splitlines() if line.startswith("VmHWM:")]
        return 1024.0 * int(line.split()[1])
    try:
        import resource
    except ImportError:  # not available on this system
        return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)
