"""The controller of the virtual machine: what it is told, it does to the world."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from errormotion.errors import ErrormotionError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.virtual_world import LEAD_IN
from errormotion.instruments.transports import Address
from errormotion.twin import Event


class SimulatedController(SimulatedDevice):
    """Answers requests in JSON lines."""

    faults = ("silence", "split", "garbage", "drop", "disconnect")

    def __init__(self, address: Address) -> None:
        super().__init__(address, line_end=b"\n", default_name="controller")

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request."""
        number: Any = None
        try:
            message = json.loads(request)
            number = message.pop("id")
            reply = {"id": number, "ok": True, "result": self._obey(message.pop("op"), message)}
        except ErrormotionError as error:
            reply = {"id": number, "ok": False, "error": str(error)}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            reply = {"id": number, "ok": False, "error": f"this is no request: {error!r}"}
        return json.dumps(reply).encode() + b"\n"

    def _obey(self, op: str, arguments: Mapping[str, Any]) -> Any:
        world = self.world
        match op:
            case "identify":
                return {"manufacturer": "errormotion", "model": world.name, "serial_number": f"seed {world.seed}"}
            case "state":
                return {**world.commanded(), "position": world.position(), "tool": world.tool, "alarms": []}
            case "mount":
                world.mount(**arguments)
            case "start":
                world.start([Event(**event) for event in arguments["schedule"]])
            case "elapse":
                world.elapse(**arguments)
            case "run_steps":
                program = world.run_steps(**arguments)
                return {"duration": program.duration, "longest_lead_in": LEAD_IN[1]}
            case "run_program":
                path = world.run_program(**arguments)
                return {"duration": path.duration, "longest_lead_in": LEAD_IN[1]}
            case "move_to":
                return {"duration": world.move_to(**arguments)}
            case "set_target":
                world.set_target(**arguments)
            case "set_station":
                world.set_station(**arguments)
            case _:
                raise ValueError(f"no such operation: {op}")
        return None
