"""What commands and streams see of the server."""

from __future__ import annotations

from typing import Any, Protocol

from errormotion.instruments.simulators.faults import Fault
from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import Triple
from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import Wire
from errormotion.instruments.simulators.laser_tracker.leica_emscon.settings import Block
from errormotion.instruments.simulators.laser_tracker.leica_emscon.tracker import Tracker
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld


class Points(Protocol):
    """Points of a continuous measurement."""

    def start_soon(self, mode: int) -> None:
        """Start as soon as the answer is out."""

    def end(self) -> None:
        """End the measurement."""


class Server(Protocol):
    """The server: its state, and what it sends unasked."""

    name: str
    world: VirtualWorld
    fault: Fault
    tracker: Tracker
    wire: Wire
    blocks: dict[int, Block]
    version: tuple[int, int, int]
    initialised: bool
    always_extended: bool

    @property
    def points(self) -> Points | None:
        """Points of the running measurement; None before the server is complete."""

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
        """Return the standard deviations of a position in the client's system, their total and the covariances."""

    def silent(self) -> bool:
        """Whether the server has fallen silent."""

    def send(self, packet: bytes) -> bool:
        """Send a packet between the answers; False without a connection."""

    def disconnect(self) -> None:
        """Break the connection."""
