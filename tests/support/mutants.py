"""Damaged inputs: seeded mutants of good bytes, and the check that a reader answers them with an error of the project.

``mutants`` is for files and for frames of a protocol. Every mutant follows from the seed and its number alone, so that
a failure is repeated with ``mutant(data, seed, number)``. The environment variable ``ERRORMOTION_MUTANTS`` sets the
number of mutants of each input (the quick default is that of the test); a long run takes the time limit off::

    ERRORMOTION_MUTANTS=1e5 pytest -n0 --timeout=0 -k damaged tests
"""

import os
import random
import re
import time
from collections.abc import Callable, Iterator, Sequence

from errormotion.errors import ErrormotionError

Change = Callable[[bytes, random.Random], bytes]
NUMBER = re.compile(rb"[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
NUMBERS = (
    *(b"", b"0", b"-0", b"-1", b"255", b"65536", b"4294967296", b"-2147483649", b"9" * 26, b"9" * 400),
    *(b"1e400", b"-1e308", b"1e-400", b"1.7976931348623157e308", b"nan", b"NaN", b"inf", b"-inf"),
    *(b"0x10", b"1_000", b"1,5"),
)
"""What replaces a number."""
TOKENS = (
    *(b"\0", b"\r", b"\n", b"\r\n", b"\n\n", b"\t", b" ", b"\x1b[0m"),
    *(b"\xff\xfe", b"\xef\xbb\xbf", b"\x80", b"\xc3\x28", b"\xe2\x80\xa8"),
    *(b'"', b'""', b"'", b"#", b"=", b";", b",", b"[", b"]", b"{", b"}", b"<", b">", b"&", b"e", b"-"),
    *(b"%s", b"../", b"://"),
)
"""What is inserted."""
WINDOW = 2048
"""Bytes among whose numbers one is chosen."""


def count(quick: int) -> int:
    """Return the number of mutants: ``quick``, or that of the environment variable ERRORMOTION_MUTANTS."""
    return int(float(os.environ.get("ERRORMOTION_MUTANTS", quick)))


def mutants(data: bytes, seed: int, number: int, changes: Sequence[Change] = ()) -> Iterator[bytes]:
    """Yield mutants of some bytes; the first one is empty. ``changes`` default to all of them."""
    yield b""
    for k in range(1, number):
        yield mutant(data, seed, k, changes)


def mutant(data: bytes, seed: int, number: int, changes: Sequence[Change] = ()) -> bytes:
    """Return one mutant: one to four changes, at most twice as long as the bytes and 1 KiB."""
    rng = random.Random(seed * 1_000_003 + number)
    found = data
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        found = rng.choice(changes or CHANGES)(found, rng)
    return found[: 2 * len(data) + 1024]


def _span(data: bytes, rng: random.Random, longest: int = 64) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.randint(1, longest))


def flip(data: bytes, rng: random.Random) -> bytes:
    """Change one bit."""
    if not data:
        return data
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]


def overwrite(data: bytes, rng: random.Random) -> bytes:
    """Replace up to eight bytes with others."""
    start, end = _span(data, rng, 8)
    return data[:start] + rng.randbytes(end - start) + data[end:]


def cut(data: bytes, rng: random.Random) -> bytes:
    """Cut off the end."""
    return data[: rng.randrange(len(data) + 1)]


def delete(data: bytes, rng: random.Random) -> bytes:
    """Take out a few bytes, or a line."""
    if rng.random() < 0.3:
        lines = data.splitlines(keepends=True)
        if lines:
            del lines[rng.randrange(len(lines))]
        return b"".join(lines)
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def duplicate(data: bytes, rng: random.Random) -> bytes:
    """Repeat a few bytes, or a line."""
    if rng.random() < 0.3:
        lines = data.splitlines(keepends=True)
        if lines:
            place = rng.randrange(len(lines))
            lines.insert(rng.randrange(len(lines) + 1), lines[place])
        return b"".join(lines)
    start, end = _span(data, rng)
    return data[:end] + data[start:end] * rng.choice((1, 1, 2, 20)) + data[end:]


def insert(data: bytes, rng: random.Random) -> bytes:
    """Insert a sign with a meaning, or any bytes."""
    place = rng.randrange(len(data) + 1)
    return (
        data[:place] + (rng.choice(TOKENS) if rng.random() < 0.7 else rng.randbytes(rng.randint(1, 16))) + data[place:]
    )


def renumber(data: bytes, rng: random.Random) -> bytes:
    """Replace a number in a text with an unusual one."""
    start = rng.randrange(len(data) - WINDOW) if len(data) > WINDOW else 0  # of a long text, those of a stretch
    places = [match.span() for match in NUMBER.finditer(data, start, start + WINDOW)]
    if not places:
        return flip(data, rng)
    start, end = rng.choice(places)
    return data[:start] + rng.choice(NUMBERS) + data[end:]


def swap(data: bytes, rng: random.Random) -> bytes:
    """Exchange two stretches."""
    (a, b), (c, d) = sorted((_span(data, rng), _span(data, rng)))
    if b > c:
        return data
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


CHANGES: Sequence[Change] = (
    flip, overwrite, cut, delete, duplicate, insert, renumber, renumber, swap,
)  # fmt: skip


def lie(data: bytes, rng: random.Random) -> bytes:
    """Replace one to eight bytes by an extreme number, as in a field that states a length or a count."""
    size = rng.choice((1, 2, 2, 4, 4, 8))
    if len(data) < size:
        return flip(data, rng)
    place = rng.randrange(len(data) - size + 1)
    number = rng.choice((0, 1, len(data), (1 << 8 * size) - 1, 1 << 8 * size - 1, (1 << 8 * size - 1) - 1))
    order = rng.choice(("little", "big"))
    stated = (number % (1 << 8 * size)).to_bytes(size, order)  # type: ignore[arg-type]
    return data[:place] + stated + data[place + size :]


FRAME_CHANGES: Sequence[Change] = (*CHANGES, lie)
"""Changes of the frames of a protocol."""


def lengthen(data: bytes, seed: int, number: int, longest: int) -> bytes:
    """Return bytes of which one stretch is repeated until they are ``longest`` long."""
    rng = random.Random(seed * 1_000_003 + number)
    start, end = _span(data, rng)
    if start == end:
        return data
    count = max(longest - len(data), 0) // (end - start)
    return data[:end] + data[start:end] * count + data[end:]


def check(
    read: Callable[[bytes], object],
    data: bytes,
    *,
    seed: int,
    number: int,
    limit: float = 10.0,
    changes: Sequence[Change] = (),
) -> int:
    """Read every mutant; anything but a value or an error of the project fails, and more than ``limit`` s for one.

    Returns
    -------
    int
        Number of mutants that gave an error; that of the good bytes must be none.
    """
    read(data)
    refused = 0
    for k, each in enumerate(mutants(data, seed, number, changes)):
        start = time.perf_counter()
        try:
            read(each)
        except ErrormotionError:
            refused += 1
        except BaseException as error:
            error.add_note(f"mutant {k} of seed {seed}: {each[:200]!r}")
            raise
        took = time.perf_counter() - start
        assert took < limit, f"mutant {k} of seed {seed} took {took:.1f} s: {each[:200]!r}"
    return refused
