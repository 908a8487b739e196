"""The machine's part of online compensation: a limit, a slew limit, and a watchdog on the heartbeat.

It does what a program in a PLC or a control has to do; the simulated machines share it. Its clock is that of this
computer, unless the address has ``clock=0``: then only `MachinePart.elapse` advances the time.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence

from errormotion.instruments.transports import Address

Offset = tuple[float, float, float]


class MachinePart:
    """Applies offsets as required of a machine.

    Parameters
    ----------
    address : Address
        With the parameters ``watchdog`` (default 3 s), ``slew`` (2e-6 m/s), ``limit`` (50e-6 m) and ``clock`` (1: the
        clock of this computer; 0: stopped).

    Attributes
    ----------
    limit : float
        Largest offset of each axis, m; a larger request is reduced to it.
    slew : float
        Largest rate of change of each axis, m/s.
    watchdog : float
        Time without a heartbeat after which the offset ramps to zero, s.
    orders : int
        Number of requests so far, valid or not.
    busy, fault : str
        Why the offset must not change, and why the machine accepts none. With a fault the offset ramps to zero.
    """

    def __init__(self, address: Address) -> None:
        self.limit = address.number("limit", 50e-6)
        self.slew = address.number("slew", 2e-6)
        self.watchdog = address.number("watchdog", 3.0)
        self.orders = 0
        self.busy = self.fault = ""
        self._rate = address.number("clock", 1.0)
        self._elapsed = 0.0
        self._lock = threading.RLock()
        self._offset: Offset = (0.0, 0.0, 0.0)
        self._target: Offset = (0.0, 0.0, 0.0)
        self._at = self._now()
        self._alive_until = self._begun = -math.inf

    @property
    def offset(self) -> Offset:
        """Present offset of X, Y, Z, m."""
        with self._lock:
            self._advance(self._now())
            return self._offset

    def order(self, offset: Sequence[float], *, alive: bool = True) -> None:
        """Accept a requested offset.

        Parameters
        ----------
        offset : (3,)
            m; an axis that is not finite keeps its last request.
        alive : bool
            Whether the heartbeat has changed.
        """
        with self._lock:
            now = self._now()
            self._advance(now)
            self.orders += 1
            wanted = [x if math.isfinite(x) else old for x, old in zip(offset, self._target, strict=True)]
            x, y, z = (min(max(value, -self.limit), self.limit) for value in wanted)
            self._target = x, y, z
            if alive:
                self._alive_until = now + self.watchdog

    @property
    def alive(self) -> bool:
        """Whether the watchdog has not expired since the last heartbeat, or since `begin`."""
        with self._lock:
            return self._now() < max(self._alive_until, self._begun + self.watchdog)

    def begin(self) -> None:
        """Start the time in which the first heartbeat of a new owner is expected."""
        with self._lock:
            self._begun = self._now()

    def elapse(self, seconds: float) -> None:
        """Advance the time of the machine, s, in addition to the clock."""
        with self._lock:
            self._elapsed += seconds
            self._advance(self._now())

    def _now(self) -> float:
        return (time.monotonic() * self._rate if self._rate else 0.0) + self._elapsed

    def _advance(self, now: float) -> None:
        """Move towards the request while the heartbeat is valid, then towards zero."""
        if self.fault:
            self._alive_until = -math.inf
        if self._at < self._alive_until:
            middle = min(self._alive_until, now)
            self._move(self._target, middle - self._at)
            self._at = middle
        self._move((0.0, 0.0, 0.0), now - self._at)
        self._at = now

    def _move(self, goal: Offset, seconds: float) -> None:
        most = self.slew * max(seconds, 0.0)
        x, y, z = (have + min(max(want - have, -most), most) for want, have in zip(goal, self._offset, strict=True))
        self._offset = x, y, z
