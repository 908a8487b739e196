"""A simulated attocube IDS3010: JSON-RPC over TCP, three beams to reflectors at the tool of the virtual machine.

Written from the manufacturer's published clients and from logs of real devices, without the driver: see the page of the
device for the sources, and for assumptions (codes of errors, the count while a beam is broken).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.virtual_world.tracker_scene import TrackerScene, numbers, refraction_index
from errormotion.instruments.transports import Address

END = b"\r\n"
LONGEST = 4096
"""Largest request, bytes; a longer one without an end is a parse error."""
PICOMETRES = 1e12  # per m
AXES = 3
FAMILIES = ("ids", "sen")
"""Names of the functions of the sensor: com.attocube.ids until firmware 1.8, com.attocube.sen from 1.9 on."""
SINGLE_MODE = -1
"""The axis that the environmental unit expects: all axes."""

IDLE, STARTING, RUNNING = "system idle", "measurement starting", "measurement running"
ALIGN_STARTING, ALIGNING = "optics alignment starting", "optics alignment running"

NOT_IN_THIS_MODE, NOT_RUNNING, BAD_AXIS, BAD_VALUE, BEAM_BROKEN, NO_CONTRAST, NO_UNIT = 5, 6, 7, 8, 9, 10, 11
TEXTS = {
    0: ("ERROR_OK", "No error"),
    NOT_IN_THIS_MODE: ("ERROR_WRONG_MODE", "Not available in the present system mode"),
    NOT_RUNNING: ("ERROR_NOT_MEASURING", "The measurement is not running"),
    BAD_AXIS: ("ERROR_AXIS", "The axis is out of range"),
    BAD_VALUE: ("ERROR_VALUE", "The value is out of range"),
    BEAM_BROKEN: ("WARNING_BEAM_INTERRUPTED", "The beam was interrupted"),
    NO_CONTRAST: ("ERROR_CONTRAST", "The contrast is too low to start the measurement"),
    NO_UNIT: ("ERROR_ECU", "The environmental compensation unit is not connected"),
}
"""Name and message of each code: assumptions, since no public source lists them."""


class RefusedError(Exception):
    """The device refuses a function; ``code`` is the number of the error."""

    def __init__(self, code: int, *values: Any) -> None:
        super().__init__(code)
        self.code, self.values = code, values


class Beam:
    """One measurement axis: its count, m, and whether its beam has been broken since it was last cleared."""

    def __init__(self, direction: np.ndarray[Any, Any], scene: TrackerScene, scale: float) -> None:
        self.direction, self.scene, self._factor = direction, scene, 1.0 + scale
        self.reference = self.count = 0.0
        self.broken = False
        self._seen = 0.0

    def path(self, when: float) -> float:
        """Return the distance of the reflector along the beam, m, with the scale error of the device."""
        return float(self.scene.places(np.array([when]))[0] @ self.direction) * self._factor

    def start(self, when: float, distance: float) -> None:
        """Start counting, at a distance (m) found by the initialisation."""
        self._seen, self.reference, self.count, self.broken = self.path(when), distance, 0.0, False

    def follow(self, when: float, broken: bool) -> None:
        """Count up to a time; a broken beam does not count until it is cleared."""
        now = self.path(when)
        self.broken = self.broken or broken
        if not self.broken:
            self.count += now - self._seen
        self._seen = now

    def reset(self) -> None:
        """Set the count to zero."""
        self.reference, self.count = self.reference + self.count, 0.0


class SimulatedIds(SimulatedDevice):
    """An IDS3010 whose three sensor heads measure reflectors on the tool of the virtual machine.

    Further parameters of the address, for the axes ``n`` 1 to 3: ``beam<n>`` (direction in machine coordinates in which
    the displacement increases; default X, Y, Z; plane mirrors, so that only the component along the beam counts),
    ``lever<n>`` (m, m, m, from the tool to its reflector), ``distance<n>`` (m, to the head, 0.5), ``noise`` (m, 2e-10),
    ``scale`` (relative error of all lengths), ``init`` (real time of a start, s, 0.02), ``contrast`` (permille, 840; a
    measurement does not start below 100), ``running`` (1: it is already measuring), ``aligning`` (1: its alignment is
    in progress), ``passes`` (1 or 2), ``ecu`` (1: an environmental unit is connected), ``api`` (1: an old firmware
    without ``api`` in requests), and ``lever``, ``thermal``, ``repeatability`` and ``air_...`` of `TrackerScene`.

    Further faults, from ``fault_at`` on, ``fault_for`` times: ``beam_broken`` (readings of the beams ``broken``,
    default ``1,2,3``) and ``refuse`` (answers; ``code``, default 8, is the number of the error).
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "late", "beam_broken", "refuse")

    def __init__(self, address: Address) -> None:
        super().__init__(address, line_end=END, default_name="ids")
        try:
            self._set_up(address)
        except (InstrumentError, ValueError) as error:
            self.close()
            raise InstrumentError(
                f"'{address.url}' has invalid parameters of an interferometer: {error}", code="simulator.setting"
            ) from None

    def _set_up(self, address: Address) -> None:
        self._noise, self._init = address.number("noise", 2e-10), address.number("init", 0.02)
        self._contrast, self._passes = int(address.number("contrast", 840)), int(address.number("passes", 1)) - 1
        self._unit = bool(address.number("ecu", 1))
        self._old, self._code = address.number("api", 2) < 2, int(address.number("code", BAD_VALUE))
        self._families = tuple(address.params.get("functions", ",".join(FAMILIES)).split(","))
        if not set(self._families) <= set(FAMILIES):
            raise InstrumentError(f"'functions': expected some of {', '.join(FAMILIES)}", code="simulator.setting")
        self._breaks = {int(each) - 1 for each in numbers(address, "broken", "1,2,3")}
        self._beams = [self._beam(address, axis) for axis in range(AXES)]
        self._distances = [address.number(f"distance{axis + 1}", 0.5) for axis in range(AXES)]
        self._average, self._quick, self._error, self._readings = 0, 0, 0, 0
        self._target, self._ready = IDLE, 0.0
        if address.number("running", 0):
            self._target = RUNNING
            self._count_from_here()
        elif address.number("aligning", 0):
            self._target = ALIGNING

    def _beam(self, address: Address, axis: int) -> Beam:
        default = ",".join("1" if axis == each else "0" for each in range(AXES))
        direction = np.array(numbers(address, f"beam{axis + 1}", default))
        if direction.shape != (3,) or not np.linalg.norm(direction) > 0.0:
            raise InstrumentError(f"'beam{axis + 1}': expected a direction of three numbers", code="simulator.setting")
        lever = address.params.get(f"lever{axis + 1}", address.params.get("lever", "0,0,0"))
        scene = TrackerScene(self.world, replace(address, params={**address.params, "lever": lever}))
        return Beam(direction / np.linalg.norm(direction), scene, address.number("scale", 0.0))

    # ------------------------------------------------------------------ requests

    def connection_opened(self) -> None:
        """Discard an incomplete request of the previous connection."""
        self._buffer = b""

    def _on_data(self, data: bytes) -> None:
        """Answer a request as soon as its object is complete; further bytes in the same segment make it invalid."""
        self._buffer += data
        text = self._buffer.strip()
        if not text:
            self._buffer = b""
            return
        end = _object_end(text)
        if end is None and len(text) <= LONGEST:
            return
        self._buffer = b""
        self.reply(self.answer(text))

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request."""
        try:
            message = json.loads(request)
            method, number, params = message["method"], message["id"], message.get("params") or []
            old = self._old or "api" not in message
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError):
            error = {"code": -32700, "message": "Parse Error", "data": "SyntaxError: Unexpected token in JSON"}
            return _line({"jsonrpc": "2.0", "id": None, "error": error})
        function = self._function(method) if isinstance(method, str) else None
        if function is None:
            error = {"code": -32099, "message": "org.freedesktop.DBus.Error.UnknownMethod"}
            return _line({"id": number, "jsonrpc": "2.0", "error": error})
        result = self._result(function, params)
        if old and len(result) == 2 and "Displacement" not in method and "Position" not in method:
            result = result[1:]  # an old firmware returns only the value
        return _line({"jsonrpc": "2.0", "id": number, "result": result})

    def _result(self, function: Callable[..., Sequence[Any]], params: Any) -> list[Any]:
        if self.fault.affects("refuse", self._answers):
            return [self._code]
        try:
            values = function(*params) if isinstance(params, list) else function(**params)
            return [0, *values]
        except RefusedError as refused:
            return [refused.code, *refused.values]
        except TypeError:
            return [BAD_VALUE]

    def _function(self, method: str) -> Callable[..., Sequence[Any]] | None:
        """Return the function for a method, such as ``_system_resetAxes`` for com.attocube.ids.system.resetAxes."""
        groups = {"com.attocube.ecu.": "_ecu_", "com.attocube.system.": "_service_"}
        for family in self._families:
            for group in ("displacement", "system", "axis", "adjustment"):
                groups[f"com.attocube.{family}.{group}."] = f"_{group}_"
        for prefix, group in groups.items():
            if method.startswith(prefix) and method.removeprefix(prefix).isidentifier():
                return getattr(self, group + method.removeprefix(prefix), None)
        return None

    # ------------------------------------------------------------------ modes

    def _mode(self) -> str:
        starting = {RUNNING: STARTING, ALIGNING: ALIGN_STARTING}.get(self._target)
        if starting is not None and time.monotonic() < self._ready:
            return starting
        if self._target == RUNNING and self._contrast < 100:
            self._target, self._error = IDLE, NO_CONTRAST
        return self._target

    def _system_getCurrentMode(self) -> Sequence[Any]:
        return (self._mode(),)

    def _system_startMeasurement(self) -> Sequence[Any]:
        self._start(RUNNING)
        self._count_from_here()
        return ()

    def _system_startOpticsAlignment(self) -> Sequence[Any]:
        self._start(ALIGNING)
        return ()

    def _start(self, mode: str) -> None:
        if self._mode() != IDLE:
            raise RefusedError(NOT_IN_THIS_MODE)
        self._target, self._ready, self._error = mode, time.monotonic() + self._init, 0

    def _count_from_here(self) -> None:
        for beam, distance in zip(self._beams, self._distances, strict=True):
            beam.start(self.world.time, distance)

    def _system_stopMeasurement(self) -> Sequence[Any]:
        return self._stop(RUNNING)

    def _system_stopOpticsAlignment(self) -> Sequence[Any]:
        return self._stop(ALIGNING)

    def _stop(self, mode: str) -> Sequence[Any]:
        if self._mode() != mode:
            raise RefusedError(NOT_IN_THIS_MODE)
        self._target = IDLE
        return ()

    def _system_getSystemError(self) -> Sequence[Any]:
        error, self._error = self._error, 0
        if error:
            raise RefusedError(error)
        return ()

    def _system_getDeviceType(self) -> Sequence[Any]:
        return ("IDS3010",)

    def _system_setInitMode(self, mode: int) -> Sequence[Any]:
        if mode not in (0, 1):
            raise RefusedError(BAD_VALUE)
        self._quick = int(mode)
        return ()

    def _system_resetAxes(self) -> Sequence[Any]:
        self._counts()
        for beam in self._beams:
            beam.reset()
        return ()

    def _system_resetAxis(self, axis: int) -> Sequence[Any]:
        beam = self._of(axis)
        self._counts()
        beam.reset()
        return ()

    def _system_resetError(self, perform: bool) -> Sequence[Any]:
        if not isinstance(perform, bool | int):
            raise RefusedError(BAD_VALUE)
        self._measuring()
        broken = self._broken_now()
        for axis, beam in enumerate(self._beams):
            beam.follow(self.world.time, False)
            beam.broken = axis in broken
        return ()

    # ------------------------------------------------------------------ displacement

    def _measuring(self) -> None:
        if self._mode() != RUNNING:
            raise RefusedError(NOT_RUNNING, *(AXES * (0,)))

    def _of(self, axis: Any) -> Beam:
        if axis not in range(AXES) or isinstance(axis, bool):
            raise RefusedError(BAD_AXIS)
        return self._beams[int(axis)]

    def _broken_now(self) -> set[int]:
        return self._breaks if self.fault.affects("beam_broken", self._readings) else set()

    def _counts(self) -> list[int]:
        """Return the displacements, pm."""
        self._measuring()
        broken = self._broken_now()
        for axis, beam in enumerate(self._beams):
            beam.follow(self.world.time, axis in broken)
        self._readings += 1
        noise = self._noise * self._rng.normal(size=AXES)
        return [round((beam.count + each) * PICOMETRES) for beam, each in zip(self._beams, noise, strict=True)]

    def _warned(self, values: Sequence[int], beams: Sequence[Beam]) -> Sequence[Any]:
        if any(beam.broken for beam in beams):
            raise RefusedError(BEAM_BROKEN, *values)
        return values

    def _displacement_getAxesDisplacement(self) -> Sequence[Any]:
        return self._warned(self._counts(), self._beams)

    def _displacement_getAxisDisplacement(self, axis: int) -> Sequence[Any]:
        beam = self._of(axis)
        return self._warned([self._counts()[axis]], [beam])

    def _references(self) -> list[int]:
        return [round(beam.reference * PICOMETRES) for beam in self._beams]

    def _displacement_getAbsolutePositions(self) -> Sequence[Any]:
        values = [a + b for a, b in zip(self._counts(), self._references(), strict=True)]
        return self._warned(values, self._beams)

    def _displacement_getAverageN(self) -> Sequence[Any]:
        return (self._average,)

    def _displacement_setAverageN(self, value: int) -> Sequence[Any]:
        if value not in range(25):
            raise RefusedError(BAD_VALUE)
        self._average = int(value)
        return ()

    # ------------------------------------------------------------------ axes, alignment, air, names

    def _axis_getPassMode(self) -> Sequence[Any]:
        return (self._passes,)

    def _ecu_getEnabled(self) -> Sequence[Any]:
        return (True,)

    def _ecu_getConnected(self) -> Sequence[Any]:
        return (self._unit,)

    def _air(self) -> tuple[float, float, float]:
        if not self._unit:
            raise RefusedError(NO_UNIT, 0.0)
        return self._beams[0].scene.air()

    def _ecu_getTemperatureInDegrees(self) -> Sequence[Any]:
        return (round(self._air()[0], 3),)

    def _ecu_getPressureInHPa(self) -> Sequence[Any]:
        return (round(self._air()[1] / 100.0, 3),)

    def _ecu_getHumidityInPercent(self) -> Sequence[Any]:
        return (round(self._air()[2], 3),)

    def _ecu_getRefractiveIndex(self) -> Sequence[Any]:
        return (refraction_index(*self._air()),)

    def _ecu_getRefractiveIndexForCompensation(self, axis: int) -> Sequence[Any]:
        if axis != SINGLE_MODE:
            raise RefusedError(BAD_AXIS, 0.0)
        return self._ecu_getRefractiveIndex() if self._unit else (1.0,)

    def _service_getSerialNumber(self) -> Sequence[Any]:
        return ("L000S0042",)

    def _service_getFirmwareVersion(self) -> Sequence[Any]:
        return ("1.9.1" if "sen" in self._families else "1.7.0",)

    def _service_errorNumberToString(self, language: int, number: int) -> Sequence[Any]:
        if language not in (0, 1):
            raise RefusedError(BAD_VALUE)
        return (TEXTS.get(number, ("ERROR_UNKNOWN", "Unknown error"))[language],)


def _object_end(text: bytes) -> int | None:
    """Return the end of the first object of a text; None if it is incomplete; 0 if it is not an object."""
    if not text.startswith(b"{"):
        return 0
    depth, quoted, escaped = 0, False, False
    for k, byte in enumerate(text):
        if quoted:
            quoted = escaped or byte != 0x22
            escaped = byte == 0x5C and not escaped
        elif byte == 0x22:
            quoted = True
        elif byte in b"{[":
            depth += 1
        elif byte in b"}]":
            depth -= 1
            if depth == 0:
                return k + 1
    return None


def _line(reply: dict[str, Any]) -> bytes:
    """Return a reply with its line end, in the compact form of the device."""
    return json.dumps(reply, separators=(",", ":"), allow_nan=False).encode() + END
