"""A simulated capaNCDT 6200: two ports, and sensors on the beams of the virtual machine."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.faults import stray_bytes
from errormotion.instruments.simulators.point_lds.capancdt.commands import (
    CHANNELS,
    FULL_SCALE,
    TIME_OUT,
    ControllerMemory,
    Sensor,
    answer,
)
from errormotion.instruments.simulators.point_lds.capancdt.frames import (
    FRAMES_PER_BLOCK,
    Averaging,
    block,
    raw_values,
    with_functions,
)
from errormotion.instruments.simulators.point_lds.data_port import BeamStream, DataPortDevice
from errormotion.instruments.transports import Address

Array = np.ndarray[Any, Any]

LINE_END = b"\r\n"
ENDS = b"\r\n"
GREETING = "DT6220"
MAX_COMMAND = 255
TIME_LIMIT = 10.0
"""Time limit for the end of a command after its last character, s."""
ANSWER_DELAY = 0.02
"""Time limit for which an answer waits for values that are being sent, s."""
ACCEPT_TIME = 0.5
"""Time limit for accepting a client of the data port, s."""
FIRST_COUNT = 100_000
"""Counter of the first value: the controller has been on for a while."""


class SimulatedCapaNCDT(DataPortDevice):
    """A controller; the device's name is the beam of its first sensor, X1 X2 Y1 Y2 or Z.

    While a target is set in the world, all its sensors move with the stage and measure the target. Without a target, a
    beam that the machine does not have sends no values. The line ``data`` (in ``urls``) sends measured values while a
    client is connected.

    Further parameters of the address: ``beams`` (of channels 1 to 4, separated by commas; empty: no sensor), ``ranges``
    (measuring ranges in um, separated by commas; default that of the machine's frame, 2000), ``serial``, ``left``
    (commands of an earlier user without ``$``, separated by semicolons: ``left=TRG1;AVT3;AVN8``), ``time_limit`` (s,
    10), ``password`` (empty), ``frames`` (largest number of frames in a block, 256), ``greeting`` (line that is sent to
    a new client of the commands).

    With the fault ``out_of_range``, FFFFFF is sent.
    """

    def __init__(self, address: Address) -> None:
        self._timer: threading.Timer | None = None
        self._streams: tuple[_Channel, ...] = ()
        self._once = 0  # single frames that are due
        self._sent = 0  # frames since the connection
        self._counter = FIRST_COUNT
        self._values: Array = np.zeros(CHANNELS, dtype=np.int64)
        self._averaging = Averaging(0, 2)
        super().__init__(address, line_end=LINE_END, default_name="X1", every=1000)
        self._open_data_port(address, self._set_up, self._data_connected)

    def _set_up(self, address: Address) -> None:
        beams = address.params.get("beams", self.name).split(",")
        channels = [channel for channel, beam in enumerate(beams, 1) if beam]
        texts = [each for each in address.params.get("ranges", "").split(",") if each]
        ranges = [float(text) for text in texts] or [self.world.machine.frame.range * 1e6]
        if not channels or len(beams) > CHANNELS or len(ranges) not in (1, len(channels)) or not min(ranges) > 0:
            raise InstrumentError(
                f"expected 1 to {CHANNELS} 'beams', and one of the 'ranges' (um) for all or one for each",
                code="simulator.setting",
            )
        ranges = ranges * len(channels) if len(ranges) == 1 else ranges
        self.serial = int(address.number("serial", 1000 + abs(self.world.seed)))
        self.sensors: Mapping[int, Sensor] = {
            channel: Sensor(beams[channel - 1], length, 100 * self.serial + channel)
            for channel, length in zip(channels, ranges, strict=True)
        }
        self.settings = ControllerMemory(password=address.params.get("password", ""))
        self._time_limit = address.number("time_limit", TIME_LIMIT)
        self._greeting = address.params.get("greeting", GREETING)
        self._frames = max(1, int(address.number("frames", FRAMES_PER_BLOCK)))
        self.port = 0
        for command in address.params.get("left", "").split(";"):
            if command and (refused := answer(self, command)).startswith("$"):
                raise InstrumentError(f"'left={command}': {refused}", code="simulator.setting")

    def close(self) -> None:
        """End the device."""
        self._cancel_timer()
        self._end_streams()
        self._data.close()
        super().close()

    def report_delivered(self, samples: int) -> None:
        """Set the number of frames that the reader has processed."""
        for stream in self._streams:
            stream.taken = samples

    # ------------------------------------------------------------------ commands

    def connection_opened(self) -> None:
        """Discard an incomplete command of the previous connection, and send the greeting."""
        super().connection_opened()
        self._cancel_timer()
        if self._greeting:
            self._send(self._greeting.encode("latin-1") + LINE_END)

    def _on_data(self, data: bytes) -> None:
        self._cancel_timer()
        for byte in data:
            character = bytes([byte])
            if character in (b"\r", b"\n"):
                command, self._buffer = self._buffer, b""
                if command.startswith(b"$"):
                    self._execute(command[1:])
                continue
            self._send(character)
            if character == b"$":
                self._buffer = character  # preceding characters are ignored
            elif self._buffer:
                self._buffer = (self._buffer + character)[: MAX_COMMAND + 1]
        if self._buffer.startswith(b"$"):
            self._timer = threading.Timer(self._time_limit, self._time_out)
            self._timer.daemon = True
            self._timer.start()

    def _execute(self, command: bytes) -> None:
        settings = self.settings
        before, kind = (settings.trigger, settings.sample_time), (settings.averaging, settings.averaging_number)
        ended: tuple[_Channel, ...] = ()
        if command == b"GMD" and settings.trigger:
            self._data.await_present_client(ACCEPT_TIME)  # a client that is connecting receives the value
        held = self._data.lock.acquire(timeout=ANSWER_DELAY)  # no value is sent meanwhile, unless its reader is blocked
        try:
            text = answer(self, command.decode("latin-1"))
            if kind != (settings.averaging, settings.averaging_number):
                self._averaging = self._new_averaging()
            if before != (settings.trigger, settings.sample_time):
                ended, self._streams = self._streams, ()  # none of their values is sent after the answer
            self._reply(text.encode("latin-1") + LINE_END)
        finally:
            if held:
                self._data.lock.release()
        for stream in ended:
            stream.taken = stream.taken or 0  # the clock continues from the position of the reader
            self._end(stream)
        self._start_if_due()

    def _reply(self, data: bytes) -> None:
        number, self._answers = self._answers, self._answers + 1
        if not self._mute:
            self._late.send(self._server, self.fault, number, data)

    def _new_averaging(self) -> Averaging:
        return Averaging(self.settings.averaging, self.settings.averaging_number)

    def _time_out(self) -> None:
        self._buffer = b""
        self._send(TIME_OUT.encode() + LINE_END)

    def _cancel_timer(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()
            if timer is not threading.current_thread():
                timer.join()

    def _send(self, data: bytes) -> None:
        if self._mute:
            return
        with self._server.lock:
            for piece in self.fault.pieces(data):
                self._server.send(piece)

    def measure_once(self) -> None:
        """Send one frame if values are not sent continuously."""
        if self.settings.trigger:
            self._once += 1

    def latest(self, channel: int) -> int:
        """Return the last value of a channel, 1 to 4."""
        return int(self._values[channel - 1])

    # ------------------------------------------------------------------ values

    def _data_connected(self) -> None:
        self._end_streams()  # of the previous client
        self._once = self._sent = 0
        self._start_if_due()

    def _start_if_due(self) -> None:
        """Start the streams if a client is connected and values are due."""
        due = self._once or not self.settings.trigger
        if due and not self._streams and not self._mute and self._data.connection is not None:
            self._start_streams()

    def _start_streams(self) -> None:
        world = self.world
        known = all(sensor.beam in world.machine.frame.channels for sensor in self.sensors.values())
        if not (known or world.stand.target is not None) or world.following:
            return
        rate = 1e6 / self.settings.sample_time
        self._averaging = self._new_averaging()
        self._sent = 0  # faults count from here
        pending: list[Array] = []
        sensors = tuple(self.sensors.values())
        self._streams = tuple(_Channel(self, pending, each, rate, last=each is sensors[-1]) for each in sensors)
        with world._change:  # all channels start at the same sample
            for stream in self._streams:
                world.start_stream(stream)

    def _end_streams(self) -> None:
        streams, self._streams = self._streams, ()
        for stream in streams:
            self._end(stream)

    def _end(self, stream: _Channel) -> None:
        stream.ended = True
        self.world.end_stream(stream)

    def pass_on(self, stream: _Channel, distances: list[Array]) -> None:
        """Send frames of the samples of all channels."""
        columns = [
            raw_values(each, sensor.range * 1e-6) for each, sensor in zip(distances, self.sensors.values(), strict=True)
        ]
        frames = np.stack(columns, axis=1)
        with self._data.lock:
            if stream not in self._streams:
                return
            if self.settings.trigger:
                frames, self._once = frames[: self._once], 0
                self._end_with(len(frames))
            self._deliver(frames)

    def _end_with(self, taken: int) -> None:
        """End the streams of single frames; the clock continues after them."""
        streams, self._streams = self._streams, ()
        for each in streams:
            each.taken, each.ended = taken, True

    def _deliver(self, frames: Array) -> None:
        first = self._sent
        numbers = first + np.arange(len(frames))
        frames[self.fault.affects("out_of_range", numbers)] = FULL_SCALE
        frames = frames[self._sent_frames(numbers)]
        values, channels = with_functions(self._averaging(frames), tuple(self.sensors), self.settings)
        if len(values):
            self._values[[channel - 1 for channel in channels]] = values[-1]
        more = self._transmit(self._bytes(values, channels, first), numbers)
        self._sent += len(numbers)
        for each in self._streams:
            each.ended = each.ended or not more

    def _bytes(self, values: Array, channels: tuple[int, ...], first: int) -> bytes:
        """Return values as blocks, with the faults of the content; each gap starts a new block."""
        fault, data = self.fault, b""
        counter, self._counter = self._counter, self._counter + len(values)
        lost = np.flatnonzero([fault.hits("drop", first + i) for i in range(len(values))])
        for start, end in zip([0, *(lost + 1)], [*lost, len(values)], strict=True):
            for i in range(start, end, self._frames):
                piece = values[i : min(i + self._frames, end)]
                if any(fault.hits("garbage", first + i + k) for k in range(len(piece))):
                    data += stray_bytes(self._rng)
                data += block(piece, channels, self.serial, counter + i)
        return data


class _Channel(BeamStream):
    """The samples of one channel.

    ``pending`` is shared by all channels.
    """

    def __init__(
        self, controller: SimulatedCapaNCDT, pending: list[Array], sensor: Sensor, rate: float, *, last: bool
    ) -> None:
        super().__init__(sensor.beam, rate, sensor.range * 1e-6)
        self._controller = controller
        self._pending = pending
        self._last = last

    def push(self, distances: Array) -> None:
        """Add the next samples; those of the last channel complete and send the frames. May wait for the reader."""
        self._pending.append(distances)
        if self._last:
            complete = self._pending[:]
            self._pending.clear()
            self._controller.pass_on(self, complete)
