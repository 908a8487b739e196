"""Common parts of the simulated thermometers: the sensors of the machine, and a temporary loss of power."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.loopback.serving import Server, TcpServer
from errormotion.twin import VirtualMachine

DEFAULT_SENSORS = "frame,ambient,spindle_front,spindle_rear,column"
NOISE = 0.02  # degC, one sigma


class Inputs:
    """The inputs of a thermometer: sensors of the machine, some of them broken.

    Parameters of the address: ``sensors`` (names, separated by commas), ``open`` and ``shorted`` (numbers of inputs
    from 0, separated by commas), ``noise`` (degC).

    Attributes
    ----------
    names : tuple of str
        Names of the sensors.
    open, shorted : frozenset of int
        Inputs without a sensor, and with a shorted one.
    """

    def __init__(self, machine: VirtualMachine, address: Address) -> None:
        known = machine.temperature_sensors
        self.names = tuple(address.params.get("sensors", DEFAULT_SENSORS).split(","))
        if unknown := [name for name in self.names if name not in known]:
            raise InstrumentError(
                f"Expected sensors of the machine, {', '.join(known)}; found {', '.join(unknown)}",
                code="simulator.setting",
            )
        self.open, self.shorted = (_numbers(address, key, len(self.names)) for key in ("open", "shorted"))
        self._machine, self._noise = machine, address.number("noise", NOISE)
        self._indices = [known.index(name) for name in self.names]

    def temperatures(self, time: float, rng: np.random.Generator) -> list[float]:
        """Return readings of intact sensors at a time of the world, degC."""
        truth = self._machine.temperatures([time])[0, self._indices]
        return [float(t) for t in truth + self._noise * rng.standard_normal(truth.size)]


def _numbers(address: Address, key: str, n: int) -> frozenset[int]:
    text = address.params.get(key, "")
    try:
        numbers = frozenset(int(part) for part in text.split(",") if part)
    except ValueError:
        numbers = frozenset((-1,))
    if not numbers <= frozenset(range(n)):
        raise InstrumentError(
            f"'{key}' in '{address.url}': expected inputs from 0 to {n - 1}; found '{text}'", code="simulator.setting"
        )
    return numbers


class Unplugging:
    """``fault=unplugged``: from answer ``fault_at`` on the thermometer has no power for ``unplugged_for`` seconds.

    Meanwhile it does not answer; without ``unplugged_for`` it remains off.

    Parameters
    ----------
    address : Address
    kinds : sequence of str
        Faults that start and end in this way.
    """

    def __init__(self, address: Address, kinds: Sequence[str] = ("unplugged",)) -> None:
        self._wanted = address.params.get("fault") in kinds
        self._at = int(address.number("fault_at", 0))
        self._length = address.number("unplugged_for", math.inf)
        self._since = math.nan

    def begins(self, answers: int) -> bool:
        """Whether the fault starts now, after a number of ``answers``; True only once."""
        if not self._wanted or answers < self._at:
            return False
        self._wanted, self._since = False, time.monotonic()
        return True

    def now(self) -> bool:
        """Whether the thermometer is unplugged."""
        return time.monotonic() < self._since + self._length

    def returns(self) -> bool:
        """Whether the power has returned since the last call; True only once."""
        if self._since != self._since or self.now():
            return False
        self._since = math.nan
        return True

    def keeps_from(self, answers: int, server: Server) -> bool:
        """Whether received data are not answered; when the power returns, an old connection is closed."""
        self.begins(answers)
        if self.now():
            return True
        if self.returns() and isinstance(server, TcpServer):
            server.disconnect()
            return True
        return False
