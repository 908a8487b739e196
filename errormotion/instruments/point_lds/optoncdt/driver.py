"""Driver of one optoNCDT."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.driver import Driver
from errormotion.instruments.point_lds.optoncdt.codec import LOST, OFFSET, OVERRUN, REASONS, SCALE
from errormotion.instruments.point_lds.optoncdt.commands import (
    LINE_END,
    PROMPT,
    Layout,
    parse_info,
    parse_layout,
    reported_range,
)
from errormotion.instruments.point_lds.optoncdt.dialogue import Dialogue
from errormotion.instruments.point_lds.optoncdt.models import MODELS
from errormotion.instruments.point_lds.optoncdt.settings import OptoSettings
from errormotion.instruments.streaming import count_reasons
from errormotion.instruments.transports import Transport, open_transport
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject, Samples

if TYPE_CHECKING:
    from errormotion.instruments.streaming import Reader

Sync = Literal["NONE", "MASTER", "SLAVE"]
BLOCK_SECONDS = 0.5
QUEUE_SECONDS = 2.0
MIN_QUEUE = 4096
Array = np.ndarray[Any, Any]


class OptoNCDT(Driver):
    """A Micro-Epsilon ILD1420 or ILD2300 point laser sensor over RS422 or TCP.

    Distances are in m from the start of the measuring range; NaN if the sensor has none.

    Parameters
    ----------
    address : str
        ``serial:///dev/ttyUSB0?baudrate=921600``, ``tcp://host:port``, ``sim://cframe/X1?seed=3``, ``replay://file``.
    settings : OptoSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="optoncdt",
        kind="point_lds",
        summary="Micro-Epsilon optoNCDT 1420/2300 laser triangulation sensor, RS422 or TCP",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.point_lds.optoncdt:SimulatedOptoNCDT",
    )
    Settings: ClassVar[type[OptoSettings]] = OptoSettings
    settings: OptoSettings
    name = "optoncdt"
    reasons: tuple[str, ...] = REASONS
    lost: tuple[int, ...] = (LOST, OVERRUN)
    _reader: Reader | None = None
    _dialogue: Dialogue
    _range: float | None = None  # as reported by the sensor
    _refused: list[str]
    _layout = Layout(())
    _termination = "TERMOFF"
    _master = False  # whether it sends synchronisation pulses

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        return InstrumentSubject(cls, "sim://cframe?seed=3")

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.settings.rate

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m; InstrumentError while the range is unknown."""
        return 0.0, self._known_range

    @property
    def mid_range(self) -> float:
        """The reading in the middle of the range, m; InstrumentError while the range is unknown."""
        return self._known_range / 2

    @property
    def encoding(self) -> dict[str, Any]:
        """Encoding that stores readings without loss: the 16-bit numbers that the sensor sends."""
        return {
            "dtype": "uint16",
            "scale_factor": SCALE * self._known_range,
            "add_offset": -OFFSET * self._known_range,
            "_FillValue": 65535,
        }

    @property
    def _known_range(self) -> float:
        known = self.settings.range if self._range is None else self._range
        if known is None:
            raise InstrumentError(
                f"The range of the {self.info.id} at {self.address} is unknown before it is opened: "
                "open it first, or state 'range' in its settings",
                code="sensor.range.unknown",
            )
        return known

    @property
    def stray_bytes(self) -> int:
        """Bytes of the running stream that were neither values nor answers."""
        return 0 if self._reader is None else self._reader.stray_bytes

    def identify(self) -> Identity:
        """Request the identity of the sensor (GETINFO)."""
        facts = parse_info(self.command("GETINFO"))
        refused = {"refused commands": ", ".join(self._refused)} if self._refused else {}
        return Identity(
            manufacturer="Micro-Epsilon",
            model=facts.get("name", "unknown"),
            serial_number=facts.get("serial", "unknown"),
            firmware=facts.get("version", ""),
            simulated=self.transport.simulated,
            details={"address": self.address, **facts, **refused},
        )

    def configure(self, settings: OptoSettings) -> None:
        """Compare the settings with the line and the sensor, and send them.

        Nothing is stored permanently in the sensor, and `close` restores its settings.

        Raises
        ------
        InstrumentError
            The rate exceeds the baud rate; model or range differ; the sensor refuses, keeps a setting that changes
            the values, or sends other values than the distance and the counter.
        """
        settings.line_speed(self.address)
        self._refuse_while_streaming()
        measured = self._check_sensor(settings)
        model, dialogue = MODELS[settings.model], self._open_dialogue
        dialogue.set(f"MEASRATE {model.rate_word(settings.rate)}")
        for command in model.cleared:
            dialogue.set(command.format(termination=self._termination_of(command.split(" ", 1)[0])))
        self._refused = [command for command in model.optional if not dialogue.neutralise(command)]
        dialogue.set(f"OUTADD_RS422 {'COUNTER' if settings.counter else 'NONE'}")
        self._layout = parse_layout(self.command("GETOUTINFO_RS422"), counter=settings.counter)
        if model.synchronises:
            self._termination = self._termination_of("SYNC")
            dialogue.set(f"SYNC NONE {self._termination}")  # no pulses while the sensors of a frame are configured
        self.settings, self._range, dialogue.timeout = settings, measured, settings.timeout

    def _termination_of(self, name: str) -> str:
        """Return the line termination that the sensor reports for a command; TERMOFF if it reports none."""
        return "TERMON" if "TERMON" in self._open_dialogue.remember(name) else "TERMOFF"

    def command(self, text: str) -> list[str]:
        """Send a command and return the lines of the answer; works while data are streaming.

        If the stop of the last stream was not confirmed, a network connection is first opened again, and the sensor is
        stopped and set up again.

        Raises
        ------
        InstrumentError
            The sensor refuses, or is not open.
        InstrumentTimeoutError
            The sensor does not answer. The next command resynchronises first: a late answer is not mistaken for another
            one.
        """
        if self._open_dialogue.lost is not None and self._reader is None:
            self._recover()
        return self._open_dialogue.command(text)

    def _recover(self) -> None:
        self.transport.reopen()
        self._dialogue.recover()
        try:
            self.command("OUTPUT NONE")
            self.configure(self.settings)
        except InstrumentError as error:
            self._dialogue.lost = error  # the next command tries again
            raise

    @property
    def _open_dialogue(self) -> Dialogue:
        self.transport  # noqa: B018 - raises before open
        return self._dialogue

    def read(self) -> float:
        """Return the present distance, m; NaN if the sensor has none."""
        for samples in self.stream(block=1):
            return float(samples.values[0, 0])
        raise InstrumentError(f"{self.name}: the stream ended before its first sample", code="stream.ended")

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of samples until the caller stops, which stops the sensor.

        Parameters
        ----------
        block : int, optional
            Samples in a block; default: half a second.

        Yields
        ------
        Samples
            ``values`` (1, block) in m.

        Raises
        ------
        InstrumentTimeoutError
            No answer within the time limit.
        ProtocolError
            The counter is inconsistent.
        """
        size = block or max(1, round(BLOCK_SECONDS * self.rate))
        self.start(size)
        try:
            first = 0
            while True:
                values, reasons = np.empty((1, size)), np.empty((1, size), dtype=np.uint8)
                self.fill(values[0], reasons[0])
                invalid = count_reasons(reasons[0], self.reasons)
                lost = sum(invalid.get(self.reasons[code], 0) for code in self.lost)
                yield Samples(values, first, self.rate, self.host_time, lost, invalid)
                first += size
        finally:
            self.stop()

    def start(self, block: int, sync: Sync = "NONE") -> None:
        """Start the stream; samples are then read with ``fill``, at most ``block`` at once.

        With ``SLAVE`` no data arrive until the master starts, and the counter of the first sample is 0. A master is
        first configured as a slave without pulses, its counter is reset, and it becomes the master last, so that its
        sample 0 belongs to its first pulse, as on the slaves.
        """
        from errormotion.instruments.point_lds.optoncdt.decoder import StreamDecoder
        from errormotion.instruments.streaming import Reader

        self._refuse_while_streaming()
        model = MODELS[self.settings.model]
        if model.synchronises:
            self.command(f"SYNC {'NONE' if sync == 'NONE' else 'SLAVE'} {self._termination}")
        elif sync != "NONE":
            raise InstrumentError(
                f"{self.name}: the {model.name} cannot be synchronised with other sensors; use sensors ILD2300, "
                "or read them one by one",
                code="sensor.not_synchronisable",
            )
        self.command("RESETCNT MEASCNT")
        decoder = StreamDecoder(
            self._known_range,
            highest=model.highest,
            counter=self._layout.counter,
            counter_first=self._layout.counter_first,
            from_zero=sync != "NONE",
        )
        decoder.warm_up()
        limit = max(MIN_QUEUE, 2 * block, round(QUEUE_SECONDS * self.rate))
        self._reader = Reader(self.transport, decoder, name=self.name, limit=limit, overrun=OVERRUN, prompt=PROMPT)
        self._dialogue.reader = self._reader
        try:
            self.command("OUTPUT RS422")
            if sync == "MASTER":
                self._master = True
                self.command(f"SYNC MASTER {self._termination}")
        except BaseException:
            self._abandon()
            raise

    def fill(self, values: Array, reasons: Array) -> None:
        """Fill both arrays with the next samples: distances in m, and positions in `codec.REASONS`."""
        if self._reader is None:
            raise InstrumentError(f"{self.name}: no stream is running; call start() first", code="stream.not_running")
        self._reader.fill(values, reasons, self.settings.timeout)

    @property
    def host_time(self) -> float:
        """``time.monotonic()`` when the last samples that ``fill`` returned were received."""
        return 0.0 if self._reader is None else self._reader.host_time

    def drain(self) -> None:
        """Discard all samples until ``stop``, so that the sensor is not blocked."""
        if self._reader is not None:
            self._reader.drain()

    def stop(self, timeout: float | None = None) -> None:
        """Stop the stream and its thread; idempotent.

        If the sensor does not confirm the stop within ``timeout`` s, the next command stops it and sets it up again.
        """
        reader, self._reader = self._reader, None
        if reader is None:
            return
        self._dialogue.reader = None
        master, self._master = self._master, False
        try:
            reader.stop(b"OUTPUT NONE" + LINE_END, self.settings.timeout if timeout is None else timeout)
            if master:
                self.command(f"SYNC NONE {self._termination}")  # slaves must start with the pulses of the next stream
        except InstrumentError as error:
            reader.abandon()
            self._dialogue.lost = error

    def _connect(self) -> Transport:
        baudrate = self.settings.line_speed(self.address)
        return open_transport(
            self.address,
            simulator=self.info.simulator,
            recorder=self._record,
            timeout=self.settings.timeout,
            baudrate=baudrate,
        )

    def _start_session(self) -> None:
        self._range, self._refused, self._master = None, [], False
        self._dialogue = Dialogue(self.exchange, self.settings.timeout)
        self._dialogue.remember("OUTPUT")  # refused if an earlier client has left an incomplete line
        self.command("OUTPUT NONE")  # it may stream since it was switched on
        try:
            self.configure(self.settings)
        except InstrumentError:
            with suppress(InstrumentError):
                self._dialogue.restore()
            raise

    def _end_session(self) -> None:
        self.stop()
        self._dialogue.restore()

    def resynchronise(self) -> None:
        """Discard late answers after a failed exchange; see `Driver.resynchronise`."""
        super().resynchronise()
        self._dialogue.synchronise(self.transport)

    def _abandon(self) -> None:
        reader, self._reader = self._reader, None
        self._dialogue.reader = None
        if reader is not None:
            reader.abandon()

    def _refuse_while_streaming(self) -> None:
        if self._reader is not None:
            raise InstrumentError(f"{self.name} is streaming; close the stream first", code="stream.running")

    def _check_sensor(self, settings: OptoSettings) -> float:
        """Compare model and range with the settings; return the measuring range, m."""
        facts = parse_info(self.command("GETINFO"))
        name, measured = facts.get("name", "unknown"), reported_range(facts)
        if not name.replace(" ", "").upper().startswith(settings.model):
            raise InstrumentError(
                f"The settings state model {settings.model}; the sensor at {self.address} is a '{name}'",
                code="sensor.model.differs",
            )
        stated = settings.range
        if measured is None and stated is None:
            raise InstrumentError(
                f"The sensor at {self.address} reports no measuring range; state 'range' in its settings",
                code="sensor.range.unknown",
            )
        if measured is not None and stated is not None and not np.isclose(measured, stated):
            raise InstrumentError(
                f"The settings state a range of {stated * 1e3:g} mm; the sensor at {self.address} "
                f"has {measured * 1e3:g} mm",
                code="sensor.range.differs",
            )
        return float(stated if measured is None else measured)  # type: ignore[arg-type]
