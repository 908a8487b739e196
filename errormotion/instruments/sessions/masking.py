"""Masking of a serial number in a recording: in received and sent bytes, and in the note."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from errormotion.errors import InstrumentError
from errormotion.instruments.transports.recording import (
    add_note,
    parts_of,
    read_note,
    read_recording,
    rewrite,
)

SHORTEST = 3
"""Shortest word that is masked, characters; a shorter one may occur in other data by chance."""
MASK_DIGIT, MASK_LETTER = "1", "X"
"""Characters of a mask, which is as long as the word; a number of ones is also a number, so that it is accepted in its
place."""
_WORD = re.compile(r"[^\W_]+")


def masked_text(text: str, words: Sequence[str]) -> str:
    """Return a text with masked words, of the same length: ones for digits, X for letters."""
    for word in words:
        text = text.replace(word, _masked(word))
    return text


def words_of(serial: str) -> list[str]:
    """Return the words of a serial number that contain digits, the longest first, without short ones.

    Raises
    ------
    InstrumentError
        All of them are too short.
    """
    words = sorted({word for word in _WORD.findall(serial) if any(c.isdigit() for c in word)}, key=len, reverse=True)
    long = [word for word in words if len(word) >= SHORTEST]
    if (words and not long) or any(_masked(word) == word for word in long):
        raise InstrumentError(
            f"The serial number '{serial}' cannot be masked: expected a word of at least {SHORTEST} characters, not "
            f"all of them {MASK_DIGIT} or {MASK_LETTER}",
            code="recording.mask.serial_form",
        )
    return long


def mask(path: Path, words: Sequence[str], early: Mapping[Path, int]) -> int:
    """Mask words of a serial number in all files of a recording; return their number of occurrences on the wire.

    A word is searched as text, and, if it is an integer of at least 2^16, as four bytes in the first frames, whose
    number ``early`` states for each file. Checksums of the protocol are not corrected: replay the masked recording to
    check that the driver accepts it.
    """
    total = 0
    for part in parts_of(path):
        frames, first = read_recording(part)[1], early.get(part, 0)
        for word in words:
            for old, new in _forms(word):
                frames, count = _replaced(frames, old, new)
                total += count
            for old, new in _integers(word):
                changed, count = _replaced(frames[:first], old, new)
                frames = [*changed, *frames[first:]]
                total += count
        rewrite(part, frames)
    if (note := read_note(path)) is not None:
        add_note(path, _masked_note(note, words))
    return total


def holds(path: Path, words: Sequence[str]) -> bool:
    """Whether any of these words occurs in the text or in the bytes of a recording."""
    texts = [part.read_text(encoding="utf-8") for part in {path, *parts_of(path)}]
    heads = ["\n".join(text.splitlines()[:2]) for text in texts]
    if any(word in head for word in words for head in heads):
        return True
    frames = [frame for part in parts_of(path) for frame in read_recording(part)[1]]
    data = [b"".join(each for way, each in frames if way == direction) for direction in "WR"]
    return any(old in each for word in words for old, new in _forms(word) if old != new for each in data)


def _masked(word: str) -> str:
    return "".join(MASK_DIGIT if c.isdigit() else MASK_LETTER for c in word)


def _forms(word: str) -> list[tuple[bytes, bytes]]:
    """Return the bytes of a word as text on a wire, each with its mask."""
    texts = {word, word.upper(), word.lower()}
    return [(text.encode(code), _masked(text).encode(code)) for text in texts for code in ("utf-8", "utf-16-le")]


def _integers(word: str) -> list[tuple[bytes, bytes]]:
    """Return the bytes of a word as an integer on a wire, each with its mask."""
    if not (word.isascii() and word.isdecimal() and 1 << 16 <= int(word) < 1 << 32):
        return []
    numbers = int(word), int(_masked(word))
    return [(numbers[0].to_bytes(4, order), numbers[1].to_bytes(4, order)) for order in ("little", "big")]


def _replaced(frames: Sequence[tuple[str, bytes]], old: bytes, new: bytes) -> tuple[list[tuple[str, bytes]], int]:
    """Replace bytes by as many others, also across frames of one direction; return frames and occurrences."""
    count = 0
    streams: dict[str, bytes] = {}
    for direction in ("W", "R"):
        data = b"".join(each for way, each in frames if way == direction)
        count += data.count(old)
        streams[direction] = data.replace(old, new)
    at = {"W": 0, "R": 0}
    changed: list[tuple[str, bytes]] = []
    for direction, data in frames:
        start = at[direction]
        at[direction] += len(data)
        changed.append((direction, streams[direction][start : at[direction]]))
    return changed, count


def _masked_note(value: Any, words: Sequence[str]) -> Any:
    if isinstance(value, dict):
        return {key: _masked_note(each, words) for key, each in value.items()}
    if isinstance(value, list):
        return [_masked_note(each, words) for each in value]
    return masked_text(value, words) if isinstance(value, str) else value
