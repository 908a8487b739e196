"""OPC UA as an exchange of lines: requests and answers in JSON.

The package asyncua implements the binary protocol with its sequence numbers, nonces and encryption. Recordings contain
the requests and answers of this module, so that they are readable and can be replayed without a server::

    {"read": ["ns=2;s=/Channel/Spindle/actSpeed[u1,1]"]}
    [{"value": 12000.0, "status": "Good", "time": "2026-03-01T12:00:00+00:00"}]

The requests are ``server``, ``browse``, ``read``, ``describe`` (type of a value, whether it is an array and can be
written) and
``write``, which only compensators send::

    {"write": [["ns=2;s=Offset.X", "Double", 0.0021], ["ns=2;s=Heartbeat", "UInt32", 17]]}
    ["Good", "Good"]
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from collections.abc import Coroutine, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.transports import load_simulator
from errormotion.instruments.transports.address import OPC, parse_address
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.opc_security import Credentials, hint, secure
from errormotion.instruments.transports.recording import Recorder, RecordingTransport, ReplayTransport

if TYPE_CHECKING:
    from asyncua import ua
    from asyncua.client.client import Client

MAX_NODES = 1000
"""Largest number of nodes in one request or answer."""
MAX_ELEMENTS = 64
"""Largest number of elements of an array that are read."""
MAX_TEXT = 4096
"""Largest number of characters of a text; the rest is cut off."""
DROP_TIMEOUT = 0.5
"""Time limit for disconnecting from a server, s."""
WRITABLE = 2
"""Bit of an access level: the present value can be written."""
MAX_BYTES = 16 << 20
"""Largest message of a server, bytes."""

Result = TypeVar("Result")


class OpcUaTransport(Transport):
    """A session with an OPC UA server; after a loss the next request opens it again.

    Parameters
    ----------
    url : str
        ``opc.tcp://host:4840/path`` or ``sim://``.
    credentials : Credentials
    timeout : float
        Time limit for one request, s.
    simulator : str, optional
        ``module:Class`` of the simulator for ``sim://``.

    Raises
    ------
    InstrumentError
        Another scheme, the package asyncua is not installed, no server, or a refused session.
    """

    def __init__(self, url: str, credentials: Credentials, *, timeout: float, simulator: str | None = None) -> None:
        super().__init__(url, timeout)
        address = parse_address(url)
        if address.scheme not in (OPC, "sim"):
            raise InstrumentError(
                f"Expected an address such as opc.tcp://192.168.0.5:4840; found '{url}'", code="address.form"
            )
        try:
            import asyncua  # noqa: F401 - an optional dependency
        except ImportError:
            raise InstrumentError(
                "OPC UA needs the package asyncua: pip install asyncua", code="package.missing"
            ) from None
        logging.getLogger("asyncua").setLevel(logging.ERROR)  # users cannot act on its warnings
        self.simulated = address.scheme == "sim"
        self._device: Any = None
        self._server = url
        if self.simulated:
            self._device = load_simulator(simulator, url)(address)
            self._server = self._device.url
        self._credentials = credentials
        self._client: Client | None = None
        self._answer = b""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="opc-ua", daemon=True)
        self._thread.start()
        try:
            self._wait(self._connected())
        except BaseException:
            self.close()
            raise

    def _send(self, data: bytes) -> None:
        self._answer = b""
        request = json.loads(data)
        self._answer = json.dumps(self._wait(self._handle(request))).encode("ascii") + b"\n"

    def _receive(self, max_bytes: int, timeout: float) -> bytes:  # noqa: ARG002 - the answer was received with the request
        if not self._answer:
            raise InstrumentTimeoutError(
                f"{self.url}: no answer, since no request was sent", code="instrument.no_answer"
            )
        data, self._answer = self._answer[:max_bytes], self._answer[max_bytes:]
        return data

    def close(self) -> None:
        """End the session, the thread, and the simulated device; idempotent."""
        if not self._loop.is_closed():
            self._drop()
            self._run(_ended())
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()
        device, self._device = self._device, None
        if device is not None:
            device.close()

    # ------------------------------------------------------------------ in the thread of the session

    def _wait(self, work: Coroutine[Any, Any, Result]) -> Result:
        """Run a coroutine in the thread of the session; convert its errors to InstrumentError."""
        from asyncua.ua.uaerrors import UaError, UaStatusCodeError

        try:
            return self._run(asyncio.wait_for(work, self.timeout))
        except TimeoutError:
            self._drop()
            raise InstrumentTimeoutError(
                f"{self.url}: no answer within {self.timeout:g} s", code="instrument.no_answer"
            ) from None
        except InstrumentError:
            raise
        except UaStatusCodeError as error:
            raise InstrumentError(
                f"{self.url}: the server refuses: {error}{hint(error.code)}", code="instrument.refused"
            ) from None
        except (OSError, UaError) as error:
            self._drop()
            reason = str(error) or type(error).__name__
            raise InstrumentError(f"The connection to {self.url} is lost: {reason}", code="connection.lost") from None
        except Exception as error:  # noqa: BLE001 - the package raises various errors for damaged bytes
            self._drop()
            raise ProtocolError(
                f"{self.url}: not an answer of an OPC UA server: {error!r}", code="protocol.opc.form"
            ) from None

    def _run(self, work: Coroutine[Any, Any, Result]) -> Result:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _drop(self) -> None:
        """End the session without waiting for the server; the next request opens another one."""
        with suppress(Exception):
            self._run(asyncio.wait_for(self._disconnected(), DROP_TIMEOUT))

    async def _connected(self) -> Client:
        if self._client is not None:
            return self._client
        from asyncua.client.client import Client

        client = Client(self._server, timeout=self.timeout)
        client.max_messagesize, client.max_chunkcount = MAX_BYTES, MAX_BYTES // 8192
        if self._credentials.user:
            client.set_user(self._credentials.user)
            client.set_password(self._credentials.password)
        if self._credentials.security:
            await secure(client, self._credentials.security)
        try:
            await client.connect()
        except BaseException:
            client.disconnect_socket()
            raise
        self._client = client
        return client

    async def _disconnected(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            await client.disconnect()

    async def _handle(self, request: Mapping[str, Any]) -> Any:
        client = await self._connected()
        match request:
            case {"server": _}:
                return {"namespaces": [text(name) for name in await client.get_namespace_array()]}
            case {"browse": str(node)}:
                return await _browse(client, node)
            case {"read": list(nodes)}:
                return await _read(client, nodes[:MAX_NODES])
            case {"describe": list(nodes)}:
                return await _describe(client, nodes[:MAX_NODES])
            case {"write": list(values)}:
                return await _write(client, values[:MAX_NODES])
        raise ProtocolError(f"{self.url}: unknown request {sorted(request)}", code="protocol.opc.request")


async def _ended() -> None:
    """Cancel the tasks that still run in the thread, such as an incomplete connection."""
    running = asyncio.all_tasks() - {asyncio.current_task()}
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    await asyncio.get_running_loop().shutdown_default_executor()


async def _browse(client: Client, node: str) -> list[dict[str, Any]]:
    """Return the children of a node: id, namespace index and name, in the order of the server."""
    found = await _node(client, node).get_children_descriptions()
    return [
        {"id": each.NodeId.to_string(), "namespace": each.BrowseName.NamespaceIndex, "name": text(each.BrowseName.Name)}
        for each in found[:MAX_NODES]
    ]


async def _read(client: Client, nodes: Sequence[str]) -> list[dict[str, Any]]:
    """Return the values of nodes; for a node that cannot be read only its status."""
    values = await client.read_attributes([_node(client, node) for node in nodes])
    return [_plain(each) for each in values]


async def _describe(client: Client, nodes: Sequence[str]) -> list[dict[str, Any]]:
    """Return type and status of the values of nodes, whether they are arrays, and whether this user can write them."""
    from asyncua.ua.attribute_ids import AttributeIds

    found = [_node(client, node) for node in nodes]
    values = await client.read_attributes(found)
    levels = await client.read_attributes(found, AttributeIds.UserAccessLevel)
    return [
        {
            "type": value.Value.VariantType.name if value.Value is not None else "Null",
            "array": value.Value is not None and bool(value.Value.is_array),
            "status": _plain(value)["status"],
            "writable": bool(((level.Value.Value if level.Value is not None else 0) or 0) & WRITABLE),
        }
        for value, level in zip(values, levels, strict=True)
    ]


async def _write(client: Client, values: Sequence[tuple[str, str, Any]]) -> list[str]:
    """Write values by one request, without status and time; return the status of each."""
    from asyncua import ua

    nodes = [_node(client, node).nodeid for node, _, _ in values]
    data = [ua.DataValue(ua.Variant(value, ua.VariantType[kind]), StatusCode=None) for _, kind, value in values]
    found = await client.uaclient.write_attributes(nodes, data)
    return ["Good" if status.is_good() else text(status.name) for status in found]


def _node(client: Client, node: str) -> Any:
    from asyncua import ua
    from asyncua.ua.uaerrors import UaError

    try:
        return client.get_node(ua.NodeId.from_string(node))
    except (UaError, ValueError, TypeError) as error:
        raise InstrumentError(f"'{text(node)}' is not the id of a node: {error}", code="opc.node.form") from None


def _plain(value: ua.DataValue) -> dict[str, Any]:
    """Return a value with its status and the time of its source as plain data."""
    status = value.StatusCode
    good = status is None or status.is_good()
    time = value.SourceTimestamp or value.ServerTimestamp
    content = value.Value.Value if good and value.Value is not None else None
    return {
        "value": plain(content),
        "status": "Good" if good or status is None else text(status.name),
        "time": time.isoformat() if isinstance(time, datetime) else None,
    }


def plain(value: Any) -> Any:
    """Return a value for JSON: numbers, texts, lists of them, engineering units; None for anything else."""
    from asyncua import ua

    if isinstance(value, bool | int | float) or value is None:
        return value
    if isinstance(value, str):
        return text(value)
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, ua.LocalizedText):
        return text(value.Text or "")
    if isinstance(value, ua.EUInformation):
        return {"unit": text(value.DisplayName.Text or ""), "code": value.UnitId}
    if isinstance(value, list):
        return [plain(each) for each in value[:MAX_ELEMENTS]]
    return None


def text(value: Any) -> str:
    """Return a text of a bounded length."""
    return str(value)[:MAX_TEXT]


def open_session(
    url: str, credentials: Credentials, *, timeout: float, simulator: str | None = None, record: Path | None = None
) -> Transport:
    """Open a session with a server, or play one back; see `OpcUaTransport`.

    Raises
    ------
    InstrumentError, ReplayError
        See `OpcUaTransport`; or the recording already exists or cannot be replayed.
    """
    address = parse_address(url)
    if address.scheme == "replay":
        return ReplayTransport(Path(address.path), timeout=timeout)
    session = OpcUaTransport(url, credentials, timeout=timeout, simulator=simulator)
    if record is None:
        return session
    try:
        return RecordingTransport(session, Recorder(record, url))
    except BaseException:
        session.close()
        raise


def request(line: Transport, content: Mapping[str, Any]) -> Any:
    """Send a request and return its answer.

    Raises
    ------
    InstrumentError
        See `OpcUaTransport`.
    ProtocolError
        The answer is not JSON.
    """
    line.write(json.dumps(content).encode("ascii") + b"\n")
    answer = line.read_until(b"\n", limit=MAX_BYTES)
    try:
        return json.loads(answer)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"{line.url}: the answer is not JSON: {error}", code="protocol.opc.form") from None
