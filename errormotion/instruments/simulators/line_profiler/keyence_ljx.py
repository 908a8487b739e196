"""A simulated LJ-X8000A with two lines: one for commands, one for the stream of profiles.

The commands are in `keyence_ljx_controller`, the layouts in `keyence_ljx_wire`.
"""

from __future__ import annotations

import struct
import threading

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.line_profiler import keyence_ljx_settings as settings
from errormotion.instruments.simulators.line_profiler import keyence_ljx_wire as wire
from errormotion.instruments.simulators.line_profiler.gantry_profiles import GantryProfiles
from errormotion.instruments.simulators.line_profiler.keyence_ljx_controller import Controller
from errormotion.instruments.simulators.line_profiler.keyence_ljx_measuring import Measuring
from errormotion.instruments.simulators.line_profiler.keyence_ljx_wire import Answer, ProfileLayout, packed
from errormotion.instruments.simulators.line_profiler.profile_sources import (
    Feed,
    FreeRunning,
    ProfileSource,
    make_source,
)
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.loopback.stream_serving import NewestConnectionServer

__all__ = ["SimulatedLJX", "packed"]

LINES_AT_ONCE = 4  # profiles in a block without a pace: more are measured in vain when a stream ends
STARTING_TIME = 5.0  # s


class SimulatedLJX(SimulatedDevice):
    """A profiler that measures a surface.

    Parameters of the address: ``artefact`` (``twin``: the artefacts on the gantry's table, see `gantry_profiles`; or a
    name of `profile_sources.SOURCES`, a surface of which profiles are taken at a constant rate), ``points`` (3200),
    ``pitch`` (m, 12.5e-6), ``intensity`` (0 or 1), ``trigger_start`` (0); for profiles at a constant rate,
    ``encoder_start`` (0), ``encoder_step`` (counts between profiles, 25) and ``rate`` (profiles per second at
    ``pace=1``, 1000); ``trigger`` (``external``, ``continuous`` or ``encoder``: the trigger mode as delivered; profiles
    are the same in all modes, but only ``external``, with pulses from the gantry's control or a generator, permits a
    trigger by command); ``notice_delay`` (s from the last profile of a stream to the notice that ends it, 0); ``batch``
    (0 or 1: whether batch measurement is on as delivered) and ``batch_points`` (profiles of a batch as delivered,
    1000).

    Parameters
    ----------
    address : Address
    source : ProfileSource, optional
        The surface; replaces that of the address.
    """

    faults = ("silence", "split", "garbage", "checksum", "out_of_range", "drop", "disconnect", "late")
    drops_answers = False

    def __init__(self, address: Address, source: ProfileSource | None = None) -> None:
        if address.params.get("wire", "tcp") != "tcp":
            raise InstrumentError(
                f"A line profiler has network connections only; found '{address.url}'", code="simulator.setting"
            )
        artefact = address.params.get("artefact", "twin" if address.host == "gantry" else "swept")
        if source is None and artefact != "twin":
            source = make_source(artefact, int(address.number("seed", 0)))
        self._ready = threading.Event()
        self._mute = False
        super().__init__(address, line_end=b"", default_name="profiler", every=20)
        self._mute = self.fault.from_the_start
        try:
            feed = self._make_feed(address, source)
            self._data = NewestConnectionServer(f"{self.name}-stream", _ignore)
        except BaseException:
            super().close()
            raise
        self._measuring = Measuring(
            self.name,
            feed,
            self._data,
            self.fault,
            trigger_start=int(address.number("trigger_start", 0)),
            notice_delay=address.number("notice_delay", 0.0),
            on_break=self._break_down,
            rng=self._rng,
        )
        self._controller = Controller(
            self._measuring,
            self._data.accept_pending,
            serial=f"{1000 * abs(self.world.seed) + sum(self.name.encode()):08d}",
            points=int(address.number("points", wire.MAX_POINTS)),
            kind=wire.ONE_PROFILE | (wire.INTENSITY if address.number("intensity", 0) else 0),
            x_pitch=round(address.number("pitch", 12.5e-6) / wire.LENGTH),
            delivered={
                settings.TRIGGER_MODE: bytes([_trigger_mode(address)]),
                settings.SAMPLING: bytes([6]),  # 1 kHz
                settings.BATCH: bytes([bool(address.number("batch", 0))]),
                settings.BATCH_POINTS: struct.pack("<H", int(address.number("batch_points", 1000))),
            },
        )
        self._data.start()
        self.urls = {"stream": self._data.url}
        self._ready.set()

    def _make_feed(self, address: Address, source: ProfileSource | None) -> Feed:
        if source is None:
            return GantryProfiles(address, self.world, self.name)
        start, step = (
            int(address.number(name, default)) for name, default in (("encoder_start", 0), ("encoder_step", 25))
        )
        rate, pace = address.number("rate", 1000.0), self.world.pace
        at_once = LINES_AT_ONCE if pace is None else max(1, round(0.01 * rate * pace))
        return FreeRunning(source, start=start, step=step, rate=rate, at_once=at_once, pace=lambda: self.world.pace)

    @property
    def layout(self) -> ProfileLayout:
        """Layout of the profiles of a stream with the present settings."""
        return self._controller.layout

    def close(self) -> None:
        """End the device."""
        self._measuring.close()
        self._data.close()
        super().close()

    def report_delivered(self, samples: int) -> None:
        """Set the number of profiles of the running stream that its reader has processed."""
        self._measuring.report_delivered(samples)

    def _break_down(self) -> None:
        if self.fault.kind == "silence":
            self._mute = True
        else:
            self._data.disconnect()
            self._server.disconnect()

    # ------------------------------------------------------------------ requests

    def _on_data(self, data: bytes) -> None:
        self._ready.wait(STARTING_TIME)  # a client may have connected before the device was complete
        self._buffer += data
        while len(self._buffer) >= 4:
            size = struct.unpack_from("<I", self._buffer)[0] + 4
            if size > wire.MAX_REQUEST:
                self._buffer = b""
                self._server.disconnect()
                return
            if size > len(self._buffer):
                return
            frame, self._buffer = self._buffer[:size], self._buffer[size:]
            self.reply(self.answer(frame))
            self._measuring.start_pending()
            if self._controller.restarts:
                self._controller.restart()
                self._data.disconnect()
                self._server.disconnect()

    def reply(self, data: bytes) -> None:
        """Send an answer; garbage is only sent in the stream."""
        number = self._answers
        self._answers += 1
        if self.fault.kind == "silence" and self._mute:
            return
        self._late.send(self._server, self.fault, number, data)

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request."""
        return self._controller.answer(request, self._execute)

    def _execute(self, opcode: int, arguments: bytes) -> Answer:
        return self._controller.execute(opcode, arguments)

    @property
    def _feed(self) -> Feed:
        return self._measuring.feed

    @_feed.setter
    def _feed(self, feed: Feed) -> None:
        self._measuring.feed = feed

    @property
    def _errors(self) -> list[int]:
        return self._controller.errors

    @_errors.setter
    def _errors(self, errors: list[int]) -> None:
        self._controller.errors = errors


def _trigger_mode(address: Address) -> int:
    name = address.params.get("trigger", "external")
    if name not in settings.TRIGGER_MODES:
        raise InstrumentError(
            f"'trigger={name}' in '{address.url}': expected one of {', '.join(settings.TRIGGER_MODES)}",
            code="simulator.setting",
        )
    return settings.TRIGGER_MODES.index(name)


def _ignore(data: bytes) -> None:
    """Ignore data received on the stream's connection."""
