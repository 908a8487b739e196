"""CAN: opening the CANopen node at an address.

``can://socketcan/can0?node=5`` states an interface of python-can, a channel and the node. Further parameters are passed
to python-can: ``bitrate=250000``, ``port=43113``. ``can://udp_multicast/239.74.163.2?node=5`` is a bus between
processes, ``can://virtual/NAME?node=5`` one within this process; ``sim://`` and ``replay://`` as for every transport.
"""

from __future__ import annotations

from pathlib import Path

from errormotion.errors import InstrumentError
from errormotion.instruments.transports import load_simulator
from errormotion.instruments.transports.address import CAN, Address, parse_address
from errormotion.instruments.transports.can.network import BUS_OFF, Network, ReplayedNetwork
from errormotion.instruments.transports.can.node import CanNode
from errormotion.instruments.transports.can.sdo import SdoRefusal
from errormotion.instruments.transports.recording import Recorder, ReplayTransport

__all__ = ["BUS_OFF", "CanNode", "SdoRefusal", "open_can"]


def open_can(
    url: str,
    *,
    node: int = 1,
    simulator: str | None = None,
    record: Path | None = None,
    timeout: float = 1.0,
    retry: float = 1.0,
) -> CanNode:
    """Open the CANopen node at an address; its ``node`` takes precedence over the argument.

    Parameters
    ----------
    url : str
        See the module.
    node, timeout, retry
        See `CanNode`.
    simulator : str, optional
        ``module:Class`` of the simulator for ``sim://``.
    record : Path, optional
        File to which every frame of this node is recorded.

    Raises
    ------
    InstrumentError
        The bus cannot be opened, the address is not that of a CAN bus, or the node number is invalid.
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
        raise InstrumentError(
            f"Expected an address on a CAN bus, such as can://socketcan/can0?node=5; found '{url}'", code="address.form"
        )
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
        raise InstrumentError(f"'node' in '{address.url}': expected 1 to 127; found 0", code="address.number")
    return number
