"""Common parts of the simulated OPC UA servers: the serving thread, and a server whose answers may be faulty."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from asyncua import ua

from errormotion.instruments.simulators.controller.opcua.listening import FaultyServer, Outgoing
from errormotion.instruments.simulators.controller.opcua.space import SmallServer
from errormotion.instruments.transports.loopback.serving import reachable_at

Result = TypeVar("Result")


class ServingThread:
    """A thread with an event loop.

    Parameters
    ----------
    name : str
        Name of the thread.
    """

    def __init__(self, name: str) -> None:
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # errors of clients do not concern the user
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, Result]) -> Result:
        """Run a coroutine in the thread; return its result."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def end(self, last: Coroutine[Any, Any, None]) -> None:
        """Run a last coroutine, cancel all running tasks, and end the thread."""
        self.run(self._end(last))
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    @staticmethod
    async def _end(last: Coroutine[Any, Any, None]) -> None:
        await last
        running = asyncio.all_tasks() - {asyncio.current_task()}
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        await asyncio.get_running_loop().shutdown_default_executor()


async def prepare_server(outgoing: Outgoing, host: str, port: int, path: str) -> tuple[FaultyServer, SmallServer]:
    """Return a server without security, not yet started, and its part with the address space."""
    inner = SmallServer()
    inner.disabled_clock = True  # its thread would delay the end by a second; requests read the time themselves
    inner.allow_remote_admin = False
    server = FaultyServer(inner)
    server.outgoing = outgoing
    server.name = "errormotion"
    server.socket_address = host, port
    server.set_endpoint(f"opc.tcp://{reachable_at(host, port)}/{path}")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await server.init()
    return server, inner
