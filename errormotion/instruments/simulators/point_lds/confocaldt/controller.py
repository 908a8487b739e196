"""A simulated confocalDT 24x1: a line for commands, one for values, and a sensor on a beam of the virtual machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.faults import stray_bytes
from errormotion.instruments.simulators.point_lds.confocaldt.commands import COMMANDS, ERRORS, MODELS
from errormotion.instruments.simulators.point_lds.confocaldt.values import (
    FRAMES_PER_BLOCK,
    NO_PEAK,
    NOT_CALCULABLE,
    Averaging,
    block,
    columns,
    flags,
    raw_values,
    states,
)
from errormotion.instruments.simulators.point_lds.data_port import BeamStream, DataPortDevice
from errormotion.instruments.simulators.point_lds.optoncdt.console import LINE_END, MAX_PARAMETER, ConsoleDevice
from errormotion.instruments.simulators.point_lds.optoncdt.grammar import RefusalError
from errormotion.instruments.transports import Address

Array = np.ndarray[Any, Any]

FIRST_COUNT = 50_000
"""Counter of the first value: the controller has been on for a while."""
TEMPERATURE = 34.51
"""deg C."""
EXPOSURE_STEP = 0.025
"""us."""
INTENSITY = 512 | 8192 << 16
"""Of each peak: half of the full scale."""
RATE_CLOCK = 40_000_000
"""Hz."""
_NEUTRAL = frozenset({"ECHO", "STDUSER", "IPCONFIG", "DARKCORRTHRES"})
"""Settings that do not affect a running stream."""


class SimulatedConfocal(ConsoleDevice, DataPortDevice):
    """A controller with one sensor; the device's name is its beam.

    It sends values on the line ``data`` (in ``urls``) while OUTPUT is ETHERNET, MEASTRANSFER is SERVER/TCP and a client
    is connected.

    Further parameters of the address: ``model`` (IFC2451, IFC2461 or IFC2471), ``range`` (mm; default that of the
    machine's frame), ``serial``, ``user`` (PROFESSIONAL or USER), ``password`` (000), ``left`` (settings of an earlier
    user, separated by semicolons: ``left=OUTADD_ETH STATE;ECHO OFF``), ``frames`` (largest number of frames in a
    block), ``header`` (``bytes`` or ``frames``: the size that is sent first).

    With the fault ``out_of_range`` there is no peak.
    """

    _commands = COMMANDS
    _errors = ERRORS
    longest_parameter = MAX_PARAMETER

    def __init__(self, address: Address) -> None:
        self._stream: _Values | None = None
        self._counter = FIRST_COUNT
        self._seconds = 0.0
        self._phase = 0  # of the reduction
        self._low, self._high = np.inf, -np.inf
        self._reference: float | None = None
        super().__init__(address, line_end=LINE_END, default_name="X1", every=1000)
        self._open_data_port(address, self._set_up, self._data_connected)

    def _set_up(self, address: Address) -> None:
        self.model_name = address.params.get("model", "IFC2451")
        if self.model_name not in MODELS:
            raise InstrumentError(f"'model': expected one of {', '.join(MODELS)}", code="simulator.setting")
        self.model = MODELS[self.model_name]
        self.range = address.number("range", self.world.machine.frame.range * 1e3) * 1e-3
        if not 0.0 < self.range < 2.0:
            raise InstrumentError("'range': expected more than 0 mm and less than 2000 mm", code="simulator.setting")
        self.serial = int(address.number("serial", 11020000 + abs(self.world.seed)))
        self._set_up_console(address)
        self._frames = max(1, int(address.number("frames", FRAMES_PER_BLOCK)))
        self._frames_first = address.params.get("header", "bytes") == "frames"
        self.port = 0
        self._boot()

    def close(self) -> None:
        """End the device."""
        self._stop()
        self._data.close()
        super().close()

    def report_delivered(self, samples: int) -> None:
        """Set the number of samples of the running stream that its reader has processed."""
        stream = self._stream
        if stream is not None:
            stream.taken = samples

    # ------------------------------------------------------------------ commands

    def reply(self, data: bytes) -> None:
        """Send an answer; a stream that it switches on starts after it."""
        if not self._mute:
            super().reply(data)
        self._start_if_due()

    def _silent(self) -> bool:
        return self._mute

    def _setting(self, name: str) -> tuple[str, ...]:
        words = self._settings[name]
        if name == "MEASTRANSFER" and words[0] == "SERVER/TCP":
            return words[0], str(self.port)  # port on which the simulator listens
        return words

    def _check(self, name: str, words: Sequence[str]) -> None:
        """Raise `RefusalError` if the model or the other settings do not permit this setting."""
        thickness = self._settings["MEASMODE"] == ("THICKNESS",)
        match name:
            case "MEASRATE" if not self.model.allows_rate(words[0]):
                raise RefusalError("range")
            case "SHUTTER" if not all(self.model.allows_exposure(word) for word in words):
                raise RefusalError("range")
            case "ROI" if int(words[0]) >= int(words[1]):
                raise RefusalError("range")
            case "DARKCORRTHRES" if not 0.0 <= float(words[0]) <= 100.0:
                raise RefusalError("range")
            case "SENSORHEAD" if words[0] != "0":
                raise RefusalError("sensor")
            case "OUTDIST_ETH" if set(words) != ({"DIST1", "DIST2"} if thickness else {"DIST1"}):
                raise RefusalError("state")
            case "OUTTHICK_ETH" if list(words) != (["THICK12"] if thickness else ["NONE"]):
                raise RefusalError("state")
            case "MASTERMV" if words[0] == "MASTER" and not abs(float(words[1])) * 1e-3 <= self.range:
                raise RefusalError("range")
            case "MASTERMV" if words[0] == "MASTER" and self._stream is None:
                raise RefusalError("timeout")  # no measured value within 2 s

    def _set(self, name: str, words: tuple[str, ...]) -> str:
        self._check(name, words)
        if name not in _NEUTRAL:
            self._stop()  # starts again after the answer
        self._settings[name] = words
        if name == "MEASMODE":
            thickness = words == ("THICKNESS",)
            self._settings["OUTDIST_ETH"] = ("DIST1", "DIST2") if thickness else ("DIST1",)
            self._settings["OUTTHICK_ETH"] = ("THICK12",) if thickness else ("NONE",)
        if name == "MASTERMV":
            self._reference = None
        return ""

    def _act(self, name: str, words: Sequence[str]) -> str:
        match name:
            case "GETINFO":
                return "\r\n".join(self._description())
            case "GETTEMP":
                return f"GETTEMP {TEMPERATURE:.2f}"
            case "SENSORINFO":
                length = f"{self.range * 1e3:.3f} mm"
                return f"Position: 0\r\nName: ifs-2405x\r\nMeasuring range: {length}\r\nSerial: 12345678"
            case "SENSORTABLE":
                length = f"{self.range * 1e3:.3f}".replace(".", ",")  # as in the manual
                return f"Pos, Sensor name, Range, Serial\r\n0, ifs-2405x, {length}mm, 12345678"
            case "PRINT":
                lines = [" ".join([each, *self._setting(each)]) for each in sorted(self._settings)]
                return "\r\n".join([*lines, *(self._description() if words else [])])
            case "RESET":
                self._stop()
                self._boot()
            case "RESETSTATISTIC":
                self._low, self._high = np.inf, -np.inf
            case _:
                return super()._act(name, words)
        return ""

    def _description(self) -> list[str]:
        return [
            f"Name: {self.model_name}",
            f"Serial: {self.serial:08d}",
            "Option: 001",
            f"Article: {self.model.article}",
            "MAC-Address: 00-0C-12-01-06-08",
            "Version: 004.093.087.02",
            "Imagetype: User",
        ]

    # ------------------------------------------------------------------ values

    def _data_connected(self) -> None:
        self._stop()  # of the previous client
        self._start_if_due()

    def _start_if_due(self) -> None:
        """Start the stream if a client is connected and values are due."""
        due = self._settings["OUTPUT"] == ("ETHERNET",) and self._settings["MEASTRANSFER"][0] == "SERVER/TCP"
        world = self.world
        known = self.name in world.machine.frame.channels or world.stand.target is not None
        if not due or self._stream is not None or self._mute or self._data.connection is None:
            return
        if not known or world.following:
            return
        kind, *depth = self._settings["AVERAGE"]
        self._averaging = Averaging(kind, int(depth[0]) if depth else 1)
        self._phase = 0
        self._stream = _Values(self, self.name, self._rate * 1e3, self.range)
        world.start_stream(self._stream)

    @property
    def _rate(self) -> float:
        """Measuring rate, kHz."""
        return float(self._settings["MEASRATE"][0])

    def _stop(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.ended = True
            self.world.end_stream(stream)

    def pass_on(self, stream: _Values, distances: Array) -> None:
        """Send the frames of further samples."""
        with self._data.lock:
            if stream is self._stream:
                self._deliver(stream, distances.astype(float))

    def _deliver(self, stream: _Values, distances: Array) -> None:
        first = stream.sent
        numbers = first + np.arange(len(distances))
        distances[self.fault.affects("out_of_range", numbers)] = np.nan
        frames, names = self._framed(self._averaging(distances))
        lost = np.array([self.fault.hits("drop", int(number)) for number in numbers], dtype=bool)
        kept = self._sent_frames(numbers)
        more = self._transmit(self._bytes(frames[kept], names, lost[kept], first), numbers)
        stream.sent += len(numbers)
        self._counter += len(numbers)
        self._seconds += len(numbers) / stream.rate
        stream.ended = stream.ended or not more

    def _framed(self, distances: Array) -> tuple[Array, tuple[str, ...]]:
        """Return the frames of distances, shape (frame, value), and the names of their values."""
        settings = self._settings
        peaks = 2 if settings["MEASMODE"] == ("THICKNESS",) else 1
        names = columns((*settings["OUTADD_ETH"], *settings["OUTSTATISTIC_ETH"]), peaks)
        offset = self._offset(distances)
        raw = raw_values(distances, self.range, offset)
        valid = (distances >= 0.0) & (distances <= self.range)
        tracked = np.where(valid, distances + offset, np.nan)
        low = np.fmin.accumulate(np.concatenate([[self._low], tracked]))[1:]
        high = np.fmax.accumulate(np.concatenate([[self._high], tracked]))[1:]
        self._low, self._high = (float(low[-1]), float(high[-1])) if len(low) else (self._low, self._high)
        number = np.arange(len(distances))
        stamp = np.rint((self._seconds + number / (self._rate * 1e3)) * 1e6).astype(np.int64)
        exposure = round(float(settings["SHUTTER"][0]) / EXPOSURE_STEP)
        known: dict[str, Array | int] = {
            "SHUTTER": exposure,
            "MEASRATE": round(RATE_CLOCK / (self._rate * 1e3)),
            "COUNTER": self._counter + number,
            "TIMESTAMP": stamp,
            "DIST1": raw,
            "DIST2": NO_PEAK,
            "INTENSITY1": np.where(np.isnan(distances), 0, INTENSITY),
            "STATE": states(distances, self.range),
            "THICK12": NOT_CALCULABLE,
            "MIN": _nanometres(low),
            "MAX": _nanometres(high),
            "PEAK2PEAK": _nanometres(high - low),
        }
        frames = np.zeros((len(distances), len(names)), dtype=np.int64)
        for column, name in enumerate(names):
            frames[:, column] = known.get(name, 0)
        return frames, names

    def _offset(self, distances: Array) -> float:
        """Return the offset from mastering, m; the first valid value after the command is its reference."""
        master = self._settings["MASTERMV"]
        if master[0] == "NONE":
            return 0.0
        valid = distances[(distances >= 0.0) & (distances <= self.range)]
        if self._reference is None and len(valid):
            self._reference = float(valid[0])
        return 0.0 if self._reference is None else float(master[1]) * 1e-3 - self._reference

    def _bytes(self, frames: Array, names: tuple[str, ...], lost: Array, first: int) -> bytes:
        """Return values as blocks, with the faults of the content; each gap starts a new block."""
        every, *interfaces = self._settings["OUTREDUCE"]
        step = int(every) if not interfaces or interfaces[0] == "ETHERNET" else 1
        kept = np.flatnonzero((np.arange(len(frames)) + first) % step == 0)
        kept = kept[~lost[kept]]
        linear = self._settings["SWITCHMD2"] == ("0",)
        marks = flags(names, self._rate, linear=linear)
        data = b""
        for run in np.split(kept, np.flatnonzero(np.diff(kept) != step) + 1):
            for i in range(0, len(run), self._frames):
                piece = run[i : i + self._frames]
                if any(self.fault.hits("garbage", first + int(number)) for number in piece):
                    data += stray_bytes(self._rng)
                counter = self._counter + int(piece[0])
                data += block(
                    frames[piece], marks, self.model.article, self.serial, counter, frames_first=self._frames_first
                )
        return data


class _Values(BeamStream):
    """The values of the sensor."""

    def __init__(self, controller: SimulatedConfocal, channel: str, rate: float, measuring_range: float) -> None:
        super().__init__(channel, rate, measuring_range)
        self.sent = 0
        self._controller = controller

    def push(self, distances: Array) -> None:
        """Send the next samples; may wait for the reader."""
        self._controller.pass_on(self, distances)


def _nanometres(lengths: Array) -> Array:
    return np.where(np.isfinite(lengths), np.rint(np.nan_to_num(lengths, posinf=0, neginf=0) * 1e9), NO_PEAK).astype(
        np.int64
    )
