"""The simulated server: a virtual machine, an address space, and the serving thread."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np
from asyncua import ua
from asyncua.ua.attribute_ids import AttributeIds

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.controller.opcua import cnc, sinumerik
from errormotion.instruments.simulators.controller.opcua.listening import FaultyServer, Outgoing
from errormotion.instruments.simulators.controller.opcua.machine import Machine
from errormotion.instruments.simulators.controller.opcua.serving import ServingThread, prepare_server
from errormotion.instruments.simulators.controller.opcua.space import UA, Attributes, Ids, SmallServer, Space
from errormotion.instruments.simulators.controller.opcua.space import number as numeric
from errormotion.instruments.simulators.device import DEFAULT_MACHINE
from errormotion.instruments.simulators.faults import parse_fault
from errormotion.instruments.simulators.virtual_world.world import world
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.loopback.serving import listening_at, not_listening, reachable_at

STYLES = ("cnc", "sinumerik")
UNITS = ("model", "ua")
REFRESH = 0.05
"""Interval between two readings of the machine for subscriptions, s."""


class SimulatedServer:
    """An OPC UA server of the virtual machine; see the package for the parameters of its address.

    Attributes
    ----------
    url : str
        Address for the client.

    Raises
    ------
    InstrumentError
        Unknown style, units or fault, or the server cannot listen.
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "late", "unavailable", "restart")

    def __init__(self, address: Address) -> None:
        self.fault = parse_fault(address, self.faults)
        self._style, self._units = address.params.get("style", "cnc"), address.params.get("units", "model")
        if self._style not in STYLES or self._units not in UNITS:
            raise InstrumentError(
                f"'{address.url}': expected 'style' one of {', '.join(STYLES)}, 'units' one of {', '.join(UNITS)}; "
                f"found '{self._style}', '{self._units}'",
                code="simulator.setting",
            )
        seed = int(address.number("seed", 0))
        rng = np.random.default_rng([abs(seed), *b"opcua"])
        self._seed = seed
        self._path = address.path or "errormotion"
        self._outgoing = Outgoing(self.fault, rng, self._restart)
        self._lock = threading.Lock()
        self._closed = False
        self._server: FaultyServer | None = None
        self._refreshing: asyncio.Task[None] | None = None
        self._host, self._port = listening_at()
        self.world = world(address.host or DEFAULT_MACHINE, seed, warm=bool(address.number("warm", 1)))
        self.world.attach(self, address.number("pace", 0.0) or None)
        self._thread = ServingThread("sim-opcua")
        try:
            if moment := address.number("clock", 0.0):
                self.world.tick(moment)
            self._machine = Machine(self.world, self._unavailable)
            try:
                self._thread.run(self._start())
            except OSError as error:
                raise not_listening(self._host, self._port, error) from None
        except BaseException:
            self.close()
            raise
        self.url = f"opc.tcp://{reachable_at(self._host, self._port)}/{self._path}"

    def close(self) -> None:
        """End the server; the last device of a world also ends the world. Idempotent."""
        with self._lock:
            closed, self._closed = self._closed, True
        if closed:
            return
        self._thread.end(self._stop())
        self.world.detach(self)

    def report_delivered(self, samples: int) -> None:
        """Do nothing: a server follows the world's clock and never drives it."""

    # ------------------------------------------------------------------ in the thread of the server

    def _unavailable(self) -> bool:
        return self.fault.kind == "unavailable" and self._outgoing.reached

    async def _start(self) -> None:
        """Start a server with a new address space, at the port of the previous one."""
        server, inner = await prepare_server(self._outgoing, self._host, self._port, self._path)
        release = version("errormotion")
        await server.set_build_info(
            "urn:errormotion", "errormotion", "simulated control", release, "0", self._machine.time
        )
        await server.set_application_uri(f"urn:errormotion:{self.world.name}:{self._seed}")
        space = Space(inner)
        further = await self._fill(server, space)
        inner.attribute_service = Attributes(inner.aspace, self._machine.refresh, further)
        await server.start()
        self._server = server
        self._port = server.port
        await self._add_clock(server, space)
        self._refreshing = asyncio.create_task(self._refresh(inner))

    async def _fill(self, server: FaultyServer, space: Space) -> Any:
        """Add the nodes of the style; return a function that reads nodes that are not in the space."""
        if self._style == "sinumerik":
            await server.register_namespace(sinumerik.NAMESPACE)
            sinumerik.add(space, self._machine)
            return lambda node: sinumerik.value(self._machine, node)
        own = await server.register_namespace("urn:errormotion:machine")
        model = await server.register_namespace(cnc.NAMESPACE)
        texts = {
            "VendorName": "errormotion",
            "CncTypeName": f"virtual {self.world.name}",
            "VendorRevision": version("errormotion"),
            "Version": cnc.VERSION,
            "Fix": f"seed {self._seed}",
        }
        cnc.Model(space, self._machine, own, model, UA if self._units == "ua" else model).add(texts)
        return None

    async def _add_clock(self, server: FaultyServer, space: Space) -> None:
        """Set the clock of the server to the time of the world."""
        started = self._machine.time
        ids = (Ids.Server_ServerStatus, Ids.Server_ServerStatus_StartTime, Ids.Server_ServerStatus_CurrentTime)
        whole, start, now = (numeric(each) for each in ids)
        shown = await server.get_node(whole).read_value()

        def status() -> ua.DataValue:
            present = replace(shown, StartTime=started, CurrentTime=self._machine.time)
            return ua.DataValue(ua.Variant(present, ua.VariantType.ExtensionObject))

        space.live(whole, status)
        space.live(start, lambda: ua.DataValue(ua.Variant(started, ua.VariantType.DateTime)))
        space.live(now, self._machine.clock)

    async def _refresh(self, inner: SmallServer) -> None:
        """Report the values of nodes to which clients have subscribed."""
        while True:
            await asyncio.sleep(REFRESH)
            if not inner.subscription_service.subscriptions:
                continue
            self._machine.refresh()
            for node in list(inner.aspace.keys()):
                value = inner.aspace[node].attributes.get(AttributeIds.Value)
                if value is None or value.value_callback is None:
                    continue
                for handle, report in list(value.datachange_callbacks.items()):
                    await report(handle, value.value_callback(node, AttributeIds.Value))

    def _restart(self) -> None:
        """Restart: sessions and subscriptions are lost."""
        self._restarting = asyncio.create_task(self._again())

    async def _again(self) -> None:
        await self._stop()
        await self._start()

    async def _stop(self) -> None:
        if self._refreshing is not None:
            self._refreshing.cancel()
        server, self._server = self._server, None
        if server is not None:
            await server.stop()
