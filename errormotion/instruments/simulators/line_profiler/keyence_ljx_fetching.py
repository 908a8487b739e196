"""Profiles that are fetched from the memory of an LJ-X8000A by command."""

from __future__ import annotations

import struct

from errormotion.instruments.simulators.line_profiler import keyence_ljx_wire as wire
from errormotion.instruments.simulators.line_profiler.keyence_ljx_memory import Batch, Memory
from errormotion.instruments.simulators.line_profiler.keyence_ljx_wire import Answer, Code, ProfileLayout

FROM_CURRENT, FROM_OLDEST, FROM_STATED, FROM_COMMITTED, CURRENT_ONLY = range(5)
COMMITTED = 0x80000000
"""Bit of the number of profiles in the newest batch: it has ended."""


def single_profiles(memory: Memory, layout: ProfileLayout, arguments: bytes) -> Answer:
    """Answer command 42: the newest, the oldest or stated profiles, if batch measurement is off."""
    bank, position, number, count, erase = struct.unpack("<4xBB2xIBB2x", arguments)
    if bank > 1 or position > FROM_STATED or not count or erase > 1:
        return Code.WRONG_PARAMETER, b""
    batch = memory.newest
    if bank == 1 or batch is None or not batch.kept:  # one bank is used; assumed
        return Code.NO_DATA, b""
    first = {FROM_CURRENT: max(batch.oldest, batch.count - count), FROM_OLDEST: batch.oldest}.get(position, number)
    if not batch.oldest <= first < batch.count:
        return Code.WRONG_PARAMETER, b""
    count = min(count, batch.count - first)
    head = struct.pack("<IIIB3x4x", batch.count - 1, batch.oldest, first, count)
    return Code.OK, head + _fetched(batch, layout, first, count, erase)


def batch_profiles(memory: Memory, layout: ProfileLayout, arguments: bytes) -> Answer:
    """Answer command 43: profiles of the newest, the newest complete or a stated batch."""
    bank, position, wanted, number, count, erase = struct.unpack("<4xBB2xIIBB2x", arguments)
    if bank > 1 or position > CURRENT_ONLY or position == FROM_OLDEST or not count or erase > 1:
        return Code.WRONG_PARAMETER, b""
    newest = memory.newest
    batch = newest
    if position == FROM_COMMITTED:
        batch = next((each for each in reversed(memory.batches) if each.committed), None)
    if bank == 1 or newest is None or batch is None:
        return Code.NO_DATA, b""
    if position == FROM_STATED:
        batch = memory.batch(wanted)
    if batch is None or not batch.oldest <= number < batch.count:
        return Code.WRONG_PARAMETER, b""
    count = min(count, batch.count - number)
    oldest, ended = memory.batches[0], COMMITTED if newest.committed else 0
    of_newest, of_oldest = (newest.number, newest.count | ended), (oldest.number, oldest.count)
    head = struct.pack("<7IB3x4x", *of_newest, *of_oldest, batch.number, batch.count, number, count)
    return Code.OK, head + _fetched(batch, layout, number, count, erase)


def _fetched(batch: Batch, layout: ProfileLayout, first: int, count: int, erase: int) -> bytes:
    data = layout.block() + wire.as_fetched(batch.rows(first, count), layout)
    if erase:
        batch.drop_before(first + count)
    return data
