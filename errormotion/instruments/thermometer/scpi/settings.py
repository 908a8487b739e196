"""Settings of a data acquisition unit with SCPI commands: channels, sensors, and the commands that set them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, Self, TypeVar

from pydantic import Field, model_validator

from errormotion.datasets.units import Temperature, Time
from errormotion.instruments.thermometer.scpi.codec import channel_list
from errormotion.instruments.thermometer.sensors import ThermometerSettings

T = TypeVar("T")
Sensor = Literal[
    "FRTD 85", "FRTD 91", "RTD 85", "RTD 91", "TC B", "TC E", "TC J", "TC K", "TC N", "TC R", "TC S", "TC T"
]
MODELS = ("34970A", "34972A", "34980A", "DAQ970A", "DAQ973A")
"""Models whose manuals describe the commands of the driver."""


class ScpiSettings(ThermometerSettings):
    """Settings of a SCPI data acquisition unit.

    A temperature is ``scale * reading + offset``, from the calibration of its sensor.
    """

    inputs: tuple[int, ...] = Field(
        default=(), description="channels of the unit, one for each name; default: 101 and the following ones"
    )
    sensors: tuple[Sensor, ...] = Field(
        default=("FRTD 85",),
        description="types of sensors, one for all channels or one for each: FRTD is a resistance thermometer with "
        "four wires, RTD with two, 85 the coefficient of IEC 60751 (Pt100); TC a thermocouple and its type",
        min_length=1,
    )
    resistance: float | tuple[float, ...] = Field(
        default=100.0,
        description="resistance at 0 degC of resistance thermometers, ohm, 49 to 2100; one for all or for each",
    )
    power_cycles: Literal["0.02", "0.2", "1", "2", "10", "20", "100", "200"] | None = Field(
        default=None, description="integration time of a reading in cycles of the mains; default: that of the unit (1)"
    )
    open_check: bool = Field(default=True, description="whether the unit checks thermocouples for a broken wire")
    reference_junction: Literal["internal", "external"] | Temperature = Field(
        default="internal",
        description="reference junction of thermocouples: 'internal' (sensor in the module), 'external' (a channel of "
        "the unit), or its temperature, -20 to 80 degC",
    )
    scale: float | tuple[float, ...] = Field(default=1.0, description="factor of the readings; one for all or for each")
    offset: float | tuple[float, ...] = Field(
        default=0.0, description="K, added to the readings; one for all or for each"
    )
    lowest: Temperature = Field(default=-273.15, description="temperatures below are out of range")
    highest: Temperature = Field(default=2500.0, description="temperatures above are out of range")
    setup: bool = Field(
        default=True,
        description="whether channels and scan list of the unit are set, which clears its stored readings; otherwise "
        "its scan list is used and must contain these inputs",
    )
    models: tuple[str, ...] = Field(default=MODELS, description="models that are accepted", min_length=1)
    baudrate: int = Field(default=9600, description="baud rate of a serial line, if its URL states none", gt=0)
    timeout: Time = Field(default=5.0, description="time limit for an answer, also for a complete scan", gt=0)
    retry: Time = Field(default=1.0, description="minimum interval between two attempts to connect again", ge=0)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        n = len(self.channels)
        if self.inputs and len(self.inputs) != n:
            raise ValueError(f"'inputs': expected one for each of the {n} channels; found {len(self.inputs)}")
        if wrong := [each for each in self.numbers if not 101 <= each <= 8999]:
            raise ValueError(f"'inputs': expected slot and channel, such as 101 or 1001; found {wrong[0]}")
        if len(set(self.numbers)) != n:
            raise ValueError("'inputs' has a channel twice; expected a different one for each name")
        for name in ("sensors", "resistance", "scale", "offset"):
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) not in (1, n):
                raise ValueError(f"'{name}': expected one, or one for each of the {n} channels; found {len(value)}")
        junction = self.reference_junction
        if not isinstance(junction, str) and not -20 <= junction <= 80:
            raise ValueError(f"'reference_junction': expected -20 to 80 degC; found {junction:g} degC")
        if wrong_resistance := [each for each in self._each(self.resistance) if not 49 <= each <= 2100]:
            raise ValueError(f"'resistance': expected 49 to 2100 ohm; found {wrong_resistance[0]:g}")
        return self

    @property
    def numbers(self) -> tuple[int, ...]:
        """Channel of the unit for each name."""
        return self.inputs or tuple(range(101, 101 + len(self.channels)))

    def corrected(self, index: int, reading: float) -> float:
        """Return a temperature (degC) from a reading (degC) of the channel with this index."""
        return float(self._each(self.scale)[index] * reading + self._each(self.offset)[index])

    def commands(self) -> Iterator[str]:
        """Yield the commands that set channels, scan list and format of the readings."""
        for sensor, numbers in self._groups(self._each(self.sensors)):
            kind, _, type_ = sensor.partition(" ")
            chosen = channel_list(numbers)
            yield f"CONF:TEMP {kind},{type_},{chosen}"
            if kind == "TC":
                yield f"TEMP:TRAN:TC:CHEC {'ON' if self.open_check else 'OFF'},{chosen}"
                yield from self._junction(chosen)
        pairs = [
            (sensor.split()[0], ohm)
            for sensor, ohm in zip(self._each(self.sensors), self._each(self.resistance), strict=True)
        ]
        for (kind, ohm), numbers in self._groups(pairs):
            if kind != "TC":
                yield f"TEMP:TRAN:{kind}:RES {ohm:g},{channel_list(numbers)}"
        every = channel_list(sorted(self.numbers))
        if self.power_cycles is not None:
            yield f"TEMP:NPLC {self.power_cycles},{every}"
        yield f"UNIT:TEMP C,{every}"
        yield f"ROUT:SCAN {every}"
        yield from ("TRIG:SOUR IMM", "TRIG:COUN 1")
        yield from self.format_commands()

    def _junction(self, chosen: str) -> Iterator[str]:
        """Yield the commands that set the reference junction of thermocouples."""
        junction = self.reference_junction
        if isinstance(junction, str):
            yield f"TEMP:TRAN:TC:RJUN:TYPE {junction[:3].upper()},{chosen}"
        else:
            yield f"TEMP:TRAN:TC:RJUN:TYPE FIX,{chosen}"
            yield f"TEMP:TRAN:TC:RJUN {junction:g},{chosen}"

    @staticmethod
    def format_commands() -> tuple[str, ...]:
        """Return the commands that set the format of readings: the reading and its channel."""
        return ("FORM:READ:ALAR OFF", "FORM:READ:CHAN ON", "FORM:READ:TIME OFF", "FORM:READ:UNIT OFF")

    def _groups(self, values: Sequence[T]) -> Iterator[tuple[T, list[int]]]:
        """Yield each distinct value with its channels in ascending order."""
        for value in dict.fromkeys(values):
            yield value, sorted(number for number, each in zip(self.numbers, values, strict=True) if each == value)

    def _each(self, value: Any) -> tuple[Any, ...]:
        """Return one value for each channel."""
        if not isinstance(value, tuple):
            return (value,) * len(self.channels)
        return value if len(value) == len(self.channels) else value * len(self.channels)
