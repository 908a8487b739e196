"""Commands that move the beam, level the tracker and measure.

Each method has the name of its command and takes its values in SI; it returns a status, the values of the reply, or all
packets.
"""

from __future__ import annotations

from typing import Any

from errormotion.instruments.simulators.laser_tracker.leica_emscon import packets
from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import Triple
from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import NUMBERS
from errormotion.instruments.simulators.laser_tracker.leica_emscon.points import BY_DISTANCE, BY_TIME, GRID
from errormotion.instruments.simulators.laser_tracker.leica_emscon.server import Server
from errormotion.instruments.simulators.laser_tracker.leica_emscon.state_commands import LEVEL, StateCommands
from errormotion.instruments.simulators.laser_tracker.leica_emscon.status import Event, Status, out_of_range, wrong
from errormotion.instruments.simulators.laser_tracker.leica_emscon.tracker import NEST

STATIONARY = 0
PROFILES = (20, 21, 22, 23)
"""Measurement modes of the AT4xx in headers after 3.6: fast, standard, precise, outdoor."""
TILT = (1e-5, -4e-6)
"""Tilt of the tracker, rad."""


class Commands(StateCommands):
    """All commands of one client."""

    def __init__(self, device: Server) -> None:
        super().__init__(device)
        self._mode = STATIONARY
        self._reported_index = 0.0

    # ------------------------------------------------------------------ level

    def _do_Initialize(self) -> bytes:
        self._device.initialised = True
        before = self._status_changes(Event.BUSY, Event.INITIALISATION)
        level = self._level() if self.system[LEVEL] else b""
        return before + level + self._ok("Initialize") + self._status_changes(Event.READY)

    def _level(self) -> bytes:
        temperature = self._device.tracker.scene.air()[0]
        return self._device.wire.result(packets.NIVEL, [0, 0, *TILT, temperature])

    # ------------------------------------------------------------------ motions

    def _do_GetDirection(self) -> list[Any]:
        return list(self._device.tracker.now()[:2])

    def _do_GoBirdBath(self) -> bytes:
        before, self._device.tracker.nested = self._device.use_beam(), True
        return self._moved("GoBirdBath", before, found=True)

    def _do_GoBirdBath2(self, clockwise: int) -> bytes | int:
        if clockwise not in (0, 1):
            return wrong(1)
        before, self._device.tracker.nested = self._device.use_beam(), True
        return self._moved("GoBirdBath2", before, found=True)

    def _do_FindReflector(self, distance: float) -> bytes | int:
        if distance < 0:
            return out_of_range(1)
        return self._moved("FindReflector", self._device.use_beam(), found=True)

    def _do_GoPosition(self, position: Triple, use_adm: int) -> bytes | int:
        return self._go("GoPosition", position, use_adm)

    def _go(self, name: str, position: Triple, use_adm: int) -> bytes | int:
        if use_adm not in (0, 1):
            return wrong(4)
        before = self._device.use_beam()
        return self._moved(name, before, found=self._device.tracker.near(position, self._radius))

    @property
    def _radius(self) -> float:
        """Search radius, m."""
        return float(self._device.blocks[NUMBERS["SetSearchParams"]].values[0])

    def _moved(self, name: str, before: bytes, *, found: bool) -> bytes:
        tracker = self._device.tracker
        before += self._status_changes(Event.BUSY)
        if not found or (tracker.broken and not tracker.can_lock()):
            tracker.broken = True
            refused = self._device.wire.reply(NUMBERS[name], Status.NO_RESULT)
            return before + self._status_changes(Event.NOT_READY) + refused
        tracker.pointing = NEST
        return before + self._device.locked() + self._ok(name)

    # ------------------------------------------------------------------ measuring

    def _do_SetMeasurementMode(self, mode: int) -> int | bytes:
        absolute = self._device.tracker.absolute
        if not 0 <= mode <= 11 and mode not in PROFILES:
            return wrong(1)
        if 6 <= mode <= 11:
            return Status.NOT_IMPLEMENTED if absolute else Status.MODE_6D_NOT_ALLOWED
        known = (STATIONARY, *PROFILES) if absolute else (STATIONARY, BY_TIME, BY_DISTANCE, GRID)
        if mode not in known or (mode in PROFILES and self._device.version < (3, 8, 0)):
            return Status.NOT_IMPLEMENTED
        self._mode = mode
        return self._ok("SetMeasurementMode") + self._status_changes(Event.MODE)

    def _do_StartMeasurement(self) -> bytes | int:
        if not self._device.initialised:
            return Status.NOT_INITIALISED
        if self._mode in (BY_TIME, BY_DISTANCE, GRID):
            self._device.stream.start_soon(self._mode)
            return self._ok("StartMeasurement") + self._status_changes(Event.BUSY)
        before = self._device.use_beam()
        if self._device.tracker.broken:
            return before + self._device.wire.reply(NUMBERS["StartMeasurement"], Status.NOT_READY)
        return (
            before + self._status_changes(Event.BUSY) + self._position() + self._ok("StartMeasurement") + self._single()
        )

    def _do_GoAndMeasure(self, position: Triple) -> bytes | int:
        tracker = self._device.tracker
        if not tracker.absolute:
            return Status.NOT_IMPLEMENTED
        if not self._device.initialised:
            return Status.NOT_INITIALISED
        before = self._device.use_beam() + self._status_changes(Event.BUSY)
        if not tracker.near(position, self._radius) or (tracker.broken and not tracker.can_lock()):
            tracker.broken = True
            refused = self._device.wire.reply(NUMBERS["GoAndMeasure"], Status.NO_RESULT)
            return before + self._status_changes(Event.NOT_READY) + refused
        tracker.broken, tracker.pointing = False, NEST
        return before + self._ok("GoAndMeasure") + self._single()

    def _do_StopMeasurement(self) -> bytes:
        self._device.stream.end()
        return self._ok("StopMeasurement") + self._status_changes(Event.READY)

    def _single(self) -> bytes:
        device, tracker = self._device, self._device.tracker
        change = b""
        if abs((index := tracker.index()) - self._reported_index) > 1e-8:
            self._reported_index = index
            change = self._status_changes(Event.REFRACTION)
        position = tracker.now()
        extended = device.always_extended or device.blocks[NUMBERS["SetStatisticMode"]].values[0]
        spread, errors = device.spread(position), [0.0, 0.0, 0.0]
        mode = self._mode if self._mode not in PROFILES else STATIONARY
        head = [0, mode, device.try_mode, position]
        if extended:
            result = device.wire.result(packets.SINGLE2, [*head, *spread, *errors, *spread, *tracker.air()])
        else:
            result = device.wire.result(packets.SINGLE, [*head, *spread[:2], *errors, *spread[:2], *tracker.air()])
        return change + result + self._status_changes(Event.READY)
