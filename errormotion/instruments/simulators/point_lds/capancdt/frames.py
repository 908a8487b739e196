"""Measured values of a capaNCDT 6200: distances to raw values, averaging, math functions, blocks."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from errormotion.instruments.simulators.point_lds.capancdt.commands import (
    CHANNELS,
    FULL_SCALE,
    ORDER_NUMBER,
    ControllerMemory,
)

Array = np.ndarray[Any, Any]

PREAMBLE = 0x4D454153  # MEAS
HEADER = struct.Struct("<IIIQIHHI")
FRAMES_PER_BLOCK = 256
_MATH_SHIFT = 3  # from 21 bits of an offset to 24 bits of a value


def raw_values(distances: Array, measuring_range: float) -> Array:
    """Return distances from the start of the range (m) as 24 bits; FFFFFF out of range and without a target."""
    scaled = np.rint(np.nan_to_num(distances, nan=np.inf) / measuring_range * FULL_SCALE)
    return np.clip(scaled, 0, FULL_SCALE).astype(np.int64)


class Averaging:
    """Averages of successive frames, continued from one call to the next."""

    def __init__(self, kind: int, number: int) -> None:
        self._kind = kind
        self._number = number
        self._past: Array | None = None

    def __call__(self, frames: Array) -> Array:
        """Return the averages that are completed by these frames, shape (frame, channel)."""
        if self._kind not in (1, 2, 3) or not len(frames):
            return frames
        n = self._number
        if self._kind == 2:
            joined = frames if self._past is None else np.concatenate([self._past, frames])
            whole = len(joined) // n * n
            self._past = joined[whole:]
            return _whole(joined[:whole].reshape(-1, n, frames.shape[1]).mean(axis=1))
        past = np.repeat(frames[:1], n - 1, axis=0) if self._past is None else self._past
        joined = np.concatenate([past, frames])
        self._past = joined[len(joined) - (n - 1) :]
        windows = np.lib.stride_tricks.sliding_window_view(joined, n, axis=0)
        averages = windows.mean(axis=-1) if self._kind == 1 else np.median(windows, axis=-1)
        return _whole(averages)


def _whole(values: Array) -> Array:
    return np.asarray(np.rint(values), dtype=np.int64)


def with_functions(frames: Array, present: Sequence[int], settings: ControllerMemory) -> tuple[Array, tuple[int, ...]]:
    """Return the values of all channels that are sent, shape (frame, channel), and their numbers.

    ``frames`` contains the channels that are ``present``; a math function replaces its channel.
    """
    channels = tuple(each for each in range(1, CHANNELS + 1) if each in present or each in settings.functions)
    columns = []
    for channel in channels:
        function = settings.functions.get(channel)
        if function is None:
            columns.append(frames[:, present.index(channel)])
            continue
        factors = np.array([function.factors[each - 1] for each in present])
        columns.append(_whole((function.offset << _MATH_SHIFT) + frames @ factors))
    return np.stack(columns, axis=1), channels


def block(frames: Array, channels: Sequence[int], serial: int, counter: int) -> bytes:
    """Return a block: the header and its frames, shape (frame, channel)."""
    field = sum(1 << 2 * (channel - 1) for channel in channels)
    width = 4 * len(channels)
    header = HEADER.pack(PREAMBLE, ORDER_NUMBER, serial, field, 0, width, len(frames), counter & 0xFFFFFFFF)
    return header + frames.astype("<i4").tobytes()
