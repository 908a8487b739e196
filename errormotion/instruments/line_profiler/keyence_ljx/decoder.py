"""Decoder of a stream: joins split data, checks profiles and trigger count, fills short gaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.line_profiler.keyence_ljx import kernels
from errormotion.instruments.line_profiler.keyence_ljx.codec import (
    GARBLED,
    LOST,
    NOTIFY_WORDS,
    REASONS,
    STOPPED,
    TRIGGER_WORD,
    StreamLayout,
    notice,
)
from errormotion.instruments.streaming import Chunk

Array = np.ndarray[Any, Any]
WORD = 4
UNSYNCHRONISED_PROFILES = 8
"""Amount of data without a valid profile after which the stream ends with an error, in profiles."""
PIECE = 1 << 16
"""Data decoded at once, bytes: longer data are decoded piece by piece, so that the time grows linearly with their
length."""


class StreamEndedError(InstrumentError):
    """The profiler has ended the stream."""

    code = "stream.ended"


class StreamDecoder:
    """Converts the bytes of one stream, however they are split, to packed profiles.

    A chunk's values are (n, words) uint32 and its reasons 0, or LOST or GARBLED for a missing profile: LOST where the
    trigger count jumps between valid profiles, GARBLED where damaged bytes are between them. A gap of more than
    `kernels.MAX_FILLED_PROFILES` profiles adds no rows; the trigger counts on both sides show its length. After damaged
    bytes, the decoder searches the next position with a valid checksum and trigger count.

    Memory: a chunk has at most ``MAX_FILLED_PROFILES + 1`` times the received bytes, and temporarily twice as many;
    between two calls at most ``UNSYNCHRONISED_PROFILES`` profiles and ``PIECE`` bytes are stored.

    Parameters
    ----------
    layout : StreamLayout
    late_notice : bool
        Whether the notice of the end of the previous stream has not arrived; one notice before the first profile is
        then ignored.
    """

    def __init__(self, layout: StreamLayout, *, late_notice: bool = False) -> None:
        self._size = layout.words
        self._late_notice = late_notice
        self._rest = b""
        self._trigger = -1  # expected next count; -1: any
        self._searching = False
        self._searched = 0  # bytes of the rest in which no profile starts
        self.first_trigger = 0
        self.stray_bytes = 0

    def __call__(self, data: bytes) -> Chunk:
        """Return the profiles that the next bytes complete; the chunk's ``end`` states why none follow.

        Its ``end`` is a ProtocolError if many bytes contain no profile, or the trigger count is inconsistent; a
        StreamEndedError if the profiler ends the stream.
        """
        values: list[Array] = []
        reasons: list[Array] = []
        end: InstrumentError | None = None
        for start in range(0, len(data), PIECE):
            self._rest += data[start : start + PIECE]
            end = self._decode(values, reasons)
            if end is not None:
                break
        return self._chunk(values, reasons, end)

    def _decode(self, values: list[Array], reasons: list[Array]) -> InstrumentError | None:
        """Append the complete profiles of the rest; return why none follow, else None."""
        while True:
            if self._searching and not self._found():
                if len(self._rest) > UNSYNCHRONISED_PROFILES * self._size * WORD:
                    return ProtocolError(
                        f"No profile of {self._size} words with a valid checksum in {len(self._rest)} bytes. Check "
                        "that no settings were changed during the stream. Start the stream again",
                        code="profiler.stream.damaged",
                    )
                return None
            words = np.frombuffer(self._rest, dtype="<u4", count=len(self._rest) // WORD)
            aheads = np.empty(words.size // self._size, dtype=np.int64)
            n, why = kernels.follow(words, self._size, self._trigger, aheads)
            if n:
                self._take(words[: n * self._size].reshape(n, self._size), aheads[:n], values, reasons)
                self._rest = self._rest[n * self._size * WORD :]
            if why == kernels.MORE:
                return None
            if why == kernels.DAMAGED:
                self._searching, self._searched = True, 0
            elif why == kernels.LEAP:
                count = int(words[n * self._size + TRIGGER_WORD])
                return ProtocolError(
                    f"The trigger count jumps from {self._trigger - 1} to {count}: it was reset, or the profiler was "
                    "restarted. Start the stream again",
                    code="profiler.trigger.jump",
                )
            elif len(self._rest) < NOTIFY_WORDS * WORD:
                return None
            elif (end := self._notice()) is not None:
                return end

    def _found(self) -> bool:
        """Skip to the next valid profile; return whether one was found. No byte is searched twice."""
        room = self._size * WORD
        while self._searched + room <= len(self._rest):
            part = self._rest[self._searched : self._searched + 2 * room - 1]
            if (start := self._first_profile(part)) >= 0:
                self.stray_bytes += self._searched + start
                self._rest = self._rest[self._searched + start :]
                return True
            self._searched += len(part) - room + 1
        return False

    def _first_profile(self, data: bytes) -> int:
        """Return the first byte of data at which a valid profile starts; -1: none."""
        starts = []
        for shift in range(WORD):
            words = np.frombuffer(data[shift:], dtype="<u4", count=(len(data) - shift) // WORD)
            start = kernels.search(words, self._size, self._trigger)
            if start >= 0:
                starts.append(start * WORD + shift)
        return min(starts, default=-1)

    def _take(self, profiles: Array, aheads: Array, values: list[Array], reasons: list[Array]) -> None:
        if self._trigger < 0:
            self.first_trigger = int(profiles[0, TRIGGER_WORD])
        self._trigger = (int(profiles[-1, TRIGGER_WORD]) + 1) & 0xFFFFFFFF
        why = GARBLED if self._searching else LOST
        self._searching = False
        aheads = np.where(aheads > kernels.MAX_FILLED_PROFILES, 0, aheads)
        if not aheads.any():
            values.append(profiles)
            reasons.append(np.zeros(len(profiles), dtype=np.uint8))
            return
        received = np.arange(len(profiles)) + np.cumsum(aheads)
        filled = np.zeros((received[-1] + 1, self._size), dtype=np.uint32)
        rows = np.arange(len(filled))
        following = np.searchsorted(received, rows)  # the received profile at a row, or the next one
        filled[:, TRIGGER_WORD] = (profiles[following, TRIGGER_WORD].astype(np.int64) + rows - received[following]) & (
            0xFFFFFFFF
        )
        filled[received] = profiles
        missing = np.full(len(filled), LOST, dtype=np.uint8)
        missing[: received[0]] = why
        missing[received] = 0
        values.append(filled)
        reasons.append(missing)

    def _notice(self) -> StreamEndedError | None:
        bits = int.from_bytes(self._rest[WORD : NOTIFY_WORDS * WORD], "little")
        self._rest = self._rest[NOTIFY_WORDS * WORD :]
        late, self._late_notice = self._late_notice, False
        if bits & STOPPED and not (late and self._trigger < 0):
            return StreamEndedError(f"the profiler has ended the stream (notice {bits:08X})")
        return None

    def _chunk(self, values: list[Array], reasons: list[Array], end: InstrumentError | None) -> Chunk:
        if len(values) == 1:
            return Chunk(values[0], reasons[0], end=end)
        if not values:
            return Chunk(np.empty((0, self._size), dtype=np.uint32), np.empty(0, dtype=np.uint8), end=end)
        return Chunk(np.concatenate(values), np.concatenate(reasons), end=end)


class HeightDecoder:
    """Unpacks heights, intensities and encoder counts of profiles."""

    def __init__(self, layout: StreamLayout) -> None:
        self._layout = layout
        self._encoder: int | None = None  # last count, corrected for overflow

    def heights(self, profiles: Array, reasons: Array, heights: Array, counts: Array) -> None:
        """Unpack the heights (m) of profiles into (n, point); add to the ``counts`` by `codec.REASONS`."""
        kernels.unpack_heights(profiles, self._layout.z_unit, reasons, heights, counts)

    def intensities(self, profiles: Array, reasons: Array, intensities: Array) -> None:
        """Unpack the intensities of profiles into (n, point)."""
        kernels.unpack_intensities(profiles, reasons, intensities)

    def encoder(self, readings: Array, reasons: Array) -> Array:
        """Return encoder counts of the next profiles (n,), float64, corrected for the overflow of their 32 bits.

        NaN for lost profiles. Between two received profiles the encoder must move by less than half of its 2**32
        counts.
        """
        valid = reasons == 0
        counts = np.full(len(reasons), np.nan)
        raw = readings[valid].astype(np.uint32).view(np.int32).astype(np.int64)
        if raw.size:
            last = int(raw[0]) if self._encoder is None else self._encoder
            steps = (np.diff(raw, prepend=last) + (1 << 31)) % (1 << 32) - (1 << 31)
            counts[valid] = last + np.cumsum(steps)
            self._encoder = int(last + steps.sum())
        return counts

    def warm_up(self) -> None:
        """Compile all loops before the first profiles arrive."""
        blank = bytes(4 * self._layout.words)  # its checksum is valid
        trial = StreamDecoder(self._layout)
        chunk = trial(blank + notice(STOPPED))
        trial._searching = True
        trial(blank)
        heights = np.empty((len(chunk.values), self._layout.points))
        self.heights(chunk.values, chunk.reasons, heights, np.zeros(len(REASONS), dtype=np.int64))
        if self._layout.with_intensity:
            self.intensities(chunk.values, chunk.reasons, heights.astype(np.uint16))
