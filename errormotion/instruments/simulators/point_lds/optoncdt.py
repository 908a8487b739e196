"""An optoNCDT on the wire: answers commands, streams what the twin's beams see."""

from __future__ import annotations

from typing import Any

import numpy as np

from errormotion.instruments.point_lds.optoncdt import kernels
from errormotion.instruments.point_lds.optoncdt.codec import (
    COUNTER_BITS,
    LINE_END,
    MODELS,
    NO_PEAK,
    PROMPT,
    rate_text,
)
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.faults import Fault, stray_bytes
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.serving import Server

_UNKNOWN = "E220 Unknown command"
_BAD_PARAMETER = "E204 Received unsupported parameter"

Array = np.ndarray[Any, Any]


class SimulatedOptoNCDT(SimulatedDevice):
    """A sensor of the frame: the device's name is its channel, X1 X2 Y1 Y2 or Z.

    While a target is set it rides on the stage and looks at that, whatever its name.

    Further parameters of the address: ``model`` (ILD2300 or ILD1420) and ``range`` (mm).
    """

    faults = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect")
    drops_answers = False

    def __init__(self, address: Address) -> None:
        self._rate = 20e3
        self._counter = False
        self._sync = "NONE"
        self._stream: SensorStream | None = None
        self._starting = False
        self._mute = False
        super().__init__(address, line_end=LINE_END, default_name="X1", every=1000)
        self._mute = self.fault.from_the_start
        kernels.quantise(np.zeros(1), 1.0, np.zeros(1, dtype=np.int32))  # compiled ahead of the first reading
        kernels.encode(np.zeros(1, dtype=np.int32), 0, True, np.zeros(6, dtype=np.uint8))
        self._model = address.params.get("model", "ILD2300")
        own_range = self.world.machine.frame.range * 1e3 if self._model == "ILD2300" else 10.0
        self._range = address.number("range", own_range) * 1e-3

    def close(self) -> None:
        """End the device."""
        self._stop()
        super().close()

    def report_delivered(self, samples: int) -> None:
        """Take note of how many samples of the running stream its reader has had."""
        stream = self._stream
        if stream is not None:
            stream.taken = samples

    # ------------------------------------------------------------------ commands

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one command."""
        words = request.decode("ascii", errors="replace").split()
        text = self._obey(words) if words else ""
        return (text + "\r\n" if text else "").encode("ascii") + PROMPT

    def _obey(self, words: list[str]) -> str:
        match words:
            case ["GETINFO"]:
                return self._description()
            case ["MEASRATE", text]:
                return self._set_rate(text)
            case ["OUTPUT", "NONE"]:
                self._stop()
            case ["OUTPUT", "RS422"]:
                return self._start()
            case ["OUTADD_RS422", ("COUNTER" | "NONE") as what]:
                self._counter = what == "COUNTER"
            case ["SYNC", ("NONE" | "MASTER" | "SLAVE") as role]:
                self._sync = role
            case ["RESETCNT", "COUNTER"] | ["MASTERMV", "NONE"] | ["LASERPOW", "FULL" | "REDUCED" | "OFF"]:
                pass
            case ["OUTPUT" | "OUTADD_RS422" | "SYNC" | "RESETCNT" | "MASTERMV" | "LASERPOW", *_]:
                return _BAD_PARAMETER
            case _:
                return _UNKNOWN
        return ""

    def _description(self) -> str:
        number = 1000 * abs(self.world.seed) + sum(i * byte for i, byte in enumerate(self.name.encode(), 1))
        lines = (
            f"Name: {self._model}-{self._range * 1e3:g}",
            f"Serial: {number:08d}",
            f"Range: {self._range * 1e3:.2f} mm",
            "Version: 001.000",
            f"Operating time: {self.world.sensors_on_for:.0f} s",
        )
        return "\r\n".join(lines)

    def _set_rate(self, text: str) -> str:
        for rate in MODELS[self._model].rates:
            if text == rate_text(rate):
                self._rate = rate
                return ""
        return _BAD_PARAMETER

    def _start(self) -> str:
        if self.name not in self.world.machine.frame.channels and self.world.stand.target is None:
            return "E300 No such beam in the frame of this machine"
        if self.world.following:
            return "E301 Another device drives the clock of this machine"
        self._stop()
        self._stream = SensorStream(
            self._server,
            self.fault,
            self._rng,
            channel=self.name,
            rate=self._rate,
            sync=self._sync,
            counter=self._counter,
            measuring_range=self._range,
        )
        self._starting = True
        return ""

    def _stop(self) -> None:
        self._silent()  # a sensor that stopped answering sends nothing more on the command to stop
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.ended = True
            self.world.end_stream(stream)

    def reply(self, data: bytes) -> None:
        """Send an answer; a stream that was just switched on starts behind it.

        It is known to the world before the answer is out: the next thing to come may be its master's start.
        """
        with self._server.lock:  # no sample passes before the answer
            if self._starting and self._stream is not None:
                self.world.start_stream(self._stream)
            self._starting = False
            super().reply(data)

    def _silent(self) -> bool:
        stream = self._stream
        self._mute = self._mute or (stream is not None and stream.sent >= self.fault.at)
        return self._mute


class SensorStream:
    """One stream of a sensor, from OUTPUT RS422 to OUTPUT NONE.

    Parameters
    ----------
    server : Server
        The wire.
    fault : Fault
        What goes wrong.
    rng : numpy.random.Generator
        For stray bytes.
    channel : str
        Beam of the frame.
    rate : float
        Samples per second.
    sync : str
        NONE, MASTER or SLAVE.
    counter : bool
        Whether each distance is followed by its counter.
    measuring_range : float
        m.
    """

    def __init__(
        self,
        server: Server,
        fault: Fault,
        rng: np.random.Generator,
        *,
        channel: str,
        rate: float,
        sync: str,
        counter: bool,
        measuring_range: float,
    ) -> None:
        self.channel = channel
        self.rate = rate
        self.sync = sync
        self.start = self.position = 0
        self.taken: int | None = None
        self.ended = False
        self.sent = 0
        self._server = server
        self._fault = fault
        self._rng = rng
        self._counter = counter
        self.measuring_range = measuring_range

    def push(self, distances: Array) -> None:
        """Send the next samples with whatever fault is due; may wait for the reader."""
        first, size = self.sent, distances.size
        raws = np.empty(size, dtype=np.int32)
        kernels.quantise(distances, self.measuring_range, raws)
        data = self._spoilt(raws, first) if self._fault.kind else self._encoded(raws, first)
        with self._server.lock:
            if self.ended:
                return
            self.sent += size
            heard = all(self._server.send(piece) for piece in self._fault.pieces(data))
        if self._fault.kind == "disconnect" and self.sent > self._fault.at:
            self._server.disconnect()
            self.ended = True
        self.ended = self.ended or not heard

    def _encoded(self, raws: Array, first: int) -> bytes:
        data = np.empty(6 * raws.size, dtype=np.uint8)
        used = kernels.encode(raws, first & (1 << COUNTER_BITS) - 1, self._counter, data)
        return data[:used].tobytes()

    def _spoilt(self, raws: Array, first: int) -> bytes:
        fault = self._fault
        numbers = first + np.arange(raws.size)

        active = numbers >= fault.at
        due = active & ((numbers - fault.at) % fault.every == 0)
        match fault.kind:
            case "silence" | "disconnect":
                raws[active] = -1
            case "drop":
                raws[due] = -1
            case "out_of_range":
                raws[active & ((numbers < fault.at + fault.length) | (fault.length == 0))] = NO_PEAK
        data = self._encoded(raws, first)
        if fault.kind == "garbage":
            for place in sorted(self._rng.integers(0, len(data) + 1, int(due.sum())), reverse=True):
                data = data[:place] + stray_bytes(self._rng) + data[place:]
        return data
