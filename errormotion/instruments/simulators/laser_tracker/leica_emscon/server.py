"""The part of the simulated server that the commands and the point stream use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import Triple
from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import Wire
from errormotion.instruments.simulators.laser_tracker.leica_emscon.settings import Block
from errormotion.instruments.simulators.laser_tracker.leica_emscon.tracker import Tracker

if TYPE_CHECKING:
    from errormotion.instruments.simulators.faults import Fault
    from errormotion.instruments.simulators.virtual_world.world import VirtualWorld


class Stream(Protocol):
    """A continuous measurement."""

    def start_soon(self, mode: int) -> None:
        """Start after the answer."""

    def end(self) -> None:
        """End it; idempotent."""


class Server(Protocol):
    """The simulated server: its state, and packets without a request."""

    name: str
    world: VirtualWorld
    fault: Fault
    wire: Wire
    blocks: dict[int, Block]
    tracker: Tracker
    version: tuple[int, int, int]
    initialised: bool
    always_extended: bool

    @property
    def stream(self) -> Stream:
        """The continuous measurement."""

    @property
    def measuring(self) -> bool:
        """Whether a continuous measurement is running."""

    @property
    def try_mode(self) -> int:
        """Whether the client has switched on the try mode, 0 or 1."""

    def status_changes(self, *events: int) -> bytes:
        """Return the packets that report changes."""

    def use_beam(self) -> bytes:
        """Count one use of the beam; return the packets that report that it breaks."""

    def locked(self) -> bytes:
        """Lock on to the reflector; return the packets that report this."""

    def spread(self, position: Triple) -> list[Any]:
        """Return the standard deviations of a position, their total, and covariances."""

    def silent(self) -> bool:
        """Whether the fault ``silence`` is active."""

    def send(self, packet: bytes) -> bool:
        """Send a packet between the answers; False without a connection."""

    def disconnect(self) -> None:
        """Break the connection."""
