"""Thermometers with Modbus registers: loggers, input modules, transmitters."""

from __future__ import annotations

from typing import ClassVar

from errormotion.instruments.modbus_driver import ModbusDriver
from errormotion.instruments.thermometer.registers import SIZES, ModbusSettings
from errormotion.instruments.thermometer.sensors import Thermometer
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject


class ModbusTemperature(ModbusDriver, Thermometer):
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
        """Return the subject of the conformance kit, whose readings differ."""
        return InstrumentSubject(cls, "sim://cframe?seed=3&noise=1")

    @property
    def repeated(self) -> int:
        """Number of repeated requests after damaged answers since the connection was opened."""
        return self.line.repeated

    def identify(self) -> Identity:
        """Check that the device answers, by its first register; Modbus thermometers report no name."""
        settings = self.settings
        self.line.registers(settings.function, min(settings.addresses), SIZES[settings.type])
        return self.identity(settings.map)

    def configure(self, settings: ModbusSettings) -> None:
        """Use other settings from now on; the device itself is configured with the manufacturer's tool."""
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

    def _start_session(self) -> None:
        self.identify()
