"""An LJ-X8000A on its two wires: answers requests, streams what lies before it."""

from __future__ import annotations

import struct
import threading
import time
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.line_profiler.keyence_ljx import codec, kernels
from errormotion.instruments.line_profiler.keyence_ljx.codec import INTENSITY, LENGTH, SMALLEST_HEIGHT, StreamLayout
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.faults import stray_bytes
from errormotion.instruments.simulators.line_profiler.gantry_profiles import GantryProfiles
from errormotion.instruments.simulators.line_profiler.profile_sources import (
    Feed,
    FreeRunning,
    Lines,
    ProfileSource,
    make_source,
)
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.serving import TcpServer

NO_HEIGHT = -(1 << 19) + 1  # raw 0x80001, invalid
CONNECTION_TIMEOUT = 0.2  # s
BATCH = 16  # profiles sent at once when running freely
POLL_INTERVAL = 0.01  # s from look to look whether a profile is due
TEMPERATURES = (3512, 4108, 2967)  # hundredths of a degC
WRONG_START, NOT_PREPARED, NO_CONNECTION, NOT_NOW = 0xA3, 0xA1, 0xA0, 0x80
UNKNOWN_REQUEST, WRONG_ARGUMENT = 0x41, 0x42  # (m)

Array = np.ndarray[Any, Any]


class SimulatedLJX(SimulatedDevice):
    """A profiler that looks at a surface.

    Parameters of the address: ``artefact`` (``twin``, what stands on the gantry's table, see `gantry_profiles`;
    or a name of `profile_sources.SOURCES`, of which profiles are taken at a rate), ``points`` (3200), ``pitch`` (m,
    12.5e-6), ``intensity`` (0 or 1), ``trigger_start`` (0); where nothing triggers profiles, ``encoder_start`` (0),
    ``encoder_step`` (counts from profile to profile, 25) and ``rate`` (profiles per second at ``pace=1``, 1000);
    ``notice_delay`` (s from the last profile of a stream to the notice that ends it, 0).

    Parameters
    ----------
    address : Address
    source : ProfileSource, optional
        The surface, instead of the one that the address names.
    """

    faults = ("silence", "split", "garbage", "checksum", "out_of_range", "drop", "disconnect")
    drops_answers = False

    def __init__(self, address: Address, source: ProfileSource | None = None) -> None:
        if address.params.get("wire", "tcp") != "tcp":
            raise InstrumentError(f"A line profiler has network connections only; found '{address.url}'")
        artefact = address.params.get("artefact", "twin" if address.host == "gantry" else "swept")
        if source is None and artefact != "twin":
            source = make_source(artefact, int(address.number("seed", 0)))
        self._points = int(address.number("points", codec.MAX_POINTS))
        self._kind = INTENSITY if address.number("intensity", 0) else 0
        self._trigger_start = int(address.number("trigger_start", 0))
        self._notice_delay = address.number("notice_delay", 0.0)
        self._program = 0
        self._x_pitch = round(address.number("pitch", 12.5e-6) / LENGTH)
        self._errors: list[int] = []
        self._prepared: StreamLayout | None = None
        self._starts = 0
        self._position = 0  # number of the next profile
        self._sent = self._taken = 0  # profiles of the running stream
        self._stream: threading.Thread | None = None
        self._starting = threading.Lock()
        self._ended = threading.Event()
        self._mute = False
        kernels.pack(  # compiled ahead of the first reading
            np.zeros(8, dtype=np.int32), np.zeros(0, dtype=np.uint16), 0, 0, np.zeros(12, dtype=np.uint32)
        )
        super().__init__(address, line_end=b"", default_name="profiler", every=20)
        self._mute = self.fault.from_the_start
        try:
            self._feed = self._make_feed(address, source)
            self._data = TcpServer(f"{self.name}-stream", _ignore)
        except BaseException:
            super().close()
            raise
        self._data.start()
        self.urls = {"stream": self._data.url}

    def _make_feed(self, address: Address, source: ProfileSource | None) -> Feed:
        if source is None:
            return GantryProfiles(address, self.world, self.name)
        start, step = (
            int(address.number(name, default)) for name, default in (("encoder_start", 0), ("encoder_step", 25))
        )
        rate, pace = address.number("rate", 1000.0), self.world.pace
        at_once = BATCH if pace is None else max(1, round(0.01 * rate * pace))
        return FreeRunning(source, start=start, step=step, rate=rate, at_once=at_once, pace=lambda: self.world.pace)

    @property
    def layout(self) -> StreamLayout:
        """What the profiles of a stream would look like now."""
        pitch = self._x_pitch * LENGTH
        return StreamLayout(0x5A00 + self._starts, self._kind, self._points, 1e-7, -(self._points // 2) * pitch, pitch)

    def close(self) -> None:
        """End the device."""
        self._ended.set()
        self._data.disconnect()
        self._join()
        self._data.close()
        super().close()

    def report_delivered(self, samples: int) -> None:
        """Take note of how many profiles of the running stream its reader has had."""
        self._taken = samples
        self._feed.report_delivered(samples)

    # ------------------------------------------------------------------ requests

    def _on_data(self, data: bytes) -> None:
        self._buffer += data
        while len(self._buffer) >= 4:
            size = struct.unpack_from("<I", self._buffer)[0] + 4
            if size > len(self._buffer):
                return
            frame, self._buffer = self._buffer[:size], self._buffer[size:]
            self.reply(self.answer(frame))
            with self._starting:
                if self._stream is not None and self._stream.ident is None:
                    self._stream.start()  # after the answer: a stream that breaks at once must not swallow it

    def reply(self, data: bytes) -> None:
        """Send an answer; garbage comes in the stream only."""
        self._answers += 1
        if self.fault.kind == "silence" and self._mute:
            return
        with self._server.lock:
            for piece in self.fault.pieces(data):
                self._server.send(piece)

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request."""
        try:
            opcode, arguments, _ = codec.parse_request(request)
            code, data = self._obey(opcode, arguments)
        except (ProtocolError, struct.error):
            code, data = WRONG_ARGUMENT, b""
        return codec.reply(data, code=code, program=self._program)

    def _obey(self, opcode: int, arguments: bytes) -> tuple[int, bytes]:
        match opcode:
            case codec.DESCRIBE:
                serial = f"{1000 * abs(self.world.seed) + sum(self.name.encode()):08d}"
                return 0, codec.description([("LJ-X8000A", serial), ("LJ-X8060", f"H{serial}")])
            case codec.GET_ERROR:
                return 0, struct.pack(f"<BBH{len(self._errors)}H", len(self._errors), 0, 0, *self._errors)
            case codec.CLEAR_ERROR:
                wanted = struct.unpack_from("<H", arguments)[0]
                self._errors = [error for error in self._errors if error != wanted]
            case codec.GET_STATUS:
                return 0, bytes(4)
            case codec.GET_COUNTS:
                number = self._position + self._sent
                return 0, struct.pack("<Ii", self._trigger(number), _wrapped(self._feed.count()))
            case codec.GET_TEMPERATURE:
                return 0, struct.pack("<3h", *TEMPERATURES)
            case codec.GET_X_PITCH:
                return 0, struct.pack("<I", self._x_pitch)
            case codec.SET_X_PITCH | codec.CHANGE_PROGRAM if self._streaming:
                return NOT_NOW, b""
            case codec.SET_X_PITCH:
                self._x_pitch = struct.unpack("<I", arguments)[0]
            case codec.CHANGE_PROGRAM if arguments[0] < codec.PROGRAMS:
                self._program = arguments[0]
            case codec.PREPARE_STREAM:
                self._starts += 1
                self._prepared = self.layout
                return 0, codec.layout_data(self._prepared)
            case codec.START_STREAM:
                return self._start(*struct.unpack("<Ii", arguments)), b""
            case codec.STOP_STREAM:
                self._ended.set()
                self._feed.end()
            case codec.TRIGGER if self._streaming:
                self._feed.trigger()
            case codec.TRIGGER | codec.START_MEASURING | codec.STOP_MEASURING | codec.CLEAR_MEMORY | codec.LASER:
                pass
            case _:
                return UNKNOWN_REQUEST, b""
        return 0, b""

    def _start(self, prepared: int, start_code: int) -> int:
        layout, self._prepared = self._prepared, None
        if self._streaming or layout is None or prepared != codec.PREPARE_STREAM:
            return NOT_PREPARED
        if start_code != layout.start_code:
            return WRONG_START
        if not self._data.await_connection(CONNECTION_TIMEOUT):
            return NO_CONNECTION
        self._join()
        self._sent = self._taken = 0
        try:
            self._feed.begin()
        except InstrumentError:
            return NOT_NOW
        self._ended.clear()
        self._stream = threading.Thread(target=self._run, args=(layout,), name=f"sim-{self.name}-profiles", daemon=True)
        return 0

    @property
    def _streaming(self) -> bool:
        return self._stream is not None and not self._ended.is_set()

    def _join(self) -> None:
        with self._starting:  # a thread that is half started cannot be joined
            stream, self._stream = self._stream, None
        if stream is not None and stream is not threading.current_thread():
            if stream.ident is not None:
                stream.join()
            self._position += self._taken or self._sent
            self._sent = 0

    # ------------------------------------------------------------------ the stream

    def _trigger(self, number: int) -> int:
        return (self._trigger_start + number) % (1 << 32)

    def _run(self, layout: StreamLayout) -> None:
        """Send profiles until it is stopped, then the notice."""
        try:
            if self._send_all(layout):
                time.sleep(self._notice_delay)
                self._data.send(codec.notice(1))
        finally:
            self._feed.end()

    def _send_all(self, layout: StreamLayout) -> bool:
        """Send profiles until it is stopped; False where the stream breaks down."""
        for lines in self._feed.lines(layout):
            if lines is None:
                self._ended.wait(POLL_INTERVAL)
            if self._ended.is_set():
                break
            if lines is None:
                continue
            data = self._encoded(layout, lines)
            self._sent += lines.times.size
            if not all(self._data.send(piece) for piece in self.fault.pieces(data)):
                return False
            if self.fault.kind in ("silence", "disconnect") and self._sent > self.fault.at:
                self._break_down()
                return False
        return True

    def _break_down(self) -> None:
        if self.fault.kind == "silence":
            self._mute = True
        else:
            self._data.disconnect()
            self._server.disconnect()

    def _encoded(self, layout: StreamLayout, lines: Lines) -> bytes:
        """Return the next profiles as bytes, with whatever fault is due."""
        fault, heights = self.fault, lines.heights
        numbers = self._sent + np.arange(lines.times.size)
        if fault.kind == "out_of_range" and heights is not None:
            last = fault.at + fault.length if fault.length else np.inf
            heights = np.where(((numbers >= fault.at) & (numbers < last))[:, None], np.nan, heights)
        triggers = (self._trigger_start + self._position + numbers) % (1 << 32)
        words = packed(layout, heights, triggers, lines.encoder % (1 << 32))
        if not fault.kind:
            return words.tobytes()
        return b"".join(self._spoilt(row, int(number)) for row, number in zip(words, numbers, strict=True))

    def _spoilt(self, words: Array, number: int) -> bytes:
        """Return the bytes of one profile with the fault that is due at it."""
        fault = self.fault
        if (fault.kind in ("silence", "disconnect") and number >= fault.at) or fault.hits("drop", number):
            return b""
        if fault.hits("checksum", number):
            words[-1] ^= 1
        data = words.tobytes()
        if fault.hits("garbage", number):
            place = int(self._rng.integers(0, len(data)))
            data = data[:place] + stray_bytes(self._rng) + data[place:]
        return data


def _ignore(data: bytes) -> None:
    """Take no notice of what comes in on the stream's connection."""


def packed(layout: StreamLayout, heights: Array | None, triggers: Array, encoder: Array) -> Array:
    """Return profiles as they are sent, uint32, (n, words).

    Parameters
    ----------
    layout : StreamLayout
    heights : ndarray, (n, point), or None
        m; NaN where there is none. None: nowhere.
    triggers, encoder : ndarray, (n,)
        Counts, from 0 to 2**32 - 1.
    """
    n = triggers.size
    words = np.empty((n, layout.words), dtype=np.uint32)
    if heights is None:  # one of them, and its counts put in
        blank = packed(layout, np.full((1, layout.points), np.nan), np.zeros(1, np.int64), np.zeros(1, np.int64))
        words[:] = blank
        words[:, codec.TRIGGER_WORD], words[:, codec.ENCODER_WORD] = triggers, encoder
        words[:, -1] = (int(blank[0, -1]) + triggers + encoder) % (1 << 32)
        return words
    raws = quantised(heights, layout.z_unit)
    intensities = _brightness(heights) if layout.with_intensity else np.empty((n, 0), dtype=np.uint16)
    for k in range(n):
        kernels.pack(raws[k], intensities[k], int(triggers[k]), int(encoder[k]), words[k])
    return words


def quantised(heights: Array, unit: float) -> Array:
    """Return heights in steps of ``unit``, int32; the code for 'invalid' where there is none, or it is out of range."""
    steps = np.rint(heights / unit)
    fits = (steps >= SMALLEST_HEIGHT) & (steps < 1 << 19)  # False for NaN
    return np.where(fits, steps, NO_HEIGHT).astype(np.int32)


def _brightness(heights: Array) -> Array:
    return np.where(np.isfinite(heights), 100 + np.arange(heights.shape[-1]) % 800, 0).astype(np.uint16)


def _wrapped(count: int) -> int:
    return (count + (1 << 31)) % (1 << 32) - (1 << 31)
