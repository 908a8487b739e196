"""A line that comes back: what an instrument needs that is asked for days, and may be unplugged meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.transports import load_simulator
from errormotion.instruments.transports.address import Address, parse_address
from errormotion.instruments.transports.base import CHUNK, Transport
from errormotion.instruments.transports.recording import Recorder, ReplayTransport


class ReconnectingTransport(Transport):
    """Connects again by itself when the connection is lost, but not more often than every ``retry`` seconds.

    The exchange in which a connection is lost fails; the next one connects anew. A connection that was closed while
    nobody used it is noticed by `forget_input`, before anything is asked.

    Parameters
    ----------
    url : str
    connect : callable
        Opens a connection, or raises InstrumentError.
    timeout : float
        Time limit of a silent read, s.
    retry : float
        Least time between two attempts to connect, s.
    simulated : bool
    end : callable, optional
        Called when this is closed.
    recorder : Recorder, optional
        Where the frames of all connections are written, and what would have been sent while there was none: played
        back, the same exchanges fail.
    """

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
        self._connect, self._retry, self._end, self._recorder = connect, retry, end, recorder
        self._inner: Transport | None = None
        self._tried = 0.0
        self._lost_by = ""
        self._closed = False
        try:
            self._line()
        except BaseException:
            self.close()
            raise

    def lose(self, why: str) -> None:
        """Give the connection up; the next exchange opens another one."""
        inner, self._inner = self._inner, None
        self._rest, self._lost_by = b"", why
        if inner is not None:
            inner.close()

    def _line(self) -> Transport:
        if self._closed:
            raise InstrumentError(f"The connection to {self.url} is closed")
        if self._inner is None:
            now = time.monotonic()
            if self._lost_by and now < self._tried + self._retry:
                raise InstrumentError(
                    f"{self._lost_by}; the next attempt is in {self._tried + self._retry - now:.1f} s"
                )
            self._tried = now
            try:
                self._inner = self._connect()
            except InstrumentError as error:
                self._lost_by = str(error)
                raise
            self._inner.url = self.url  # messages name the address that a person knows
            self.holds_back = self._inner.holds_back
            self._lost_by = ""
        return self._inner

    def _send(self, data: bytes) -> None:
        if self._recorder is not None:
            self._recorder.frame("W", data)  # before it goes out: the answer must not overtake it
        line = self._line()
        try:
            line.write(data)
        except InstrumentError as error:
            self.lose(str(error))
            raise

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        if self._inner is None:
            raise InstrumentError(self._lost_by or f"The connection to {self.url} is closed")
        try:
            data = self._inner.read(max_bytes, timeout)
        except InstrumentTimeoutError:
            raise
        except InstrumentError as error:
            self.lose(str(error))
            raise
        if self._recorder is not None:
            self._recorder.frame("R", data)
        return data

    def close(self) -> None:
        """Close for good; idempotent."""
        self._closed = True
        inner, self._inner = self._inner, None
        end, self._end = self._end, None
        try:
            if inner is not None:
                inner.close()
        finally:
            if end is not None:
                end()
            if self._recorder is not None:
                self._recorder.close()


def forget_input(line: Transport) -> bytes:
    """Return what lies unread on a line, and so forget late answers; a connection that was lost meanwhile is let go."""
    old = b""
    with suppress(InstrumentError):  # silence is what is hoped for; a lost connection is opened by the next write
        while data := line.read(CHUNK, timeout=0.0):
            old += data
    return old


def give_up_silent(line: Transport) -> None:
    """After silence: a TCP connection may be a dead one, and a late answer of no use; so begin with a new one."""
    if isinstance(line, ReconnectingTransport) and line.holds_back:
        line.lose(f"{line.url} was silent")


def open_reconnecting(
    url: str | Address,
    *,
    simulator: str | None = None,
    record: Path | None = None,
    timeout: float = 1.0,
    retry: float = 1.0,
    baudrate: int | None = None,
) -> ReconnectingTransport | ReplayTransport:
    """Open a line of bytes that comes back after it was lost; ``replay://`` as ever.

    Parameters
    ----------
    url : str or Address
        ``serial://``, ``tcp://``, ``sim://`` or ``replay://``.
    simulator, timeout, baudrate
        As in `open_transport`.
    record : Path, optional
        File to which the frames of all connections are recorded.
    retry : float
        Least time between two attempts to connect, s.

    Raises
    ------
    InstrumentError
        Nobody at the address now, or an address of another kind.
    """
    address = parse_address(url) if isinstance(url, str) else url
    if address.scheme == "replay":
        return ReplayTransport(Path(address.path), timeout=timeout)
    device, wire = None, address
    if address.scheme == "sim":
        device = load_simulator(simulator, address.url)(address)
        wire = parse_address(device.url)
    try:
        connect = _connector(wire, timeout, baudrate)
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
    raise InstrumentError(f"This instrument needs a serial line or a TCP connection; found '{address.url}'")
