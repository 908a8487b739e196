"""The controller of the virtual machine: executes commands in the world."""

from __future__ import annotations

import json
from typing import Any, Literal

from errormotion.errors import ErrormotionError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.virtual_world.world import LEAD_IN
from errormotion.instruments.transports import Address
from errormotion.twin import Event

MACHINE_FAULTS = ("alarm", "estop", "no_trip", "tripped")


class SimulatedController(SimulatedDevice):
    """Answers requests in JSON lines.

    Further parameters of the address: ``balls`` (number on the table; 4). Further faults, counted in requests:
    ``alarm`` and ``estop`` (at request ``fault_at`` the machine sets an alarm or the emergency stop), ``no_trip`` and
    ``tripped`` (from then on, for ``fault_for`` requests or permanently, the probe never trips, or is stuck).
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "late", *MACHINE_FAULTS)

    def __init__(self, address: Address) -> None:
        super().__init__(address, line_end=b"\n", default_name="controller")
        if "balls" in address.params:
            self.world.balls = self.world.machine.balls_on_table(int(address.number("balls", 0)))

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request."""
        number: Any = None
        try:
            self._apply_fault()
            message = json.loads(request)
            number = message.pop("id")
            reply = {"id": number, "ok": True, "result": self._execute(message.pop("op"), message)}
        except ErrormotionError as error:
            reply = {"id": number, "ok": False, "error": str(error)}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            reply = {"id": number, "ok": False, "error": f"expected a request in JSON: {error!r}"}
        return json.dumps(reply).encode() + b"\n"

    def _apply_fault(self) -> None:
        """Apply a fault of the machine at this request."""
        if self.fault.kind == "alarm" and self._answers == self.fault.at:
            self.world.raise_alarm("servo alarm (simulated)")
        if self.fault.kind == "estop" and self._answers == self.fault.at:
            self.world.press_estop()
        if self.fault.kind in ("no_trip", "tripped"):
            broken = self.fault.affects(self.fault.kind, self._answers)
            how: Literal["open", "closed"] = "open" if self.fault.kind == "no_trip" else "closed"
            self.world.stuck = how if broken else None

    def _execute(self, op: str, arguments: dict[str, Any]) -> Any:
        world = self.world
        match op:
            case "identify":
                return {"manufacturer": "errormotion", "model": world.name, "serial_number": f"seed {world.seed}"}
            case "state":
                return world.commanded()
            case "mount":
                world.mount(**arguments)
            case "start":
                world.start([Event(**event) for event in arguments["schedule"]])
            case "follow":
                world.follow([Event(**event) for event in arguments["schedule"]], float(arguments["time"]))
            case "snapshot":
                return world.snapshot()
            case "restore":
                world.restore(**arguments)
            case "elapse":
                world.elapse(**arguments)
            case "run_steps":
                program = world.run_steps(**arguments)
                return {"duration": program.duration, "longest_lead_in": LEAD_IN[1]}
            case "run_program":
                path = world.run_program(**arguments)
                return {"duration": path.duration, "longest_lead_in": LEAD_IN[1]}
            case "move_to":
                limit = arguments.pop("feed_limit", None)
                if arguments.get("feed") is None and limit is not None and limit < world.machine.rapid:
                    arguments = {**arguments, "feed": limit}
                return {"duration": world.move_to(**arguments)}
            case "probe":
                return world.probe(**arguments)
            case "spindle":
                world.spindle(**arguments)
            case "stop":
                world.stop()
                if arguments["spindle"]:
                    world.spindle(0.0)
            case "estop":
                world.press_estop()
            case "reset":
                world.reset_alarms()
            case "set_target":
                world.set_target(**arguments)
            case "set_station":
                world.set_station(**arguments)
            case _:
                raise ValueError(f"unknown operation: {op}")
        return None
