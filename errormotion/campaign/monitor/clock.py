"""The clock of a monitor."""

from __future__ import annotations

import threading
import time

from errormotion.datasets.clock import steady


class Clock:
    """The monotonic clock of the computer; a subclass may run at another rate, as for simulated days."""

    def now(self) -> float:
        """Return the monotonic time, s."""
        return steady()

    def sleep(self, seconds: float) -> None:
        """Wait for a time, s."""
        time.sleep(seconds)

    def wait(self, event: threading.Event, seconds: float) -> None:
        """Wait for an event, at most for a time, s."""
        event.wait(seconds)
