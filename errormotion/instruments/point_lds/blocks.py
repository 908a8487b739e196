"""Blocks of counted values on a data port: a header with a preamble, then frames of 32-bit values.

Some manuals state the preamble ``MEAS``; other drivers read it as a little-endian word, ``SAEM``. Both are
accepted.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

PREAMBLES = (b"SAEM", b"MEAS")
PREAMBLE_BYTES = 4
BYTES_OF_VALUE = 4
MAX_BLOCK_BYTES = 65536
"""Longest block: the size of one TCP packet."""

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Header:
    """Content of a header.

    Attributes
    ----------
    counter : int
        Number of the first frame, modulo 2**32.
    frames : int
        Number of frames.
    channels : tuple of int
        Numbers of the values of a frame, from 1.
    """

    counter: int
    frames: int
    channels: tuple[int, ...] = (1,)

    @property
    def size(self) -> int:
        """Bytes of the frames."""
        return self.frames * len(self.channels) * BYTES_OF_VALUE


@dataclass(frozen=True)
class Block:
    """Frames of all channels.

    Attributes
    ----------
    counter : int
        Number of the first frame, modulo 2**32.
    channels : tuple of int
        Numbers of the channels, from 1.
    count : int
        Number of the frames.
    values : ndarray, int64, (frame, channel)
        As received; empty if the block is not intact.
    intact : bool
        Whether another block or nothing follows; if not, bytes of this block have been lost or added.
    """

    counter: int
    channels: tuple[int, ...]
    count: int
    values: Array
    intact: bool = True


class BlockDecoder:
    """Splits the bytes of the data port into blocks; stray bytes between them are discarded.

    Parameters
    ----------
    size : int
        Bytes of a header.
    possible : bytes
        Regular expression for the bytes from the end of the preamble to the end of a header; other bytes are not a
        header and are skipped without further examination.
    parse : callable
        Takes the bytes and the position of a header; returns its content, None if it is not a header.

    Attributes
    ----------
    stray : int
        Number of discarded bytes.
    """

    def __init__(self, size: int, possible: bytes, parse: Callable[[bytearray, int], Header | None]) -> None:
        self._size, self._parse = size, parse
        rest = size - PREAMBLE_BYTES
        self._start = re.compile(b"(?:%s)(?=%s|(?!.{%d}))" % (b"|".join(PREAMBLES), possible, rest), re.DOTALL)
        self._buffer = bytearray()
        self.stray = 0

    def feed(self, data: bytes, *, last: bool = False) -> list[Block]:
        """Return the blocks that are complete.

        A block is returned when the start of the next one is received, or at once if ``last`` states that none follows.

        Raises
        ------
        InstrumentError
            The header announces other values than those that are read.
        """
        self._buffer += data
        blocks: list[Block] = []
        start = 0
        while (found := self._next(start, last)) is not None:
            block, start = found
            if block is not None:
                blocks.append(block)
        del self._buffer[:start]
        return blocks

    def _next(self, start: int, last: bool) -> tuple[Block | None, int] | None:
        """Return the block at a position, or None with the position where to search; None if bytes are missing."""
        buffer, size = self._buffer, len(self._buffer) - start
        if size < PREAMBLE_BYTES:
            return None
        if buffer[start : start + PREAMBLE_BYTES] not in PREAMBLES:
            return None, self._skip(start)
        if size < self._size:
            return None
        header = self._parse(buffer, start)
        if header is None:
            return None, self._skip(start)
        begin = start + self._size
        end = begin + header.size
        follows = len(buffer) - end
        if follows < 0 or (follows < PREAMBLE_BYTES and not last):
            return None
        counter, channels, count = header.counter, header.channels, header.frames
        if follows >= PREAMBLE_BYTES and buffer[end : end + PREAMBLE_BYTES] not in PREAMBLES:
            # the block may end earlier: continue the search for the next one within it
            return Block(counter, channels, count, _NOTHING, False), min(self._search(begin), end)
        values = np.frombuffer(bytes(buffer[begin:end]), dtype="<i4").astype(np.int64)
        return Block(counter, channels, count, values.reshape(count, -1)), end

    def _skip(self, start: int) -> int:
        end = self._search(start + 1)
        self.stray += end - start
        return end

    def _search(self, start: int) -> int:
        """Return the first position from ``start`` on where a header starts or may start."""
        found = self._start.search(self._buffer, start)
        return found.start() if found else max(start, len(self._buffer) - PREAMBLE_BYTES + 1)


_NOTHING: Array = np.empty((0, 0), dtype=np.int64)
