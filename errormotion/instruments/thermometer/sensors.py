"""Bases of thermometers: named sensors with positions on the machine, and a flag for each missing temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Length
from errormotion.errors import InstrumentError
from errormotion.instruments.driver import Driver
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.reconnecting import open_reconnecting
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
        description="names of the inputs, starting at the first one",
        min_length=1,
    )
    places: dict[str, Position] = Field(
        default_factory=dict,
        description="positions of sensors on the machine: name to X, Y, Z; unknown ones are omitted",
    )

    @model_validator(mode="after")
    def _names(self) -> Self:
        if double := {name for name in self.channels if self.channels.count(name) > 1}:
            raise ValueError(
                f"'channels' has {', '.join(sorted(double))} twice; expected a different name for each sensor"
            )
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
        Flag of each channel in the last reading: empty for a valid temperature, else ``open``, ``shorted``, ``faulty``
        (either of the two), ``out of range``, ``no answer`` (all channels, after `read` failed), or ``not read`` before
        the first reading.
    """

    settings: ThermometerSettings
    flags: dict[str, str]

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return self.settings.channels

    @property
    def places(self) -> dict[str, tuple[float, float, float] | None]:
        """Position of each sensor on the machine, m; None if unknown."""
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
        """Return the present temperatures, degC by channel; NaN if missing, with the reason in `flags`.

        Raises
        ------
        InstrumentError
            No answer or an invalid one; after a lost connection the next call connects again.
        """
        try:
            temperatures = self._measure()
        except InstrumentError:
            self.flags = dict.fromkeys(self.channels, NO_ANSWER)
            raise
        self.flags = {name: flag for name, (_, flag) in temperatures.items()}
        return {name: math.nan if flag else value for name, (value, flag) in temperatures.items()}

    def _measure(self) -> Mapping[str, tuple[float, str]]:
        """Return temperature (degC) and flag of each channel, in their order."""
        raise NotImplementedError


class LineThermometer(Thermometer):
    """Base of thermometers on one line, serial or TCP, that is opened again after it was lost.

    Settings called ``timeout`` (s), ``retry`` (s) and ``baudrate`` apply to the line, and those of two wires.
    """

    def _connect(self) -> Transport:
        settings: Any = self.settings
        return open_reconnecting(
            self.address,
            simulator=self.info.simulator,
            record=self._record,
            timeout=settings.timeout,
            retry=settings.retry,
            baudrate=settings.baudrate,
            echo=getattr(settings, "echo", False),
            zeros=getattr(settings, "leading_zeros", False),
        )
