"""Driver of one optoNCDT."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.driver import Driver
from errormotion.instruments.point_lds.optoncdt.codec import (
    LINE_END,
    LOST,
    OFFSET,
    OVERRUN,
    PROMPT,
    REASONS,
    SCALE,
    parse_reply,
    rate_text,
    text_of,
)
from errormotion.instruments.point_lds.optoncdt.settings import OptoSettings
from errormotion.instruments.streaming import count_reasons
from errormotion.instruments.transports import Transport, open_transport
from errormotion.plugins import Identity, InstrumentInfo, Samples

if TYPE_CHECKING:
    from errormotion.instruments.streaming import Reader

Sync = Literal["NONE", "MASTER", "SLAVE"]
ON_FOR = "operating time"  # (m)
BLOCK_SECONDS = 0.5
QUEUE_SECONDS = 2.0
SMALLEST_QUEUE = 4096
Array = np.ndarray[Any, Any]


class OptoNCDT(Driver):
    """A Micro-Epsilon ILD1420 or ILD2300 point laser sensor over RS422 or TCP.

    Distances are in m from the start of the measuring range; NaN where the sensor has none.

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
    _lost: InstrumentError | None = None

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.settings.rate

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m."""
        return 0.0, self.settings.range

    @property
    def mid_range(self) -> float:
        """The reading in the middle of the range, m."""
        return self.settings.range / 2

    @property
    def encoding(self) -> dict[str, Any]:
        """Encoding that stores readings without loss: the 16-bit numbers of the wire."""
        return {
            "dtype": "uint16",
            "scale_factor": SCALE * self.settings.range,
            "add_offset": -OFFSET * self.settings.range,
            "_FillValue": 65535,
        }

    @property
    def stray_bytes(self) -> int:
        """Bytes of the running stream that were neither values nor answers."""
        return 0 if self._reader is None else self._reader.stray_bytes

    def identify(self) -> Identity:
        """Request the identity of the sensor (GETINFO)."""
        facts = self._facts()
        facts.pop(ON_FOR, None)
        return Identity(
            manufacturer="Micro-Epsilon",
            model=facts.get("name", "unknown"),
            serial_number=facts.get("serial", "unknown"),
            firmware=facts.get("version", ""),
            simulated=self.transport.simulated,
            details={"address": self.address, **facts},
        )

    def _facts(self) -> dict[str, str]:
        parts = [line.partition(":") for line in self.command("GETINFO")]
        return {key.strip().lower(): value.strip() for key, mark, value in parts if mark}

    def on_for(self) -> float:
        """Return the operating time that the sensor reports, s; 0 where it reports none."""
        stated = re.match(r"([\d.]+)", self._facts().get(ON_FOR, ""))
        return float(stated[1]) if stated else 0.0

    def configure(self, settings: OptoSettings) -> None:
        """Compare settings with the line and the sensor, and send them.

        Raises
        ------
        InstrumentError
            The rate does not fit through the baud rate; another model or range answers; the sensor refuses.
        """
        settings.line_speed(self.address)
        self._refuse_while_streaming()
        self._check_sensor(settings)
        self.command(f"MEASRATE {rate_text(settings.rate)}")
        self.command("MASTERMV NONE")  # no offset: distances count from the start of the range
        self.command(f"OUTADD_RS422 {'COUNTER' if settings.counter else 'NONE'}")  # (m)
        self.command("LASERPOW FULL")
        self.settings = settings

    def command(self, text: str) -> list[str]:
        """Send a command and return the lines of the answer; works while data are streaming.

        Raises
        ------
        InstrumentError
            The sensor refuses.
        InstrumentTimeoutError
            It does not answer.
        """
        if self._lost is not None:
            raise InstrumentError(f"The connection to {self.name} is lost ({self._lost}); close and open it again")
        request = text.encode("ascii") + LINE_END
        timeout = self.settings.timeout
        if self._reader is not None:
            return parse_reply(text, self._reader.query(request, timeout))
        self.transport.write(request)
        return parse_reply(text, text_of(self.transport.read_until(PROMPT, limit=1 << 24, timeout=timeout)))

    def read(self) -> float:
        """Return one distance now, m; NaN where the sensor has none."""
        for samples in self.stream(block=1):
            return float(samples.values[0, 0])
        raise InstrumentError(f"{self.name}: the stream ended before its first sample")

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of samples until the caller stops; the end of the loop stops the sensor.

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

        With ``SLAVE`` no data arrive until the master starts, and the counter of the first sample is 0.
        """
        from errormotion.instruments.point_lds.optoncdt.decoder import StreamDecoder
        from errormotion.instruments.streaming import Reader

        self._refuse_while_streaming()
        self.command(f"SYNC {sync}")
        self.command("RESETCNT COUNTER")  # (m)
        decoder = StreamDecoder(self.settings.range, counter=self.settings.counter, from_zero=sync != "NONE")
        decoder.warm_up()
        limit = max(SMALLEST_QUEUE, 2 * block, round(QUEUE_SECONDS * self.rate))
        self._reader = Reader(self.transport, decoder, name=self.name, limit=limit, overrun=OVERRUN, prompt=PROMPT)
        try:
            self.command("OUTPUT RS422")
        except BaseException:
            self._abandon()
            raise

    def fill(self, values: Array, reasons: Array) -> None:
        """Fill both arrays with the next samples: distances in m, and positions in `codec.REASONS`."""
        if self._reader is None:
            raise InstrumentError(f"{self.name}: no stream is running; call start() first")
        self._reader.fill(values, reasons, self.settings.timeout)

    @property
    def host_time(self) -> float:
        """``time.monotonic()`` when the last samples that ``fill`` returned were received."""
        return 0.0 if self._reader is None else self._reader.host_time

    def drain(self) -> None:
        """Discard all samples until ``stop``, so that the sensor need not wait."""
        if self._reader is not None:
            self._reader.drain()

    def stop(self, timeout: float | None = None) -> None:
        """Stop the stream and its thread; idempotent.

        A sensor that does not confirm the stop within ``timeout`` s must be opened again; the next
        command raises the error.
        """
        reader, self._reader = self._reader, None
        if reader is None:
            return
        try:
            reader.stop(b"OUTPUT NONE" + LINE_END, self.settings.timeout if timeout is None else timeout)
        except InstrumentError as error:
            reader.abandon()
            self._lost = error

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
        self._lost = None
        self.command("OUTPUT NONE")  # it may have been streaming since it was switched on
        self.configure(self.settings)

    def _end_session(self) -> None:
        self.stop()

    def _abandon(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.abandon()

    def _refuse_while_streaming(self) -> None:
        if self._reader is not None:
            raise InstrumentError(f"{self.name} is streaming; close the stream first")

    def _check_sensor(self, settings: OptoSettings) -> None:
        identity = self.identify()
        if settings.model not in identity.model.replace(" ", ""):
            raise InstrumentError(
                f"The settings state model {settings.model}; the sensor at {self.address} is a '{identity.model}'"
            )
        stated = re.match(r"([\d.]+)\s*mm", str(identity.details.get("range", "")))
        if stated and not np.isclose(float(stated[1]) * 1e-3, settings.range):
            raise InstrumentError(
                f"The settings state a range of {settings.range * 1e3:g} mm; the sensor at {self.address} "
                f"has {stated[1]} mm"
            )
