"""The corpus of each codec and file reader: read or refused, with the limits of a frame, or of a file."""

import time
from collections.abc import Callable
from pathlib import Path

import corpus
import pytest
from file_readers import READERS
from fuzzing import SLOWEST, Codec

from errormotion.errors import ProtocolError

LARGEST, MOST = 1 << 20, 1000
"""Bytes and files of the corpus."""


@pytest.mark.parametrize("target", corpus.TARGETS.values(), ids=corpus.TARGETS)
def test_inputs_of_the_corpus_are_read_or_refused(target: Codec) -> None:
    for data in target.seeds():
        corpus.judge(target, data, memory=False)  # compiles what is compiled at its first use
    judged = {data: corpus.judge(target, data).fault for data in corpus.load(target)}
    faults = [f"{fault}: {data[:200]!r}" for data, fault in judged.items() if fault]
    assert faults == []


def test_the_corpus_is_small_and_belongs_to_what_is_read() -> None:
    files = sorted(corpus.FOLDER.iterdir())
    assert set(files) <= {corpus.file_of(target) for target in corpus.TARGETS.values()}
    assert len({corpus.file_of(target) for target in corpus.TARGETS.values()}) == len(corpus.TARGETS)
    assert sum(path.stat().st_size for path in files) < LARGEST
    assert len(files) < MOST


# ---------------------------------------------------------------------- the tools themselves


def sized(data: bytes) -> None:
    """Read a toy format: a letter, and a length that must be true."""
    if data[:1] == b"A":
        if len(data) < 2:
            raise ProtocolError("no length")
        if data[1] != len(data) - 2:
            raise ProtocolError("another length")
    elif data:
        raise ValueError("no letter")


def slow(data: bytes) -> None:
    end = time.thread_time() + 2 * SLOWEST
    while data and time.thread_time() < end:
        pass


def large(data: bytes) -> bytes:
    return bytes(4 << 20) if data else b""


@pytest.mark.parametrize(
    ("read", "fault"), [(sized, "ValueError: no letter"), (slow, "ms of processor time"), (large, "bytes of memory")]
)
def test_what_is_not_allowed_is_found(read: Callable[[bytes], object], fault: str) -> None:
    target = Codec("a", "b", read, lambda: [b""], 8)
    assert not corpus.judge(target, b"").fault
    assert fault in corpus.judge(target, b"B").fault


def test_the_smallest_inputs_that_take_all_steps_are_kept() -> None:
    here = str(Path(__file__).parent)
    known = corpus.reached(sized, b"", inside=here)
    inputs = [b"Axxxxxx", b"A", b"A\1x", b"A\3xxx", b"", b"A\0", b"BBB", b"B"]
    kept, found = corpus.smallest(sized, inputs, known, inside=here)
    assert kept == [b"A", b"B", b"A\0", b"Axxxxxx"]
    assert found == set().union(*(corpus.reached(sized, data, inside=here) for data in inputs)) - known


def test_inputs_come_back_from_their_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corpus, "FOLDER", tmp_path / "corpus")
    target = next(iter(corpus.TARGETS.values()))
    inputs = [bytes(range(256)), b"", b"\\x41\r\n", "é".encode()]
    corpus.store(target, inputs)
    assert corpus.load(target) == sorted(inputs, key=len)


def test_every_reader_accepts_one_of_its_good_inputs() -> None:
    for reader in READERS:
        assert any(corpus.judge(reader, data, memory=False).error is None for data in reader.seeds()), reader.name
