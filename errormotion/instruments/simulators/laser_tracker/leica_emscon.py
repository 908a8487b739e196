"""An emScon server with a tracker beside the virtual machine, on the wire."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from itertools import count
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.laser_tracker.leica_emscon import codec, statuses
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.virtual_world.tracker_scene import TrackerScene, cartesian, refraction_index
from errormotion.instruments.transports import Address

POINTS_A_PACKET = 20
CLOCK = 1000  # s, of the tracker when a stream starts
LENGTHS = {0: 1.0, 1: 1e3, 2: 1e6}  # units a metre
REFLECTORS = (("RRR 1.5in", 5, 19.05e-3), ("RRR 0.5in", 6, 6.35e-3), ("Cat's eye", 2, 0.0))
MODELS = {"AT901": (14, "AT901-MR", 80.0), "AT4xx": (72, "AT402", 160.0)}
NEST = (0.0, math.pi / 2, 0.3)  # direction (rad) and distance (m) of the position at the tracker for a reflector
CARRIED = 5e-3  # m, one sigma: deviation of a carried tracker from its station
BEAM_ERROR = 201  # (m): a number of the tracker processor


class SimulatedEmScon(SimulatedDevice):
    """A tracker that follows the reflector at the machine's tool.

    Further parameters of the address: those of `tracker_scene.TrackerScene`; ``tracker`` (``AT901`` or ``AT4xx``),
    ``noise`` (m, of one distance, 0.5e-6 as the driver states), ``angle_noise`` (rad, 3e-6), ``dead_path`` (m; else it
    is drawn: up to 10 mm whenever an interferometer takes up its reflector, up to 0.1 mm once for absolute distances),
    ``initialised`` (1), ``result`` (1 or 2: which packet a single measurement is).

    Between the answers come status changes, levels and reflector positions, as from the real one.

    Faults beyond the menu, from ``fault_at`` on, ``fault_for`` times (without end): ``busy`` (answers), ``beam_broken``
    (points, measurements and motions), ``refuse`` and ``error`` (answers; ``code`` is their status).
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "busy", "beam_broken", "refuse", "error")
    drops_answers = False  # `drop` and `disconnect` are about points of a stream

    def __init__(self, address: Address) -> None:
        super().__init__(address, line_end=b"", default_name="tracker", every=7)
        try:
            self._set_up(address)
        except (InstrumentError, KeyError, ValueError) as error:
            self.close()
            raise InstrumentError(f"'{address.url}' has invalid parameters of a tracker: {error}") from None

    def _set_up(self, address: Address) -> None:
        self.scene = TrackerScene(self.world, address, self._rng)
        self._absolute = address.params.get("tracker", "AT901") == "AT4xx"
        self._model = MODELS[address.params.get("tracker", "AT901")]
        self._noise = address.number("noise", 0.5e-6)
        self._angle_noise = address.number("angle_noise", 3e-6)
        self._given_dead_path = address.number("dead_path", math.nan)
        self._result = codec.SINGLE2 if address.number("result", 1) == 2 else codec.SINGLE
        self._code = int(address.number("code", 35))
        self._initialised = bool(address.number("initialised", 1))
        self._length = 1.0
        self._system = {"meteo": codec.METEO_OFF, "unsolicited": 1, "reflector_position": 1, "level": 1}
        self._set_air = (20.0, 101_325.0, 50.0)
        self._set_index = refraction_index(*self._set_air)
        self._reported_index = 0.0
        self._mode, self._milliseconds, self._reflector = codec.STATIONARY, 10, 1
        self._radius = 0.05
        self._tries = 0
        self._broken = False
        self._nested = False  # the reflector is in the nest at the tracker
        self.dead_path = self._new_dead_path()
        self._stop = threading.Event()
        self._sender: threading.Thread | None = None
        self._starting = False
        self._start_time = 0.0

    def close(self) -> None:
        """End the device and its stream."""
        if stop := getattr(self, "_stop", None):
            stop.set()
        super().close()
        self._end_stream()

    def report_delivered(self, samples: int) -> None:
        """Let the world's clock follow the reader, unless others drive it."""
        now = self._start_time + samples * self._milliseconds / 1000.0
        if not self.world.streaming and now > self.world.time:
            self.world.elapse(now - self.world.time)

    def carry_to(self, position: Sequence[float]) -> None:
        """Put the tracker near a position in machine coordinates, m, as people do; it counts from a new start."""
        self.scene.station = np.array(position, dtype=float) + CARRIED * self._rng.normal(size=3)
        self._broken = self._nested = False
        self.dead_path = self._new_dead_path()

    # ------------------------------------------------------------------ commands

    def _on_data(self, data: bytes) -> None:
        self._buffer += data
        while len(self._buffer) >= codec.HEADER.size + 4:
            size, _ = codec.HEADER.unpack_from(self._buffer)
            if not codec.HEADER.size + 4 <= size <= codec.MAX_PACKET_BYTES:
                self._buffer = b""
                self._server.disconnect()
                return
            if len(self._buffer) < size:
                return
            request, self._buffer = self._buffer[:size], self._buffer[size:]
            self.reply(self.answer(request))
            if self._starting:
                self._starting = False
                self._start_stream()

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one command, with what comes unrequested before and behind it."""
        try:
            number, values = codec.decode_command(request)
        except ProtocolError:
            return codec.encode_error(codec.UNKNOWN, 3)
        faulty = self._hits(self._answers)
        if faulty and self.fault.kind == "busy":
            return codec.encode_answer(number, statuses.BUSY)
        if faulty and self.fault.kind == "refuse":
            return codec.encode_answer(number, self._code)
        if faulty and self.fault.kind == "error":
            return codec.encode_error(number, self._code)
        if number not in codec.COMMANDS:
            return codec.encode_answer(number, statuses.NOT_IMPLEMENTED)
        act = getattr(self, f"_do_{codec.COMMANDS[number].name}", None)
        if act is None:
            return codec.encode_answer(number)
        done: bytes | int | dict[str, Any] = act(**values)
        if isinstance(done, bytes):
            return done
        return codec.encode_answer(number, done) if isinstance(done, int) else codec.encode_answer(number, 0, **done)

    def _hits(self, number: int) -> bool:
        fault = self.fault
        return number >= fault.at and (fault.length == 0 or number < fault.at + fault.length)

    def _said(self, *changes: int) -> bytes:
        return b"".join(map(codec.encode_change, changes)) if self._system["unsolicited"] else b""

    def _do_GetSystemStatus(self) -> dict[str, Any]:
        processor = codec.INITIALISED if self._initialised else 4
        version = {"major": 3, "minor": 8, "build": 900}
        return {"processor": processor, "laser": 3, "adm": 2, "serial_number": 390_000, **version}

    def _do_GetTrackerInfo(self) -> dict[str, Any]:
        kind, name, longest = self._model
        return {"type": kind, "name": name, "serial_number": 390_000, "adm": 1, "level": 1, "longest": longest}

    def _do_GetMeteoStationInfo(self) -> dict[str, Any]:
        return {"type": 2, "name": "AT MeteoStation", "major": 1, "minor": 0}

    def _do_SetUnits(self, length: int, angle: int, temperature: int, pressure: int, humidity: int) -> int | bytes:
        if length not in LENGTHS or any((angle, temperature, pressure, humidity)):
            return 3
        self._length = LENGTHS[length]
        return codec.encode_answer(codec.SET_UNITS) + self._said(statuses.UNITS_CHANGED)

    def _do_SetCoordinateSystemType(self, kind: int) -> int | bytes:
        if kind != codec.SPHERICAL:
            return statuses.NOT_IMPLEMENTED
        return self._said(statuses.COORDINATES_CHANGED) + codec.encode_answer(codec.SET_COORDINATES)

    def _do_Initialize(self) -> bytes:
        self._initialised = True
        level = codec.encode_result(codec.LEVEL, {"tilt_x": 1e-5, "tilt_y": -4e-6, "temperature": self.scene.air()[0]})
        before = self._said(statuses.MEASURE_BUSY, 151)
        return before + level + codec.encode_answer(codec.INITIALIZE) + self._said(statuses.MEASURE_READY)

    def _do_GetSystemSettings(self) -> dict[str, Any]:
        return self._system

    def _do_SetSystemSettings(self, **values: int) -> bytes:
        self._system = values
        return codec.encode_answer(codec.SET_SYSTEM_SETTINGS) + self._said(8)

    def _do_GetReflectors(self) -> bytes:
        return b"".join(
            self._position(codec.REFLECTOR)
            + codec.encode_answer(
                codec.GET_REFLECTORS,
                0,
                total=len(REFLECTORS),
                number=number,
                kind=kind,
                surface_offset=self._length * offset,
                name=name,
            )
            for number, (name, kind, offset) in enumerate(REFLECTORS, 1)
        )

    def _do_GetReflector(self) -> dict[str, Any]:
        return {"number": self._reflector}

    def _do_SetReflector(self, number: int) -> int | bytes:
        if not 1 <= number <= len(REFLECTORS):
            return 4
        self._reflector = number
        return codec.encode_answer(codec.SET_REFLECTOR) + self._said(7)

    def _do_SetSearchParams(self, radius: float, milliseconds: int) -> int | dict[str, Any]:
        self._radius = radius / self._length
        return {} if milliseconds > 0 and self._radius > 0 else 3

    # ------------------------------------------------------------------ air

    def _air(self, when: float | None = None) -> tuple[float, float, float]:
        """Return the air that the server reckons with."""
        return self._set_air if self._system["meteo"] == codec.METEO_OFF else self.scene.air(when)

    def _index(self, when: float | None = None) -> float:
        """Return the index by which the server divides."""
        if self._system["meteo"] == codec.METEO_REFRACTION:
            self._set_index = refraction_index(*self.scene.air(when))
        return self._set_index

    def _do_GetEnvironmentParams(self) -> dict[str, Any]:
        temperature, pressure, humidity = self._air()
        return {"temperature": temperature, "pressure": pressure / 100.0, "humidity": humidity}

    def _do_SetEnvironmentParams(self, temperature: float, pressure: float, humidity: float) -> int | bytes:
        if not (-20 <= temperature <= 60 and 500 <= pressure <= 1200 and 0 <= humidity <= 100):
            return 57
        self._set_air = (temperature, 100.0 * pressure, humidity)
        self._set_index = refraction_index(*self._set_air)
        changes = self._said(statuses.ENVIRONMENT_CHANGED, statuses.REFRACTION_CHANGED)
        return codec.encode_answer(codec.SET_ENVIRONMENT) + changes

    def _do_GetRefractionParams(self) -> dict[str, Any]:
        return {"ifm": self._index(), "adm": self._index()}

    def _do_SetRefractionParams(self, ifm: float, adm: float) -> int | bytes:
        if not (1.0 <= ifm <= 1.0005 and 1.0 <= adm <= 1.0005):
            return 12
        self._set_index = adm if self._absolute else ifm
        return codec.encode_answer(codec.SET_REFRACTION) + self._said(statuses.REFRACTION_CHANGED)

    # ------------------------------------------------------------------ beam

    def _new_dead_path(self) -> float:
        drawn = float(self._rng.uniform(-1.0, 1.0)) * (1e-4 if self._absolute else 1e-2)
        return drawn if math.isnan(self._given_dead_path) else self._given_dead_path

    def _try_beam(self) -> bytes:
        """Count one use of the beam; return what the server states where that breaks it or brings it back."""
        broken = self.fault.kind == "beam_broken" and self._hits(self._tries)
        self._tries += 1
        if broken and not self._broken:
            self._broken = True
            error = codec.encode_error(codec.UNKNOWN, BEAM_ERROR)
            return error + self._said(statuses.MEASURE_NOT_READY)
        return b""

    def _mends(self) -> bool:
        """Whether the beam can be taken up again: the fault is over."""
        return self._broken and not (self.fault.kind == "beam_broken" and self._hits(self._tries))

    def _lock(self) -> bytes:
        self._broken = False
        if not self._absolute:
            self.dead_path = self._new_dead_path()
        return self._said(statuses.DISTANCE_SET, statuses.MEASURE_READY)

    def _seen(self, times: np.ndarray[Any, Any] | None = None) -> np.ndarray[Any, Any]:
        """Return azimuth, zenith angle and distance as they are read, (n, 3), rad and m."""
        times = np.array([self.world.time]) if times is None else times
        true = np.tile(NEST, (len(times), 1)) if self._nested else self.scene.seen(times)
        noise = self._rng.normal(size=true.shape) * (self._angle_noise, self._angle_noise, self._noise)
        when = float(times[0])
        true[:, 2] *= refraction_index(*self.scene.air(when)) / self._index(when)
        true[:, 2] += self.dead_path
        return np.asarray(true + noise)

    def _position(self, kind: int) -> bytes:
        if not self._system["reflector_position"] or self._broken:
            return b""
        return codec.encode_result(kind, self._values(self._seen()[0]))

    def _values(self, seen: np.ndarray[Any, Any]) -> dict[str, float]:
        return {"val1": float(seen[0]), "val2": float(seen[1]), "val3": float(seen[2]) * self._length}

    def _do_GetDirection(self) -> dict[str, Any]:
        azimuth, zenith, _ = self._seen()[0]
        return {"azimuth": float(azimuth), "zenith": float(zenith)}

    def _do_GoBirdBath2(self, clockwise: int) -> bytes:  # noqa: ARG002 - which way round makes no difference here
        before, self._nested = self._try_beam(), True
        return self._moved(codec.GO_BIRD_BATH2, before, found=True)

    def _do_FindReflector(self, distance: float) -> bytes:  # noqa: ARG002 - it looks around the present direction
        return self._moved(codec.FIND_REFLECTOR, self._try_beam(), found=True)

    def _do_GoPosition(self, val1: float, val2: float, val3: float, use_adm: int) -> bytes:  # noqa: ARG002
        before = self._try_beam()
        return self._moved(codec.GO_POSITION, before, found=self._near(val1, val2, val3))

    def _near(self, azimuth: float, zenith: float, distance: float) -> bool:
        """Whether the reflector is within the search radius of a position; it is taken out of the nest for that."""
        self._nested = False
        wanted = cartesian(azimuth, zenith, distance / self._length)
        there = cartesian(*self.scene.seen(np.array([self.world.time]))[0])
        across = wanted - there * (wanted @ there) / (there @ there)
        return float(np.linalg.norm(across)) <= self._radius and float(wanted @ there) > 0

    def _moved(self, number: int, before: bytes, *, found: bool) -> bytes:
        before += self._said(statuses.MEASURE_BUSY)
        if not found or (self._broken and not self._mends()):
            self._broken = True
            after = self._said(statuses.MEASURE_NOT_READY)
            return before + after + codec.encode_answer(number, statuses.NO_RESULT)
        return before + self._lock() + codec.encode_answer(number)

    # ------------------------------------------------------------------ measuring

    def _do_GoAndMeasure(self, val1: float, val2: float, val3: float) -> bytes | int:
        if not self._absolute:
            return statuses.NOT_IMPLEMENTED
        before = self._try_beam() + self._said(statuses.MEASURE_BUSY)
        if not self._near(val1, val2, val3) or (self._broken and not self._mends()):
            self._broken = True
            refused = codec.encode_answer(codec.GO_AND_MEASURE, statuses.NO_RESULT)
            return before + self._said(statuses.MEASURE_NOT_READY) + refused
        self._broken = False
        return before + codec.encode_answer(codec.GO_AND_MEASURE) + self._single()

    def _do_StartMeasurement(self) -> bytes | int:
        if not self._initialised:
            return statuses.NOT_INITIALISED
        if self._mode == codec.CONTINUOUS_TIME:
            self._starting = True  # as soon as the answer is out
            return codec.encode_answer(codec.START_MEASUREMENT)
        before = self._try_beam()
        if self._broken:
            return before + codec.encode_answer(codec.START_MEASUREMENT, statuses.NOT_READY)
        busy = self._said(statuses.MEASURE_BUSY) + self._position(codec.REFLECTOR)
        return before + busy + codec.encode_answer(codec.START_MEASUREMENT) + self._single()

    def _single(self) -> bytes:
        temperature, pressure, humidity = self._air()
        change = b""
        if abs(self._index() - self._reported_index) > 1e-8:
            self._reported_index = self._index()
            change = self._said(statuses.REFRACTION_CHANGED)
        spread = {"std1": self._angle_noise, "std2": self._angle_noise, "std3": self._noise * self._length}
        air = {"temperature": temperature, "pressure": pressure / 100.0, "humidity": humidity}
        result = codec.encode_result(self._result, {**self._values(self._seen()[0]), **spread, **air})
        return change + result + self._said(statuses.MEASURE_READY)

    def _do_SetMeasurementMode(self, mode: int) -> int | bytes:
        if mode not in (codec.STATIONARY, codec.CONTINUOUS_TIME) or (mode and self._absolute):
            return statuses.NOT_IMPLEMENTED
        self._mode = mode
        return codec.encode_answer(codec.SET_MODE) + self._said(17)

    def _do_SetContinuousTimeModeParams(self, milliseconds: int, **_: int) -> int | dict[str, Any]:
        if milliseconds < 1:
            return 4
        self._milliseconds = milliseconds
        return {}

    def _do_StopMeasurement(self) -> bytes:
        self._end_stream()
        return codec.encode_answer(codec.STOP_MEASUREMENT) + self._said(statuses.MEASURE_READY)

    # ------------------------------------------------------------------ stream

    def _start_stream(self) -> None:
        self._end_stream()
        self._stop = threading.Event()
        self._start_time = self.world.time
        self._sender = threading.Thread(target=self._send_points, name=f"sim-{self.name}-points", daemon=True)
        self._sender.start()

    def _end_stream(self) -> None:
        if stop := getattr(self, "_stop", None):
            stop.set()
        sender, self._sender = getattr(self, "_sender", None), None
        if sender is not None and sender is not threading.current_thread():
            sender.join()

    def _send_points(self) -> None:
        started = time.monotonic()
        for first in count(0, POINTS_A_PACKET):
            if self._stop.is_set() or (self.fault.kind == "silence" and self._silent()):
                return
            for packet in self._packets(first):
                with self._server.lock:  # an answer may want to go out as well
                    if not all(map(self._server.send, self.fault.pieces(packet))):
                        return
            if self.fault.kind == "disconnect" and first + POINTS_A_PACKET > self.fault.at:
                self._server.disconnect()
                return
            if self.world.pace:
                ahead = (first + POINTS_A_PACKET) * self._milliseconds / 1000.0 / self.world.pace
                self._stop.wait(max(0.0, started + ahead - time.monotonic()))

    def _packets(self, first: int) -> Iterator[bytes]:
        """Yield what is sent for the next points: those of them that are there, and news of the beam."""
        times = self._start_time + (first + np.arange(POINTS_A_PACKET)) * self._milliseconds / 1000.0
        points: list[dict[str, Any]] = []
        for k, seen in enumerate(self._seen(times), first):
            if self._mends():
                yield self._lock()
                seen = self._seen(times[k - first : k - first + 1])[0]
            if news := self._try_beam():
                yield from self._multi(points, float(times[0]))
                points = []
                yield news
            if self._broken or self.fault.hits("drop", k):
                continue
            clock = CLOCK * 1000 + k * self._milliseconds
            stamp = {"seconds": clock // 1000, "microseconds": clock % 1000 * 1000}
            points.append({"status": 0, **stamp, **self._values(seen)})
        yield from self._multi(points, float(times[0]))

    def _multi(self, points: list[dict[str, Any]], when: float) -> Iterator[bytes]:
        if points:
            temperature, pressure, humidity = self._air(when)
            air = {"temperature": temperature, "pressure": pressure / 100.0, "humidity": humidity}
            yield codec.encode_result(codec.MULTI, {"mode": codec.CONTINUOUS_TIME, **air}, points=points)
