"""A virtual machine under a real LinuxCNC, which probes the balls of the twin.

The device forwards messages between the driver and the bridge. Before each command it sets the positions of the balls
in HAL, minus the error of the tip there, so that the probe in the servo thread trips at the positions of the twin. The
world's clock advances with the real time of motion, and at once with ``elapse``.

Parameters of the address in addition to the common ones: ``ready`` (1; 0: in e-stop and not homed, as after power-on),
``unit`` (``mm`` or ``inch``, of the INI file), ``route`` (of a compensation: ``external`` or ``feedback``), ``limit``
and ``slew`` (of a compensation, 50 um and 1 um/s), ``linger`` (10 s; time for which LinuxCNC continues after the last
driver has closed; it always ends with the process), ``wait`` (90 s; time limit for the end of another simulated
LinuxCNC on this computer).
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.controller.linuxcnc import BRIDGE, COMPENSATION
from errormotion.instruments.simulators.controller.linuxcnc_config import (
    PINS,
    Compensated,
    hal_text,
    ini_text,
    pin_values,
)
from errormotion.instruments.simulators.controller.linuxcnc_process import LinuxCNCProcess
from errormotion.instruments.simulators.controller.linuxcnc_servo import ServoThreadPart
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld
from errormotion.instruments.transports import Address, Transport, open_transport

LINGER = 10.0  # s
START_TIMEOUT = 90.0  # s
MIN_IDLE = 5.0  # s, minimum time for which LinuxCNC waits for its first driver
OWN = "simulator"
"""Prefix of the numbers of the simulator's requests."""
ANSWER_TIMEOUT = 10.0  # s
CHECK_INTERVAL = 0.1  # s between two checks whether the device is still open

Message = dict[str, Any]


class Control:
    """A running LinuxCNC, its world, and the devices that share it."""

    def __init__(self, world: VirtualWorld, address: Address) -> None:
        self.world = world
        self.inch = address.params.get("unit", "mm") == "inch"
        self.ready = bool(address.number("ready", 1))
        self.users = 0
        self.lock = threading.RLock()
        self._seen: float | None = None  # time of the bridge up to which the world's clock has advanced
        self._moving = False
        self._speed = 0.0
        self.process = self._start_process(address)

    def _start_process(self, address: Address) -> LinuxCNCProcess:
        machine, linger = self.world.machine, address.number("linger", LINGER)
        own = "--socket {folder}/bridge.sock --token {folder}/token --announce {folder}/bridge.json"
        arguments = f"--compensate --idle {max(linger, MIN_IDLE):g} --pins {PINS} {own}"  # at most 255 characters
        ini = ini_text(
            self.world.name,
            machine.travel,
            machine.rapid,
            machine.top_speed,
            arguments=arguments,
            inch=self.inch,
            compensated=_compensated(address),
        )
        files = {
            "linuxcnc.ini": ini,
            "balls.hal": hal_text(len(self.world.balls)),
            COMPENSATION.name: COMPENSATION.read_text(),
        }
        return LinuxCNCProcess(files, BRIDGE, wait=address.number("wait", START_TIMEOUT))

    def join(self, world: VirtualWorld) -> None:
        """Register a device; use its world if it is another one."""
        with self.lock:
            self.users += 1
            if self.world is not world:
                self.world, self._seen, self._moving, self._speed = world, None, False, 0.0

    def leave(self, linger: float) -> None:
        """Unregister a device; without ``linger`` LinuxCNC ends with its last device."""
        with self.lock:
            self.users -= 1
            if linger <= 0 and self.users == 0:
                self.process.end()

    def follow(self, time: float, moving: bool) -> None:
        """Advance the world's clock by the time of motion since the last call."""
        with self.lock:
            passed = 0.0 if self._seen is None or not self._moving else time - self._seen
            self._seen, self._moving = time, moving
            if passed > 0:
                with suppress(InstrumentError):  # streams drive the clock
                    self.world.elapse(passed)

    def turn(self, speed: float) -> None:
        """Set the speed of the twin's spindle to the commanded speed."""
        with self.lock:
            if speed != self._speed:
                self._speed = speed
                self.world.spindle(abs(speed))

    # ------------------------------------------------------------------ the probe

    def balls_for(self, start: list[float], target: list[float] | None, feed: float | None) -> dict[str, float]:
        """Return the pins with the present positions of the balls.

        On the path from the start to the target the probe trips where the twin does, with its scatter and the lobes of
        its pre-travel; elsewhere with its mean pre-travel.
        """
        world, now = self.world, self.world.time
        machine, balls = world.machine, world.balls
        if world.tool != "probe":
            return {f"{PINS}{ball}.trip.in1": 0.0 for ball in range(len(balls))}
        centres = balls.centre - machine.probe_error(balls.centre, np.full(len(balls), now))
        contact_distance = balls.radius + machine.probe.tip_radius - machine.probe.mean
        if target is not None:
            contact, distance = machine.contact(start, target, now, feed, balls=balls)
            if contact is not None and distance > 0:
                distances = np.linalg.norm(contact - centres, axis=1)
                nearest = int(np.argmin(np.abs(distances - contact_distance)))
                contact_distance[nearest] = distances[nearest]
        pins: dict[str, float] = {}
        for ball, (centre, radius) in enumerate(zip(centres.tolist(), contact_distance.tolist(), strict=True)):
            pins |= pin_values(ball, tuple(centre), radius, inch=self.inch)
        return pins


Key = tuple[str, int, bool, str, float, Compensated]

_controls: dict[Key, Control] = {}
_lock = threading.Lock()


def _compensated(address: Address) -> Compensated:
    default = Compensated()
    limit, slew = address.number("limit", 1e6 * default.limit), address.number("slew", 1e6 * default.slew)
    return Compensated(address.params.get("route", default.route), 1e-6 * limit, 1e-6 * slew)


def _control(world: VirtualWorld, address: Address) -> Control:
    """Return the running LinuxCNC of a world; reuse one that lingers after a world with the same parameters.

    Raises
    ------
    InstrumentError
        LinuxCNC is not installed, does not start, or runs for another world.
    """
    warm, ready = world.machine.sensors_on_for > 0, address.number("ready", 1)
    key = (world.name, world.seed, warm, address.params.get("unit", "mm"), ready, _compensated(address))
    with _lock:
        control = _controls.get(key)
        if control is None or not control.process.running:
            _end_unused()
            control = _controls[key] = Control(world, address)
        control.join(world)
        return control


def _end_unused() -> None:
    for key, control in list(_controls.items()):
        if control.users and control.process.running:
            raise InstrumentError(
                f"A computer can only run one LinuxCNC; it runs for {key[0]} with seed {key[1]}: "
                "close that driver first, or use the same seed and parameters in both addresses",
                code="simulator.linuxcnc.used",
            )
        control.process.end()
        del _controls[key]


def end() -> None:
    """End a LinuxCNC that lingers."""
    with _lock:
        _end_unused()


class SimulatedLinuxCNC(SimulatedDevice):
    """Forwards messages between the driver and the bridge of a real LinuxCNC."""

    faults = ("silence", "split", "garbage", "drop", "disconnect", "late")

    def __init__(self, address: Address) -> None:
        self._numbers = 0
        self._then: dict[str, Callable[[Message], None]] = {}
        self._requests: dict[Any, str] = {}
        self._closed = False
        self._own_error = ""  # error of the simulator's own requests
        self._controls = False  # whether the driver may move the machine
        super().__init__(address, line_end=b"\n", default_name="linuxcnc")
        self._linger = address.number("linger", LINGER)
        try:
            self._control = _control(self.world, address)
        except BaseException:
            super().close()
            raise
        unit, found = 25.4e-3 if self._control.inch else 1e-3, _compensated(address)
        self.machine = ServoThreadPart(
            unit, found.slew, found.watchdog, lambda: self._forward({"id": OWN, "op": "estop"})
        )
        try:
            self._bridge: Transport = open_transport(f"unix://{self._control.process.socket}", timeout=ANSWER_TIMEOUT)
            try:
                ready = self._control.users == 1 and self._control.ready
                self._wait_for("hello", token=self._control.process.token, control=ready, client=OWN)
                if ready:
                    self._make_ready()
                    self._wait_for("hello", token=self._control.process.token, control=False, client=OWN)
            except BaseException:
                self._bridge.close()
                raise
        except BaseException:
            self._control.leave(self._linger)
            super().close()
            raise
        self._pump = threading.Thread(target=self._carry_back, name=f"sim-{self.name}-bridge", daemon=True)
        self._pump.start()

    def close(self) -> None:
        """Disconnect; LinuxCNC ends ``linger`` s after its last device. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self.machine.busy = ""
        self._pump.join()
        self._bridge.close()
        self._control.leave(self._linger)
        super().close()

    @property
    def driver_settings(self) -> dict[str, str]:
        """Settings with which a driver or a compensator connects at `url`."""
        return {"token_file": str(self._control.process.folder / "token")}

    # ------------------------------------------------------------------ to the bridge

    def answer(self, request: bytes) -> bytes:
        """Not used: answers come from the bridge."""
        raise NotImplementedError

    def _on_data(self, data: bytes) -> None:
        self._buffer += data
        while self._line_end in self._buffer:
            line, _, self._buffer = self._buffer.partition(self._line_end)
            try:
                request = json.loads(line)
                number, op = request["id"], request["op"]
            except (ValueError, KeyError, TypeError):
                self._forward_line(line + b"\n")  # the bridge answers with the error
                continue
            if op == "hello":  # a simulated machine needs no token
                request["token"] = self._control.process.token
            self._requests[number] = op
            if op in ("elapse", "move_to", "probe", "run_program"):
                self._request_state(partial(self._prepared, request))
            else:
                self._forward(request)

    def _request_state(self, then: Callable[[Message], None]) -> None:
        self._numbers += 1
        number = f"{OWN} {self._numbers}"
        self._then[number] = then
        self._forward({"id": number, "op": "state"})

    def _prepared(self, request: Message, state: Message) -> None:
        """Forward a command that depends on the state."""
        op, start = request["op"], state["commanded_position"]
        if op == "elapse" and not state["ordered"]:
            self._jump(request)
            return
        if op != "elapse" and not state["ordered"]:
            self._set_balls(op, start, request)
        self._forward(request)

    def _jump(self, request: Message) -> None:
        try:
            self.world.elapse(float(request.get("seconds", np.nan)))
        except (InstrumentError, TypeError, ValueError) as error:
            self._send({"id": request["id"], "ok": False, "error": str(error)})
        else:
            self._send({"id": request["id"], "ok": True, "result": None})

    def _set_balls(self, op: str, start: list[float], request: Mapping[str, Any]) -> None:
        if not self._controls:
            return
        if op == "probe":
            self.world.tool = "probe"  # mounted automatically for probing
        try:
            target = request.get("target") if op == "probe" else None
            pins = self._control.balls_for(start, target, request.get("feed"))
        except (ValueError, TypeError, ArithmeticError):
            return  # no position or no feed: the bridge answers with the error
        self._forward({"id": OWN, "op": "set_pins", "pins": pins})

    def _forward(self, request: Message) -> None:
        self._forward_line(json.dumps(request).encode() + b"\n")

    def _forward_line(self, line: bytes) -> None:
        with suppress(InstrumentError):  # the other thread detects this and disconnects
            self._bridge.write(line)

    # ------------------------------------------------------------------ from the bridge

    def _make_ready(self) -> None:
        """Release the e-stop, switch on, home, and stop the spindle, before the driver connects."""
        self._wait_for("reset")
        self._wait_for("enable")
        if not self._wait_for("state")["homed"]:
            self._wait_for("home")
        self._wait_for("spindle", speed=0.0)

    def _wait_for(self, op: str, **arguments: Any) -> Any:
        self._forward({"id": OWN, "op": op, **arguments})
        while True:
            message = json.loads(self._bridge.read_until(b"\n"))
            if "beat" not in message:
                break
        if not message["ok"]:
            raise InstrumentError(f"The simulated LinuxCNC refuses '{op}': {message['error']}", code="linuxcnc.refused")
        return message["result"]

    def _carry_back(self) -> None:
        buffer = b""
        while not self._closed:
            try:
                buffer += self._bridge.read(timeout=CHECK_INTERVAL)
            except InstrumentTimeoutError:
                continue
            except InstrumentError:
                self._server.disconnect()
                return
            *lines, buffer = buffer.split(b"\n")
            for line in lines:
                self._carry(json.loads(line))

    def _carry(self, message: Message) -> None:
        number, result = message["id"], message.get("result")
        state = result if isinstance(result, dict) and "spindle_commanded" in result else None
        beating = "beat" in message
        running = bool(message["running"] if beating else state["running"] if state else False)
        if beating or state or self._requests.get(number) in ("move_to", "probe", "home"):
            self._control.follow(message["time"], running)
        if state:
            self._control.turn(state["spindle_commanded"])
        if isinstance(number, str) and number.startswith(OWN):
            then = self._then.pop(number, None)
            if then is not None and state:
                then(state)
            elif not message["ok"]:
                self._own_error = str(message["error"])
            return
        if self._requests.get(number) == "hello":
            self._controls = bool(result and result["control"])
            self._requests.pop(number)
            with self._server.lock:  # not an answer to which faults apply
                self._server.send(json.dumps(message).encode() + b"\n")
            return
        if self._own_error:
            message = {"id": number, "ok": False, "error": f"error of the simulated probe: {self._own_error}"}
        if not beating and self._requests.pop(number, None) == "set_offset" and message["ok"]:
            self.machine.orders += 1
        if isinstance(result, dict):
            if "time" in result:
                result["time"] = self.world.time
            if "serial_number" in result:
                result["serial_number"] = f"seed {self.world.seed}"
        self._send(message)

    def _send(self, message: Message) -> None:
        line = json.dumps(message).encode() + b"\n"
        if "beat" in message:
            with self._server.lock:
                self._server.send(line)
        else:
            self.reply(line)
            if self.fault.kind == "disconnect" and self._answers > self.fault.at:
                self._bridge.close()  # so that the bridge also detects the loss
