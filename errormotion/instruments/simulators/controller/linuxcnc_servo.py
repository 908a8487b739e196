"""The machine's part of online compensation in a simulated LinuxCNC: its servo thread, read by ``halcmd``."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable

from errormotion.errors import InstrumentError

TIMEOUT = 10.0  # s
HELD = "errormotion-hold-2.in1"
"""Pin with which a program holds the offset."""


class ServoThreadPart:
    """The machine's part of a simulated LinuxCNC, for the conformance kit; its clock is real time.

    Parameters
    ----------
    unit : float
        Unit of length of LinuxCNC, m.
    slew, watchdog : float
        Slew limit, m/s, and time limit of the watchdog, s.
    stop : callable
        Stops the machine (e-stop).

    Attributes
    ----------
    orders : int
        Number of offsets that the bridge has accepted.
    """

    def __init__(self, unit: float, slew: float, watchdog: float, stop: Callable[[], None]) -> None:
        self.slew, self.watchdog = slew, watchdog
        self.orders = 0
        self._unit, self._stop = unit, stop
        self._busy = self._fault = self._signal = ""

    @property
    def offset(self) -> tuple[float, float, float]:
        """Present offset of X, Y, Z, m."""
        x, y, z = (self._unit * float(self._hal(f"getp errormotion-limit-{axis}.out")) for axis in "xyz")
        return x, y, z

    def elapse(self, seconds: float) -> None:
        """Wait in real time, s."""
        time.sleep(seconds)

    @property
    def busy(self) -> str:
        """Why the offset must not change; setting a text holds it, like a program."""
        return self._busy

    @busy.setter
    def busy(self, why: str) -> None:
        if why and not self._busy:
            self._signal = self._hal(f"show pin {HELD}").split()[-1]
            self._hal(f"unlinkp {HELD}", f"setp {HELD} 1")
        elif self._busy and not why:
            self._hal(f"setp {HELD} 0", f"net {self._signal} {HELD}")
        self._busy = why

    @property
    def fault(self) -> str:
        """Why the machine accepts no offsets; setting a text stops it, and the next device switches it on again."""
        return self._fault

    @fault.setter
    def fault(self, why: str) -> None:
        if why and not self._fault:
            self._stop()
        self._fault = why

    def _hal(self, *lines: str) -> str:
        done = subprocess.run(
            ["halcmd", "-s", "-f"], input="\n".join(lines), capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
        if done.returncode:
            raise InstrumentError(
                f"halcmd {lines[0]!r} failed: {done.stderr.strip()[:300]}", code="simulator.linuxcnc.command"
            )
        return done.stdout
