"""What the commands and the stream of points use of the simulated server."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from errormotion.instruments.simulators.faults import Fault
from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import Triple
from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import Wire
from errormotion.instruments.simulators.laser_tracker.leica_emscon.settings import Block
from errormotion.instruments.simulators.laser_tracker.leica_emscon.tracker import Tracker
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld


class Points(Protocol):
    """A stream of points, see `points.PointStream`."""

    def start_soon(self, mode: int) -> None:
        """Start as soon as the answer is out."""

    def end(self) -> None:
        """End the stream; idempotent."""


class TrackerServer(Protocol):
    """The server, see `device.SimulatedEmScon`."""

    name: str
    fault: Fault
    world: VirtualWorld
    tracker: Tracker
    wire: Wire
    initialised: bool
    always_extended: bool

    @property
    def blocks(self) -> Mapping[int, Block]:
        """Settings that are read and set as a whole, by the number of the command that sets them."""

    @property
    def version(self) -> tuple[int, int, int]:
        """Version of the server."""

    @property
    def points(self) -> Points | None:
        """The stream of points."""

    @property
    def measuring(self) -> bool:
        """Whether a continuous measurement is running."""

    @property
    def try_mode(self) -> int:
        """Whether the client has switched on the try mode, 0 or 1."""

    def said(self, *events: int) -> bytes:
        """Return the packets that report changes."""

    def use_beam(self) -> bytes:
        """Count one use of the beam; return what the server states where that breaks it."""

    def locked(self) -> bytes:
        """Take up the reflector; return what the server states then."""

    def spread(self, seen: Triple) -> list[Any]:
        """Return the standard deviations of a position and its covariances."""

    def silent(self) -> bool:
        """Whether the fault ``silence`` holds."""

    def send(self, packet: bytes) -> bool:
        """Send a packet between the answers; False without a connection."""

    def disconnect(self) -> None:
        """Break the connection."""
