"""Base of drivers with one Modbus line: TCP, RTU on a serial line, RTU through a serial server."""

from __future__ import annotations

from errormotion.instruments.driver import Driver
from errormotion.instruments.transports.modbus.client import ModbusLine, open_modbus
from errormotion.plugins import Identity


class ModbusDriver(Driver):
    """Base of drivers with one Modbus line.

    Its settings have ``unit``, ``timeout``, ``retry``, ``retries``, ``baudrate``, ``echo`` and ``leading_zeros``, see
    `open_modbus`.
    """

    @property
    def line(self) -> ModbusLine:
        """The open Modbus line; InstrumentError before ``open``."""
        line = self.transport
        if not isinstance(line, ModbusLine):
            raise TypeError(f"expected a ModbusLine, found {type(line).__name__}")
        return line

    def identity(self, model: str) -> Identity:
        """Return the identity of the unit; devices report no name by their registers."""
        line = self.line
        return Identity(
            manufacturer="Modbus",
            model=model,
            serial_number=f"unit {line.unit}",
            simulated=line.simulated,
            details={"address": self.address, "framing": line.framing},
        )

    def _connect(self) -> ModbusLine:
        settings = self.settings
        return open_modbus(
            self.address,
            unit=settings.unit,
            simulator=self.info.simulator,
            record=self._record,
            timeout=settings.timeout,
            retry=settings.retry,
            retries=settings.retries,
            baudrate=settings.baudrate,
            echo=settings.echo,
            zeros=settings.leading_zeros,
        )
