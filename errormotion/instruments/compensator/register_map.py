"""Assignment of the parts of an offset to holding registers of a PLC, and the format of their numbers."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Length, Time
from errormotion.instruments.two_wires import TwoWireSettings

SIZES: Mapping[str, int] = {"i16": 1, "i32": 2}
Three = tuple[int, int, int]


class RegisterSettings(TwoWireSettings):
    """Settings of a PLC: its registers, counted from 0, and its line."""

    unit: int = Field(default=1, description="address of the PLC, if its URL states none", ge=0, le=255)
    offset: Three = Field(default=(0, 2, 4), description="first register of the offset of X, Y, Z")
    heartbeat: int = Field(default=6, description="register that is increased by 1 at each write")
    applied: Three | None = Field(
        default=None,
        description="first register of the offset of X, Y, Z in effect, written by the PLC; default: those of `offset`",
    )
    stop: int | None = Field(default=None, description="register that is not 0 while the PLC accepts no offsets")
    busy: int | None = Field(default=None, description="register that is not 0 while the offset must not change")
    owner: int | None = Field(
        default=None,
        description="register with the number of the program that writes, 0 for none, which the PLC sets to 0 when its "
        "watchdog ends a compensation; a second program is refused",
    )
    type: Literal["i16", "i32"] = Field(default="i32", description="type of a number: signed, in one or two registers")
    word_order: Literal["big", "little"] = Field(
        default="big", description="order of two registers; big: the upper 16 bits first"
    )
    scale: Length = Field(default=1e-9, description="offset for one count", gt=0, le=1e-6)
    function: Literal[6, 16] = Field(
        default=16, description="Modbus function for writing: 16 for several registers at once, 6 for one"
    )
    timeout: Time = Field(default=0.5, description="time limit for an answer", gt=0, le=10)
    retry: Time = Field(default=1.0, description="minimum interval between two attempts to connect again", ge=0)
    retries: int = Field(default=1, description="number of repeated requests after a damaged answer", ge=0, le=10)
    baudrate: int = Field(default=19200, description="baud rate of a serial line, if its URL states none", gt=0)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        size = SIZES[self.type]
        used = [(register + i, name) for name, register, n in self._named() for i in range(n)]
        for name, register, n in self._named():
            if not 0 <= register <= (1 << 16) - n:
                raise ValueError(f"'{name}': expected a register from 0 to {(1 << 16) - n}; found {register}")
        registers = [register for register, _ in used]
        if double := next((each for each in used if registers.count(each[0]) > 1), None):
            raise ValueError(f"'{double[1]}': register {double[0]} is used twice")
        if self.function == 6 and size > 1:
            raise ValueError("'function': 6 writes one register, and an i32 has two; expected 16, or 'type' i16")
        return self

    def _named(self) -> Iterator[tuple[str, int, int]]:
        """Yield name, first register and number of registers of each quantity."""
        for register in self.offset:
            yield "offset", register, SIZES[self.type]
        for register in self.applied or ():
            yield "applied", register, SIZES[self.type]
        for name in ("heartbeat", "stop", "busy", "owner"):
            register = getattr(self, name)
            if register is not None:
                yield name, register, 1

    @property
    def largest(self) -> float:
        """Largest offset that the registers can represent, m."""
        return float(((1 << (16 * SIZES[self.type] - 1)) - 1) * self.scale)

    @property
    def states(self) -> dict[int, int]:
        """Registers that are read for the state: first register to number of registers."""
        size = SIZES[self.type]
        found = dict.fromkeys(self.applied or self.offset, size)
        return found | {register: 1 for register in (self.stop, self.busy) if register is not None}

    def words(self, count: int) -> list[int]:
        """Return the registers that represent a number of counts."""
        size = SIZES[self.type]
        data = struct.pack(">i" if size > 1 else ">h", count)
        found = list(struct.unpack(f">{size}H", data))
        return found if self.word_order == "big" else found[::-1]

    def count(self, words: Sequence[int]) -> int:
        """Return the number of counts that registers represent."""
        order = list(words) if self.word_order == "big" else list(words)[::-1]
        (found,) = struct.unpack(">i" if len(order) > 1 else ">h", struct.pack(f">{len(order)}H", *order))
        return int(found)


def runs(registers: Mapping[int, int], most: int) -> Iterator[tuple[int, list[int]]]:
    """Yield runs of at most ``most`` adjacent registers: the first one and the values.

    Parameters
    ----------
    registers : mapping of int to int
        Value by register.
    most : int
        Largest number of registers of a run.
    """
    first, values = -1, list[int]()
    for register in sorted(registers):
        if values and register == first + len(values) and len(values) < most:
            values.append(registers[register])
            continue
        if values:
            yield first, values
        first, values = register, [registers[register]]
    if values:
        yield first, values
