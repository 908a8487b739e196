"""A thermocouple module with the DCON protocol: its settings, and its answer to each line.

Sources: ICP DAS I-7011, I-7018 User Manual, rev. B1.0, p. 17 to 62 (commands of the I-7018, ``?AA``, silence);
Advantech ADAM 4000 Series User's Manual, p. 5-4 to 5-23 and appendix B (ADAM-4018, inputs out of bounds, ranges,
formats); ADLINK NuDAM ND-6000 User's Manual, p. 41 and 88 (bits of the format, formats); ICP DAS I-7088 User Manual, p.
17 and 153 (checksum, upper case, INIT*). ``docs/reference/devices/dcon_temperature.md`` lists the assumptions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

LINE_END = b"\r"
CHANNELS = 8
BAUD_CODES = range(0x03, 0x0B)  # 1200 to 115200
BAUD_9600 = 0x06
ENGINEERING, PERCENT, HEXADECIMAL = 0, 1, 2  # bits 1 and 0 of the data format
FORMAT_BITS, CHECKSUM_BIT, FILTER_BIT = 0x03, 0x40, 0x80
ENABLED_BIT, TIMED_OUT_BIT = 0x80, 0x04  # of the module status
SEEBECK = 40.6e-3  # mV/K, type T at room temperature
CJC_STEP = 0.01  # degC, one count of the offset
MAX_CJC_OFFSET = 0x1000
MAX_NAME = 6
WATCHDOG_STEP = 0.1  # s

Model = Literal["7018", "4018"]


@dataclass(frozen=True)
class Span:
    """One input range.

    Attributes
    ----------
    lowest, highest : float
        degC, or mV.
    decimals : int
        Digits after the point in engineering units.
    thermocouple : bool
        Whether the module linearises a thermocouple; else it measures the voltage.
    volts : bool
        Whether engineering units are V, not mV.
    """

    lowest: float
    highest: float
    decimals: int
    thermocouple: bool = True
    volts: bool = False


def _voltage(highest: float, decimals: int, *, volts: bool = False) -> Span:
    return Span(-highest, highest, decimals, thermocouple=False, volts=volts)


_VOLTAGES = {
    0x00: _voltage(15.0, 3),
    0x01: _voltage(50.0, 3),
    0x02: _voltage(100.0, 2),
    0x03: _voltage(500.0, 2),
    0x04: _voltage(1000.0, 4, volts=True),
    0x05: _voltage(2500.0, 4, volts=True),
}

SPANS: dict[Model, dict[int, Span]] = {
    "7018": {
        **_VOLTAGES,
        0x0E: Span(-210.0, 760.0, 2),  # J
        0x0F: Span(-270.0, 1372.0, 1),  # K
        0x10: Span(-270.0, 400.0, 2),  # T
        0x11: Span(-270.0, 1000.0, 1),  # E
        0x12: Span(0.0, 1768.0, 1),  # R
        0x13: Span(0.0, 1768.0, 1),  # S
        0x14: Span(0.0, 1820.0, 1),  # B
        0x15: Span(-270.0, 1300.0, 1),  # N
        0x16: Span(0.0, 2320.0, 1),  # C
    },
    "4018": {
        **_VOLTAGES,
        0x0E: Span(0.0, 760.0, 2),
        0x0F: Span(0.0, 1370.0, 1),
        0x10: Span(-100.0, 400.0, 2),
        0x11: Span(0.0, 1000.0, 1),
        0x12: Span(500.0, 1750.0, 1),
        0x13: Span(500.0, 1750.0, 1),
        0x14: Span(500.0, 1800.0, 1),
    },
}

# under and over range, by data format
OUT_OF_RANGE: dict[Model, tuple[tuple[str, str], tuple[str, str], tuple[str, str]]] = {
    "7018": (("-9999.9", "+9999.9"), ("-999.99", "+999.99"), ("8000", "7FFF")),
    "4018": (("-0000", "+9999"), ("-0000", "+9999"), ("0000", "FFFF")),
}


def sum_of_characters(text: str) -> str:
    """Return the checksum of a line: the sum of its characters, two hexadecimal digits."""
    return f"{sum(text.encode('latin-1')) % 256:02X}"


def format_reading(value: float, span: Span, form: int, model: Model = "7018") -> str:
    """Return one reading in the format of the module, from degC or mV of the input, NaN for an open input."""
    under, over = OUT_OF_RANGE[model][form]
    if math.isnan(value):
        return over
    if span.thermocouple and not span.lowest <= value <= span.highest:
        return under if value < span.lowest else over
    if form == HEXADECIMAL:
        counts = math.trunc(value / span.highest * 32768)
        return f"{max(-32768, min(counts, 32767)) & 0xFFFF:04X}"
    if form == PERCENT:
        return _signed(100.0 * value / span.highest, 2)
    return _signed(value / 1000.0 if span.volts else value, span.decimals)


def _signed(value: float, decimals: int) -> str:
    """Return a sign, five digits and a point."""
    return f"{round(value, decimals) + 0.0:+07.{decimals}f}"


class Module:
    """The settings of a module and its answers.

    Parameters
    ----------
    inputs : callable
        Returns the present temperatures of the inputs, degC; NaN for an open input.
    clock : callable
        Returns the time, s.
    cold_junction : callable
        Returns the temperature of the terminals, degC.
    address : int
        0 to 255.
    type_code, form : int
        Input range and data format as in ``%AANNTTCCFF``.
    enabled : int
        Bits of the enabled channels.
    grounded : bool
        Whether INIT* was connected to GND at power on: the module then has address 00, 9600 baud and no checksum.
    model : str
        ``7018`` (ICP DAS) or ``4018`` (Advantech).
    """

    def __init__(
        self,
        inputs: Callable[[], Sequence[float]],
        clock: Callable[[], float],
        cold_junction: Callable[[], float],
        *,
        address: int = 1,
        type_code: int = 0x10,
        form: int = 0,
        enabled: int = 0xFF,
        grounded: bool = False,
        model: Model = "7018",
    ) -> None:
        self._inputs, self._clock, self._cold_junction = inputs, clock, cold_junction
        self._model, self._grounded = model, grounded
        self._stored = self._address = address
        self._type, self._baud, self._form = type_code, BAUD_9600, form
        self._enabled, self._offset = enabled, 0.0
        self._checked = bool(form & CHECKSUM_BIT)
        if grounded:
            self._address, self._checked = 0, False
        self._name: str = model
        self._firmware = {"7018": "A2.0", "4018": "A1.0"}[model]
        self._watching, self._timed_out, self._interval, self._last_ok = False, False, 0xFF, clock()

    # ------------------------------------------------------------------ lines

    def answer(self, line: bytes) -> str | None:
        """Return the answer to a line, both without line end; None if the module does not answer."""
        text = line.decode("latin-1")
        if self._checked:
            text, sent = text[:-2], text[-2:]
            if sent != sum_of_characters(text):
                return None
        checked = self._checked
        answer = self._execute(text)
        return None if answer is None else answer + (sum_of_characters(answer) if checked else "")

    def _execute(self, text: str) -> str | None:
        self._watch()
        if text == "~**" and self._model == "7018":
            self._last_ok = self._clock()
            return None
        if text[:1] not in tuple("%#$~@") or text[1:3] != f"{self._address:02X}":
            return None  # syntax error, or another module
        leading, rest = text[0], text[3:]
        if not (leading == "~" and rest.startswith("O")) and rest != rest.upper():
            return None
        address = f"{self._address:02X}"
        if leading == "#":
            return self._read(rest)
        if leading == "%":
            return self._configure(rest) if len(rest) == 8 else None
        execute, length = self._command(leading, rest[:1])
        if not rest:
            return None
        if execute is None:
            return f"?{address}"
        parameter = rest[1:]
        if length is not None and len(parameter) != length:
            return None
        data = execute(parameter)
        return f"?{address}" if data is None else data if data.startswith(">") else f"!{data}"

    def _command(self, leading: str, code: str) -> tuple[Callable[[str], str | None] | None, int | None]:
        """Return the method of a command and the length of its parameter; None: any length."""
        dollar: dict[str, tuple[Callable[[str], str | None], int | None]] = {
            "2": (self._read_configuration, 0),
            "3": (self._read_cold_junction, 0),
            "5": (self._enable, 2),
            "6": (lambda _: f"{self._own}{self._enabled:02X}", 0),
            "9": (self._set_offset, 5),
            "F": (lambda _: f"{self._own}{self._firmware}", 0),
            "M": (lambda _: f"{self._own}{self._name}", 0),
        }
        tilde: dict[str, tuple[Callable[[str], str | None], int | None]] = {
            "0": (lambda _: f"{self._own}{self._status():02X}", 0),
            "1": (self._reset_status, 0),
            "2": (lambda _: f"{self._own}{self._interval:02X}", 0),
            "3": (self._set_watchdog, 3),
            "O": (self._set_name, None),
        }
        known = {"$": dollar, "~": tilde if self._model == "7018" else {}}.get(leading, {})
        return known.get(code, (None, None))

    @property
    def _own(self) -> str:
        return f"{self._address:02X}"

    # ------------------------------------------------------------------ readings

    def _read(self, channel: str) -> str | None:
        if len(channel) > 1:
            return None
        if channel and channel not in tuple("01234567"):
            return f"?{self._own}"
        readings = [float("nan")] * CHANNELS
        found = self._inputs()
        readings[: len(found)] = found
        if channel:
            return f">{self._write(readings[int(channel)])}"
        blank = " " * (4 if self._form & FORMAT_BITS == HEXADECIMAL else 7)
        return ">" + "".join(
            self._write(reading) if self._enabled >> number & 1 else blank for number, reading in enumerate(readings)
        )

    def _write(self, temperature: float) -> str:
        span = SPANS[self._model][self._type]
        value = temperature + self._offset
        if not span.thermocouple:
            value = SEEBECK * (temperature - self._cold_junction())
        return format_reading(value, span, self._form & FORMAT_BITS, self._model)

    def _read_cold_junction(self, _: str) -> str:
        return f">{_signed(self._cold_junction() + self._offset, 1)}"

    # ------------------------------------------------------------------ settings

    def _configure(self, parameter: str) -> str:
        refused = f"?{self._own}"
        if not re.fullmatch("[0-9A-F]{8}", parameter):
            return refused
        address, type_code, baud, form = bytes.fromhex(parameter)
        forms = (ENGINEERING,) if self._model == "4018" else (ENGINEERING, PERCENT, HEXADECIMAL)
        if type_code not in SPANS[self._model] or baud not in BAUD_CODES or form & FORMAT_BITS not in forms:
            return refused
        if form & ~(FORMAT_BITS | CHECKSUM_BIT | FILTER_BIT):
            return refused
        if (baud, form & CHECKSUM_BIT) != (self._baud, self._form & CHECKSUM_BIT) and not self._grounded:
            return refused
        self._stored, self._type, self._baud, self._form = address, type_code, baud, form
        if not self._grounded:
            self._address = address
        return f"!{address:02X}"

    def _read_configuration(self, _: str) -> str:
        return f"{self._stored:02X}{self._type:02X}{self._baud:02X}{self._form:02X}"

    def _enable(self, parameter: str) -> str | None:
        if not re.fullmatch("[0-9A-F]{2}", parameter):
            return None
        self._enabled = int(parameter, 16)
        return self._own

    def _set_offset(self, parameter: str) -> str | None:
        if not re.fullmatch("[+-][0-9A-F]{4}", parameter) or int(parameter[1:], 16) > MAX_CJC_OFFSET:
            return None
        self._offset = int(parameter, 16) * CJC_STEP
        return self._own

    def _set_name(self, parameter: str) -> str | None:
        if not 0 < len(parameter) <= MAX_NAME or not (parameter.isascii() and parameter.isprintable()):
            return None
        self._name = parameter
        return self._own

    # ------------------------------------------------------------------ host watchdog

    def _watch(self) -> None:
        """Set the flag if the host has been silent for too long; the watchdog is then off."""
        if self._watching and self._clock() - self._last_ok > self._interval * WATCHDOG_STEP:
            self._watching, self._timed_out = False, True

    def _status(self) -> int:
        return ENABLED_BIT * self._watching | TIMED_OUT_BIT * self._timed_out

    def _reset_status(self, _: str) -> str:
        self._timed_out = False
        return self._own

    def _set_watchdog(self, parameter: str) -> str | None:
        if not re.fullmatch("[01][0-9A-F]{2}", parameter) or parameter[1:] == "00":
            return None
        self._watching, self._interval, self._last_ok = parameter[0] == "1", int(parameter[1:], 16), self._clock()
        return self._own
