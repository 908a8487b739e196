"""The device end of a Modbus line: a server of `pymodbus`, unchanged, in a thread of its own."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.framer import FramerType
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from errormotion.instruments.transports.modbus.codec import Framing

logging.getLogger("pymodbus").addHandler(logging.NullHandler())
CHUNK = 4096


class ModbusServer:
    """A Modbus server that accepts and returns bytes, over a connection on loopback.

    The simulator forwards the bytes between the server and the client, and can damage them.

    Parameters
    ----------
    name : str
        For the thread.
    framing : str
        ``tcp`` or ``rtu``.
    unit : int
        Address of the device; requests to others are not answered.
    blocks : mapping of int to int
        Existing register blocks: first register to number of registers.
    registers : callable
        Returns registers by number, or the code of an exception reply; called at each request with its function.
    on_answer : callable
        Called with the bytes that the server sends.

    Attributes
    ----------
    address : (str, int)
        Host and port at which the server listens.
    """

    def __init__(
        self,
        name: str,
        framing: Framing,
        unit: int,
        blocks: Mapping[int, int],
        registers: Callable[[int], Mapping[int, int] | int],
        on_answer: Callable[[bytes], None],
    ) -> None:
        self._framing, self._unit, self._blocks, self._registers = framing, unit, dict(blocks), registers
        self._on_answer = on_answer
        self._loop = asyncio.new_event_loop()
        self._writer: asyncio.StreamWriter | None = None
        self._thread = threading.Thread(target=self._run, name=f"sim-modbus-{name}", daemon=True)
        self._ready = threading.Event()
        self._failure: BaseException | None = None
        self._end: asyncio.Event | None = None
        self.address = ("127.0.0.1", 0)
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            self._thread.join()
            raise self._failure

    def handle_request(self, data: bytes) -> None:
        """Pass a request to the server, which answers by ``on_answer``."""
        unit = data[0] if self._framing == "rtu" else data[6] if len(data) > 6 else self._unit
        if unit == self._unit:
            with suppress(RuntimeError):  # closed meanwhile
                self._loop.call_soon_threadsafe(self._write, data)

    def close(self) -> None:
        """End the server and its thread; idempotent."""
        if self._thread.is_alive() and self._end is not None:
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._end.set)
            if self._thread is not threading.current_thread():
                self._thread.join()

    def _write(self, data: bytes) -> None:
        if self._writer is not None:
            self._writer.write(data)

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        except BaseException as error:  # noqa: BLE001 - raised in the constructor
            self._failure = error
        finally:
            self._loop.close()
            self._ready.set()

    async def _serve(self) -> None:
        self._end = asyncio.Event()
        data = [
            SimData(first, values=[0] * count, datatype=DataType.REGISTERS) for first, count in self._blocks.items()
        ]
        server: Any = ModbusTcpServer(  # Any: its shutdown() has no types
            SimDevice(self._unit, simdata=data, action=self._act),
            framer=FramerType.RTU if self._framing == "rtu" else FramerType.SOCKET,
            address=self.address,
        )
        await server.serve_forever(background=True)
        try:
            self.address = server.transport.sockets[0].getsockname()
            reader, self._writer = await asyncio.open_connection(*self.address)
            listening = asyncio.create_task(self._listen(reader))
            self._ready.set()
            await self._end.wait()
            listening.cancel()
            self._writer.close()
            with suppress(OSError):
                await self._writer.wait_closed()
        finally:
            await server.shutdown()
            await asyncio.sleep(0)

    async def _listen(self, reader: asyncio.StreamReader) -> None:
        while data := await reader.read(CHUNK):
            self._on_answer(data)

    async def _act(
        self,
        function: int,
        start: int,
        address: int,  # noqa: ARG002 - the server's signature
        count: int,  # noqa: ARG002
        current: list[int],
        new: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Copy the present registers to those that the server reads."""
        if new is not None:
            return ExcCodes.ILLEGAL_FUNCTION
        found = self._registers(function)
        if isinstance(found, int):
            return ExcCodes(found)
        for register, value in found.items():
            if 0 <= register - start < len(current):
                current[register - start] = value
        return None
