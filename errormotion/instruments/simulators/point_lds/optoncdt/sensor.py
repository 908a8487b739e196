"""A simulated optoNCDT: answers commands and streams readings of a beam of the virtual machine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.point_lds.optoncdt.console import LINE_END, ConsoleDevice
from errormotion.instruments.simulators.point_lds.optoncdt.grammar import RefusalError
from errormotion.instruments.simulators.point_lds.optoncdt.models import MODELS, NEWER_RATES, Model
from errormotion.instruments.simulators.point_lds.optoncdt.stream import (
    Counters,
    Output,
    SensorStream,
    depth_of,
)
from errormotion.instruments.simulators.point_lds.optoncdt.values import encode
from errormotion.instruments.transports import Address

_NO_BEAM = "E300 No such beam in the frame of this machine"
_OTHER_CLOCK = "E301 Another device controls the clock of this machine"
"""Errors of the virtual world, not of the sensor."""

_FREE = ("ECHO", "HELP", "PRINT", "LOGIN", "LOGOUT", "GETUSERLEVEL")
_ENDLESS = 16383  # of TRIGGERCOUNT
_FIRST_COUNT = 4711  # of the measured value counter of a sensor that has been on for a while


class SimulatedOptoNCDT(ConsoleDevice):
    """A sensor of the frame: the device's name is its channel, X1 X2 Y1 Y2 or Z.

    While a target is set, the sensor moves with the stage and measures the target, whatever its name.

    Further parameters of the address: ``model`` (ILD2300 or ILD1420), ``range`` (mm), ``newer`` (1: a newer 1420, which
    also measures at 8 kHz), ``user`` (PROFESSIONAL or USER: user level after power-on), ``password`` (000),
    ``baudrate`` (of the line: if it is too slow, values are sent as error 262075; without it, the line is never too
    slow) and ``left`` (settings of an earlier user, as commands separated by semicolons, with ``+`` for a space:
    ``left=OUTADD_RS422+COUNTER;ECHO+OFF``; with ``OUTPUT+RS422`` the sensor streams from the first byte that it
    receives).
    """

    faults = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect", "late")
    drops_answers = False

    def __init__(self, address: Address) -> None:
        self._stream: SensorStream | None = None
        self._starting = self._resuming = False
        self._mute = False
        super().__init__(address, line_end=LINE_END, default_name="X1", every=1000)
        self._mute = self.fault.from_the_start
        try:
            self._set_up(address)
        except InstrumentError:
            self.close()
            raise

    def _set_up(self, address: Address) -> None:
        self._model_name = address.params.get("model", "ILD2300")
        if self._model_name not in MODELS:
            raise InstrumentError(
                f"'model' in '{address.url}': expected {' or '.join(MODELS)}; found another", code="simulator.setting"
            )
        self._model: Model = MODELS[self._model_name]
        newer = address.number("newer", 0) and self._model_name == "ILD1420"
        self._commands = {**self._model.commands, "MEASRATE": NEWER_RATES} if newer else self._model.commands
        frame = self.world.machine.frame.range * 1e3
        self._range = address.number("range", frame if self._model_name == "ILD2300" else self._model.range) * 1e-3
        self._baudrate = address.number("baudrate", 0.0)
        self._errors = self._model.errors
        encode(np.zeros((1, 1)))  # compiled now, so that the first samples are not delayed
        self._counters = Counters(measured=_FIRST_COUNT)
        self._set_up_console(address)
        self._boot()
        if self._baudrate:
            self._settings["BAUDRATE"] = (f"{self._baudrate:.0f}",)

    def _boot(self) -> None:
        super()._boot()
        self._resuming = self._settings["OUTPUT"] == ("RS422",)

    def close(self) -> None:
        """End the device."""
        self._stop()
        super().close()

    def report_delivered(self, samples: int) -> None:
        """Set the number of samples of the running stream that its reader has processed."""
        stream = self._stream
        if stream is not None:
            stream.taken = samples

    # ------------------------------------------------------------------ lines

    def _on_data(self, data: bytes) -> None:
        if self._resuming:
            self._resuming = False
            if not self._start():
                self._begin()
        super()._on_data(data)

    # ------------------------------------------------------------------ settings

    def _set(self, name: str, words: tuple[str, ...]) -> str:
        self._check_state(name, words)
        if name == "OUTPUT":
            self._stop()
            self._settings[name] = words
            return self._start() if words == ("RS422",) else ""
        self._settings[name] = words
        match name:
            case "BAUDRATE":
                self._baudrate = float(words[0]) if self._baudrate else 0.0
            case "MASTERMV":
                self._counters.reference = None
            case "TRIGGER" | "TRIGGERCOUNT":
                self._counters.gate = self._closed_gate()
        if name not in _FREE and self._stream is not None and not self._starting:
            self._restart()
        return ""

    def _check_state(self, name: str, words: tuple[str, ...]) -> None:
        """Raise `RefusalError` if the other settings do not permit this setting."""
        thickness = self._settings.get("MEASMODE") == ("THICKNESS",)
        if name == "OUTTHICK_RS422" and not thickness:
            raise RefusalError("state")
        if name == "OUTDIST_RS422" and "DIST2" in words and not thickness:
            raise RefusalError("state")
        if name == "MASTERMV" and words[0] == "MASTER":
            least = -2.0 if self._model_name == "ILD2300" else 0.0
            if not least * self._range <= float(words[1]) * 1e-3 <= 2 * self._range:
                raise RefusalError("range")
            if self._settings["LASERPOW"] == ("OFF",):  # no measured value within 2 s
                raise RefusalError("timeout")

    def _closed_gate(self) -> int | None:
        return None if self._settings["TRIGGER"][0] == "NONE" else 0

    # ------------------------------------------------------------------ commands other than settings

    def _act(self, name: str, words: Sequence[str]) -> str:
        match name:
            case "GETINFO":
                return self._description()
            case "GETOUTINFO_RS422":
                return " ".join([name, *self._output_names()])
            case "GETOUTINFO_ETH":
                return " ".join([name, "DIST1"])
            case "PRINT":
                return "\r\n".join(" ".join([each, *value]) for each, value in sorted(self._settings.items()))
            case "RESET":
                self._stop()
                self._boot()
            case "RESETCNT":
                self._reset_counters(words)
            case "RESETSTATISTIC":
                self._counters.low, self._counters.high = Counters.low, Counters.high
            case "SETDEFAULT":
                self._stop()
                self._left = []
                self._boot()
            case "TRIGGERSW":
                if self._settings["TRIGGER"][0] != "SOFTWARE":
                    raise RefusalError("state")
                count = int(self._settings["TRIGGERCOUNT"][0])
                self._counters.gate = None if count == _ENDLESS else count
            case _:
                return super()._act(name, words)
        return ""

    def _reset_counters(self, words: Sequence[str]) -> None:
        with self._server.lock:
            if "MEASCNT" in words:
                self._counters.measured = 0
            if "TIMESTAMP" in words:
                self._counters.seconds = 0.0

    def _description(self) -> str:
        number = 1000 * abs(self.world.seed) + sum(i * byte for i, byte in enumerate(self.name.encode(), 1))
        lines = [line.format(range=self._range * 1e3, number=number) for line in self._model.description]
        return "\r\n".join(lines)

    # ------------------------------------------------------------------ data

    def _output_names(self) -> tuple[str, ...]:
        """Return the values of a block in the order in which they are sent."""
        chosen: set[str] = set()
        for name in ("OUTDIST_RS422", "OUTTHICK_RS422", "OUTSTATISTIC_RS422", "OUTADD_RS422"):
            chosen |= set(self._settings.get(name, ()))
        if self._model_name == "ILD1420":
            chosen.add("DIST1")
            if "TIMESTAMP" in chosen:
                chosen |= {"TIMESTAMP_LO", "TIMESTAMP_HI"}
        if self._settings.get("MEASMODE") == ("VIDEO",):
            return ()
        return tuple(name for name in self._model.order if name in chosen)

    def _output(self) -> Output:
        settings = self._settings
        reduced = "RS422" in settings.get("OUTREDUCEDEVICE", ())
        every = settings.get("OUTREDUCE") or (settings["OUTREDUCECOUNT"] if reduced else ("1",))
        hold = settings["OUTHOLD"][0]
        master = settings["MASTERMV"]
        names = self._output_names()
        rate = self._rate / int(every[0])
        return Output(
            names=names,
            measuring_range=self._range,
            largest=self._model.largest,
            every=int(every[0]),
            hold={"NONE": 0, "INFINITE": None}.get(hold, int(hold) if hold.isdigit() else 0),
            average=depth_of(settings["AVERAGE"]),
            master=float(master[1]) * 1e-3 if master[0] == "MASTER" else None,
            laser=settings["LASERPOW"] != ("OFF",),
            overflow=bool(self._baudrate) and Output.overflows(names, rate, self._baudrate),
            microseconds=256 if self._model_name == "ILD2300" else 10,
        )

    @property
    def _rate(self) -> float:
        return self._model.rate(self._settings["MEASRATE"][0])

    def _start(self) -> str:
        if self.name not in self.world.machine.frame.channels and self.world.stand.target is None:
            return _NO_BEAM
        if self.world.following:
            return _OTHER_CLOCK
        self._stop()
        self._counters.past = self._counters.past[:0]
        self._counters.gate = self._closed_gate()
        self._stream = self._new_stream()
        self._starting = True
        return ""

    def _new_stream(self) -> SensorStream:
        sync = self._settings.get("SYNC", ("NONE",))[0].removesuffix("_ALT")
        return SensorStream(
            self._server,
            self.fault,
            self._rng,
            channel=self.name,
            rate=self._rate,
            sync=sync,
            output=self._output(),
            counters=self._counters,
        )

    def _begin(self) -> None:
        """Add the stream that was switched on to the world."""
        if self._starting and self._stream is not None:
            self.world.start_stream(self._stream)
        self._starting = False

    def _restart(self) -> None:
        """Restart the running stream with new settings."""
        self._stop()
        self._start()

    def _stop(self) -> None:
        self._silent()  # a silent sensor sends nothing after the command to stop
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.ended = True
            self.world.end_stream(stream)

    def reply(self, data: bytes) -> None:
        """Send an answer; a stream that was just switched on starts after it.

        It is added to the world before the answer is sent: its master may start immediately afterwards.
        """
        with self._server.lock:  # no sample is sent before the answer
            self._begin()
            super().reply(data)

    def _silent(self) -> bool:
        stream = self._stream
        self._mute = self._mute or (stream is not None and stream.sent >= self.fault.at)
        return self._mute
