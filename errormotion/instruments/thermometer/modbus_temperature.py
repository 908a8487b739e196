"""Thermometers with Modbus registers: loggers, input modules, transmitters."""

from __future__ import annotations

from typing import ClassVar

from errormotion.instruments.thermometer.registers import SIZES, ModbusSettings
from errormotion.instruments.thermometer.sensors import Thermometer
from errormotion.instruments.transports.modbus.client import ModbusLine, open_modbus
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject


class ModbusTemperature(Thermometer):
    """A thermometer with Modbus TCP, RTU on a serial line, or RTU through a serial server.

    Parameters
    ----------
    address : str
        ``modbus+tcp://host:502?unit=1``, ``modbus+rtu:///dev/ttyUSB0?baudrate=9600&unit=1``,
        ``modbus+rtu-tcp://host:4001?unit=1``, ``sim://cframe/logger``, ``replay://file``.
    settings : ModbusSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="modbus_temperature",
        kind="thermometer",
        summary="Temperatures in Modbus registers (ADAM-6018, 16-channel loggers, any map): TCP, RTU, RTU over TCP",
        status="peer_verified",
        simulator="errormotion.instruments.simulators.thermometer.modbus:SimulatedModbus",
    )
    Settings: ClassVar[type[ModbusSettings]] = ModbusSettings
    settings: ModbusSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return what the conformance kit examines: readings that differ from one another."""
        return InstrumentSubject(cls, "sim://cframe?seed=3&noise=1")

    @property
    def line(self) -> ModbusLine:
        """The open Modbus line; InstrumentError before ``open``."""
        line = self.transport
        if not isinstance(line, ModbusLine):
            raise TypeError(f"expected a ModbusLine, found {type(line).__name__}")
        return line

    @property
    def repeated(self) -> int:
        """Number of repeated requests after damaged answers since the connection was opened."""
        return self.line.repeated

    def identify(self) -> Identity:
        """Check that the device answers, by its first register; Modbus thermometers report no name."""
        line, settings = self.line, self.settings
        line.registers(settings.function, min(settings.addresses), SIZES[settings.type])
        return Identity(
            manufacturer="Modbus",
            model=settings.map,
            serial_number=f"unit {line.unit}",
            simulated=line.simulated,
            details={"address": self.address, "framing": line.framing},
        )

    def configure(self, settings: ModbusSettings) -> None:
        """Use other settings from now on; the device itself is configured with the maker's tool."""
        self.settings = settings

    def _measure(self) -> dict[str, tuple[float, str]]:
        settings, line = self.settings, self.line
        words: dict[int, int] = {}
        for first, count in settings.blocks():
            words.update(enumerate(line.registers(settings.function, first, count), start=first))
        size = SIZES[settings.type]
        return {
            name: settings.temperature(i, [words[address + k] for k in range(size)])
            for i, (name, address) in enumerate(zip(settings.channels, settings.addresses, strict=True))
        }

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
        )

    def _start_session(self) -> None:
        self.identify()
