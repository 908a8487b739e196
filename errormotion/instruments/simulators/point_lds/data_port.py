"""Base of simulated controllers with a second port, on which they send the values of sensors at the machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.loopback.serving import TcpServer

Array = np.ndarray[Any, Any]


class DataPortDevice(SimulatedDevice):
    """A controller that sends the measured values on the line ``data`` (in ``urls``).

    Faults of the menu: ``silence``, ``split``, ``garbage`` (stray bytes between blocks), ``out_of_range``, ``drop``
    (missing frames, which the counter shows) and ``disconnect`` (of the data port) are counted in frames, ``late`` in
    answers.
    """

    faults = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect", "late")
    drops_answers = False

    _mute = False

    def _open_data_port(
        self, address: Address, set_up: Callable[[Address], None], on_connection: Callable[[], None]
    ) -> None:
        """Set the controller up and open its second port; InstrumentError if the address has invalid parameters."""
        self._mute = self.fault.kind == "silence" and self.fault.from_the_start
        try:
            set_up(address)
            self._data = TcpServer(f"{self.name}-data", _ignore, on_connection)
        except (InstrumentError, ValueError) as error:
            SimulatedDevice.close(self)
            raise InstrumentError(
                f"'{address.url}' has invalid parameters of a controller: {error}", code="simulator.setting"
            ) from None
        self._data.start()
        self.urls = {"data": self._data.url}
        self.port = int(self._data.url.rsplit(":", 1)[1])

    def _sent_frames(self, numbers: Array) -> Array:
        """Return for each frame whether it precedes the fault ``silence`` or ``disconnect``."""
        before = self.fault.kind not in ("silence", "disconnect")
        return np.asarray(before | (numbers < self.fault.at))

    def _transmit(self, data: bytes, numbers: Array) -> bool:
        """Send the bytes of these frames with the fault of the line; return whether more can be sent."""
        fault = self.fault
        heard = all(self._data.send(piece) for piece in fault.pieces(data))
        reached = bool((numbers >= fault.at).any())
        if fault.kind == "disconnect" and reached:
            self._data.disconnect()
            heard = False
        self._mute = self._mute or (fault.kind == "silence" and reached)
        return heard and not self._mute


class BeamStream:
    """Samples of one beam of the machine: a `Stream` of the virtual world."""

    sync = "NONE"

    def __init__(self, channel: str, rate: float, measuring_range: float) -> None:
        self.channel, self.rate, self.measuring_range = channel, rate, measuring_range
        self.start = self.position = 0
        self.taken: int | None = None
        self.ended = False


def _ignore(data: bytes) -> None:
    """Ignore data received on the data port."""
