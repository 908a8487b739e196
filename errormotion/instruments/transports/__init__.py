"""Transports of bytes: serial lines, TCP, buses, simulators, recordings.

Only this package uses ``serial`` and ``socket``.

``open_transport(url)`` returns a `Transport`:

* ``serial:///dev/ttyUSB0?baudrate=921600`` a serial line, 8N1
* ``tcp://host:port`` a TCP connection; `transports.lines` opens several to one device
* ``unix:///run/device.sock`` a Unix socket of this computer; ``unix://~/device.sock``
* ``sim://machine/device?seed=3`` a simulated device, with a real TCP connection or pty
* ``replay://session.rec`` a recorded session, played back strictly

Buses have separate modules: `transports.modbus` (``modbus+tcp``, ``modbus+rtu``, ``modbus+rtu-tcp``) and
`transports.can` (``can``). A line that is opened again after it was lost is in `transports.reconnecting`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from errormotion.errors import InstrumentError
from errormotion.instruments.transports.address import BYTES, SCHEMES, Address, parse_address
from errormotion.instruments.transports.base import Transport

if TYPE_CHECKING:
    from errormotion.instruments.transports.recording import Recorder


def open_transport(
    url: str,
    *,
    simulator: str | None = None,
    recorder: Recorder | Path | str | None = None,
    timeout: float = 1.0,
    baudrate: int | None = None,
) -> Transport:
    """Open the transport for an address.

    Parameters
    ----------
    url : str
        Address, see the module.
    simulator : str, optional
        ``module:Class`` of the wire simulator behind ``sim://``.
    recorder : Recorder or path, optional
        File or recorder to which every frame of the session is written.
    timeout : float
        Time limit for a read without data, s.
    baudrate : int, optional
        Baud rate of a serial line; that of the address takes precedence.

    Raises
    ------
    InstrumentError
        Unknown scheme, no device at the address, no simulator for this instrument.
    """
    from errormotion.instruments.transports.recording import Recorder, RecordingTransport, ReplayTransport

    address = parse_address(url)
    transport: Transport
    match address.scheme:
        case "tcp":
            from errormotion.instruments.transports.tcp import TcpTransport

            transport = TcpTransport(address, timeout=timeout)
        case "unix":
            from errormotion.instruments.transports.tcp import UnixTransport

            transport = UnixTransport(address, timeout=timeout)
        case "serial":
            from errormotion.instruments.transports.serial_line import SerialTransport

            transport = SerialTransport(address, timeout=timeout, baudrate=baudrate)
        case "replay":
            transport = ReplayTransport(Path(address.path), timeout=timeout)
        case "sim":
            from errormotion.instruments.transports.loopback.simulated import SimulatedTransport

            transport = SimulatedTransport(address, load_simulator(simulator, url), timeout=timeout, baudrate=baudrate)
        case _:
            raise InstrumentError(
                f"This instrument has no connection of type {address.scheme}: expected "
                f"{', '.join(f'{each}://' for each in BYTES)}; found '{url}'",
                code="address.type",
            )
    if recorder is None:
        return transport
    try:
        return RecordingTransport(transport, recorder if isinstance(recorder, Recorder) else Recorder(recorder, url))
    except BaseException:
        transport.close()
        raise


def load_simulator(name: str | None, url: str) -> Callable[[Address], Any]:
    """Return a function that starts the simulator ``module:Class`` at an address; InstrumentError without one."""
    if name is None:
        raise InstrumentError(
            f"This instrument has no simulator: expected the address of a device; found '{url}'",
            code="simulator.missing",
        )
    module, _, attribute = name.partition(":")
    try:
        simulator = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise InstrumentError(
            f"The simulator '{name}' for '{url}' does not load: {error}", code="simulator.not_loaded"
        ) from error

    def start(address: Address) -> Any:
        from errormotion.instruments.transports.loopback.serving import placed

        with placed(address):
            return simulator(address)

    return start


__all__ = ["SCHEMES", "Address", "Transport", "open_transport", "parse_address"]
