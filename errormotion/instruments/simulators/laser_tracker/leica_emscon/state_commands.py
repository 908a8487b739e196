"""Commands about the state of the server: status, units, coordinates, settings, reflectors, air.

Each method has the name of its command and takes its values in SI; it returns a status, the values of the reply, or all
packets.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from errormotion.instruments.simulators.laser_tracker.leica_emscon import packets
from errormotion.instruments.simulators.laser_tracker.leica_emscon.information import REFLECTORS, SERIAL
from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import SYSTEMS, Units
from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import NUMBERS
from errormotion.instruments.simulators.laser_tracker.leica_emscon.server import Server
from errormotion.instruments.simulators.laser_tracker.leica_emscon.status import Event, Status, out_of_range, wrong
from errormotion.instruments.simulators.laser_tracker.leica_emscon.tracker import METEO_REFRACTION

METEO, TRANSFORMATION, ORIENTATION, KEEP, UNSOLICITED, POSITION, TRY, LEVEL, CAMERA = range(9)
"""Positions in the system settings."""
LIMITS_OF_AIR = ((-20.0, 60.0), (50_000.0, 120_000.0), (0.0, 100.0))
"""degC, Pa, %: accepted values (assumed)."""
LIMITS_OF_INDEX = (1.0, 1.0005)


class StateCommands:
    """State that a client sets and reads.

    Parameters
    ----------
    device : Server
    """

    def __init__(self, device: Server) -> None:
        self._device = device
        self.system = [0, 0, 0, 0, 1, 1, 0, 1, 0]
        self._reflector = 1

    def do(self, name: str, values: Sequence[Any]) -> bytes | int | list[Any]:
        """Execute a command; return all packets, a status, or the values of the reply.

        The server has the commands of the driver and of CESAPI's client; others are not implemented.
        """
        command = getattr(self, f"_do_{name}", None)
        found: bytes | int | list[Any] = Status.NOT_IMPLEMENTED if command is None else command(*values)
        return found

    def set_block(self, number: int, values: list[Any]) -> bytes:
        """Set a block of parameters."""
        wire, block = self._device.wire, self._device.blocks[number]
        if status := block.check(values):
            return wire.reply(number, status)
        block.values = values
        return wire.reply(number) + (self._status_changes(block.event) if block.event is not None else b"")

    def _ok(self, name: str, values: Sequence[Any] | None = None) -> bytes:
        return self._device.wire.reply(NUMBERS[name], Status.OK, values)

    def _status_changes(self, *events: int) -> bytes:
        return self._device.status_changes(*events)

    # ------------------------------------------------------------------ state

    def _do_GetSystemStatus(self) -> list[Any]:
        meteo = self._device.tracker.meteo
        return [0, 5 if self._device.initialised else 4, 3, 2, *self._device.version, meteo, 0, SERIAL]

    def _do_GetTrackerStatus(self) -> list[Any]:
        if self._device.measuring:
            return [1]
        return [2 if self._ready else 0]

    @property
    def _ready(self) -> bool:
        return self._device.initialised and not self._device.tracker.broken

    # ------------------------------------------------------------------ units, coordinates, settings

    def _do_GetUnits(self) -> list[Any]:
        units = self._device.wire.units
        return [units.length, units.angle, units.temperature, units.pressure, units.humidity]

    def _do_SetUnits(self, *numbers: int) -> int | bytes:
        units = Units(*numbers)
        if units.wrong:
            return wrong(units.wrong)
        self._device.wire.units = units
        return self._ok("SetUnits") + self._status_changes(Event.UNITS)

    def _do_GetCoordinateSystemType(self) -> list[Any]:
        return [self._device.wire.system]

    def _do_SetCoordinateSystemType(self, kind: int) -> int | bytes:
        if not 0 <= kind < SYSTEMS:
            return wrong(1)
        self._device.wire.system = kind
        return self._status_changes(Event.COORDINATES) + self._ok("SetCoordinateSystemType")

    def _do_GetSystemSettings(self) -> list[Any]:
        return list(self.system)

    def _do_SetSystemSettings(self, *values: int) -> int | bytes:
        if not 0 <= values[METEO] <= METEO_REFRACTION:
            return wrong(1)
        for position, value in enumerate(values[1:], 2):
            if value not in (0, 1):
                return wrong(position)
        blocks = self._device.blocks
        turned = any(blocks[NUMBERS["SetStationOrientationParams"]].values)
        moved = blocks[NUMBERS["SetTransformationParams"]].values != [0.0] * 6 + [1.0]
        if (values[TRANSFORMATION] and moved) or (values[ORIENTATION] and turned):
            return Status.NOT_IMPLEMENTED  # the simulator does not transform coordinates
        self.system = list(values)
        self._device.tracker.meteo = values[METEO]
        return self._ok("SetSystemSettings") + self._status_changes(Event.SYSTEM_SETTINGS)

    # ------------------------------------------------------------------ reflectors

    def _do_GetReflectors(self) -> bytes:
        total = len(REFLECTORS)
        return b"".join(
            self._position() + self._ok("GetReflectors", [total, number, kind, offset, name])
            for number, (name, kind, offset) in enumerate(REFLECTORS, 1)
        )

    def _do_GetReflector(self) -> list[Any]:
        return [self._reflector]

    def _do_SetReflector(self, number: int) -> int | bytes:
        if not 1 <= number <= len(REFLECTORS):
            return wrong(1)
        self._reflector = number
        return self._ok("SetReflector") + self._status_changes(Event.REFLECTOR)

    # ------------------------------------------------------------------ air

    def _do_GetEnvironmentParams(self) -> list[Any]:
        return list(self._device.tracker.air())

    def _do_SetEnvironmentParams(self, *air: float) -> int | bytes:
        if not all(low <= value <= high for value, (low, high) in zip(air, LIMITS_OF_AIR, strict=True)):
            return Status.AIR_OUT_OF_RANGE
        self._device.tracker.set_air(*air)
        return self._ok("SetEnvironmentParams") + self._status_changes(Event.ENVIRONMENT, Event.REFRACTION)

    def _do_GetRefractionParams(self) -> list[Any]:
        index = self._device.tracker.index()
        return [index, index]

    def _do_SetRefractionParams(self, interferometer: float, absolute: float) -> int | bytes:
        low, high = LIMITS_OF_INDEX
        for position, value in enumerate((interferometer, absolute), 1):
            if not low <= value <= high:
                return out_of_range(position)
        tracker = self._device.tracker
        tracker.set_index(absolute if tracker.absolute else interferometer)
        return self._ok("SetRefractionParams") + self._status_changes(Event.REFRACTION)

    def _position(self) -> bytes:
        tracker = self._device.tracker
        if not self.system[POSITION] or tracker.broken:
            return b""
        return self._device.wire.result(packets.REFLECTOR, [0, tracker.now()])
