"""The listening side of the server: connections whose messages can have a fault."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.server import Server

from errormotion.instruments.simulators.faults import Fault, stray_bytes


class Outgoing:
    """Passes on the messages of the server, with the fault that applies to them.

    Parameters
    ----------
    fault : Fault
    rng : numpy.random.Generator
        Random numbers for the stray bytes.
    restart : callable
        Restarts the server.

    Attributes
    ----------
    messages : int
        Number of messages so far, of all connections.
    """

    def __init__(self, fault: Fault, rng: np.random.Generator, restart: Callable[[], None]) -> None:
        self._fault, self._rng, self._restart = fault, rng, restart
        self._held: tuple[asyncio.Transport, bytes] | None = None
        self._restarted = False
        self.messages = 0

    @property
    def reached(self) -> bool:
        """Whether the first message with the fault is the next one, or has been sent."""
        return self.messages >= self._fault.at

    def send(self, line: asyncio.Transport, data: bytes) -> None:
        """Send a message, or apply the fault to it."""
        number, fault = self.messages, self._fault
        due = self.reached
        self.messages += 1
        if fault.suppresses(number):
            return
        if fault.kind == "disconnect" and due:
            line.close()
            return
        if fault.kind == "restart" and due and not self._restarted:
            self._restarted = True
            self._restart()
            return
        if fault.hits("garbage", number):
            data = stray_bytes(self._rng) + data
        if fault.kind == "late" and number == fault.at:
            self._held = line, data
            if math.isfinite(fault.delay):
                asyncio.get_running_loop().call_later(fault.delay, self._release)
            return
        self._release()
        for piece in fault.pieces(data):
            line.write(piece)

    def _release(self) -> None:
        """Send the delayed message, if its connection is still open."""
        held, self._held = self._held, None
        if held is not None and not held[0].is_closing():
            held[0].write(held[1])


class _Line(asyncio.Transport):
    """A connection whose writer is `Outgoing`."""

    def __init__(self, line: asyncio.Transport, outgoing: Outgoing) -> None:
        super().__init__()
        self._line, self._outgoing = line, outgoing

    def write(self, data: Any) -> None:
        self._outgoing.send(self._line, bytes(data))

    def close(self) -> None:
        self._line.close()

    def is_closing(self) -> bool:
        return self._line.is_closing()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return self._line.get_extra_info(name, default)


class _Protocol(OPCUAProtocol):
    outgoing: Outgoing

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        super().connection_made(_Line(transport, self.outgoing))


class _Listener(BinaryServer):
    outgoing: Outgoing

    def _make_protocol(self) -> OPCUAProtocol:
        protocol = _Protocol(
            iserver=self.iserver,
            policies=self._policies,
            clients=self.clients,
            closing_tasks=self.closing_tasks,
            limits=self.limits,
        )
        protocol.outgoing = self.outgoing
        return protocol


class FaultyServer(Server):
    """A server of asyncua whose messages pass through `Outgoing`."""

    outgoing: Outgoing

    async def start(self) -> None:
        """Start listening at ``socket_address``.

        Raises
        ------
        OSError
            The server cannot listen there.
        """
        assert self.socket_address is not None
        await self._setup_server_nodes()
        await self.iserver.start()
        listener = _Listener(self.iserver, *self.socket_address, self.limits)
        listener.outgoing = self.outgoing
        listener.set_policies(self._policies)
        await listener.start()
        self.bserver = listener

    @property
    def port(self) -> int:
        """The port at which the server listens."""
        return self.bserver.port if self.bserver is not None else 0
