"""The answer that a simulated device sends late; see `errormotion.instruments.simulators.faults`."""

from __future__ import annotations

import math
import threading

from errormotion.instruments.transports.loopback.serving import Server


class LateAnswer:
    """Holds an answer back, and sends it with the next one or after a delay."""

    def __init__(self) -> None:
        self._held: tuple[object, bytes] | None = None  # the connection, and what is late
        self._timer: threading.Timer | None = None

    def hold(self, server: Server, data: bytes, delay: float) -> None:
        """Hold an answer to the present connection back for ``delay`` s; if infinite, until the next answer."""
        self._held = server.connection, data
        if math.isfinite(delay):
            self._timer = threading.Timer(delay, self.release, (server,))
            self._timer.daemon = True
            self._timer.start()

    def release(self, server: Server) -> None:
        """Send what was held back, if its connection is still open."""
        with server.lock:
            held, self._held = self._held, None
            if held is not None and held[0] is server.connection:
                server.send(held[1])

    def close(self) -> None:
        """End the wait for the delay."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()
