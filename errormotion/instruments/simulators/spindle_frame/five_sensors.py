"""Five simulated laser sensors around the bar of a virtual machine, on its clock."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from errormotion.instruments.simulators.point_lds.optoncdt import SimulatedOptoNCDT
from errormotion.instruments.transports import parse_address

if TYPE_CHECKING:
    from errormotion.instruments.transports import Address

CHANNELS = ("X1", "X2", "Y1", "Y2", "Z")


class SimulatedFrame:
    """Five sensors; parameters of the address and faults apply to each of them.

    Attributes
    ----------
    url : str
        Address of the first sensor.
    urls : dict of str to str
        Addresses of the other sensors, by channel.
    """

    faults = SimulatedOptoNCDT.faults

    def __init__(self, address: Address) -> None:
        with ExitStack() as started:
            self._sensors = []
            for name in CHANNELS:
                sensor = SimulatedOptoNCDT(parse_address(address.with_path(name)))
                started.callback(sensor.close)
                self._sensors.append(sensor)
            self._open = started.pop_all()
        self.url, *others = (sensor.url for sensor in self._sensors)
        self.urls = dict(zip(CHANNELS[1:], others, strict=True))

    def report_delivered(self, samples: int) -> None:
        """Record the number of samples that the reader has received."""
        for sensor in self._sensors:
            sensor.report_delivered(samples)

    def close(self) -> None:
        """End all sensors."""
        self._open.close()
