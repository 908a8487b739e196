"""The corpus: a few inputs of each codec and reader that go where good frames do not, found by ``make guided``.

A file of ``tests/data/corpus`` belongs to one target and holds one input a line, in the notation of Python's bytes
without quotes. An input is kept because it takes a branch that neither the good frames nor the others take.
"""

import re
import sys
import tracemalloc
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import fuzzing
from file_readers import READERS
from fuzzing import Codec
from wire_codecs import CODECS

import errormotion
from errormotion.errors import ErrormotionError

FOLDER = Path(__file__).parents[1] / "data" / "corpus"
LONGEST = 8192
"""Longest input of the search, bytes."""
TARGETS: dict[str, Codec] = {each.name: each for each in (*CODECS, *READERS)}
"""What is searched, by name."""
OURS = str(Path(errormotion.__file__).parent)
Arc = tuple[CodeType, int, int]


def file_of(target: Codec) -> Path:
    """Return the file of a target's inputs."""
    return FOLDER / (re.sub(r"[^a-z0-9]+", "_", target.name.lower()).strip("_") + ".txt")


def load(target: Codec) -> list[bytes]:
    """Return the inputs of a target; none where it has no file."""
    path = file_of(target)
    lines = path.read_text(encoding="ascii").splitlines() if path.exists() else []
    return [line.encode("ascii").decode("unicode_escape").encode("latin-1") for line in lines]


def store(target: Codec, inputs: Sequence[bytes]) -> None:
    """Write the inputs of a target, shortest first."""
    lines = [data.decode("latin-1").encode("unicode_escape").decode("ascii") for data in sorted(inputs, key=_order)]
    FOLDER.mkdir(exist_ok=True)
    file_of(target).write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


def _order(data: bytes) -> tuple[int, bytes]:
    return len(data), data


# ---------------------------------------------------------------------- what is allowed


@dataclass
class Judged:
    """How one input was read: the error or None, CPU time (s), memory (bytes), and what is not allowed."""

    error: BaseException | None
    seconds: float
    memory: int
    fault: str = ""


def judge(target: Codec, data: bytes, *, memory: bool = True) -> Judged:
    """Read an input: only errors of the project, within the limits of a frame, or of a file, in time and memory."""
    limit = getattr(target, "limit", fuzzing.SLOWEST)
    error, took = fuzzing._timed(target, data)
    for _ in range(fuzzing.REPEATS if took > limit else 0):
        took = min(took, fuzzing._timed(target, data)[1])
    found = Judged(error, took, _memory(target, data) if memory else 0)
    if error is not None and not isinstance(error, ErrormotionError):
        found.fault = f"{type(error).__name__}: {str(error)[:200]}"
    elif took > limit:
        found.fault = f"{1e3 * took:.1f} ms of processor time; expected at most {1e3 * limit:g}"
    elif found.memory > target.memory:
        found.fault = f"{found.memory} bytes of memory; expected at most {target.memory}"
    return found


def _memory(target: Codec, data: bytes) -> int:
    tracemalloc.start()
    try:
        fuzzing._outcome(target, data)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


# ---------------------------------------------------------------------- what is reached


def reached(read: Callable[[bytes], object], data: bytes, *, inside: str = OURS) -> set[Arc]:
    """Return the steps from line to line that reading takes in files of a folder; compiled functions have none."""
    arcs: set[Arc] = set()

    def enter(frame: FrameType, event: str, _: Any) -> Any:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(inside):
            return None
        last = 0

        def step(frame: FrameType, event: str, _: Any) -> Any:
            nonlocal last
            if event in ("line", "return"):
                line = frame.f_lineno if event == "line" else -1
                arcs.add((code, last, line))
                last = line
            return step

        return step

    before = sys.gettrace()
    sys.settrace(enter)
    try:
        read(data)
    except Exception:  # noqa: BLE001 - judged elsewhere
        pass
    finally:
        sys.settrace(before)
    return arcs


def smallest(
    read: Callable[[bytes], object], inputs: Iterable[bytes], known: set[Arc], *, inside: str = OURS
) -> tuple[list[bytes], set[Arc]]:
    """Return the inputs that reach what is not known, short ones first, without those that others make superfluous.

    Returns
    -------
    list of bytes, set
        The inputs, and what they reach beyond what is known.
    """
    kept: list[tuple[bytes, set[Arc]]] = []
    found: set[Arc] = set()
    for data in sorted(set(inputs), key=_order):
        new = reached(read, data, inside=inside) - known
        if new - found:
            kept.append((data, new))
            found |= new
    for pair in sorted(kept, key=lambda pair: _order(pair[0]), reverse=True):
        others = set().union(*(arcs for each, arcs in kept if each != pair[0]))
        if pair[1] <= others:
            kept.remove(pair)
    return [data for data, _ in kept], found
