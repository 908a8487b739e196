"""The time of a monitor, by which it reads, logs and retries."""

from __future__ import annotations

import threading
import time

from errormotion.datasets.clock import steady


class Clock:
    """The clock of the computer, which is monotonic; a subclass may run at another rate, as for simulated days."""

    def now(self) -> float:
        """Return the time, s; it is never set back."""
        return steady()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)

    def wait(self, event: threading.Event, seconds: float) -> None:
        """Wait until an event happens, or a time has passed, s."""
        event.wait(seconds)
