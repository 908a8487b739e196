"""Faults of simulated devices, selected by parameters of the address.

``fault=`` one of

* ``silence``: the device sends nothing
* ``split``: all data arrive in pieces of a few bytes
* ``garbage``: stray bytes between valid ones
* ``checksum``: wrong checksums, where the protocol has one
* ``out_of_range``: no target in the range
* ``drop``: samples, or answers, are missing
* ``disconnect``: the connection is lost; it can be opened again
* ``late``: one answer, number ``fault_at``, is delayed by ``late_by`` s, at most until the next answer, which it
  precedes (without ``late_by``: until then); it is lost with its connection

``fault_at`` is the first sample (of a stream) or answer (of others) with the fault; default 0. ``silence`` without
``fault_at`` starts before the first answer. ``fault_every`` is the period of ``garbage`` and ``drop``, ``fault_for``
the number of samples that ``out_of_range`` lasts (default: no limit).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.loopback.serving import Server

FAULTS = ("silence", "split", "garbage", "checksum", "out_of_range", "drop", "disconnect", "late")


@dataclass
class Fault:
    """One fault and its start.

    Attributes
    ----------
    kind : str
        Type of the fault; empty: none.
    at : int
        First sample or answer with the fault.
    every : int
        Period of the fault.
    length : int
        Number of samples; 0: no limit.
    from_the_start : bool
        Whether ``fault_at`` is not given.
    delay : float
        Delay of an answer by ``late``, s; infinite: until the next answer.
    """

    kind: str = ""
    at: int = 0
    every: int = 1
    length: int = 0
    from_the_start: bool = False
    delay: float = math.inf

    def hits(self, kind: str, number: int) -> bool:
        """Whether a sample or answer with this number has this fault."""
        if kind != self.kind or number < self.at:
            return False
        return (number - self.at) % self.every == 0

    def affects(self, kind: str, number: Any) -> Any:
        """Whether a sample or answer, or each of an array, is among the ``length`` ones with this fault."""
        return (kind == self.kind) & (number >= self.at) & ((self.length == 0) | (number < self.at + self.length))

    def suppresses(self, number: int) -> bool:
        """Whether an answer with this number is not sent: silence, or a missing answer."""
        return (self.kind == "silence" and number >= self.at) or self.hits("drop", number)

    def pieces(self, data: bytes) -> Iterator[bytes]:
        """Yield the pieces to be sent: all data, or with ``split`` first pieces of 1 to 7 bytes, later of 1009 bytes.

        1009 is a prime, so that pieces do not coincide with frames.
        """
        if self.kind != "split":
            yield data
            return
        start = count = 0
        while start < len(data):
            size = count % 7 + 1 if count < 50 else 1009
            yield data[start : start + size]
            start, count = start + size, count + 1


def parse_fault(address: Address, offered: tuple[str, ...], *, every: int = 1) -> Fault:
    """Return the fault that an address states.

    Raises
    ------
    InstrumentError
        The fault is unknown, or not offered by this device.
    """
    kind = address.params.get("fault", "")
    if not kind:
        return Fault()
    if kind not in offered:
        why = "this device does not have this fault" if kind in FAULTS else "unknown fault"
        raise InstrumentError(
            f"'fault={kind}' in '{address.url}': {why}; expected one of {', '.join(offered)}", code="simulator.setting"
        )
    return Fault(
        kind,
        at=int(address.number("fault_at", 0)),
        every=max(1, int(address.number("fault_every", every))),
        length=int(address.number("fault_for", 0)),
        from_the_start="fault_at" not in address.params,
        delay=address.number("late_by", math.inf),
    )


def stray_bytes(rng: np.random.Generator, most: int = 5) -> bytes:
    """Return one to ``most`` random bytes."""
    return rng.integers(0, 256, rng.integers(1, most + 1), dtype=np.uint8).tobytes()


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
