"""A thermometer with Modbus on the virtual machine, on a network connection or a serial line that can fail."""

from __future__ import annotations

import math

from pydantic import ValidationError

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.thermometer.register_values import to_registers, words_of
from errormotion.instruments.simulators.thermometer.temperatures import Inputs, Unplugging
from errormotion.instruments.thermometer.registers import ModbusSettings
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.modbus.client import framing_of
from errormotion.instruments.transports.modbus.serving import ModbusServer, checksum

FAILURE = 4  # Modbus exception: server device failure
_SAME = ("map", "type", "function", "first", "stride", "word_order", "byte_order", "scale", "offset", "open_from")
_UNIT_POSITION = {"tcp": 6, "rtu": 0}  # position of the unit in a frame


class SimulatedModbus(SimulatedDevice):
    """A device whose registers are temperature sensors of the machine.

    Further parameters of the address: ``framing`` (``tcp`` or ``rtu``; default by ``wire``), ``map``, ``type``,
    ``function``, ``first``, ``stride``, ``word_order``, ``byte_order``, ``scale``, ``offset``, ``open_from``,
    ``thermocouples`` (joined by commas) as in the settings of the instrument; ``sensors`` (names of the twin's
    sensors, joined by commas), ``open`` and ``shorted`` (numbers of inputs, from 0), ``unit`` (1), ``code`` (of the
    exception reply).

    Further faults: ``exception`` (a reply that refuses), ``unit`` (the answer of another device), ``short`` (the
    answer breaks off), ``unplugged`` (see `simulators.thermometers`; old
    connections are dead then).
    """

    faults: tuple[str, ...] = (
        *("silence", "split", "garbage", "out_of_range", "drop", "disconnect", "late", "exception", "unit", "short"),
        "unplugged",
    )

    def __init__(self, address: Address) -> None:
        self._framing = framing_of(address)
        if self._framing == "rtu":
            self.faults = (*self.faults, "checksum")
        self._unplugging = Unplugging(address)
        self._code = address.whole("code", FAILURE, 11)
        self._unit = address.whole("unit", 1, 255)
        self._device: ModbusServer | None = None
        super().__init__(address, line_end=b"", default_name="thermometer")
        try:
            self._inputs = Inputs(self.world.machine, address)
            self._settings = _settings(address, self._inputs.names)
            self._device = ModbusServer(
                self._framing, self._unit, self._settings.function, self._blocks(), self._registers
            )
        except BaseException:
            self.close()
            raise

    @property
    def driver_url(self) -> str:
        """Address of the device in a bench file."""
        scheme, _, place = self.url.partition("://")
        kind = "rtu" if scheme == "serial" else "tcp" if self._framing == "tcp" else "rtu-tcp"
        return f"modbus+{kind}://{place}?unit={self._unit}"

    def reply(self, data: bytes) -> None:
        """Send an answer, damaged where that is due."""
        if self.fault.hits("checksum", self._answers):
            data = data[:-1] + bytes((data[-1] ^ 1,))
        elif self.fault.hits("unit", self._answers):
            place = _UNIT_POSITION[self._framing]
            data = data[:place] + bytes((data[place] ^ 2,)) + data[place + 1 :]
            if self._framing == "rtu":
                data = data[:-2] + checksum(data[:-2])
        elif self.fault.hits("short", self._answers):
            data = data[: len(data) // 2]
        super().reply(data)

    def connection_opened(self) -> None:
        """Forget the incomplete request of the connection before."""
        super().connection_opened()
        if self._device is not None:
            self._device.reset()

    def _on_data(self, data: bytes) -> None:
        if self._unplugging.keeps_from(self._answers, self._server):
            return
        if self._device is None:
            return
        for answer in self._device.receive(data):
            self.reply(answer)
        if self._device.lost:
            self._server.disconnect()

    def _blocks(self) -> dict[int, int]:
        """Return the registers that the device has: those of its channels, and what lies between."""
        addresses = self._settings.addresses
        first = min(addresses)
        return {first: max(addresses) + words_of(self._settings.type) - first}

    def _registers(self) -> dict[int, int] | int:
        """Return the registers now, or the code of a refusal."""
        if self.fault.hits("exception", self._answers):
            return self._code
        found: dict[int, int] = {}
        far = self.fault.hits("out_of_range", self._answers)
        readings = self._inputs.temperatures(self.world.time, self._rng)
        for i, (address, temperature) in enumerate(zip(self._settings.addresses, readings, strict=True)):
            words = self._code_words((temperature - _each(self._settings.offset, i)) / _each(self._settings.scale, i))
            if far or i in self._inputs.open:
                words = self._no_sensor()
            elif i in self._inputs.shorted:
                words = self._code_words(min(self._settings.shorted_codes, default=0))
            found.update(enumerate(words, start=address))
        return found

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
    """Return the value of one channel, where one holds for all or there is one for each."""
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
        raise InstrumentError(f"The register map in '{address.url}' cannot be: {error.errors()[0]['msg']}") from None
