"""Base of thermometers: named sensors with positions on the machine, and a flag for each missing temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Length
from errormotion.errors import InstrumentError
from errormotion.instruments.driver import Driver
from errormotion.plugins import PluginSettings

Position = tuple[Length, Length, Length]

GOOD = ""
OPEN, SHORTED, OUT_OF_RANGE, NO_ANSWER, NOT_READ = "open", "shorted", "out of range", "no answer", "not read"
FAULTY = "faulty"
"""Open or shorted: the device does not distinguish them."""
FLAGS = (GOOD, OPEN, SHORTED, FAULTY, OUT_OF_RANGE, NO_ANSWER, NOT_READ)


class ThermometerSettings(PluginSettings):
    """Settings of every thermometer."""

    channels: tuple[str, ...] = Field(
        default=("frame", "ambient", "spindle_front", "spindle_rear", "column"),
        description="names of the inputs, from the first one on",
        min_length=1,
    )
    places: dict[str, Position] = Field(
        default_factory=dict, description="positions of sensors on the machine: name to X, Y, Z; as far as known"
    )

    @model_validator(mode="after")
    def _names(self) -> Self:
        if double := {name for name in self.channels if self.channels.count(name) > 1}:
            raise ValueError(f"'channels' has {', '.join(sorted(double))} twice; each sensor needs its own name")
        if unknown := [name for name in self.places if name not in self.channels]:
            raise ValueError(
                f"'places' has {', '.join(unknown)}; expected names of the channels {', '.join(self.channels)}"
            )
        return self


class Thermometer(Driver):
    """Base of thermometers: `_measure` returns temperatures and flags, `read` stores the flags.

    Attributes
    ----------
    flags : dict of str to str
        Of the last reading: empty for a good temperature, else ``open``, ``shorted``, ``faulty`` (one of the two),
        ``out of range``, ``no answer`` (all of them, when `read` has failed), or ``not read`` before the first reading.
    """

    settings: ThermometerSettings
    flags: dict[str, str]

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return self.settings.channels

    @property
    def places(self) -> dict[str, tuple[float, float, float] | None]:
        """Position of each sensor on the machine, m; None where unknown."""
        return {name: self.settings.places.get(name) for name in self.channels}

    @property
    def open_sensors(self) -> tuple[str, ...]:
        """Channels that had no value in the last reading."""
        return tuple(name for name, flag in self.flags.items() if flag not in (GOOD, NOT_READ))

    def open(self) -> None:
        """Open the connection and check the device; idempotent."""
        if self._transport is None:
            self.flags = dict.fromkeys(self.channels, NOT_READ)
        super().open()

    def read(self) -> dict[str, float]:
        """Return the temperatures now, degC by channel; NaN where missing, with the reason in `flags`.

        Raises
        ------
        InstrumentError
            No answer, or an invalid one; after a lost connection the next call connects again.
        """
        try:
            found = self._measure()
        except InstrumentError:
            self.flags = dict.fromkeys(self.channels, NO_ANSWER)
            raise
        self.flags = {name: flag for name, (_, flag) in found.items()}
        return {name: math.nan if flag else value for name, (value, flag) in found.items()}

    def _measure(self) -> Mapping[str, tuple[float, str]]:
        """Return temperature (degC) and flag of each channel, in their order."""
        raise NotImplementedError
