"""Numbers in 16-bit registers: 16 or 32 bits, in either order of words and of bytes."""

from __future__ import annotations

import math
import struct

#: Format and bits of each type of number.
KINDS = {"u16": ("H", 16), "i16": ("h", 16), "u32": ("I", 32), "i32": ("i", 32), "f32": ("f", 32)}


def words_of(kind: str) -> int:
    """Return the number of registers of a number of this type."""
    return KINDS[kind][1] // 16


def to_registers(value: float, kind: str, *, word_order: str = "big", byte_order: str = "big") -> list[int]:
    """Return the registers that represent a number; integers are rounded and limited to the range of their type."""
    letter, bits = KINDS[kind]
    if kind == "f32":
        data = struct.pack(">f", value)
    else:
        low = -(1 << bits - 1) if kind.startswith("i") else 0
        high = low + (1 << bits) - 1
        data = struct.pack(">" + letter, high if math.isinf(value) else min(max(round(value), low), high))
    words = [
        int.from_bytes(data[i : i + 2], "big" if byte_order == "big" else "little") for i in range(0, len(data), 2)
    ]
    return words if word_order == "big" else words[::-1]
