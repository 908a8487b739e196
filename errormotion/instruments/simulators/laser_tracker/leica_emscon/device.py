"""The simulated server on its line: requests, replies, events, and faults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.laser_tracker.leica_emscon import information, packets, settings
from errormotion.instruments.simulators.laser_tracker.leica_emscon.commands import Commands
from errormotion.instruments.simulators.laser_tracker.leica_emscon.information import ABSENT, IDLE, MODELS
from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import RHR, Triple, deviations
from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import AT4XX, COMMANDS, HEADER, UNKNOWN
from errormotion.instruments.simulators.laser_tracker.leica_emscon.points import PointStream
from errormotion.instruments.simulators.laser_tracker.leica_emscon.state_commands import TRY, UNSOLICITED
from errormotion.instruments.simulators.laser_tracker.leica_emscon.status import Event, Status
from errormotion.instruments.simulators.laser_tracker.leica_emscon.tracker import Tracker
from errormotion.instruments.transports import Address

BEAM_ERROR = 201
"""Status of the error that reports a broken beam: a number of the tracker processor (assumed)."""
LARGEST = 1e12
"""Larger numbers of a request, in SI, and NaN are wrong parameters (assumed)."""
VERSIONS = {"3.6": (3, 6, 500), "3.8": (3, 8, 900)}


class SimulatedEmScon(SimulatedDevice):
    """A tracker that follows the reflector at the machine's tool.

    Further parameters of the address: those of `tracker.Tracker`; ``tracker`` (``AT901`` or ``AT4xx``), ``server``
    (``3.8`` or ``3.6``), ``initialised`` (1), ``result`` (1; with 2 every single measurement is the longer packet).

    It sends status changes, levels and reflector positions between the answers, as a real one.

    Faults in addition to the menu, from ``fault_at`` on, ``fault_for`` times (without end): ``busy`` (answers),
    ``beam_broken`` (points, measurements and motions), ``refuse`` and ``error`` (answers; ``code`` is their status).
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "late", "busy", "beam_broken", "refuse", "error")
    drops_answers = False  # `drop` and `disconnect` affect points of a stream

    def __init__(self, address: Address) -> None:
        self.points: PointStream | None = None
        super().__init__(address, line_end=b"", default_name="tracker", every=7)
        try:
            self._set_up(address)
        except (InstrumentError, KeyError, ValueError) as error:
            self.close()
            raise InstrumentError(
                f"'{address.url}' has invalid parameters of a tracker: {error}", code="simulator.setting"
            ) from None

    def _set_up(self, address: Address) -> None:
        kind = address.params.get("tracker", "AT901")
        self.model = MODELS[kind]
        self.version = VERSIONS[address.params.get("server", "3.8")]
        self.wire = packets.Wire()
        self.blocks = settings.blocks(newest=self.version >= VERSIONS["3.8"])
        self.tracker = Tracker(
            self.world,
            address,
            self._rng,
            absolute=kind == "AT4xx",
            obstructed=lambda use: bool(self.fault.affects("beam_broken", use)),
        )
        self.initialised = bool(address.number("initialised", 1))
        self.always_extended = address.number("result", 1) == 2
        self._code = int(address.number("code", Status.USAGE_CONFLICT))
        self._facts = information.identity(self.model, self.version)
        self._commands = Commands(self)
        self.points = PointStream(self)

    @property
    def scene(self) -> Any:
        """The scene around the tracker."""
        return self.tracker.scene

    @property
    def dead_path(self) -> float:
        """Error of the distances from their start value, m."""
        return self.tracker.dead_path

    @dead_path.setter
    def dead_path(self, value: float) -> None:
        self.tracker.dead_path = value

    def carry_to(self, position: Sequence[float]) -> None:
        """Set up the tracker near a position in machine coordinates, m; distances get a new start value."""
        self.tracker.carry_to(position)

    def close(self) -> None:
        """End the device and its stream."""
        if self.points is not None:
            self.points.request_end()
        super().close()
        if self.points is not None:
            self.points.end()

    def report_delivered(self, samples: int) -> None:
        """Advance the world's clock with the reader, unless another device controls it."""
        if self.points is not None:
            self.points.report_delivered(samples)

    def connection_opened(self) -> None:
        """Discard an incomplete request, and end the measurement, of the previous connection."""
        super().connection_opened()
        if self.points is not None:
            self.points.request_end()

    # ------------------------------------------------------------------ requests

    def _on_data(self, data: bytes) -> None:
        self._buffer += data
        while len(self._buffer) >= HEADER.size:
            size, _ = HEADER.unpack_from(self._buffer)
            if not HEADER.size <= size <= packets.MAX_REQUEST:
                self._buffer = b""
                self._server.disconnect()
                return
            if len(self._buffer) < size:
                return
            request, self._buffer = self._buffer[:size], self._buffer[size:]
            self.reply(self.answer(request))
            if self.points is not None:
                self.points.start_if_due()

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request, with the unrequested packets before and after it."""
        _, kind = HEADER.unpack_from(request)
        if kind != packets.COMMAND or len(request) < HEADER.size + 4:
            return self.error(UNKNOWN, Status.WRONG_PARAMETER)
        number = int.from_bytes(request[HEADER.size : HEADER.size + 4], "little", signed=True)
        if self.fault.affects("busy", self._answers):
            return self.wire.reply(number, Status.BUSY)
        if self.fault.affects("refuse", self._answers):
            return self.wire.reply(number, self._code)
        if self.fault.affects("error", self._answers):
            return self.error(number, self._code)
        if number not in COMMANDS or (self.tracker.absolute and number not in AT4XX):
            return self.wire.reply(number, Status.NOT_IMPLEMENTED)
        arguments = request[HEADER.size + 4 :]
        if len(arguments) != packets.size_of(COMMANDS[number].request):
            return self.wire.reply(number, Status.WRONG_PARAMETER)
        if self.measuring and not self._allowed_while_measuring(COMMANDS[number].name):
            return self.wire.reply(number, Status.BUSY)
        values = self.wire.unpack(COMMANDS[number].request, arguments)
        if not np.all(np.abs(np.hstack([0.0, *values])) < LARGEST):
            return self.wire.reply(number, Status.WRONG_PARAMETER)
        return self._execute(number, values)

    def _execute(self, number: int, values: list[Any]) -> bytes:
        name = COMMANDS[number].name
        if name in ABSENT:
            return self.wire.reply(number, ABSENT[name])
        if name in IDLE:
            return self.wire.reply(number)
        if name in self._facts:
            return self.wire.reply(number, 0, self._facts[name])
        if number in self.blocks:
            return self._commands.set_block(number, values)
        block = next((block for block in self.blocks.values() if block.get == name), None)
        if block is not None:
            return self.wire.reply(number, 0, block.values)
        answer = self._commands.do(name, values)
        if isinstance(answer, bytes):
            return answer
        return self.wire.reply(number, answer) if isinstance(answer, int) else self.wire.reply(number, 0, answer)

    @staticmethod
    def _allowed_while_measuring(name: str) -> bool:
        return name.startswith("Get") or name in ("StopMeasurement", "ClearCommandQueue", "ExitApplication")

    @property
    def stream(self) -> PointStream:
        """The continuous measurement."""
        if self.points is None:
            raise InstrumentError("The simulated tracker is not set up", code="simulator.not_set_up")
        return self.points

    @property
    def measuring(self) -> bool:
        """Whether a continuous measurement is running."""
        return self.points is not None and self.points.running

    # ------------------------------------------------------------------ unrequested packets

    def status_changes(self, *events: int) -> bytes:
        """Return the packets that report changes; none if the client has switched them off."""
        if not self._commands.system[UNSOLICITED]:
            return b""
        return b"".join(self.wire.result(packets.CHANGE, [event]) for event in events)

    def error(self, number: int, status: int) -> bytes:
        """Return an error packet."""
        return self.wire.result(packets.ERROR, [number, status])

    def use_beam(self) -> bytes:
        """Count one use of the beam; return the packets that report that it breaks."""
        if self.tracker.use_beam():
            return self.error(UNKNOWN, BEAM_ERROR) + self.status_changes(Event.NOT_READY)
        return b""

    def locked(self) -> bytes:
        """Lock on to the reflector; return the packets that report this."""
        self.tracker.lock()
        return self.status_changes(Event.DISTANCE_SET, Event.READY)

    @property
    def try_mode(self) -> int:
        """Whether the client has switched on the try mode, 0 or 1."""
        return self._commands.system[TRY]

    def spread(self, position: Triple) -> list[Any]:
        """Return the standard deviations of a position in the client's system, their total (m), and no covariances."""
        tracker, system = self.tracker, self.wire.system
        sigmas = (tracker.angle_noise, tracker.angle_noise, tracker.noise)
        total = math.hypot(*deviations(position, sigmas, RHR))
        return [deviations(position, sigmas, system), self.wire.units.out("L", total), 0.0, 0.0, 0.0]

    def silent(self) -> bool:
        """Whether the fault ``silence`` is active."""
        return self.fault.kind == "silence" and self._silent()

    def send(self, packet: bytes) -> bool:
        """Send a packet between the answers; False without a connection."""
        with self._server.lock:  # an answer may be sent at the same time
            return all(map(self._server.send, self.fault.pieces(packet)))

    def disconnect(self) -> None:
        """Break the connection."""
        self._server.disconnect()
