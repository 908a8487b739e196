"""Base of simulated Modbus devices: framing, unit, requests and damaged answers."""

from __future__ import annotations

from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.modbus.client import framing_of
from errormotion.instruments.transports.modbus.serving import ModbusServer, checksum

FAILURE = 4  # Modbus exception: server device failure
_UNIT_POSITION = {"tcp": 6, "rtu": 0}  # position of the unit in a frame


class SimulatedModbusDevice(SimulatedDevice):
    """A device that answers requests with its ``_device``.

    Parameters of the address: ``framing`` (``tcp`` or ``rtu``; default by ``wire``), ``unit`` (1).
    """

    def __init__(self, address: Address, default_name: str) -> None:
        self._framing = framing_of(address)
        if self._framing == "rtu":
            self.faults = (*self.faults, "checksum")
        self._unit = address.whole("unit", 1, 255)
        self._device: ModbusServer | None = None
        super().__init__(address, line_end=b"", default_name=default_name)

    @property
    def driver_url(self) -> str:
        """Address of the device in a bench file."""
        scheme, _, location = self.url.partition("://")
        kind = "rtu" if scheme == "serial" else "tcp" if self._framing == "tcp" else "rtu-tcp"
        return f"modbus+{kind}://{location}?unit={self._unit}"

    def reply(self, data: bytes) -> None:
        """Send an answer, with the fault that applies to it."""
        if self.fault.hits("checksum", self._answers):
            data = data[:-1] + bytes((data[-1] ^ 1,))
        elif self.fault.hits("unit", self._answers):
            k = _UNIT_POSITION[self._framing]
            data = data[:k] + bytes((data[k] ^ 2,)) + data[k + 1 :]
            if self._framing == "rtu":
                data = data[:-2] + checksum(data[:-2])
        elif self.fault.hits("short", self._answers):
            data = data[: len(data) // 2]
        super().reply(data)

    def connection_opened(self) -> None:
        """Discard an incomplete request of the previous connection."""
        super().connection_opened()
        if self._device is not None:
            self._device.reset()

    def _on_data(self, data: bytes) -> None:
        if self._device is None:
            return
        for answer in self._device.receive(data):
            self.reply(answer)
        if self._device.lost:
            self._server.disconnect()
