"""Late answers of simulated devices; see `errormotion.instruments.simulators.faults`."""

from __future__ import annotations

import math
import threading

from errormotion.instruments.simulators.faults import Fault
from errormotion.instruments.transports.loopback.serving import Server


class LateAnswer:
    """Delays an answer, and sends it with the next one or after a time."""

    def __init__(self) -> None:
        self._held: tuple[object, bytes] | None = None  # connection and delayed answer
        self._timer: threading.Timer | None = None

    def hold(self, server: Server, data: bytes, delay: float) -> None:
        """Delay an answer to the present connection by ``delay`` s; if infinite, until the next answer."""
        self._held = server.connection, data
        if math.isfinite(delay):
            self._timer = threading.Timer(delay, self.release, (server,))
            self._timer.daemon = True
            self._timer.start()

    def send(self, server: Server, fault: Fault, number: int, data: bytes) -> None:
        """Send the answer with a number, in the pieces of the fault; delay it if it is the late one."""
        if fault.kind == "late" and number == fault.at:
            self.hold(server, data, fault.delay)
            return
        with server.lock:
            self.release(server)
            for piece in fault.pieces(data):
                server.send(piece)

    def release(self, server: Server) -> None:
        """Send the delayed answer, if its connection is still open."""
        with server.lock:
            held, self._held = self._held, None
            if held is not None and held[0] is server.connection:
                server.send(held[1])

    def close(self) -> None:
        """Cancel the delayed answer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()
