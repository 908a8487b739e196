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
from errormotion.instruments.simulators.faults import stray_bytes
from errormotion.instruments.transports import Address

_UNKNOWN = "E220 Unknown command"
_BAD_PARAMETER = "E204 Received unsupported parameter"

Array = np.ndarray[Any, Any]


class SimulatedOptoNCDT(SimulatedDevice):
    """A sensor of the frame: the device's name is its channel, X1 X2 Y1 Y2 or Z.

    Further parameters of the address: ``model`` (ILD2300 or ILD1420) and ``range`` (mm).
    """

    faults = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect")
    _drops_answers = False

    def __init__(self, address: Address) -> None:
        self.rate = 20e3
        self.start = self.position = 0
        self.taken: int | None = None
        self.counter_on = False
        self.output = False
        self.sync = "NONE"
        self._number = 0
        self._starting = False
        super().__init__(address, line_end=LINE_END, default_name="X1", every=1000)
        self.model = address.params.get("model", "ILD2300")
        own_range = self.world.machine.frame.range * 1e3 if self.model == "ILD2300" else 10.0
        self._range = address.number("range", own_range) * 1e-3

    @property
    def channel(self) -> str:
        """Which beam of the frame it is."""
        return self.name

    def close(self) -> None:
        """End the device."""
        self._stop()
        super().close()

    def handed_over(self, samples: int) -> None:
        """Take note of how many samples of the running stream its reader has had."""
        self.taken = samples

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
                self.counter_on = what == "COUNTER"
            case ["SYNC", ("NONE" | "MASTER" | "SLAVE") as role]:
                self.sync = role
            case ["RESETCNT", "COUNTER"] | ["MASTERMV", "NONE"] | ["LASERPOW", "FULL" | "REDUCED" | "OFF"]:
                pass
            case ["OUTPUT" | "OUTADD_RS422" | "SYNC" | "RESETCNT" | "MASTERMV" | "LASERPOW", *_]:
                return _BAD_PARAMETER
            case _:
                return _UNKNOWN
        return ""

    def _description(self) -> str:
        lines = (
            f"Name: {self.model}-{self._range * 1e3:g}",
            f"Serial: {1000 * self.world.seed + sum(self.name.encode()):08d}",
            f"Range: {self._range * 1e3:.2f} mm",
            "Version: 001.000",
            f"Operating time: {self.world.sensors_on_for:.0f} s",
        )
        return "\r\n".join(lines)

    def _set_rate(self, text: str) -> str:
        for rate in MODELS[self.model].rates:
            if text == rate_text(rate):
                self.rate = rate
                return ""
        return _BAD_PARAMETER

    # ------------------------------------------------------------------ samples

    def _start(self) -> str:
        if self.channel not in self.world.machine.frame.channels:
            return "E300 No such beam in the frame of this machine"
        self._number = 0
        self.output = self._starting = True
        if self.fault.kind == "disconnect" and self.fault.at == 0:
            self._server.hang_up()
        return ""

    def reply(self, data: bytes) -> None:
        """Send an answer; a stream that was just switched on begins behind it."""
        super().reply(data)
        if self._starting:
            self._starting = False
            self.world.begin_stream(self)

    def _silent(self) -> bool:
        return self.fault.from_the_start or (self.output and self._number >= self.fault.at > 0)

    def _stop(self) -> None:
        self.output = False
        self.world.end_stream(self)

    def push(self, distances: Array) -> None:
        """Send the next samples with whatever fault is due."""
        first, size = self._number, distances.size
        self._number += size
        raws = np.empty(size, dtype=np.int32)
        kernels.quantise(distances, self._range, raws)
        data = self._spoilt(raws, first) if self.fault.kind else self._encoded(raws, first)
        with self._server.lock:
            if not self.output:
                return
            heard = all(self._server.send(piece) for piece in self.fault.pieces(data))
        if not heard:  # nobody is there any more
            self._stop()
        if self.fault.kind == "disconnect" and first + size > self.fault.at:
            self._server.hang_up()
            self._stop()

    def _encoded(self, raws: Array, first: int) -> bytes:
        data = np.empty(6 * raws.size, dtype=np.uint8)
        used = kernels.encode(raws, first & (1 << COUNTER_BITS) - 1, self.counter_on, data)
        return data[:used].tobytes()

    def _spoilt(self, raws: Array, first: int) -> bytes:
        fault = self.fault
        numbers = first + np.arange(raws.size)
        begun = numbers >= fault.at
        due = begun & ((numbers - fault.at) % fault.every == 0)
        match fault.kind:
            case "silence":
                raws[begun] = -1
            case "disconnect":
                raws[begun] = -1
            case "drop":
                raws[due] = -1
            case "out_of_range":
                raws[begun & ((numbers < fault.at + fault.length) | (fault.length == 0))] = NO_PEAK
        data = self._encoded(raws, first)
        if fault.kind == "garbage":
            for place in sorted(self._rng.integers(0, len(data) + 1, int(due.sum())), reverse=True):
                data = data[:place] + stray_bytes(self._rng) + data[place:]
        return data
