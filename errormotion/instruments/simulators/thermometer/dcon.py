"""A DCON thermocouple module on the virtual machine."""

from __future__ import annotations

from errormotion.errors import ProtocolError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.thermometer.temperatures import Inputs, Unplugging
from errormotion.instruments.thermometer.dcon import LINE_END, checksum, decode, encode, format_temperatures
from errormotion.instruments.transports import Address


class SimulatedDcon(SimulatedDevice):
    """A module whose inputs are temperature sensors of the machine.

    Further parameters of the address: ``sensors``, ``open``, ``noise`` and ``unplugged_for`` (see
    `simulators.thermometers`), ``unit`` (1), ``checksum`` (0 or 1).
    """

    faults: tuple[str, ...] = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect", "late", "unplugged")

    def __init__(self, address: Address) -> None:
        self._unit = f"{int(address.number('unit', 1)):02X}"
        self._checksum = bool(address.number("checksum", 0))
        self._unplugging = Unplugging(address)
        if self._checksum:
            self.faults = (*self.faults, "checksum")
        super().__init__(address, line_end=LINE_END, default_name="thermometer")
        try:
            self._inputs = Inputs(self.world.machine, address)
        except BaseException:
            self.close()
            raise

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request."""
        try:
            text = self._obey(decode(request, with_checksum=self._checksum))
        except ProtocolError:
            return b""  # a module keeps quiet when the checksum is wrong
        if self.fault.hits("checksum", self._answers):
            wrong = int(checksum(text), 16) ^ 1
            return f"{text}{wrong:02X}".encode() + LINE_END
        return encode(text, with_checksum=self._checksum)

    def _obey(self, request: str) -> str:
        if request == f"#{self._unit}":
            return format_temperatures(self._temperatures())
        if request == f"${self._unit}M":
            return f"!{self._unit}4018"
        if request == f"${self._unit}F":
            return f"!{self._unit}A1.0"
        return f"?{self._unit}"

    def _temperatures(self) -> list[float]:
        readings = self._inputs.temperatures(self.world.time, self._rng)
        far = self.fault.hits("out_of_range", self._answers)
        return [float("nan") if far or i in self._inputs.open else t for i, t in enumerate(readings)]

    def _on_data(self, data: bytes) -> None:
        if self._unplugging.keeps_from(self._answers, self._server):
            return
        super()._on_data(data)
