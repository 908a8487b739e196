"""Devices with several connections: commands on one TCP connection, data on another.

``open_lines("tcp://192.168.0.1:24691?stream=24692", {"stream": 24692})`` opens both. A recording of them is a list
of files, one for each line.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from errormotion.errors import InstrumentError, ReplayError
from errormotion.instruments.transports import load_simulator
from errormotion.instruments.transports.address import Address, parse_address
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.loopback.simulated import SimulatedTransport
from errormotion.instruments.transports.recording import (
    Recorder,
    RecordingTransport,
    ReplayTransport,
    read_index,
    write_index,
)
from errormotion.instruments.transports.tcp import TcpTransport

COMMAND = "command"
"""Name of the first line in recordings."""


class ManyLines(Transport):
    """Several lines to one device: reads and writes use the first one, ``line(name)`` returns the others."""

    def __init__(self, lines: Mapping[str, Transport]) -> None:
        self._lines = dict(lines)
        self._first = next(iter(self._lines.values()))
        super().__init__(self._first.url, self._first.timeout)
        self.flow_control = self._first.flow_control
        self.simulated = self._first.simulated

    def line(self, name: str) -> Transport:
        """Return the line of this name."""
        return self._lines[name]

    def _send(self, data: bytes) -> None:
        self._first.write(data)

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        return self._first.read(max_bytes, timeout)

    def reopen(self) -> bool:
        """Open the connection of the first line again; the others remain open."""
        self._rest = b""
        return self._first.reopen()

    def close(self) -> None:
        """Close all lines; idempotent. The first of several errors is raised when all are closed."""
        errors: list[InstrumentError] = []
        for line in self._lines.values():
            try:
                line.close()
            except InstrumentError as error:
                errors.append(error)
        if errors:
            raise errors[0]


def open_lines(
    url: str,
    further: Mapping[str, int],
    *,
    simulator: str | None = None,
    record: Path | None = None,
    timeout: float = 1.0,
) -> ManyLines:
    """Open all lines of a device.

    Parameters
    ----------
    url : str
        ``tcp://host:port``, with ``name=port`` for the port of a further line; ``sim://``; ``replay://``.
    further : mapping of str to int
        Further lines by name, with the default port.
    simulator, timeout
        See `open_transport`.
    record : Path, optional
        List of the recordings of all lines, which are written beside it.

    Raises
    ------
    InstrumentError
        Another scheme, no device at one of the ports, or the recording already exists.
    """
    address = parse_address(url)
    lines: dict[str, Transport] = {}
    try:
        for name, transport in _opened(address, further, simulator, timeout):
            lines[name] = transport
        if record is not None:
            for name, path in write_index(record, list(lines)).items():
                lines[name] = RecordingTransport(lines[name], Recorder(path, url))
    except BaseException:
        for line in lines.values():
            with suppress(InstrumentError):
                line.close()
        raise
    return ManyLines(lines)


def _opened(
    address: Address, further: Mapping[str, int], simulator: str | None, timeout: float
) -> Iterator[tuple[str, Transport]]:
    match address.scheme:
        case "tcp":
            yield COMMAND, TcpTransport(address, timeout=timeout)
            for name, port in further.items():
                yield name, TcpTransport(address.line(name, port), timeout=timeout)
        case "sim":
            first = SimulatedTransport(address, load_simulator(simulator, address.url), timeout=timeout)
            yield COMMAND, first
            for name in further:
                yield name, first.further(name)
        case "replay":
            recordings = read_index(Path(address.path))
            for name in (COMMAND, *further):
                if name not in recordings:
                    raise ReplayError(
                        f"The recording {address.path} has no line '{name}'; check the type of the device",
                        code="recording.line.missing",
                    )
                yield name, ReplayTransport(recordings[name], timeout=timeout)
        case _:
            raise InstrumentError(
                f"This instrument has {len(further) + 1} network connections: expected tcp://HOST:PORT; "
                f"found '{address.url}'",
                code="address.type",
            )
