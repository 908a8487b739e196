"""Mutants of the frames of one codec: errors by type, the slowest frame, the largest memory of a frame."""

import gc
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mutants

from errormotion.errors import ErrormotionError

SLOWEST = 10e-3
"""Limit of one frame, or of one piece as a connection delivers it, with up to some thousand frames, s of CPU time."""
REPEATS = 5
"""A frame above the limit is read again so many times: what else the process does is no time of the codec."""
LENGTHENED = 50
"""Every so manieth mutant is made as long as the longest frame, or as a piece that a connection delivers."""
SAMPLED = 200
"""The memory of every so manieth mutant is measured."""
OWN_MEMORY, MEMORY_PER_BYTE = 1 << 16, 64
"""Largest memory of a frame: so many bytes, and so many for each byte of the longest frame that is tried."""
SHOWN = 5
"""Failures that are kept."""


class Steps:
    """Longest CPU time between two pieces of what is read, s."""

    def __init__(self) -> None:
        self.longest = self._since = 0.0

    def start(self) -> None:
        """Start at what is read next."""
        self.longest, self._since = 0.0, time.thread_time()

    def mark(self) -> None:
        """Note that a piece was read, or the end."""
        now = time.thread_time()
        self.longest, self._since = max(self.longest, now - self._since), now


STEPS = Steps()
"""Those of the frame that is being read: codecs that take pieces mark each of them."""


@dataclass(frozen=True)
class Codec:
    """A codec of the wire.

    Attributes
    ----------
    device : str
        Ids of the plugins that use it.
    part : str
        What is decoded.
    read : callable
        Takes the received bytes.
    seeds : callable
        Returns good bytes.
    longest : int
        Longest frame that the codec's module states, bytes.
    tried : int
        Length up to which frames are lengthened, bytes; longer ones are documents or files, which take their time.
    per_byte : int
        Bytes of memory for each byte of the longest frame that is tried.
    """

    device: str
    part: str
    read: Callable[[bytes], object]
    seeds: Callable[[], Sequence[bytes]]
    longest: int
    tried: int = 1 << 16
    per_byte: int = MEMORY_PER_BYTE

    @property
    def name(self) -> str:
        """Name in tables and tests."""
        return f"{self.device}: {self.part}"

    @property
    def lengthened(self) -> int:
        """Length to which frames are lengthened, bytes."""
        return min(self.longest, self.tried)

    @property
    def memory(self) -> int:
        """Largest memory while a frame is read, bytes."""
        return OWN_MEMORY + self.per_byte * self.lengthened


@dataclass
class Found:
    """What was found; results of several processes can be added.

    Attributes
    ----------
    frames, lengthened : int
        Number of mutants, and of those as long as the longest frame.
    slowest, slowest_piece : float
        Longest CPU time of one frame, and of a piece of one that was lengthened, s.
    size, size_piece : int
        Length of these, bytes.
    memory : int
        Largest memory while one of the sampled frames was read, bytes.
    sampled : int
        Number of these.
    errors : Counter
        Number of the project's errors by class.
    failures : list of str
        What was not allowed.
    """

    frames: int = 0
    lengthened: int = 0
    slowest: float = 0.0
    size: int = 0
    slowest_piece: float = 0.0
    size_piece: int = 0
    memory: int = 0
    sampled: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def __add__(self, other: "Found") -> "Found":
        slower = max(self, other, key=lambda found: found.slowest)
        slower_piece = max(self, other, key=lambda found: found.slowest_piece)
        return Found(
            self.frames + other.frames,
            self.lengthened + other.lengthened,
            slower.slowest,
            slower.size,
            slower_piece.slowest_piece,
            slower_piece.size_piece,
            max(self.memory, other.memory),
            self.sampled + other.sampled,
            self.errors + other.errors,
            [*self.failures, *other.failures][:SHOWN],
        )


def fuzz(codec: Codec, numbers: range, *, seed: int = 1, sampled: int = SAMPLED) -> Found:
    """Read the mutants of these numbers; every result follows from seed and number."""
    seeds = codec.seeds()
    accepted = [data for data in seeds if _outcome(codec, data) is None]  # compiles what is compiled at its first use
    if not accepted:
        raise AssertionError(f"{codec.name}: none of its good frames is accepted")
    found = Found()
    gc.collect()
    gc.freeze()  # also for later tests: what was loaded is not searched again
    gc.disable()
    try:
        for number in numbers:
            good = seeds[number % len(seeds)]
            data = mutants.mutant(good, seed, number, mutants.FRAME_CHANGES)
            piece = number % LENGTHENED == 0
            if piece:
                data = mutants.lengthen(data, seed, number, codec.lengthened)
            _read(codec, data, number, found, piece=piece)
            if number % sampled == 0:
                _measure(codec, data, number, found)
            if number % 1000 == 999:
                gc.collect()
    finally:
        gc.enable()
    return found


def _read(codec: Codec, data: bytes, number: int, found: Found, *, piece: bool) -> None:
    found.frames += 1
    found.lengthened += piece
    error, took = _timed(codec, data)
    for _ in range(REPEATS if took > SLOWEST else 0):
        took = min(took, _timed(codec, data)[1])
    if piece and took > found.slowest_piece:
        found.slowest_piece, found.size_piece = took, len(data)
    elif not piece and took > found.slowest:
        found.slowest, found.size = took, len(data)
    if isinstance(error, ErrormotionError):
        found.errors[type(error).__name__] += 1
    elif error is not None:
        _fail(found, number, data, f"{type(error).__name__}: {str(error)[:200]}")
    if took > SLOWEST:
        _fail(found, number, data, f"{1e3 * took:.1f} ms for {len(data)} bytes")


def _measure(codec: Codec, data: bytes, number: int, found: Found) -> None:
    tracemalloc.start()
    try:
        _outcome(codec, data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    found.sampled += 1
    found.memory = max(found.memory, peak)
    if peak > codec.memory:
        _fail(found, number, data, f"{peak} bytes of memory for {len(data)} bytes; expected at most {codec.memory}")


def _timed(codec: Codec, data: bytes) -> tuple[BaseException | None, float]:
    STEPS.start()
    error = _outcome(codec, data)
    STEPS.mark()
    return error, STEPS.longest


def _outcome(codec: Codec, data: bytes) -> BaseException | None:
    try:
        codec.read(data)
    except Exception as error:  # noqa: BLE001 - judged by the caller
        return error
    return None


def _fail(found: Found, number: int, data: bytes, what: str) -> None:
    if len(found.failures) < SHOWN:
        found.failures.append(f"mutant {number}: {what}; {data[:200]!r}")
