"""The printer port of the virtual machine's control: what NC programs print.

The port is a pty, or TCP where ``port`` or ``host`` is stated. A line goes out as soon as the world's clock has come to
it. Beyond the menu of `faults` there is ``duplicate``: lines come twice. ``fault_at`` and ``fault_every`` count lines.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.faults import stray_bytes
from errormotion.instruments.transports import Address

_POLL_INTERVAL = 0.005  # s of real time between two looks at the clock


class SimulatedPrinter(SimulatedDevice):
    """Sends the lines of NC programs; receives nothing."""

    faults = ("silence", "split", "garbage", "drop", "disconnect", "duplicate")

    def __init__(self, address: Address) -> None:
        self._ended = threading.Event()
        wire = "tcp" if "port" in address.params or "host" in address.params else "pty"
        super().__init__(
            replace(address, params={"wire": wire, **address.params}), line_end=b"\n", default_name="printer"
        )
        self._sent: dict[int, Any] = {id(each): each for each in self.world.printed if each[0] <= self.world.time}
        self._lines = 0
        self._thread = threading.Thread(target=self._watch, name=f"sim-{self.name}-lines", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the device."""
        self._ended.set()
        if self._thread is not threading.current_thread():
            self._thread.join()
        super().close()

    def answer(self, request: bytes) -> bytes:  # noqa: ARG002 - a printer receives nothing
        """Return nothing."""
        return b""

    def _watch(self) -> None:
        while not self._ended.wait(_POLL_INTERVAL):
            now = self.world.time
            for each in list(self.world.printed):
                if each[0] <= now and id(each) not in self._sent:
                    self._sent[id(each)] = each
                    self._print(each[1])

    def _print(self, text: str) -> None:
        number, fault = self._lines, self.fault
        self._lines += 1
        if (fault.kind == "silence" and number >= fault.at) or fault.hits("drop", number):
            return
        if fault.kind == "disconnect" and number >= fault.at:
            self._server.disconnect()
            return
        line = text.encode("ascii", errors="replace") + b"\r\n"
        if fault.hits("garbage", number):
            line = b"\xff" + stray_bytes(self._rng) + line
        with self._server.lock:
            for piece in fault.pieces(line * (2 if fault.hits("duplicate", number) else 1)):
                self._server.send(piece)
