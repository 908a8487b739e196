"""The device end of a python-can bus, for simulators: receiving and sending frames."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import can

from errormotion.instruments.transports.can.bus import BUS_OFF

MAX_WAIT = 0.05  # s, between two checks of the clock
_channels = itertools.count(1)


class CanServer:
    """A device on a bus with 11-bit identifiers.

    One thread calls ``received`` and ``due``; after `start`, only these may send.

    Parameters
    ----------
    node : int
        Number of the node in the address.
    received : callable
        ``received(can_id, data, remote)`` processes a frame of another participant.
    due : callable
        ``due(now)`` performs the tasks due at a time of `time.monotonic`, s, and returns the time of the next task.
    bus : mapping, optional
        Arguments of `can.Bus`; default: a new bus within this process.

    Attributes
    ----------
    url : str
        Address of the node for the driver.
    """

    def __init__(
        self,
        node: int,
        received: Callable[[int, bytes, bool], None],
        due: Callable[[float], float],
        *,
        bus: Mapping[str, Any] | None = None,
    ) -> None:
        bus = bus or {"interface": "virtual", "channel": f"sim-{next(_channels)}"}
        further = "".join(f"&{key}={each}" for key, each in bus.items() if key not in ("interface", "channel"))
        self.url = f"can://{bus['interface']}/{bus['channel']}?node={node}{further}"
        self._received, self._due = received, due
        self._bus = can.Bus(**bus, ignore_config=True)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"sim-can-{node}", daemon=True)

    def start(self) -> None:
        """Start to receive."""
        self._thread.start()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a data frame of at most 8 bytes; it is lost if the bus does not accept it."""
        self._send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def send_bus_off(self) -> None:
        """Make every controller on the bus report that it is bus-off."""
        self._send(can.Message(arbitration_id=BUS_OFF, is_error_frame=True, is_extended_id=False, data=bytes(8)))

    def close(self) -> None:
        """Leave the bus; idempotent."""
        if self._ended.is_set():
            return
        self._ended.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()
        self._bus.shutdown()

    def _send(self, message: can.Message) -> None:
        with suppress(can.CanError):
            self._bus.send(message)

    def _run(self) -> None:
        while not self._ended.is_set():
            wait = self._due(time.monotonic()) - time.monotonic()
            try:
                message = self._bus.recv(min(max(wait, 0.0), MAX_WAIT))
            except can.CanError:
                self._ended.wait(MAX_WAIT)
                continue
            if message is None or message.is_error_frame or message.is_extended_id or self._ended.is_set():
                continue
            self._received(message.arbitration_id, bytes(message.data), message.is_remote_frame)
