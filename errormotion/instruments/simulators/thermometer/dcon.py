"""A DCON thermocouple module on the virtual machine."""

from __future__ import annotations

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.thermometer.dcon_module import (
    CHANNELS,
    CHECKSUM_BIT,
    LINE_END,
    SPANS,
    Module,
    sum_of_characters,
)
from errormotion.instruments.simulators.thermometer.temperatures import Inputs, Unplugging
from errormotion.instruments.transports import Address

MAX_LINE = 64
"""Longest request, bytes; a longer one is discarded up to the next line."""
FORMATS = ("engineering", "percent", "hexadecimal")
TYPE_T = 0x10


class SimulatedDcon(SimulatedDevice):
    """An ICP DAS I-7018 or Advantech ADAM-4018 whose thermocouples measure temperatures of the machine.

    Further parameters of the address: ``sensors``, ``open``, ``noise`` and ``unplugged_for`` (see
    `temperatures`), ``unit`` (1), ``checksum`` (0 or 1), ``model`` (``7018``, ``4018``), ``format``
    (``engineering``, ``percent``, ``hexadecimal``), ``type`` (code of the input range, 16: type T), ``enabled`` (bits
    of the enabled channels; default: those with a sensor), ``init`` (1: INIT* was grounded at power on).
    """

    faults: tuple[str, ...] = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect", "late", "unplugged")

    def __init__(self, address: Address) -> None:
        self._unplugging = Unplugging(address)
        self._discarding = False
        self._checked = bool(address.whole("checksum", 0, 1)) and not address.whole("init", 0, 1)
        if self._checked:
            self.faults = (*self.faults, "checksum")
        super().__init__(address, line_end=LINE_END, default_name="thermometer")
        try:
            self._inputs = Inputs(self.world.machine, address)
            self._module = self._make_module(address)
        except BaseException:
            self.close()
            raise

    def _make_module(self, address: Address) -> Module:
        model, form = address.params.get("model", "7018"), address.params.get("format", FORMATS[0])
        if model not in SPANS or form not in FORMATS or (model == "4018" and form != FORMATS[0]):
            raise InstrumentError(
                f"'{address.url}': expected 'model' 7018 or 4018 and 'format' {', '.join(FORMATS)} (4018: the first); "
                f"found '{model}' and '{form}'",
                code="simulator.setting",
            )
        type_code = address.whole("type", TYPE_T, 255)
        if type_code not in SPANS[model]:
            raise InstrumentError(
                f"'type' in '{address.url}': expected an input range of a {model}; found {type_code}",
                code="simulator.setting",
            )
        if len(self._inputs.names) > CHANNELS:
            raise InstrumentError(
                f"'sensors' in '{address.url}': expected at most {CHANNELS} sensors; found {len(self._inputs.names)}",
                code="simulator.setting",
            )
        return Module(
            self._temperatures,
            lambda: self.world.time,
            self._terminals,
            address=address.whole("unit", 1, 255),
            type_code=type_code,
            form=FORMATS.index(form) | CHECKSUM_BIT * address.whole("checksum", 0, 1),
            enabled=address.whole("enabled", (1 << len(self._inputs.names)) - 1, 255),
            grounded=bool(address.whole("init", 0, 1)),
            model=model,
        )

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request; empty if the module does not answer."""
        text = self._module.answer(request)
        if text is None:
            return b""
        if self.fault.hits("checksum", self._answers):
            wrong = int(sum_of_characters(text[:-2]), 16) ^ 1
            text = f"{text[:-2]}{wrong:02X}"
        return text.encode("latin-1") + LINE_END

    def connection_opened(self) -> None:
        """Discard an incomplete request of the previous connection."""
        super().connection_opened()
        self._discarding = False

    def _temperatures(self) -> list[float]:
        readings = self._inputs.temperatures(self.world.time, self._rng)
        far = self.fault.hits("out_of_range", self._answers)
        return [float("nan") if far or i in self._inputs.open else t for i, t in enumerate(readings)]

    def _terminals(self) -> float:
        """Return the temperature of the terminals: that of the machine's ambient sensor, or of the first sensor."""
        machine = self.world.machine
        known = machine.temperature_sensors
        return float(machine.temperatures([self.world.time])[0, known.index("ambient") if "ambient" in known else 0])

    def _on_data(self, data: bytes) -> None:
        if self._unplugging.keeps_from(self._answers, self._server):
            return
        self._buffer += data
        while LINE_END in self._buffer:
            request, _, self._buffer = self._buffer.partition(LINE_END)
            answer = b"" if self._discarding or len(request) > MAX_LINE else self.answer(request)
            self._discarding = False
            if answer:
                self.reply(answer)
        if len(self._buffer) > MAX_LINE:
            self._buffer, self._discarding = b"", True
