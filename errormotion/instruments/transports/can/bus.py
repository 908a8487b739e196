"""CAN: one CANopen node on a bus, read by SDO.

``can://socketcan/can0?node=5`` names an interface of python-can, a channel and the node. Further parameters go to
python-can: ``bitrate=250000``, ``port=43113``. ``can://udp_multicast/239.74.163.2?node=5`` is a bus that crosses
processes, ``can://virtual/NAME?node=5`` one inside this process; ``sim://`` and ``replay://`` as for every transport.

A recording holds the frames of this node: four bytes of identifier, as SocketCAN has them (bit 29: an error frame),
then the data.
"""

from __future__ import annotations

import logging
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError, ReplayError
from errormotion.instruments.transports import load_simulator
from errormotion.instruments.transports.address import CAN, Address, parse_address
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.lost import Reopened
from errormotion.instruments.transports.recording import Recorder, ReplayTransport

logging.getLogger("canopen").addHandler(logging.NullHandler())  # its messages are those of the errors raised here

ERROR_FRAME = 0x20000000
BUS_OFF = 0x40
"""In the identifier of an error frame: the controller has left the bus."""
_CYCLE = 0.05  # s that closing may wait for the listening thread
_TIMEOUT_TEXT = "No SDO response"  # canopen's text for a timeout


class SdoRefusal(InstrumentError):  # noqa: N818 - that is what it is
    """A node aborts the transfer.

    Attributes
    ----------
    code : int
        SDO abort code.
    """

    def __init__(self, code: int, what: str) -> None:
        self.code = code
        super().__init__(f"{what} is refused: {SdoAbortedError(code)}")


class Network(canopen.Network):
    """A CANopen network that detects when its controller leaves the bus, and records every frame.

    Attributes
    ----------
    failed : str
        Reason why the bus can no longer be used; empty while it can.
    """

    NOTIFIER_CYCLE = _CYCLE

    def __init__(self, address: Address, recorder: Recorder | None) -> None:
        super().__init__()
        self.failed = ""
        self._recorder = recorder
        listeners: list[Any] = self.listeners
        listeners.append(_Errors(self))
        self._open(address)

    def _open(self, address: Address) -> None:
        further = {k: int(v) if v.isdigit() else v for k, v in address.params.items() if k != "node"}
        try:
            bus = can.Bus(interface=address.host, channel=address.path, ignore_config=True, **further)  # type: ignore[arg-type]
        except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as error:
            raise InstrumentError(f"The CAN bus '{address.url}' cannot be opened: {error}") from None
        self.bus = bus
        self.connect()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a frame."""
        if self._recorder is not None:
            self._recorder.frame("W", to_bytes(can_id, bytes(data)))
        super().send_message(can_id, data, remote)

    def notify(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Accept a frame; one that is too short for its type is ignored."""
        if can_id not in self.subscribers:
            return
        if self._recorder is not None:
            self._recorder.frame("R", to_bytes(can_id, bytes(data)))
        with suppress(struct.error):
            super().notify(can_id, data, timestamp)

    def on_error_frame(self, can_id: int) -> None:
        """Take note of an error frame of the controller."""
        if self._recorder is not None:
            self._recorder.frame("R", to_bytes(can_id | ERROR_FRAME, b""))
        if can_id & BUS_OFF:
            self.failed = "the controller is bus-off"


class _Errors(can.Listener):
    """Receives what canopen ignores: error frames and the loss of the bus."""

    def __init__(self, network: Network) -> None:
        self._network = network

    def on_message_received(self, message: can.Message) -> None:
        if message.is_error_frame:
            self._network.on_error_frame(message.arbitration_id)

    def on_error(self, error: Exception) -> None:
        self._network.failed = f"the bus is lost: {error}"
        time.sleep(_CYCLE)  # the library retries at once, until the bus is closed


class ReplayedNetwork(Network):
    """Plays the frames of a recorded session."""

    def __init__(self, frames: ReplayTransport) -> None:
        self._frames = frames
        super().__init__(parse_address(frames.url), None)

    def _open(self, address: Address) -> None:  # noqa: ARG002
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._play, name="replay-can", daemon=True)
        self._thread.start()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002 - not recorded
        """Accept a frame that must be the next recorded one."""
        self._frames.write(to_bytes(can_id, bytes(data)))

    def disconnect(self) -> None:
        """Stop after all frames that need no further request."""
        if not self._stopped.is_set():
            self._stopped.set()
            self._thread.join()
            self._take_all(0.0)

    def _play(self) -> None:
        while not self._stopped.is_set():
            self._take_all(_CYCLE)
            self._stopped.wait(0.001)

    def _take_all(self, timeout: float) -> None:
        with suppress(InstrumentTimeoutError, ReplayError):  # the next one follows a request, or all are played
            while frame := self._frames.read(timeout=timeout):
                can_id = int.from_bytes(frame[:4], "big")
                if can_id & ERROR_FRAME:
                    self.on_error_frame(can_id & ~ERROR_FRAME)
                else:
                    self.notify(can_id, bytearray(frame[4:]), time.time())


def to_bytes(can_id: int, data: bytes) -> bytes:
    """Return a frame as it is recorded."""
    return can_id.to_bytes(4, "big") + data


class CanNode(Transport):
    """One CANopen node; a bus that was lost is opened again, see `transports.lost`.

    Parameters
    ----------
    url : str
    network : callable
        Opens the network, or raises InstrumentError.
    node : int
        Node number, 1 to 127.
    timeout : float
        Time limit of an answer, s.
    retry : float
        Least time between two attempts to open the bus, s.
    simulated : bool
    end : callable, optional
        Called when this is closed.
    """

    def __init__(
        self,
        url: str,
        network: Callable[[], Network],
        node: int,
        *,
        timeout: float,
        retry: float,
        simulated: bool = False,
        end: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(url, timeout)
        self.simulated = simulated
        self.node = node
        self._bus, self._end = Reopened(url, self._opened, retry), end
        self._connect = network
        self._remote: Any = None
        try:
            self._bus.get()
        except BaseException:
            self.close()
            raise

    @property
    def state(self) -> str:
        """State that the node's last heartbeat reported, such as ``OPERATIONAL``; empty before the first one."""
        nmt = None if self._remote is None else self._remote.nmt
        return str(nmt.state) if nmt is not None and nmt.timestamp is not None else ""

    def start_node(self) -> None:
        """Send the node to OPERATIONAL."""
        self._guarded(lambda remote: remote.nmt.send_command(1), "the command to start")

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an entry of the node's object dictionary.

        Raises
        ------
        SdoRefusal
            The node aborts.
        InstrumentTimeoutError
            The node does not answer; the message states its last heartbeat.
        ProtocolError
            An answer to another request.
        InstrumentError
            The bus is off or lost; a later call opens it again.
        """
        data: bytes = self._guarded(lambda remote: remote.sdo.upload(index, subindex), f"0x{index:04X}:{subindex}")
        return data

    def _guarded(self, exchange: Callable[[Any], Any], what: str) -> Any:
        network = self._bus.get()
        where = f"{self.url}: node {self.node}"
        try:
            self._check(network)
            return exchange(self._remote)
        except SdoAbortedError as error:
            raise SdoRefusal(error.code, f"{where}, {what}") from None
        except SdoCommunicationError as error:
            self._check(network)
            if _TIMEOUT_TEXT not in str(error):
                raise ProtocolError(f"{where}, {what}: {error}") from None
            seen = f"its last heartbeat stated {self.state}" if self.state else "no heartbeat was received"
            raise InstrumentTimeoutError(f"{where} did not answer within {self.timeout:g} s; {seen}") from None
        except struct.error as error:
            raise ProtocolError(f"{where}, {what}: the answer is too short: {error}") from None
        except (can.CanError, OSError) as error:
            self._drop_bus(f"{self.url}: the bus is lost: {error}")
            raise InstrumentError(self._bus.reason) from None

    def _check(self, network: Network) -> None:
        if network.failed:
            self._drop_bus(f"{self.url}: {network.failed}")
            raise InstrumentError(self._bus.reason)

    def _opened(self) -> Network:
        network = self._connect()
        library: Any = canopen  # partly without types
        self._remote = library.RemoteNode(self.node, library.ObjectDictionary())
        self._remote.sdo.RESPONSE_TIMEOUT = self.timeout
        network.add_node(self._remote)
        return network

    def _drop_bus(self, reason: str) -> None:
        self._remote = None
        _disconnect(self._bus.drop(reason))

    def _send(self, data: bytes) -> None:  # noqa: ARG002
        raise InstrumentError(f"{self.url} transports CAN frames, not a stream of bytes")

    def _receive(self, max_bytes: int, timeout: float) -> bytes:  # noqa: ARG002
        raise InstrumentError(f"{self.url} transports CAN frames, not a stream of bytes")

    def close(self) -> None:
        """Leave the bus; idempotent."""
        network, self._remote = self._bus.close(), None
        end, self._end = self._end, None
        try:
            _disconnect(network)
        finally:
            if end is not None:
                end()


def _disconnect(network: Network | None) -> None:
    if network is not None:
        with suppress(can.CanError, OSError, struct.error):  # the network is not used again
            network.disconnect()


def open_can(
    url: str,
    *,
    node: int = 1,
    simulator: str | None = None,
    record: Path | None = None,
    timeout: float = 1.0,
    retry: float = 1.0,
) -> CanNode:
    """Open the CANopen node that an address names; its ``node`` takes precedence over the argument.

    Parameters
    ----------
    url : str
        See the module.
    node, timeout, retry
        As in `CanNode`.
    simulator : str, optional
        ``module:Class`` of the simulator behind ``sim://``.
    record : Path, optional
        File to which every frame of this node is recorded.

    Raises
    ------
    InstrumentError
        No such bus, no address of a CAN bus, or an invalid node number.
    """
    address = parse_address(url)
    if address.scheme == "replay":
        frames = ReplayTransport(Path(address.path))
        number, simulated = _number(parse_address(frames.recorded_address), node), frames.simulated
        return CanNode(
            url,
            lambda: ReplayedNetwork(frames),
            number,
            timeout=timeout,
            retry=retry,
            simulated=simulated,
            end=frames.close,
        )
    if address.scheme not in (CAN, "sim"):
        raise InstrumentError(f"Expected an address on a CAN bus, such as can://socketcan/can0?node=5; found '{url}'")
    number = _number(address, node)
    device = load_simulator(simulator, url)(address) if address.scheme == "sim" else None
    try:
        recorder = None if record is None else Recorder(record, url)
    except BaseException:
        if device is not None:
            device.close()
        raise
    bus = address if device is None else parse_address(device.url)

    def end() -> None:
        if device is not None:
            device.close()
        if recorder is not None:
            recorder.close()

    return CanNode(
        url,
        lambda: Network(bus, recorder),
        number,
        timeout=timeout,
        retry=retry,
        simulated=device is not None,
        end=end,
    )


def _number(address: Address, node: int) -> int:
    number = address.whole("node", node, 127)
    if number == 0:
        raise InstrumentError(f"'node' in '{address.url}': expected 1 to 127; found 0")
    return number
