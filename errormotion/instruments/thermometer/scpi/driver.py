"""Driver of data acquisition units with SCPI commands (Keysight, Agilent, HP 34970A and its successors)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.thermometer.scpi import codec
from errormotion.instruments.thermometer.scpi.settings import ScpiSettings
from errormotion.instruments.thermometer.sensors import GOOD, OPEN, OUT_OF_RANGE, LineThermometer
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.base import LINE_ENDS
from errormotion.plugins import Identity, InstrumentInfo

T = TypeVar("T")

MAX_ERRORS = 32
"""Largest number of entries that are read from the error queue; the units have 10 or 20."""


class ScpiTemperature(LineThermometer):
    """Resistance thermometers and thermocouples at a data acquisition unit with SCPI commands.

    Opening sets channels and scan list of the unit (``CONF:TEMP``, ``ROUT:SCAN``), which clears its stored readings and
    its error queue; with the setting ``setup = false`` only the format of the readings is set. A reading is one scan
    (``READ?``), whose values contain their channels. After an error the unit is synchronised and set up again: late
    answers are discarded until it returns its identity.

    Parameters
    ----------
    address : str
        ``tcp://host:5025``, ``serial:///dev/ttyUSB0?baudrate=9600``, ``sim://cframe/unit``, ``replay://file``.
    settings : ScpiSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="scpi_temperature",
        kind="thermometer",
        summary="Pt100 (4-wire) and thermocouples at an SCPI data acquisition unit (34970A, 34972A, DAQ970A)",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.thermometer.scpi:SimulatedScpiUnit",
    )
    Settings: ClassVar[type[ScpiSettings]] = ScpiSettings
    settings: ScpiSettings
    unit_errors: tuple[str, ...] = ()
    """Entries of the unit's error queue when it was last set up, from an earlier client or from a failed reading."""
    _ready = False

    def identify(self) -> Identity:
        """Return manufacturer, model, serial number and revision of the unit; InstrumentError for another model."""
        manufacturer, model, serial, revision = self._query("*IDN?", codec.parse_identity)
        if model not in self.settings.models:
            raise InstrumentError(
                f"{self.address}: expected one of {', '.join(self.settings.models)}; found a {manufacturer} {model}. "
                "Add it to 'models' if it has the same commands",
                code="instrument.model.unknown",
            )
        return Identity(
            manufacturer=manufacturer,
            model=model,
            serial_number=serial,
            firmware=revision,
            simulated=self.transport.simulated,
            details={"address": self.address, "inputs": list(self.settings.numbers)},
        )

    def configure(self, settings: ScpiSettings) -> None:
        """Use other settings from the next reading on, which sets up the unit again."""
        self.settings = settings
        self._ready = False

    def errors(self) -> list[str]:
        """Read and empty the error queue of the unit; return entries such as ``-113 Undefined header``."""
        texts = []
        for _ in range(MAX_ERRORS):
            number, text = self._query("SYST:ERR?", codec.parse_error)
            if not number:
                break
            texts.append(f"{number} {text}")
        return texts

    def _measure(self) -> dict[str, tuple[float, str]]:
        if not self._ready:
            self._prepare()
        try:
            readings = self._query("READ?", self._by_channel)
        except InstrumentError:
            self._ready = False
            raise
        return {
            name: self._evaluate(index, readings[number])
            for index, (name, number) in enumerate(zip(self.channels, self.settings.numbers, strict=True))
        }

    def _by_channel(self, text: str) -> dict[int, float]:
        """Return the readings of a scan by channel; ProtocolError unless each channel has one."""
        pairs = codec.parse_readings(text)
        channels = [channel for channel, _ in pairs]
        if sorted(channels) != sorted(self.settings.numbers):
            raise ProtocolError(
                f"{self.address}: expected one reading of each of the channels "
                f"{codec.channel_list(sorted(self.settings.numbers))}; found {codec.channel_list(channels)}",
                code="thermometer.channels.differ",
            )
        return dict(pairs)

    def _evaluate(self, index: int, reading: float) -> tuple[float, str]:
        """Return temperature (degC) and flag of a reading (degC); above its range a sensor counts as open."""
        if math.isinf(reading):
            return math.nan, OPEN if reading > 0 else OUT_OF_RANGE
        value = self.settings.corrected(index, reading)
        return value, GOOD if self.settings.lowest <= value <= self.settings.highest else OUT_OF_RANGE

    def _prepare(self) -> None:
        """Set up the unit; InstrumentError if it refuses a command."""
        self.unit_errors = tuple(self.errors())
        self._set("*CLS")
        if self._serial:
            self._set("SYST:REM")
        for command in self.settings.commands() if self.settings.setup else self.settings.format_commands():
            self._set(command)
        if not self.settings.setup:
            scanned = self._query("ROUT:SCAN?", codec.parse_channels)
            if sorted(scanned) != sorted(self.settings.numbers):
                wanted = codec.channel_list(sorted(self.settings.numbers))
                raise InstrumentError(
                    f"{self.address}: expected the scan list {wanted}; found {codec.channel_list(scanned)}. Set "
                    "'inputs' to it, or 'setup' to true",
                    code="thermometer.scan_list.differs",
                )
        self._ready = True

    def _set(self, command: str) -> None:
        """Send a command, and raise an error of the unit's error queue; waiting for it also paces a serial line."""
        with self.exchange() as line:
            line.write(codec.encode(command))
            line.write(codec.encode("SYST:ERR?"))
            number, text = self._answer(line, "SYST:ERR?", codec.parse_error)
        if number:
            raise InstrumentError(
                f"{self.address}: the unit refuses '{command}': {number} {text}", code="instrument.refused"
            )

    def _query(self, command: str, parse: Callable[[str], T]) -> T:
        with self.exchange() as line:
            line.write(codec.encode(command))
            return self._answer(line, command, parse)

    def _answer(self, line: Transport, command: str, parse: Callable[[str], T]) -> T:
        try:
            return parse(codec.decode(line.read_until(LINE_ENDS, limit=codec.LONGEST)))
        except InstrumentTimeoutError as error:
            raise InstrumentTimeoutError(f"'{command}': {error}", code=error.code) from None

    def resynchronise(self) -> None:
        """Discard late answers; even later ones precede the identity of the unit.

        Raises
        ------
        InstrumentError
            The unit does not answer.
        """
        super().resynchronise()
        line = self.transport
        line.write(codec.encode("*IDN?"))

        def identity(text: bytes) -> Any:
            try:
                return codec.parse_identity(codec.decode(text))
            except ProtocolError:
                return None

        self.answer_line(line, "'*IDN?'", identity, limit=codec.LONGEST)

    @property
    def _serial(self) -> bool:
        """Whether the unit is on a serial line, which has a remote mode."""
        return str(getattr(self.transport, "recorded_address", self.address)).startswith("serial:")

    def _start_session(self) -> None:
        self._ready = False
        self.identify()
        self._prepare()

    def _end_session(self) -> None:
        if self._serial:
            with self.exchange() as line:
                line.write(codec.encode("SYST:LOC"))
