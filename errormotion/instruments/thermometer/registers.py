"""Temperatures in Modbus registers: addresses, number types, scales, and codes of missing temperatures."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Temperature, Time
from errormotion.instruments.thermometer.sensors import GOOD, OPEN, OUT_OF_RANGE, SHORTED, ThermometerSettings
from errormotion.instruments.two_wires import TwoWireSettings

Kind = Literal["u16", "i16", "u32", "i32", "f32"]
Order = Literal["big", "little"]
Thermocouple = Literal["J", "K", "T", "E", "R", "S", "B"]

SIZES: Mapping[str, int] = {"u16": 1, "i16": 1, "u32": 2, "i32": 2, "f32": 2}
_CODES = {"u16": "H", "i16": "h", "u32": "I", "i32": "i", "f32": "f"}
#: Ranges of an ADAM-6018, degC; E to B are from memory.
RANGES: Mapping[str, tuple[float, float]] = {
    "J": (0.0, 760.0),
    "K": (0.0, 1370.0),
    "T": (-100.0, 400.0),
    "E": (0.0, 1000.0),
    "R": (500.0, 1750.0),
    "S": (500.0, 1750.0),
    "B": (500.0, 1800.0),
}
#: Register maps: the default settings for each name.
MAPS: Mapping[str, Mapping[str, Any]] = {
    "custom": {},
    "adam-6018": {"function": 3, "first": 0, "type": "u16", "open_codes": (65535,)},
    "logger-16": {"function": 3, "first": 0x20, "type": "i16", "scale": 0.1, "open_from": 10000},
}
_MAX_CHANNELS = {"adam-6018": 8, "logger-16": 16}


class ModbusSettings(ThermometerSettings, TwoWireSettings):
    """Settings of a thermometer with Modbus.

    A temperature is ``scale * number + offset``. Settings that are not given are those of the ``map``.
    """

    map: Literal["custom", "adam-6018", "logger-16"] = Field(
        default="custom", description="register map with the defaults of the other settings"
    )
    thermocouples: tuple[Thermocouple, ...] = Field(
        default=("K",),
        description="types, one for all channels or one for each; they determine the scale of an ADAM-6018",
        min_length=1,
    )
    unit: int = Field(default=1, description="address of the device, if its URL states none", ge=0, le=255)
    function: Literal[3, 4] = Field(default=3, description="3 reads holding registers, 4 input registers")
    first: int = Field(default=0, description="register of the first channel, from 0", ge=0, le=65535)
    stride: int | None = Field(
        default=None,
        description="number of registers from one channel to the next; default: the size of the type",
        ge=1,
    )
    registers: tuple[int, ...] = Field(
        default=(), description="register of each channel, if they are not evenly spaced"
    )
    most: int = Field(default=125, description="largest number of registers in one request", ge=2, le=125)
    type: Kind = Field(default="i16", description="type of a number: u16, i16, u32, i32 or f32")
    word_order: Order = Field(default="big", description="order of two registers; big: the upper 16 bits first")
    byte_order: Order = Field(default="big", description="order of the two bytes of a register; the standard has big")
    scale: float | tuple[float, ...] = Field(default=1.0, description="degC for one count; one for all or for each")
    offset: float | tuple[float, ...] = Field(default=0.0, description="degC at the count 0; one for all or for each")
    open_codes: tuple[int, ...] = Field(default=(), description="counts that mean an open sensor")
    open_from: int | None = Field(default=None, description="counts from this one on mean an open sensor")
    shorted_codes: tuple[int, ...] = Field(default=(), description="counts that mean a shorted sensor")
    lowest: Temperature = Field(default=-273.15, description="temperatures below are out of range")
    highest: Temperature = Field(default=2500.0, description="temperatures above are out of range")
    baudrate: int = Field(default=9600, description="baud rate of a serial line, if its URL states none", gt=0)
    timeout: Time = Field(default=1.0, description="time limit for an answer", gt=0)
    retry: Time = Field(default=1.0, description="minimum interval between two attempts to connect again", ge=0)
    retries: int = Field(default=1, description="number of repeated requests after a damaged answer", ge=0, le=10)

    @model_validator(mode="before")
    @classmethod
    def _defaults_of_the_map(cls, given: Any) -> Any:
        name = given.get("map", "custom") if isinstance(given, Mapping) else ""
        if not isinstance(name, str) or not MAPS.get(name):
            return given
        defaults = dict(MAPS[name])
        if name == "adam-6018":
            types = given.get("thermocouples", ("K",))
            types = [types] if isinstance(types, str) else types
            if all(isinstance(each, str) and each in RANGES for each in types):
                defaults["scale"] = tuple((RANGES[each][1] - RANGES[each][0]) / 65535 for each in types)
                defaults["offset"] = tuple(RANGES[each][0] for each in types)
        return {**defaults, **given}

    @model_validator(mode="after")
    def _fits(self) -> Self:
        n = len(self.channels)
        if n > _MAX_CHANNELS.get(self.map, n):
            raise ValueError(f"the {self.map} has {_MAX_CHANNELS[self.map]} channels; found {n} names")
        if self.registers and len(self.registers) != n:
            raise ValueError(f"'registers': expected one for each of the {n} channels; found {len(self.registers)}")
        for name in ("scale", "offset", "thermocouples"):
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) not in (1, n):
                raise ValueError(f"'{name}': expected one, or one for each of the {n} channels; found {len(value)}")
        size = SIZES[self.type]
        if self.stride is not None and self.stride < size:
            raise ValueError(f"'stride': a {self.type} needs {size} registers; found {self.stride}")
        if max(self.addresses) + size > 1 << 16:
            raise ValueError(f"expected registers up to 65535; the last channel starts at {max(self.addresses)}")
        return self

    @property
    def addresses(self) -> tuple[int, ...]:
        """First register of each channel."""
        if self.registers:
            return self.registers
        return tuple(self.first + i * (self.stride or SIZES[self.type]) for i in range(len(self.channels)))

    def blocks(self) -> Iterator[tuple[int, int]]:
        """Yield first register and number of registers of each request.

        Registers between evenly spaced channels exist and are read with them; registers between
        channels with explicit addresses may not exist and are not read.
        """
        size, gap = SIZES[self.type], 0 if self.registers else (self.stride or 0)
        begin = end = -1
        for address in sorted(set(self.addresses)):
            if begin >= 0 and address <= end + gap and address + size - begin <= self.most:
                end = max(end, address + size)
                continue
            if begin >= 0:
                yield begin, end - begin
            begin, end = address, address + size
        yield begin, end - begin

    def temperature(self, channel: int, words: Sequence[int]) -> tuple[float, str]:
        """Return temperature (degC) and flag of a channel from its registers."""
        number = decode_number(words, self.type, self.word_order, self.byte_order)
        if not math.isfinite(number) or number in self.open_codes:
            return math.nan, OPEN
        if number in self.shorted_codes:
            return math.nan, SHORTED
        if self.open_from is not None and number >= self.open_from:
            return math.nan, OPEN
        value = round(
            _each(self.scale, channel) * number + _each(self.offset, channel), 9
        )  # 19.7, not 19.700000000000003
        return value, GOOD if self.lowest <= value <= self.highest else OUT_OF_RANGE

    def words(self, channel: int, temperature: float) -> list[int]:
        """Return the registers that represent a temperature (degC)."""
        number = (temperature - _each(self.offset, channel)) / _each(self.scale, channel)
        return encode_number(number, self.type, self.word_order, self.byte_order)


def _each(value: float | tuple[float, ...], channel: int) -> float:
    if isinstance(value, tuple):
        return value[channel if len(value) > 1 else 0]
    return value


def decode_number(words: Sequence[int], kind: Kind, word_order: Order = "big", byte_order: Order = "big") -> float:
    """Return the number in one or two registers."""
    order = list(words) if word_order == "big" else list(words)[::-1]
    data = b"".join(word.to_bytes(2, byte_order) for word in order)
    (number,) = struct.unpack(f">{_CODES[kind]}", data)
    return float(number)


def encode_number(number: float, kind: Kind, word_order: Order = "big", byte_order: Order = "big") -> list[int]:
    """Return the registers that represent a number; integers are limited to the range of their type."""
    if kind != "f32":
        bits = 16 * SIZES[kind]
        low, high = (0, (1 << bits) - 1) if kind[0] == "u" else (-(1 << bits - 1), (1 << bits - 1) - 1)
        number = min(max(round(number), low), high)
    data = struct.pack(f">{_CODES[kind]}", number)
    words = [int.from_bytes(data[i : i + 2], byte_order) for i in range(0, len(data), 2)]
    return words if word_order == "big" else words[::-1]
