"""An LK-G5000 or LK-G3000 controller on its RS-232C line, with what the virtual machine's sensor sees.

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
"""What a head reads that has no position on the machine, m."""
SIGNS = {"near": -1.0, "far": 1.0}
"""Sign of a value for a reading that grows with the distance, by the side on which values are positive."""
MOST_WAITING = 1024
"""Bytes kept of a command whose end has not arrived."""


class SimulatedKeyenceLK(SimulatedDevice):
    """A controller with one head.

    It reads what the world's point sensor reads of the target that is set there, from the middle of the range on; it
    has no value without a target. Where the address names no device it looks at a plate that never moves until then.

    Further parameters of the address: ``readings`` (mm along the beam, joined by commas: taken one after the other
    instead of the world's; ``nan`` is no value), ``head`` (LK-H050), ``controller`` (LK-G5000), ``output`` (1: the
    output that shows the head), ``outputs`` (number of active outputs; default: up to that one), ``display`` (number
    of the display unit, 2), ``positive`` (near or far), ``offset`` (mm, in the controller's settings), ``zero`` (mm,
    set on its panel).

    Faults beyond the menu: ``over_range``, ``under_range``, and ``error``, where ``code`` (default: that of an unknown
    command) is answered to every request from ``fault_at`` on.
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
            raise InstrumentError(f"'{address.url}' has invalid parameters of a controller: {error}") from None

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
        self._given = bool(texts)
        self._on_the_desk = not address.path
        self._commands = Commands(controller, self._value, output=output, outputs=outputs, display=display)
        self._commands.offset = 1e-3 * address.number("offset", 0)
        self._commands.zero = 1e-3 * address.number("zero", 0)

    def _on_data(self, data: bytes) -> None:
        super()._on_data(data)
        self._buffer = self._buffer[:MOST_WAITING]

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request; a line feed ahead of it, behind the last carriage return, is ignored."""
        text = request.lstrip(b"\n").decode("ascii", errors="replace").upper()
        header, errors = text.split(",")[0], self._commands.controller.errors
        if self.fault.kind == "error" and self._answers >= self.fault.at:
            code = self.params.get("code", errors[grammar.Mistake.COMMAND])
            return _line(f"ER,{header},{code}")
        try:
            return _line(self._commands.obey(text))
        except MistakeError as mistake:
            return _line(f"ER,{header},{errors[mistake.kind]}")

    def _value(self) -> float | str:
        """Return what the head reads, m, or the text of a value that is none."""
        for fault, shown in (
            ("out_of_range", grammar.NO_VALUE),
            ("over_range", grammar.OVER),
            ("under_range", grammar.UNDER),
        ):
            if self.fault.kind == fault and self._faulty():
                return shown
        reading = self._seen()
        if math.isnan(reading):
            return grammar.NO_VALUE
        value = self._sign * reading
        if not -self._half <= value <= self._half:
            return grammar.OVER if value > 0 else grammar.UNDER
        return value

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


def _line(text: str) -> bytes:
    return text.encode("ascii", errors="replace") + grammar.LINE_END
