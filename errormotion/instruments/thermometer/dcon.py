"""Thermocouple modules with the DCON protocol (ADAM-4018, ICP DAS I-7018): ASCII on RS-485 or behind a serial server.

Sources and assumptions: ``docs/reference/devices/dcon_temperature.md``.
"""

from __future__ import annotations

import re
from typing import ClassVar

from pydantic import Field

from errormotion.datasets.units import Time
from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.thermometer.sensors import GOOD, OPEN, LineThermometer, ThermometerSettings
from errormotion.instruments.transports.base import LINE_ENDS
from errormotion.instruments.two_wires import TwoWireSettings
from errormotion.plugins import Identity, InstrumentInfo

LINE_END = b"\r"
MAX_LINE_BYTES = 512
OPEN_SENSOR = 9999.0  # degC: absolute values from here on mean an open or overrun input
UNDER_RANGE = "-0000"  # the code of an ADAM for the same
_VALUE = re.compile(r"[+-]\d+(?:\.\d+)?| {7}")  # blanks: a disabled channel
_CONFIGURATION = re.compile(r"([0-9A-F]{2})[0-9A-F]{2}([0-9A-F]{2})")  # type, baud rate, data format
_FORMATS = {1: "per cent of the range", 2: "hexadecimal", 3: "ohms"}  # bits 1 and 0; 0: engineering units
_LAST_ELECTRICAL_TYPE = 0x0D  # types up to this one are ranges of voltage and current


# ---------------------------------------------------------------------- codec


def checksum(text: str) -> str:
    """Return the checksum of a request or answer: the sum of its characters, two hexadecimal digits."""
    return f"{sum(text.encode('ascii')) & 0xFF:02X}"


def encode(text: str, *, with_checksum: bool = False) -> bytes:
    """Return a request or answer as bytes, with its line end."""
    return (text + (checksum(text) if with_checksum else "")).encode("ascii") + LINE_END


def decode(line: bytes, *, with_checksum: bool = False) -> str:
    """Return the text of an answer without its checksum and line end.

    Raises
    ------
    ProtocolError
        The answer is not ASCII, or its checksum is wrong.
    """
    try:
        text = line.rstrip(b"\r\n").decode("ascii")
    except UnicodeDecodeError:
        raise ProtocolError(f"Expected a line in ASCII; found {line!r}", code="protocol.text.form") from None
    if not with_checksum:
        return text
    body, check = text[:-2], text[-2:]
    if check != checksum(body):
        raise ProtocolError(
            f"The answer '{body}' has the checksum '{check}'; expected '{checksum(body)}'", code="protocol.checksum"
        )
    return body


def parse_temperatures(text: str) -> list[float | None]:
    """Return the temperatures (degC) of an answer such as ``>+025.12+026.00``.

    An open sensor is NaN, a disabled channel None.

    Raises
    ------
    ProtocolError
        The answer has another format.
    """
    values = _VALUE.findall(text)
    if not text.startswith(">") or not values or ">" + "".join(values) != text:
        raise ProtocolError(
            f"Expected temperatures such as '>+025.12+026.00'; found '{text}'", code="protocol.reply.number_form"
        )
    return [_temperature(value) for value in values]


def _temperature(value: str) -> float | None:
    if value.isspace():
        return None
    return float("nan") if value == UNDER_RANGE or abs(float(value)) >= OPEN_SENSOR else float(value)


def check_configuration(text: str) -> None:
    """Check that a module measures temperatures and reports them in degC.

    Parameters
    ----------
    text : str
        Answer to ``$AA2`` after the address: type, baud rate and data format, two digits each.

    Raises
    ------
    InstrumentError
        The module has a range of voltage or current, or another format than engineering units.
    ProtocolError
        The text is not a configuration.
    """
    match = _CONFIGURATION.fullmatch(text)
    if match is None:
        raise ProtocolError(f"Expected a configuration such as '100600'; found '{text}'", code="protocol.reply.form")
    type_code, data_format = int(match[1], 16), int(match[2], 16)
    if type_code <= _LAST_ELECTRICAL_TYPE:
        raise InstrumentError(
            f"The module is set to input range {match[1]}, a voltage or current; set it to the type of the sensors",
            code="thermometer.range.other",
        )
    if form := _FORMATS.get(data_format & 3):
        raise InstrumentError(
            f"The module reports {form} (data format {match[2]}); expected engineering units: set bits 1 and 0 of the "
            "data format to 00",
            code="thermometer.format.other",
        )


# ---------------------------------------------------------------------- driver


class DconSettings(ThermometerSettings, TwoWireSettings):
    """Settings of a DCON thermometer."""

    unit: int = Field(default=1, description="address of the module on its line", ge=0, le=255)
    checksum: bool = Field(default=False, description="whether the module is set to use checksums")
    baudrate: int = Field(default=9600, description="baud rate of a serial line", gt=0)
    timeout: Time = Field(default=1.0, description="time limit for an answer", gt=0)
    retry: Time = Field(default=1.0, description="minimum interval between two attempts to connect again", ge=0)


class DconTemperature(LineThermometer):
    """A DCON thermocouple module: ``#AA`` requests all inputs.

    Parameters
    ----------
    address : str
        ``serial:///dev/ttyUSB1?baudrate=9600``, ``tcp://host:port``, ``sim://cframe/thermometer``, ``replay://file``.
    settings : DconSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="dcon_temperature",
        kind="thermometer",
        summary="Thermocouple module with the DCON protocol (ADAM-4018, I-7018), RS-485 or TCP",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.thermometer.dcon:SimulatedDcon",
    )
    Settings: ClassVar[type[DconSettings]] = DconSettings
    settings: DconSettings

    def identify(self) -> Identity:
        """Return the name and firmware of the module."""
        name, firmware = (self._query(f"${self._unit}{what}", "!" + self._unit) for what in "MF")
        return Identity(
            manufacturer="DCON",
            model=name,
            serial_number=f"unit {self._unit}",
            firmware=firmware,
            simulated=self.transport.simulated,
            details={"address": self.address},
        )

    def configure(self, settings: DconSettings) -> None:
        """Use other settings from now on; the module itself is configured with the manufacturer's tool."""
        self.settings = settings

    def _measure(self) -> dict[str, tuple[float, str]]:
        temperatures = parse_temperatures(">" + self._query(f"#{self._unit}", ">"))
        if len(temperatures) < len(self.channels):
            raise ProtocolError(
                f"Expected at least {len(self.channels)} temperatures ({', '.join(self.channels)}); "
                f"found {len(temperatures)}",
                code="thermometer.channels.too_few",
            )
        readings = dict(zip(self.channels, temperatures, strict=False))
        if disabled := [name for name, value in readings.items() if value is None]:
            raise ProtocolError(
                f"The channels of {', '.join(disabled)} are disabled in the module; enable or omit them",
                code="thermometer.channels.disabled",
            )
        return {
            name: (value, OPEN if value != value else GOOD) for name, value in readings.items() if value is not None
        }

    @property
    def _unit(self) -> str:
        return f"{self.settings.unit:02X}"

    def _query(self, request: str, expected: str) -> str:
        """Send a request and return the answer without its expected start."""
        with_checksum = self.settings.checksum
        with self.exchange() as line:
            line.write(encode(request, with_checksum=with_checksum))
            answer = decode(line.read_until(LINE_ENDS, limit=MAX_LINE_BYTES), with_checksum=with_checksum)
        if answer.startswith("?"):
            raise InstrumentError(
                f"The module {self._unit} at {self.address} refuses '{request}': '{answer}'", code="instrument.refused"
            )
        if not answer.startswith(expected):
            echo = ". The line returns the request: set 'echo' to true" if answer.startswith(request) else ""
            raise ProtocolError(
                f"'{request}': expected an answer that starts with '{expected}'; found '{answer}'{echo}",
                code="protocol.reply.form",
            )
        return answer.removeprefix(expected)

    def resynchronise(self) -> None:
        """Discard late answers; even later ones precede the answer with the name of the module.

        Raises
        ------
        InstrumentError
            The module does not answer.
        """
        super().resynchronise()
        line, start = self.transport, f"!{self._unit}".encode("ascii")
        line.write(encode(f"${self._unit}M", with_checksum=self.settings.checksum))
        self.answer_line(line, f"'${self._unit}M'", lambda text: text.startswith(start) or None, limit=MAX_LINE_BYTES)

    def _start_session(self) -> None:
        self.identify()
        check_configuration(self._query(f"${self._unit}2", "!" + self._unit))
