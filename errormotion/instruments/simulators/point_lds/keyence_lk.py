"""A simulated LK-G5000 or LK-G3000 controller on RS-232C; it measures in the virtual machine.

The commands are in `keyence_lk_grammar`.
"""

from __future__ import annotations

import math
from itertools import cycle

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.point_lds import keyence_lk_grammar as grammar
from errormotion.instruments.simulators.point_lds.keyence_lk_commands import Commands, MistakeError
from errormotion.instruments.transports import Address

STILL = 1.2345e-3
"""Reading of a head that is not mounted on the machine, m."""
SIGNS = {"near": -1.0, "far": 1.0}
"""Sign of the value of a reading that increases with the distance, by the side on which values are positive."""
MAX_WAITING = 1024
"""Largest number of bytes kept of an incomplete command."""


class SimulatedKeyenceLK(SimulatedDevice):
    """A controller with one head.

    It measures the target that is set in the world, from the middle of the range; without a target it has no value. If
    the address names no device, it measures a stationary plate until a target is set.

    Further parameters of the address: ``readings`` (mm along the beam, separated by commas: used in turn instead of
    readings of the world; ``nan`` is no value), ``head`` (LK-H050), ``controller`` (LK-G5000), ``output`` (number of
    the output of the head, 1), ``outputs`` (number of active outputs; default: ``output``), ``display`` (number of the
    display unit, 2), ``positive`` (near or far), ``offset`` (mm, in the controller's settings), ``zero`` (mm, set on
    its panel).

    Faults in addition to the menu: ``over_range``, ``under_range``, and ``error``: the answer to every request from
    ``fault_at`` on is the error ``code`` (default: that of an unknown command).
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
        super().__init__(address, line_end=grammar.LINE_END, default_name="lk")
        try:
            self._set_up(address)
        except (InstrumentError, KeyError, ValueError) as error:
            self.close()
            raise InstrumentError(
                f"'{address.url}' has invalid parameters of a controller: {error}", code="simulator.setting"
            ) from None

    def _set_up(self, address: Address) -> None:
        controller = grammar.CONTROLLERS[address.params.get("controller", "LK-G5000")]
        self._half = grammar.HEADS[address.params.get("head", "LK-H050")]
        output = int(address.number("output", 1))
        outputs = int(address.number("outputs", output))
        display = int(address.number("display", 2))
        if not 1 <= output <= outputs <= controller.outputs or not 0 <= display < len(grammar.DISPLAYS):
            raise ValueError(f"output {output} of {outputs}, display unit {display}")
        self._sign = SIGNS[address.params.get("positive", "near")]
        texts = address.params.get("readings", "")
        self._readings = cycle([1e-3 * float(text) for text in texts.split(",")] if texts else ())
        self._has_readings = bool(texts)
        self._unmounted = not address.path
        self._commands = Commands(controller, self._value, output=output, outputs=outputs, display=display)
        self._commands.offset = 1e-3 * address.number("offset", 0)
        self._commands.zero = 1e-3 * address.number("zero", 0)

    def _on_data(self, data: bytes) -> None:
        super()._on_data(data)
        self._buffer = self._buffer[:MAX_WAITING]

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request; a line feed after the previous carriage return is ignored."""
        text = request.lstrip(b"\n").decode("ascii", errors="replace").upper()
        header, errors = text.split(",")[0], self._commands.controller.errors
        if self.fault.kind == "error" and self._answers >= self.fault.at:
            code = self.params.get("code", errors[grammar.Mistake.COMMAND])
            return _line(f"ER,{header},{code}")
        try:
            return _line(self._commands.execute(text))
        except MistakeError as mistake:
            return _line(f"ER,{header},{errors[mistake.kind]}")

    def _value(self) -> float | str:
        """Return the value of the head, m, or the text that replaces a missing value."""
        for fault, text in (
            ("out_of_range", grammar.NO_VALUE),
            ("over_range", grammar.OVER),
            ("under_range", grammar.UNDER),
        ):
            if self.fault.affects(fault, self._answers):
                return text
        reading = self._reading()
        if math.isnan(reading):
            return grammar.NO_VALUE
        value = self._sign * reading
        if not -self._half <= value <= self._half:
            return grammar.OVER if value > 0 else grammar.UNDER
        return value

    def _reading(self) -> float:
        """Return the reading of the head along its beam, m."""
        if self._has_readings:
            return next(self._readings)
        if self._unmounted and self.world.stand.target is None:
            return STILL
        return self.world.read_point(self.name)


def _line(text: str) -> bytes:
    return text.encode("ascii", errors="replace") + grammar.LINE_END
