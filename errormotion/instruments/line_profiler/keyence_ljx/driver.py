"""Driver of one LJ-X8000A."""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.driver import Driver
from errormotion.instruments.line_profiler.keyence_ljx import codec
from errormotion.instruments.line_profiler.keyence_ljx.codec import (
    ENCODER_WORD,
    LENGTH,
    LOST,
    REASONS,
    STREAM_PORT,
    TEMPERATURE,
    Reply,
    StreamLayout,
)
from errormotion.instruments.line_profiler.keyence_ljx.commands import CommandLine
from errormotion.instruments.line_profiler.keyence_ljx.settings import LJXSettings
from errormotion.instruments.transports import Transport
from errormotion.plugins import Identity, InstrumentInfo
from errormotion.plugins.readings import Profiles

if TYPE_CHECKING:
    from errormotion.instruments.line_profiler.keyence_ljx.blocks import SpacedRows
    from errormotion.instruments.line_profiler.keyence_ljx.decoder import HeightDecoder
    from errormotion.instruments.streaming import Reader
    from errormotion.instruments.transports.lines import ManyLines

STREAM = "stream"
BLOCK_SECONDS = 0.1
QUEUE_SECONDS = 0.5
MIN_QUEUE = 64
BATCH_PROFILES = 64
"""Number of profiles unpacked at once; their packed data fit into the processor's cache."""
QUIET_INTERVAL = 0.3
"""Time without data after which a stopped stream counts as ended if no notice was received, s."""


@dataclass(frozen=True)
class Counts:
    """Triggers and encoder pulses that a profiler has counted; the encoder count overflows at 32 bits."""

    trigger: int
    encoder: int


class KeyenceLJX(Driver):
    """A Keyence LJ-X8000A line profiler over Ethernet: one connection for commands, one for the stream.

    Heights and positions on the line are in m; heights are NaN where the profiler reports none.

    Parameters
    ----------
    address : str
        ``tcp://192.168.0.1:24691?stream=24692``, ``sim://cframe/profiler?seed=3``, ``replay://file``.
    settings : LJXSettings, optional
    record : Path, optional
        List of the recordings of both connections.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="keyence_ljx",
        kind="line_profiler",
        summary="Keyence LJ-X8000A laser line profiler, Ethernet, commands and high-speed stream",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.line_profiler.keyence_ljx:SimulatedLJX",
    )
    Settings: ClassVar[type[LJXSettings]] = LJXSettings
    settings: LJXSettings
    name = "keyence_ljx"
    _reader: Reader | None = None
    _commands: CommandLine | None = None
    _notice_pending = False  # whether the notice of a stopped stream has not arrived

    @property
    def rate(self) -> float:
        """Profiles per second, as in the settings."""
        return self.settings.rate

    # ------------------------------------------------------------------ commands

    def identify(self) -> Identity:
        """Return the models and serial numbers of the controller and its head."""
        units = codec.parse_description(self.command(codec.DESCRIBE))
        if not units:
            raise InstrumentError(
                f"Expected the description of the controller at {self.address}; found none",
                code="profiler.controller.missing",
            )
        model, serial = zip(*units, strict=True)
        return Identity(
            manufacturer="Keyence",
            model=" with head ".join(model),
            serial_number=", head ".join(serial),
            simulated=self.transport.simulated,
            details={"address": self.address},
        )

    def configure(self, settings: LJXSettings) -> None:
        """Change program and X pitch, if the settings state them.

        Raises
        ------
        InstrumentError
            The profiler refuses, or is streaming.
        """
        self._refuse_while_streaming()
        if settings.program is not None:
            self.change_program(settings.program)
        if settings.x_pitch is not None:
            self.set_x_pitch(settings.x_pitch)
        self.settings = settings

    def program(self) -> int:
        """Request the active program."""
        return self.command(codec.GET_STATUS).program

    def change_program(self, number: int) -> None:
        """Activate another program."""
        self._refuse_while_streaming()
        if not 0 <= number < codec.PROGRAMS:
            raise InstrumentError(
                f"Expected the number of a program, 0 to {codec.PROGRAMS - 1}; found {number}",
                code="profiler.program.number",
            )
        self.command(codec.CHANGE_PROGRAM, bytes((number, 0, 0, 0)))
        if (active := self.program()) != number:
            raise InstrumentError(
                f"Program {number} was requested, but {active} is active", code="profiler.program.other"
            )

    def x_pitch(self) -> float:
        """Request the distance between points on the line, m."""
        return float(self.command(codec.GET_X_PITCH).unpack("I")[0] * LENGTH)

    def set_x_pitch(self, pitch: float) -> None:
        """Set the distance between points on the line, m, rounded to 0.01 um."""
        self._refuse_while_streaming()
        self.command(codec.SET_X_PITCH, struct.pack("<I", round(pitch / LENGTH)))

    def counts(self) -> Counts:
        """Request the trigger and encoder counts; works while profiles are streaming."""
        return Counts(*self.command(codec.GET_COUNTS).unpack("Ii"))

    def temperature(self) -> dict[str, float]:
        """Request the head's temperatures, degC: its sensor, processor and case."""
        values = self.command(codec.GET_TEMPERATURE).unpack("3h")
        return {name: value * TEMPERATURE for name, value in zip(("sensor", "processor", "case"), values, strict=True)}

    def errors(self) -> list[int]:
        """Request the codes of the displayed errors."""
        return codec.parse_errors(self.command(codec.GET_ERROR))

    def clear_error(self, code: int) -> None:
        """Clear one error."""
        self.command(codec.CLEAR_ERROR, struct.pack("<HH", code, 0))

    def trigger(self) -> None:
        """Trigger one profile, if the program waits for external triggers."""
        self.command(codec.TRIGGER)

    def command(self, opcode: int, arguments: bytes = b"") -> Reply:
        """Send a request and return the reply; works while profiles are streaming.

        If replies can no longer be assigned to requests, and no profiles are streaming, both connections are first
        opened again, and the session is started as by `open`.

        Raises
        ------
        InstrumentError
            The profiler refuses, or the connection is lost.
        InstrumentTimeoutError
            The profiler does not answer. A late reply is skipped.
        ProtocolError
            The bytes are not a reply.
        """
        if self._reader is None and not self._line().usable():
            self._reconnect()
        return self._line().command(opcode, arguments)

    def _reconnect(self) -> None:
        lines: ManyLines = self.transport  # type: ignore[assignment]
        lines.reopen()
        lines.line(STREAM).reopen()
        try:
            self._start_session()
        except InstrumentError as error:
            self._line().lost = error  # the next command tries again
            raise

    def _line(self) -> CommandLine:
        if self._commands is None:
            self._commands = CommandLine(self.transport, self.name, self.settings.generation, self.settings.timeout)
        return self._commands

    # ------------------------------------------------------------------ measuring

    def read(self) -> np.ndarray[Any, Any]:
        """Measure one profile and return its heights, m, (point,); NaN where missing.

        A profiler that waits for its encoder is triggered by command; a free-running one may refuse the trigger.

        Raises
        ------
        InstrumentTimeoutError
            No profile within the time limit: the profiler waits for its trigger, or does not answer.
        """
        refused: list[InstrumentError] = []
        try:
            with closing(self._stream(1, lambda: refused.extend(self._refusals()))) as stream:
                return np.asarray(next(stream).heights[0])
        except InstrumentTimeoutError as error:
            if not self._line().answers:  # it does not answer commands either
                raise
            raise InstrumentTimeoutError(self._untriggered(refused), code="profiler.not_triggered") from error

    def _refusals(self) -> list[InstrumentError]:
        """Trigger one profile; return the refusal, if any."""
        try:
            self.trigger()
        except InstrumentError as error:
            if not self._line().answers:
                raise
            return [error]
        return []

    def _untriggered(self, refused: list[InstrumentError]) -> str:
        try:
            counts = self.counts()
            counted = f" (trigger count {counts.trigger}, encoder {counts.encoder})"
        except InstrumentError:
            counted = ""
        by_command = (
            f"the trigger by command was refused: {refused[0]}" if refused else "a trigger by command had no effect"
        )
        return (
            f"{self.name}: no profile within {self.settings.timeout:g} s: the profiler waits for its trigger{counted}, "
            f"and {by_command}. Move the axis whose encoder triggers it, or set its program to continuous measurement; "
            "check that its laser is on."
        )

    def stream(self, block: int | None = None) -> Iterator[Profiles]:
        """Yield blocks of profiles until the caller stops, which stops the stream.

        Parameters
        ----------
        block : int, optional
            Profiles in a block; default: a tenth of a second.

        Yields
        ------
        Profiles
            ``values`` (point, block) in m. Profiles that are missing by the trigger count are NaN and counted. The rest
            of a gap at the end of a block is counted there and skipped: ``first`` and ``trigger`` of the next block are
            those of the next profile.

        Raises
        ------
        InstrumentTimeoutError
            No answer within the time limit.
        ProtocolError
            No profile in the received bytes, or an inconsistent trigger count.
        InstrumentError
            The profiler ends the stream.
        """
        yield from self._stream(block)

    def _stream(self, block: int | None, on_start: Callable[[], None] | None = None) -> Generator[Profiles]:
        """Yield blocks as `stream`; call ``on_start`` when the stream has started."""
        from errormotion.instruments.line_profiler.keyence_ljx.blocks import SpacedRows
        from errormotion.instruments.line_profiler.keyence_ljx.decoder import HeightDecoder, StreamDecoder
        from errormotion.instruments.streaming import Reader

        self._refuse_while_streaming()
        size = block or max(1, round(BLOCK_SECONDS * self.rate))
        layout = codec.parse_layout(self.command(codec.PREPARE_STREAM, bytes((codec.FROM_NEXT, 0, 0, 0))))
        unpack = HeightDecoder(layout)
        unpack.warm_up()
        follow = StreamDecoder(layout, late_notice=self._notice_pending)
        limit = max(MIN_QUEUE, 2 * size, round(QUEUE_SECONDS * self.rate))
        lines: ManyLines = self.transport  # type: ignore[assignment]
        timeout = self.settings.timeout
        self._reader = reader = Reader(lines.line(STREAM), follow, name=self.name, limit=limit, overrun=LOST)
        rows = SpacedRows(lambda values, reasons: reader.fill(values, reasons, timeout), BATCH_PROFILES, layout.words)
        try:
            self.command(codec.START_STREAM, struct.pack("<Ii", codec.PREPARE_STREAM, layout.start_code))
            if on_start is not None:
                on_start()
            first = 0
            while True:
                if self._reader is not reader:
                    raise InstrumentError(
                        f"{self.name}: this stream was closed; start another one", code="stream.closed"
                    )
                parts, skipped = self._block(rows, unpack, layout, size)
                yield Profiles(
                    first=first,
                    rate=self.rate,
                    host_time=reader.host_time,
                    x=layout.x,
                    trigger=follow.first_trigger + first + np.arange(size),
                    **parts,
                )
                first += size + skipped
        finally:
            self._stop()

    def _block(
        self, rows: SpacedRows, unpack: HeightDecoder, layout: StreamLayout, size: int
    ) -> tuple[dict[str, Any], int]:
        """Return the parts of the next block, and the number of lost profiles skipped after it."""
        heights = np.empty((size, layout.points))
        intensity = np.empty((size, layout.points), dtype=np.uint16) if layout.with_intensity else None
        encoder = np.empty(size)
        counts = np.zeros(len(REASONS), dtype=np.int64)
        packed = np.empty((min(size, BATCH_PROFILES), layout.words), dtype=np.uint32)
        reasons = np.empty(len(packed), dtype=np.uint8)
        for start in range(0, size, BATCH_PROFILES):
            part = slice(start, min(start + BATCH_PROFILES, size))
            n = part.stop - part.start
            rows.fill(packed[:n], reasons[:n])
            unpack.heights(packed[:n], reasons[:n], heights[part], counts)
            encoder[part] = unpack.encoder(packed[:n, ENCODER_WORD], reasons[:n])
            if intensity is not None:
                unpack.intensities(packed[:n], reasons[:n], intensity[part])
        skipped = rows.skip_gap()
        parts = {
            "values": heights.T,
            "intensity": intensity,
            "encoder": encoder,
            "dropped": int(counts[LOST]) // layout.points + skipped,
            "invalid": {name: int(count) for name, count in zip(REASONS, counts, strict=True) if count},
        }
        return parts, skipped

    def _stop(self) -> None:
        """Stop the stream and its thread; if the profiler does not confirm this, the next command reconnects."""
        from errormotion.instruments.line_profiler.keyence_ljx.decoder import StreamEndedError

        reader, self._reader = self._reader, None
        if reader is None:
            return
        reader.drain()
        try:
            self.command(codec.STOP_STREAM)
            ended = reader.finish(QUIET_INTERVAL, self.settings.timeout)
            self._notice_pending = ended is None
            if ended is not None and not isinstance(ended, StreamEndedError):
                self._line().lost = ended
        except InstrumentError as error:
            self._line().lost = error
        finally:
            reader.abandon()

    # ------------------------------------------------------------------ opening and closing

    def _connect(self) -> Transport:
        from errormotion.instruments.transports.lines import open_lines

        return open_lines(
            self.address,
            {STREAM: STREAM_PORT},
            simulator=self.info.simulator,
            record=self._record,
            timeout=self.settings.timeout,
        )

    def _start_session(self) -> None:
        self._commands, self._notice_pending = None, False
        try:
            self.command(codec.STOP_STREAM)  # an earlier connection may have left it streaming
            self._notice_pending = True
        except InstrumentError:
            if not self._line().answers:  # if it answers, there was no stream to stop
                raise
        self.configure(self.settings)

    def _end_session(self) -> None:
        self._stop()

    def _refuse_while_streaming(self) -> None:
        if self._reader is not None:
            raise InstrumentError(f"{self.name} is streaming; close the stream first", code="stream.running")
