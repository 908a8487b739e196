"""Readings of the virtual machine for the server: by name, in the units of a control, as values of nodes."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from typing import Any

from asyncua import ua
from asyncua.ua.status_codes import StatusCodes

from errormotion.instruments.simulators.virtual_world.clock import EPOCH
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld

AXES = "XYZ"
State = dict[str, Any]
_MM, _PERCENT, _PER_MINUTE = 1e3, 1e2, 60.0
STEADY = 0.5
"""Largest difference from the set speed at which a spindle has reached it, 1/min."""


class Machine:
    """The readings at one instant, updated at each request.

    Parameters
    ----------
    world : VirtualWorld
    unavailable : callable
        Returns whether the machine is not reachable; all values then have a bad status.

    Attributes
    ----------
    time : ua.DateTime
        Time of the instant, on the clock of the world.
    """

    def __init__(self, world: VirtualWorld, unavailable: Callable[[], bool]) -> None:
        self._world = world
        self._unavailable = unavailable
        self._shown: dict[object, tuple[Any, ua.DateTime]] = {}  # by node: value, and time of its last change
        self.refresh()

    def refresh(self) -> None:
        """Read the machine."""
        state = self._world.commanded()
        self.time = ua.DateTime.fromisoformat((EPOCH + timedelta(seconds=state["time"])).isoformat())
        self._readings = readings(state)
        self._good = not self._unavailable()

    def reading(self, name: str) -> Any:
        """Return a reading; None if the machine has none with this name, or it is unknown."""
        return self._readings.get(name)

    def value(self, node: object, value: Any, kind: ua.VariantType) -> ua.DataValue:
        """Return the value of a node; None, or a machine that is not reachable, results in a bad status.

        The source timestamp is the time of the last change of value or status that a request has read (OPC 10000-4,
        7.11.3).
        """
        status = StatusCodes.Good
        if not self._good or value is None:
            value = None
            status = StatusCodes.BadNoData if self._good else StatusCodes.BadNotConnected
        state = (value, status)
        if node not in self._shown or self._shown[node][0] != state:
            self._shown[node] = state, self.time
        return ua.DataValue(
            ua.Variant() if value is None else ua.Variant(value, kind),
            ua.StatusCode(ua.UInt32(status)),
            SourceTimestamp=self._shown[node][1],
            ServerTimestamp=self.time,
        )

    def clock(self) -> ua.DataValue:
        """Return the time of the machine as the value of a node."""
        return ua.DataValue(ua.Variant(self.time, ua.VariantType.DateTime), ServerTimestamp=self.time)


def readings(state: State) -> dict[str, Any]:
    """Return the readings by name: positions in mm, feed in mm/min, speeds in 1/min, load in %.

    Parameters
    ----------
    state : dict
        State that the controller of the world displays.
    """
    moving = bool(state["running"] or state["stepping"])
    speed, wanted = state["spindle_speed"], state["commanded_spindle_speed"]
    values: dict[str, Any] = {
        "moving": moving,
        "homed": state["homed"],
        "mode": state["mode"],
        "program": state["program"],
        "feed": state["feed"] * _MM * _PER_MINUTE,
        "speed": abs(speed),
        "set speed": abs(wanted),
        "load": state["spindle_load"] * _PERCENT,
        "spindle": _spindle(speed, wanted),
        "direction": 0 if abs(speed) < STEADY else 1 if speed > 0 else 2,
    }
    for i, axis in enumerate(AXES):
        values[f"{axis}.actual"] = state["position"][i] * _MM
        values[f"{axis}.set"] = state["commanded_position"][i] * _MM
        # unknown during a motion
        values[f"{axis}.left"] = None if moving else 0.0
    return values


def _spindle(speed: float, wanted: float) -> int:
    """Return the state of the spindle by OPC 40502, Table 20."""
    if abs(speed - wanted) <= STEADY:
        return 1 if abs(wanted) > STEADY else 0
    return 2 if abs(speed) < abs(wanted) else 3
