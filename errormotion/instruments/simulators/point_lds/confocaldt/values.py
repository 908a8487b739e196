"""Measured values of a confocalDT 24x1: conversion to nm and error values, averages, frames and blocks."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

NO_PEAK = 0x7FFFFFFB
BEFORE_RANGE = 0x7FFFFFFA
BEHIND_RANGE = 0x7FFFFFF9
NOT_CALCULABLE = 0x7FFFFFF8

PREAMBLE = 0x4D454153  # MEAS
HEADER = struct.Struct("<IIIIIHHI")
FRAMES_PER_BLOCK = 300
"""Largest number, so that a block with a few values fits an Ethernet packet; assumption."""

RATE_CODES = {70.0: 0, 50.0: 1, 25.0: 2, 10.0: 3, 5.0: 4, 2.5: 5, 1.0: 6, 0.3: 7, 0.2: 8, 0.1: 9}
"""Code of the frame rate in flags 2, by kHz."""
OTHER_RATE = 14

_FLAGS_1 = {"SHUTTER": 7, "ENC1": 8, "ENC2": 9, "ENC3": 10, "COUNTER": 11, "TIMESTAMP": 12, "INTENSITY": 15}
_FLAGS_1 |= {"STATE": 26, "TRIGTIMEDIFF": 27, "DIST1": 19, "DIST2": 20}
_FLAGS_2 = {"THICK12": 0, "MIN": 15, "MAX": 16, "PEAK2PEAK": 17}
_ORDER = ("SHUTTER", "MEASRATE", "ENC1", "ENC2", "ENC3", "COUNTER", "TIMESTAMP")
_NON_LINEAR, _MEASURED = 14, 18


def raw_values(distances: Array, measuring_range: float, offset: float = 0.0) -> Array:
    """Return distances from the start of the range (m) in nm, or as error values.

    ``offset`` (m) is added by mastering.
    """
    known = np.nan_to_num(distances, nan=0.0)
    raw = np.rint((known + offset) * 1e9).astype(np.int64)
    raw[known < 0.0] = BEFORE_RANGE
    raw[known > measuring_range] = BEHIND_RANGE
    raw[np.isnan(distances)] = NO_PEAK
    return raw


def states(distances: Array, measuring_range: float) -> Array:
    """Return error states: bit 2 no peak, 5 before, 6 beyond the range."""
    missing = np.isnan(distances).astype(np.int64)
    before = (distances < 0.0).astype(np.int64)
    behind = (distances > measuring_range).astype(np.int64)
    return np.asarray(missing << 2 | before << 5 | behind << 6)


class Averaging:
    """Moving, recursive and median averages of distances, continued from one call to the next."""

    def __init__(self, kind: str = "NONE", depth: int = 1) -> None:
        self._kind = kind
        self._depth = depth
        self._past: Array = np.empty(0)

    def __call__(self, distances: Array) -> Array:
        """Return as many averages as there are distances, m."""
        if self._kind == "NONE" or not len(distances):
            return distances
        if self._kind == "RECURSIVE":
            return self._recursive(distances)
        past = self._past if len(self._past) else np.full(self._depth - 1, distances[0])
        joined = np.concatenate([past, distances])
        self._past = joined[len(joined) - (self._depth - 1) :]
        windows = np.lib.stride_tricks.sliding_window_view(joined, self._depth)
        return np.asarray(windows.mean(axis=1) if self._kind == "MOVING" else np.median(windows, axis=1))

    def _recursive(self, distances: Array) -> Array:
        mean = float(self._past[0]) if len(self._past) else float(distances[0])
        averages = np.empty(len(distances))
        for i, distance in enumerate(distances):
            if not np.isnan(distance):
                mean = float(distance) if np.isnan(mean) else mean + (float(distance) - mean) / self._depth
            averages[i] = mean if not np.isnan(distance) else np.nan
        self._past = np.array([mean])
        return averages


def columns(selected: Sequence[str], peaks: int) -> tuple[str, ...]:
    """Return the values of a frame in the order in which they are sent (p. 110)."""
    names = [name for name in _ORDER if name in selected]
    for peak in range(1, peaks + 1):
        names.append(f"DIST{peak}")
        if "INTENSITY" in selected:
            names.append(f"INTENSITY{peak}")
    names += [name for name in ("STATE", "TRIGTIMEDIFF") if name in selected]
    names += ["THICK12"] if peaks > 1 else []
    return (*names, *(name for name in ("MIN", "MAX", "PEAK2PEAK") if name in selected))


def flags(names: Sequence[str], rate: float, *, linear: bool) -> tuple[int, int]:
    """Return flags 1 and 2 of the header for these values and a rate in kHz (p. 116)."""
    first = 1 << _MEASURED | (0 if linear else 1 << _NON_LINEAR)
    second = RATE_CODES.get(rate, OTHER_RATE) << 28
    for name in names:
        plain = "INTENSITY" if name.startswith("INTENSITY") else name
        first |= 1 << _FLAGS_1[plain] if plain in _FLAGS_1 else 0
        second |= 1 << _FLAGS_2[plain] if plain in _FLAGS_2 else 0
    return first, second


def block(
    frames: Array, marks: tuple[int, int], article: int, serial: int, counter: int, *, frames_first: bool
) -> bytes:
    """Return a block: the header, and frames, shape (frame, value)."""
    sizes = 4 * frames.shape[1], len(frames)
    sizes = sizes[::-1] if frames_first else sizes
    header = HEADER.pack(PREAMBLE, article, serial, *marks, *sizes, counter & 0xFFFFFFFF)
    return header + (frames & 0xFFFFFFFF).astype("<u4").tobytes()
