"""A thermometer with Modbus on the virtual machine, with a network connection or a serial line."""

from __future__ import annotations

import math
import struct

from pydantic import ValidationError

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.modbus_device import FAILURE, SimulatedModbusDevice
from errormotion.instruments.simulators.thermometer.temperatures import Inputs, Unplugging
from errormotion.instruments.thermometer.registers import ModbusSettings
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.modbus.serving import ModbusServer

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


_SAME = ("map", "type", "function", "first", "stride", "word_order", "byte_order", "scale", "offset", "open_from")


class SimulatedModbus(SimulatedModbusDevice):
    """A device whose registers contain temperatures of the machine's sensors.

    Further parameters of the address: ``framing`` (``tcp`` or ``rtu``; default by ``wire``), ``map``, ``type``,
    ``function``, ``first``, ``stride``, ``word_order``, ``byte_order``, ``scale``, ``offset``, ``open_from``,
    ``thermocouples`` (separated by commas) as in the settings of the instrument; ``sensors`` (names of the twin's
    sensors, separated by commas), ``open`` and ``shorted`` (numbers of inputs, from 0), ``unit`` (1), ``code`` (of the
    exception reply).

    Further faults: ``exception`` (an exception reply), ``unit`` (the answer of another device), ``short`` (an
    incomplete answer), ``unplugged`` (see `temperatures`; old connections are then closed).
    """

    faults: tuple[str, ...] = (
        *("silence", "split", "garbage", "out_of_range", "drop", "disconnect", "late", "exception", "unit", "short"),
        "unplugged",
    )

    def __init__(self, address: Address) -> None:
        self._unplugging = Unplugging(address)
        self._code = address.whole("code", FAILURE, 11)
        super().__init__(address, "thermometer")
        try:
            self._inputs = Inputs(self.world.machine, address)
            self._settings = _settings(address, self._inputs.names)
            self._device = ModbusServer(
                self._framing, self._unit, self._settings.function, self._blocks(), self._registers
            )
        except BaseException:
            self.close()
            raise

    def _on_data(self, data: bytes) -> None:
        if not self._unplugging.keeps_from(self._answers, self._server):
            super()._on_data(data)

    def _blocks(self) -> dict[int, int]:
        """Return the registers of the device: those of its channels, and all between them."""
        addresses = self._settings.addresses
        first = min(addresses)
        return {first: max(addresses) + words_of(self._settings.type) - first}

    def _registers(self) -> dict[int, int] | int:
        """Return the present registers, or the code of an exception."""
        if self.fault.hits("exception", self._answers):
            return self._code
        registers: dict[int, int] = {}
        far = self.fault.hits("out_of_range", self._answers)
        readings = self._inputs.temperatures(self.world.time, self._rng)
        for i, (address, temperature) in enumerate(zip(self._settings.addresses, readings, strict=True)):
            words = self._code_words((temperature - _each(self._settings.offset, i)) / _each(self._settings.scale, i))
            if far or i in self._inputs.open:
                words = self._no_sensor()
            elif i in self._inputs.shorted:
                words = self._code_words(min(self._settings.shorted_codes, default=0))
            registers.update(enumerate(words, start=address))
        return registers

    def _no_sensor(self) -> list[int]:
        if self._settings.type == "f32":
            return self._code_words(math.nan)
        if self._settings.open_codes:
            return self._code_words(self._settings.open_codes[0])
        return self._code_words(self._settings.open_from if self._settings.open_from is not None else 1 << 40)

    def _code_words(self, number: float) -> list[int]:
        settings = self._settings
        return to_registers(number, settings.type, word_order=settings.word_order, byte_order=settings.byte_order)


def _each(value: float | tuple[float, ...], i: int) -> float:
    """Return the value for one channel, from one for all channels or one for each."""
    if not isinstance(value, tuple):
        return value
    return value[i if len(value) > 1 else 0]


def _settings(address: Address, names: tuple[str, ...]) -> ModbusSettings:
    """Return the register map that the parameters of an address describe."""
    given: dict[str, object] = {key: address.params[key] for key in _SAME if key in address.params}
    if "function" in given:
        given["function"] = address.whole("function", 3, 4)
    if "thermocouples" in address.params:
        given["thermocouples"] = tuple(address.params["thermocouples"].split(","))
    if "shorted_code" in address.params:
        given["shorted_codes"] = (int(address.number("shorted_code", 0)),)
    try:
        return ModbusSettings.model_validate({**given, "channels": names})
    except ValidationError as error:
        raise InstrumentError(
            f"The register map in '{address.url}' is invalid: {error.errors()[0]['msg']}", code="simulator.setting"
        ) from None
