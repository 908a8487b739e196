"""What the simulated thermometers share: which sensors of the machine they read, and being unplugged for a time."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.transports import Address
from errormotion.twin import VirtualMachine

DEFAULT_SENSORS = "frame,ambient,spindle_front,spindle_rear,column"
NOISE = 0.02  # degC, one sigma
UNPLUGGED = "unplugged"


class Inputs:
    """The inputs of a thermometer: sensors of the machine, some of them broken.

    Parameters of the address: ``sensors`` (names, joined by commas), ``open`` and ``shorted`` (numbers of inputs from
    0, joined by commas), ``noise`` (degC).

    Attributes
    ----------
    names : tuple of str
        Of the sensors.
    open, shorted : frozenset of int
        Inputs without a sensor, and with a shorted one.
    """

    def __init__(self, machine: VirtualMachine, address: Address) -> None:
        known = machine.temperature_sensors
        self.names = tuple(address.params.get("sensors", DEFAULT_SENSORS).split(","))
        if unknown := [name for name in self.names if name not in known]:
            raise InstrumentError(f"The machine has the sensors {', '.join(known)}; found {', '.join(unknown)}")
        self.open, self.shorted = (_numbers(address, key, len(self.names)) for key in ("open", "shorted"))
        self._machine, self._noise = machine, address.number("noise", NOISE)
        self._places = [known.index(name) for name in self.names]

    def temperatures(self, time: float, rng: np.random.Generator) -> list[float]:
        """Return what good sensors read at a time of the world, degC."""
        truth = self._machine.temperatures([time])[0, self._places]
        return [float(t) for t in truth + self._noise * rng.standard_normal(truth.size)]


def _numbers(address: Address, key: str, n: int) -> frozenset[int]:
    text = address.params.get(key, "")
    try:
        found = frozenset(int(part) for part in text.split(",") if part)
    except ValueError:
        found = frozenset((-1,))
    if not found <= frozenset(range(n)):
        raise InstrumentError(f"'{key}' in '{address.url}': expected inputs from 0 to {n - 1}; found '{text}'")
    return found


class Unplugging:
    """``fault=unplugged``: from answer ``fault_at`` on the thermometer is without power for ``unplugged_for`` seconds.

    Meanwhile it is silent. When it is back it knows nothing of the connections that it had: what comes over one of
    them is answered by hanging up. By default it stays away.
    """

    def __init__(self, address: Address) -> None:
        self._wanted = address.params.get("fault") == UNPLUGGED
        self._at = int(address.number("fault_at", 0))
        self._length = address.number("unplugged_for", float("inf"))
        self._since: float | None = None
        self._back = False

    def swallows(self, answers: int, hang_up: Callable[[], None]) -> bool:
        """Whether what comes in now gets no answer; ``answers`` have been given so far."""
        if not self._wanted or self._back or answers < self._at:
            return False
        now = time.monotonic()
        if self._since is None:
            self._since = now
        if now < self._since + self._length:
            return True
        self._back = True
        hang_up()
        return True
