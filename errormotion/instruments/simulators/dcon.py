"""A DCON thermocouple module on the virtual machine."""

from __future__ import annotations

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.thermometer.dcon import LINE_END, checksum, decode, encode, format_temperatures
from errormotion.instruments.transports import Address

DEFAULT_SENSORS = "frame,ambient,spindle_front,spindle_rear,column"
NOISE = 0.02  # degC, one sigma


class SimulatedDcon(SimulatedDevice):
    """A module whose inputs are temperature sensors of the machine.

    Further parameters of the address: ``sensors`` (names of the twin's sensors, joined by commas), ``open`` (number of
    an input whose sensor is open, from 0), ``unit`` (1), ``checksum`` (0 or 1).
    """

    faults: tuple[str, ...] = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect")

    def __init__(self, address: Address) -> None:
        self._unit = f"{int(address.number('unit', 1)):02X}"
        self._checksum = bool(address.number("checksum", 0))
        self._open = int(address.number("open", -1))
        if self._checksum:
            self.faults = (*self.faults, "checksum")
        super().__init__(address, line_end=LINE_END, default_name="thermometer")
        names = self.world.machine.temperature_sensors
        wanted = address.params.get("sensors", DEFAULT_SENSORS).split(",")
        unknown = [name for name in wanted if name not in names]
        if unknown:
            self.close()
            raise InstrumentError(f"The machine has the sensors {', '.join(names)}; found {', '.join(unknown)}")
        self._inputs = [names.index(name) for name in wanted]

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request."""
        try:
            text = self._obey(decode(request, with_checksum=self._checksum))
        except ProtocolError:
            return b""  # a module keeps quiet when the checksum is wrong
        if self.fault.hits("checksum", self._answers):
            wrong = int(checksum(text), 16) ^ 1
            return f"{text}{wrong:02X}".encode() + LINE_END
        return encode(text, with_checksum=self._checksum)

    def _obey(self, request: str) -> str:
        if request == f"#{self._unit}":
            return format_temperatures(self._temperatures())
        if request == f"${self._unit}M":
            return f"!{self._unit}4018"
        if request == f"${self._unit}F":
            return f"!{self._unit}A1.0"
        return f"?{self._unit}"

    def _temperatures(self) -> list[float]:
        if self.fault.hits("out_of_range", self._answers):
            return [float("nan")] * len(self._inputs)
        truth = self.world.machine.temperatures([self.world.time])[0, self._inputs]
        readings = [float(t) for t in truth + NOISE * self._rng.standard_normal(truth.size)]
        if 0 <= self._open < len(readings):
            readings[self._open] = float("nan")
        return readings
