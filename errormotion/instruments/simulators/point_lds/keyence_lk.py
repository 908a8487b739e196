"""An LK-G or LK-H controller on the wire: answers line by line, and shows what the virtual machine's sensor sees."""

from __future__ import annotations

import math
from itertools import cycle

from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.keyence_lk.codec import (
    COMMAND_ERROR,
    CONTROLLERS,
    COUNT_ERROR,
    DISPLAY_SETTING,
    DISPLAYS,
    ERROR,
    HEADS,
    LENGTH_ERROR,
    LINE_END,
    MEASURING,
    NO_OFFSET,
    NO_VALUE,
    OFFSET_SETTING,
    OVER,
    PARAMETER_ERROR,
    SETTING,
    SIGNS,
    STATE_ERROR,
    UNDER,
    encode,
    format_value,
)
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.transports import Address

STILL = 1.2345e-3
"""What a head reads that has no position on the machine, m."""


class SimulatedKeyenceLK(SimulatedDevice):
    """A controller with one head.

    It reads what the world's point sensor reads of the target that is set there, from the middle of the range on; it
    has no value without a target. Where the address names no device it looks at a plate that never moves until then.

    Further parameters of the address: ``readings`` (mm along the beam, joined by commas: taken one after the other
    instead of the world's; ``nan`` is no value), ``head`` (LK-H050), ``controller`` (LK-G5000), ``output`` (1),
    ``display`` (number of the display unit, 2), ``positive`` (near or far), ``offset`` (mm, in the controller's
    settings), ``zero`` (mm, set on its panel).

    Faults beyond the menu: ``over_range``, ``under_range``, and ``error``, where ``code`` (00) is answered to
    every request from ``fault_at`` on.
    """

    faults = (
        "silence",
        "split",
        "garbage",
        "out_of_range",
        "over_range",
        "under_range",
        "error",
        "drop",
        "disconnect",
        "late",
    )

    def __init__(self, address: Address) -> None:
        super().__init__(address, line_end=LINE_END, default_name="lk")
        try:
            self._set_up(address)
        except (InstrumentError, KeyError, ValueError) as error:
            self.close()
            raise InstrumentError(f"'{address.url}' has invalid parameters of a controller: {error}") from None

    def _set_up(self, address: Address) -> None:
        self._controller = CONTROLLERS[address.params.get("controller", "LK-G5000")]
        self._low, self._high = HEADS[address.params.get("head", "LK-H050")]
        self._output = self._controller.output.format(int(address.number("output", 1)))
        display = int(address.number("display", 2))
        self._display = {unit.number: unit for unit in DISPLAYS.values()}[display]
        self._sign = SIGNS[address.params.get("positive", "near")]
        self._offset = 1e-3 * address.number("offset", 0)
        self._zero = 1e-3 * address.number("zero", 0)
        self._mode = MEASURING
        texts = address.params.get("readings", "")
        self._readings = cycle([1e-3 * float(text) for text in texts.split(",")] if texts else ())
        self._given = bool(texts)
        self._on_the_desk = not address.path

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request."""
        text = request.decode("ascii", errors="replace").upper()
        if self.fault.kind == "error" and self._answers >= self.fault.at:
            code = self.params.get("code", COMMAND_ERROR)
            return encode(f"{ERROR},{text.split(',')[0]},{code}")
        return encode(self._obey(text))

    def _obey(self, text: str) -> str:
        measure, zero_off = self._controller.measure, self._controller.zero_off
        if text in (MEASURING, SETTING):
            if text == self._mode:
                return _error(text, STATE_ERROR)
            self._mode = text
            return text
        for command in (measure, zero_off):
            word = command.rstrip(",")
            if text.startswith(word) and text[len(word) :].strip("0123456789,") == "":
                return self._complaint(text, command) or self._measured(text, zero=command == zero_off)
        if text.startswith(("SR,", "SW,")):
            return self._setting(text)
        return _error(text, COMMAND_ERROR)

    def _complaint(self, text: str, command: str) -> str:
        """Return the error that a request to measure deserves; empty where it is right."""
        if self._mode != MEASURING:
            return _error(text, STATE_ERROR)
        identifier = text[len(command) :]
        if not text.startswith(command) or "," in identifier or not identifier:
            return _error(text, COUNT_ERROR)
        if len(identifier) != len(self._output):
            return _error(text, LENGTH_ERROR)
        return "" if identifier == self._output else _error(text, PARAMETER_ERROR)

    def _measured(self, text: str, *, zero: bool) -> str:
        if zero:
            self._zero = 0.0
            return text
        return f"{text},{self._shown()}"

    def _shown(self) -> str:
        for fault, shown in (("out_of_range", NO_VALUE), ("over_range", OVER), ("under_range", UNDER)):
            if self.fault.kind == fault and self._faulty():
                return shown
        reading = self._seen()
        if math.isnan(reading):
            return NO_VALUE
        value = self._sign * reading
        if not self._low <= value <= self._high:
            return OVER if value > 0 else UNDER
        return format_value(value + self._offset - self._zero, self._display)

    def _seen(self) -> float:
        """Return what the head reads along its beam, m."""
        if self._given:
            return next(self._readings)
        if self._on_the_desk and self.world.stand.target is None:
            return STILL
        return self.world.read_point(self.name)

    def _faulty(self) -> bool:
        count = self._answers - self.fault.at
        return count >= 0 and (self.fault.length == 0 or count < self.fault.length)

    def _setting(self, text: str) -> str:
        """Read or write a setting: SR,name,output and SW,name,output,value."""
        if self._mode != SETTING:
            return _error(text, STATE_ERROR)
        word, *rest = text.split(",")
        if len(rest) != (2 if word == "SR" else 3):
            return _error(text, COUNT_ERROR)
        name, output, *value = rest
        if name not in (DISPLAY_SETTING, OFFSET_SETTING) or output != self._output:
            return _error(text, PARAMETER_ERROR)
        if word == "SR":
            return f"{text},{self._display.number if name == DISPLAY_SETTING else self._offset_text()}"
        return f"{word},{name}" if self._write(name, value[0]) else _error(text, PARAMETER_ERROR)

    def _offset_text(self) -> str:
        """Return the offset: a sign, six digits and a point."""
        return f"{self._offset / self._display.unit:+08.{self._display.decimals}f}"

    def _write(self, name: str, value: str) -> bool:
        if name == OFFSET_SETTING:
            if len(value) != len(NO_OFFSET) or value[0] not in "+-" or not value[1:].isdecimal():
                return False
            self._offset = int(value) * self._display.step
            return True
        units = [unit for unit in DISPLAYS.values() if str(unit.number) == value]
        if units:
            self._display = units[0]
        return bool(units)


def _error(text: str, code: str) -> str:
    return f"{ERROR},{text.split(',')[0]},{code}"
