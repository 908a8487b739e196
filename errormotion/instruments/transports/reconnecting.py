"""A line of bytes that is opened again after it was lost, for instruments that are read for days."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.transports import load_simulator
from errormotion.instruments.transports.address import Address, parse_address
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.half_duplex import half_duplex
from errormotion.instruments.transports.lost import Reopened
from errormotion.instruments.transports.recording import Recorder, ReplayTransport


class ReconnectingTransport(Transport):
    """A transport whose connection is opened again after it was lost; see `transports.lost`.

    `quiet.discard_input` before a request detects a connection that was closed while it was not in use.

    Parameters
    ----------
    url : str
    connect : callable
        Opens a connection, or raises InstrumentError.
    timeout : float
        Time limit for a read without data, s.
    retry : float
        Minimum interval between two attempts to connect, s.
    simulated : bool
    end : callable, optional
        Called when the transport is closed.
    recorder : Recorder, optional
        Records the frames of all connections, and those that could not be sent without a connection, so that the same
        exchanges fail in a replay.
    """

    reconnects = True

    def __init__(
        self,
        url: str,
        connect: Callable[[], Transport],
        *,
        timeout: float,
        retry: float,
        simulated: bool = False,
        end: Callable[[], None] | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(url, timeout)
        self.simulated = simulated
        self._line, self._end, self._recorder = Reopened(url, self._opened, retry), end, recorder
        self._connect = connect
        try:
            self._line.get()
        except BaseException:
            self.close()
            raise

    def drop(self, reason: str) -> None:
        """Drop the connection; the next exchange opens another one."""
        self._rest = b""
        lost = self._line.drop(reason)
        if lost is not None:
            lost.close()

    def reopen(self) -> bool:
        """Drop a TCP connection; the next exchange opens another one."""
        if self.flow_control:
            self.drop(f"{self.url} did not answer")
        return self.flow_control

    def _opened(self) -> Transport:
        line = self._connect()
        line.url = self.url  # messages state the address in the bench file
        self.flow_control = line.flow_control
        return line

    def _send(self, data: bytes) -> None:
        if self._recorder is not None:
            self._recorder.frame("W", data)  # before sending, so that the answer is recorded after it
        line = self._line.get()
        try:
            line.write(data)
        except InstrumentError as error:
            self.drop(str(error))
            raise

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        line = self._line.connection
        if line is None:
            raise InstrumentError(
                self._line.reason or f"The connection to {self.url} is closed", code="connection.closed"
            )
        try:
            data = line.read(max_bytes, timeout)
        except InstrumentTimeoutError:
            raise
        except InstrumentError as error:
            self.drop(str(error))
            raise
        if self._recorder is not None:
            self._recorder.frame("R", data)
        return data

    def close(self) -> None:
        """Close permanently; idempotent."""
        line = self._line.close()
        end, self._end = self._end, None
        try:
            if line is not None:
                line.close()
        finally:
            if end is not None:
                end()
            if self._recorder is not None:
                self._recorder.close()


def disconnect_after_timeout(line: Transport) -> None:
    """Drop a TCP connection after a timeout: it may be broken, and a late answer must not be read as the next one."""
    if isinstance(line, ReconnectingTransport):
        line.reopen()


def open_reconnecting(
    url: str | Address,
    *,
    simulator: str | None = None,
    record: Path | None = None,
    timeout: float = 1.0,
    retry: float = 1.0,
    baudrate: int | None = None,
    echo: bool = False,
    zeros: bool = False,
) -> ReconnectingTransport | ReplayTransport:
    """Open a line of bytes that is opened again after it was lost; ``replay://`` as in `open_transport`.

    Parameters
    ----------
    url : str or Address
        ``serial://``, ``tcp://``, ``sim://`` or ``replay://``.
    simulator, timeout, baudrate
        See `open_transport`.
    record : Path, optional
        File to which the frames of all connections are recorded.
    retry : float
        Minimum interval between two attempts to connect, s.
    echo, zeros : bool
        See `HalfDuplexTransport`.

    Raises
    ------
    InstrumentError
        No device answers at the address, or the address has another scheme.
    """
    address = parse_address(url) if isinstance(url, str) else url
    if address.scheme == "replay":
        return ReplayTransport(Path(address.path), timeout=timeout)
    device, wire = None, address
    if address.scheme == "sim":
        device = load_simulator(simulator, address.url)(address)
        wire = parse_address(device.url)
    try:
        connect = half_duplex(_connector(wire, timeout, baudrate), echo=echo, zeros=zeros)
        recorder = None if record is None else Recorder(record, address.url)
    except BaseException:
        if device is not None:
            device.close()
        raise
    return ReconnectingTransport(
        address.url,
        connect,
        timeout=timeout,
        retry=retry,
        simulated=device is not None,
        end=None if device is None else device.close,
        recorder=recorder,
    )


def _connector(address: Address, timeout: float, baudrate: int | None) -> Callable[[], Transport]:
    if address.scheme == "tcp":
        from errormotion.instruments.transports.tcp import TcpTransport

        return lambda: TcpTransport(address, timeout=timeout)
    if address.scheme == "serial":
        from errormotion.instruments.transports.serial_line import SerialTransport

        return lambda: SerialTransport(address, timeout=timeout, baudrate=baudrate)
    raise InstrumentError(
        f"This instrument needs a serial line or a TCP connection; found '{address.url}'", code="address.type"
    )
