"""A CANopen node on a bus: entries by SDO, PDOs, state, emergencies."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from typing import TypeVar

import can

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.can.network import Network, Reset
from errormotion.instruments.transports.can.pdo import (
    COB_ID,
    COMMUNICATION,
    EVENT_TIMER,
    MAPPING,
    MAX_ENTRIES,
    SYNC,
    SYNC_IDENTIFIER,
    TRANSMISSION,
    TransmitPdo,
    decode_identifier,
    decode_mapping,
)
from errormotion.instruments.transports.can.sdo import SdoClient, SdoRefusal
from errormotion.instruments.transports.lost import Reopened
from errormotion.instruments.transports.quiet import after_others

MAX_PDOS = 8
"""Number of transmit PDOs that are examined: the four standard ones and further ones."""
START = 1
"""Command of the network management to enter OPERATIONAL."""
_NMT, _EMERGENCY, _ANSWERS, _REQUESTS, _HEARTBEAT = 0x000, 0x080, 0x580, 0x600, 0x700
_BOOTED = 0
_STATES = {_BOOTED: "PRE-OPERATIONAL", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE-OPERATIONAL"}  # also after its boot-up
Result = TypeVar("Result")


class CanNode(Transport):
    """A CANopen node; a bus that was lost is opened again, see `transports.lost`.

    Parameters
    ----------
    url : str
    network : callable
        Opens the network, or raises InstrumentError.
    node : int
        Node number, 1 to 127.
    timeout : float
        Time limit for an answer, s.
    retry : float
        Minimum interval between two attempts to open the bus, s.
    simulated : bool
    end : callable, optional
        Called when the node is closed.

    Attributes
    ----------
    boots : int
        Number of boot-up messages, and of buses opened again, after each of which entries of the node may have changed.
    emergency : int
        Code of the last emergency message; 0: none, or the emergency has ended.
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
        self.boots = -1
        self.emergency = 0
        self._state = ""
        self._sdo = SdoClient(self._request, timeout)
        self._fresh: dict[int, bytes] = {}  # first PDO of each identifier since the last request for new ones
        self._news = threading.Condition()
        self._awaited: tuple[int, ...] = ()
        self._bus, self._end = Reopened(url, self._opened, retry), end
        self._connect = network
        try:
            self._bus.get()
        except BaseException:
            self.close()
            raise

    @property
    def state(self) -> str:
        """State that the node's last heartbeat reported, such as ``OPERATIONAL``; empty before the first one."""
        return self._state

    @property
    def late(self) -> int:
        """Number of SDO answers that were ignored because they were late or belonged to another request."""
        return self._sdo.late

    # ------------------------------------------------------------------ entries

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an entry of the node's object dictionary.

        Raises
        ------
        SdoRefusal
            The node aborts.
        InstrumentTimeoutError
            The node does not answer; the message states its last heartbeat.
        ProtocolError
            The answer is invalid.
        InstrumentError
            The bus is off or lost; a later call opens it again.
        """
        what = f"0x{index:04X}:{subindex}"
        try:
            return self._guarded(lambda: self._sdo.upload(index, subindex))
        except SdoRefusal as refusal:
            raise SdoRefusal(refusal.number, f"{self._where}, {what}") from None
        except InstrumentTimeoutError:
            raise after_others(self._silence("did not answer"), self._sdo.others, what) from None
        except ProtocolError as error:
            raise ProtocolError(f"{self._where}, {what}: {error}", code=error.code) from None

    def unsigned(self, index: int, subindex: int = 0, size: int = 4) -> int:
        """Return an entry that is an unsigned number of 1 to ``size`` bytes; errors as for `upload`.

        A node that does not state the size of its entries sends 4 bytes; those beyond ``size`` have no meaning.
        """
        data = self.upload(index, subindex)
        if not 1 <= len(data) <= 4:
            found = f"{len(data)} bytes"
            raise ProtocolError(
                f"{self._where}, 0x{index:04X}:{subindex}: expected a number of 1 to 4 bytes; found {found}",
                code="protocol.value.form",
            )
        return int.from_bytes(data[:size], "little")

    # ------------------------------------------------------------------ network management, PDOs

    def start_node(self) -> None:
        """Set the node to OPERATIONAL."""
        self._guarded(lambda: self._bus.get().send(_NMT, bytes((START, self.node))))

    def transmit_pdos(self) -> list[TransmitPdo]:
        """Return the PDOs that the node sends, by its object dictionary; errors as for `upload`."""
        found: list[TransmitPdo] = []
        for number in range(MAX_PDOS):
            try:
                identifier = decode_identifier(self.unsigned(COMMUNICATION + number, COB_ID))
                if identifier is None:
                    continue
                transmission = self.unsigned(COMMUNICATION + number, TRANSMISSION, 1)
                entries = self.unsigned(MAPPING + number, size=1)
                if entries > MAX_ENTRIES:
                    continue
                mapped = decode_mapping([self.unsigned(MAPPING + number, 1 + i) for i in range(entries)])
            except SdoRefusal:  # no such PDO
                continue
            found.append(TransmitPdo(number + 1, identifier, transmission, self._event_timer(number), mapped))
        return found

    def sync_identifier(self) -> int:
        """Return the identifier of SYNC; errors as for `upload`."""
        try:
            return self.unsigned(SYNC_IDENTIFIER) & 0x7FF
        except SdoRefusal:
            return SYNC

    def await_pdos(self, identifiers: Iterable[int]) -> None:
        """Receive only the PDOs with these identifiers from now on."""
        self._awaited = tuple(identifiers)
        self._guarded(lambda: self._subscribe_pdos(self._bus.get()))

    def fresh_pdos(
        self, identifiers: Sequence[int], timeout: float, syncs: int = 0, sync: int = SYNC
    ) -> dict[int, bytes]:
        """Return the first frame with each identifier after this call.

        Parameters
        ----------
        identifiers : sequence of int
            See `await_pdos`.
        timeout : float
            Time limit, s.
        syncs : int
            Number of SYNC messages to send; 0: wait for those of another producer.
        sync : int
            Identifier of SYNC.

        Raises
        ------
        InstrumentTimeoutError
            Not all PDOs were received in time.
        InstrumentError
            The bus is off or lost.
        """

        def exchange() -> dict[int, bytes]:
            network = self._bus.get()
            network.mark(self._forget_pdos)
            for _ in range(syncs):
                network.send(sync, b"")
            end = time.monotonic() + timeout
            with self._news:
                while missing := [each for each in identifiers if each not in self._fresh]:
                    if network.failed or not self._news.wait(max(end - time.monotonic(), 0.0)):
                        self._check(network)
                        names = ", ".join(f"0x{each:03X}" for each in missing)
                        raise self._silence(f"sent no PDO {names}", timeout)
                return {each: self._fresh[each] for each in identifiers}

        return self._guarded(exchange)

    # ------------------------------------------------------------------ the bus

    @property
    def _where(self) -> str:
        return f"{self.url}: node {self.node}"

    def _silence(self, what: str, timeout: float | None = None) -> InstrumentTimeoutError:
        seen = f"its last heartbeat stated {self.state}" if self.state else "no heartbeat was received"
        limit = self.timeout if timeout is None else timeout
        return InstrumentTimeoutError(f"{self._where} {what} within {limit:g} s; {seen}", code="instrument.no_answer")

    def _event_timer(self, number: int) -> float:
        try:
            return self.unsigned(COMMUNICATION + number, EVENT_TIMER, 2) / 1e3
        except SdoRefusal:
            return 0.0

    def _guarded(self, exchange: Callable[[], Result]) -> Result:
        network = self._bus.get()
        try:
            self._check(network)
            return exchange()
        except InstrumentTimeoutError:
            self._check(network)
            raise
        except (can.CanError, OSError) as error:
            self._drop_bus(f"{self.url}: the bus is lost: {error}")
            raise InstrumentError(self._bus.reason, code="connection.lost") from None

    def _check(self, network: Network) -> None:
        if network.failed:
            self._drop_bus(f"{self.url}: {network.failed}")
            raise InstrumentError(self._bus.reason, code="connection.lost")

    def _opened(self) -> Network:
        network = self._connect()
        self.boots += 1
        self._state = ""
        self._sdo = SdoClient(self._request, self.timeout)
        network.subscribe(_ANSWERS + self.node, self._sdo.answers.put)
        network.subscribe(_HEARTBEAT + self.node, self._on_heartbeat)
        network.subscribe(_EMERGENCY + self.node, self._on_emergency)
        self._subscribe_pdos(network)
        return network

    def _subscribe_pdos(self, network: Network) -> None:
        for identifier in self._awaited:
            network.subscribe(identifier, partial(self._on_pdo, identifier))

    def _request(self, frame: bytes, reset: Reset | None = None) -> None:
        self._bus.get().send(_REQUESTS + self.node, frame, reset)

    def _on_heartbeat(self, data: bytes) -> None:
        if len(data) == 1:
            state = data[0] & 0x7F
            self._state = _STATES.get(state, f"state {state}")
            if state == _BOOTED:
                self.boots += 1

    def _on_emergency(self, data: bytes) -> None:
        with suppress(struct.error):
            (self.emergency,) = struct.unpack_from("<H", data)

    def _on_pdo(self, identifier: int, data: bytes) -> None:
        with self._news:
            self._fresh.setdefault(identifier, data)
            self._news.notify_all()

    def _forget_pdos(self) -> None:
        with self._news:
            self._fresh = {}

    def _drop_bus(self, reason: str) -> None:
        lost = self._bus.drop(reason)
        if lost is not None:
            lost.close()

    def _send(self, data: bytes) -> None:  # noqa: ARG002
        raise InstrumentError(f"{self.url} transports CAN frames, not a stream of bytes", code="connection.no_bytes")

    def _receive(self, max_bytes: int, timeout: float) -> bytes:  # noqa: ARG002
        raise InstrumentError(f"{self.url} transports CAN frames, not a stream of bytes", code="connection.no_bytes")

    def close(self) -> None:
        """Leave the bus; idempotent."""
        network = self._bus.close()
        end, self._end = self._end, None
        try:
            if network is not None:
                network.close()
        finally:
            if end is not None:
                end()
