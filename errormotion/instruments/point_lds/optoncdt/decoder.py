"""Decoder of a stream: stores incomplete values, checks the counter, fills gaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from errormotion.errors import ProtocolError
from errormotion.instruments.point_lds.optoncdt import kernels
from errormotion.instruments.point_lds.optoncdt.codec import COUNTER_BITS, encode_value
from errormotion.instruments.streaming import Chunk

MAX_GAP_SAMPLES = 1 << (COUNTER_BITS - 1)
"""Samples: half the range of the counter; a larger gap cannot be distinguished from a counter that ran backwards."""


class StreamDecoder:
    """Converts the bytes of one stream, however they are split, to samples without gaps.

    Parameters
    ----------
    measuring_range : float
        m.
    highest : int
        Last raw value of the measuring range.
    counter : bool
        Whether each sample contains its counter.
    counter_first : bool
        Whether the counter precedes the distance.
    from_zero : bool
        Whether the first sample has counter 0; otherwise its counter is the reference.
    """

    def __init__(
        self,
        measuring_range: float,
        *,
        highest: int,
        counter: bool,
        counter_first: bool = False,
        from_zero: bool = False,
    ) -> None:
        self._range = measuring_range
        self._highest = highest
        self._counter = counter
        self._counter_first = counter_first
        self._look_ahead = int(kernels.look_ahead(counter, counter_first))
        self._rest = b""
        self._waiting = np.empty(0, dtype=np.uint32)  # values that the following ones have to confirm
        self._after_text = False
        self._next = 0
        self._state = np.zeros(kernels.STATE_SIZE, dtype=np.int64)
        self._state[kernels.ANCHORED] = from_zero

    def __call__(self, data: bytes) -> Chunk:
        """Return the samples that the next bytes complete.

        Raises
        ------
        ProtocolError
            The counter jumps by more than half its range: the sensor has restarted, or the data are not samples.
        """
        buffer = np.frombuffer(self._rest + data, dtype=np.uint8)
        values = np.empty(buffer.size // 3, dtype=np.uint32)
        text = np.empty(buffer.size, dtype=np.uint8)
        used, n_values, n_text, self._after_text = kernels.split(buffer, values, text, self._after_text)
        self._rest = buffer[used:].tobytes()
        pending = np.concatenate([self._waiting, values[:n_values]])
        self._waiting = pending[max(pending.size - self._look_ahead, 0) :]
        raws = np.empty(pending.size + 1, dtype=np.int32)
        numbers = np.empty(pending.size + 1, dtype=np.int64)
        count = kernels.assemble(pending, self._counter, self._counter_first, self._state, raws, numbers)
        return Chunk(*self._convert(raws[:count], numbers[:count]), text[:n_text].tobytes())

    def _convert(self, raws: np.ndarray[Any, Any], numbers: np.ndarray[Any, Any]) -> tuple[Any, Any]:
        if not raws.size:
            return np.empty(0), np.empty(0, dtype=np.uint8)
        size = int(numbers[-1]) + 1 - self._next
        if size - raws.size > MAX_GAP_SAMPLES:
            raise ProtocolError(
                f"The sample counter jumps by {size - raws.size}, more than half of its {COUNTER_BITS} bits: "
                "the sensor was restarted, or the data are not samples; start the stream again",
                code="protocol.counter.jump",
            )
        distances, reasons = np.empty(size), np.empty(size, dtype=np.uint8)
        kernels.convert(raws, numbers, self._next, self._range, self._highest, distances, reasons)
        self._next += size
        return distances, reasons

    def warm_up(self) -> None:
        """Compile all functions now, so that the first samples are not delayed."""
        trial = StreamDecoder(1.0, highest=self._highest, counter=self._counter)
        trial(encode_value(1000) + encode_value(0, first=False))
