"""Driver of one channel of a capaNCDT 6200 controller."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError, ReplayError
from errormotion.instruments.driver import Driver
from errormotion.instruments.point_lds.capancdt import codec
from errormotion.instruments.point_lds.capancdt.blocks import LOST, REASONS, Block, BlockDecoder, scale
from errormotion.instruments.point_lds.capancdt.sequence import Sequence, column, reasons
from errormotion.instruments.point_lds.capancdt.settings import CapaSettings
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.lines import ManyLines
from errormotion.plugins import Identity, InstrumentInfo, Samples

BLOCK_SECONDS = 0.5
DATA = "data"
"""Name of the data line, and of the parameter of the address that states its port."""
MAX_OTHER_LINES = 16
PAUSE_OF_REQUEST = 0.3
"""Time after which a reading is requested again on a data line that was just opened, s."""
RANGE_TOLERANCE = 1e-3
"""Of the range: two statements of it that differ less are the same."""


class CapaNCDT(Driver):
    """A capacitive displacement sensor at a channel of a Micro-Epsilon capaNCDT 6200 (DT6220, DT6230).

    Readings are the distance in m that the controller reports, larger for a more distant surface; NaN where the
    sensor has none.

    Opening sets the trigger mode of the controller to single readings; closing restores it.

    Parameters
    ----------
    address : str
        ``tcp://host:23`` (``?data=10001`` for another data port), ``sim://cframe/X1?seed=3``, ``replay://file``.
    settings : CapaSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    no_value : str
        Reason of the last reading where it is NaN, one of `blocks.REASONS`; else empty.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="capancdt",
        kind="point_lds",
        summary="Micro-Epsilon capaNCDT 6200 capacitive displacement sensor, Ethernet",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.point_lds.capancdt:SimulatedCapaNCDT",
    )
    Settings: ClassVar[type[CapaSettings]] = CapaSettings
    settings: CapaSettings
    no_value: str = ""
    _channel: codec.Channel | None = None
    _rate = float("nan")
    _trigger: int | None = None  # of the controller, before it was opened
    _stale = False  # whether the data line may hold values of an earlier stream
    _streaming = False
    _failed = False

    @property
    def rate(self) -> float:
        """Readings per second of a stream, as the controller states it; NaN before it was opened."""
        return self._rate

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m, as the controller states them."""
        channel = self._ready()
        return channel.offset, channel.offset + channel.measuring_range

    @property
    def mid_range(self) -> float:
        """Reading in the middle of the range, m."""
        return sum(self.measuring_range) / 2

    def identify(self) -> Identity:
        """Return what the controller and the demodulator of the channel report."""
        channel = self._ready()
        details: dict[str, Any] = {"address": self.address, "channel": self.settings.channel}
        try:
            fields = codec.parse_fields(codec.CONTROLLER, self._query(codec.CONTROLLER))
            name, number, version = (fields.get(field, "") for field in ("NAM", "SNO", "VER"))
        except ReplayError:
            raise
        except InstrumentTimeoutError:
            raise
        except InstrumentError:  # older controllers report a version only
            name, version, *_ = [*self._query(codec.VERSION).split(";"), ""]
            number = ""
        details["demodulator"] = f"{channel.name} {channel.serial_number}".strip()
        details["linearisation"] = self._query(f"{codec.LINEARISATION}?")
        return Identity(
            manufacturer="Micro-Epsilon",
            model=name or "capaNCDT 6200",
            serial_number=number or channel.serial_number or "unknown",
            firmware=version,
            simulated=self.transport.simulated,
            details=details,
        )

    def configure(self, settings: CapaSettings) -> None:
        """Compare the settings with the controller and send those that are given; they hold for all its channels.

        Raises
        ------
        InstrumentError
            No sensor at the channel, another measuring range, a mathematical function at the channel; or it refuses.
        """
        if self._streaming:
            raise InstrumentError(f"{self.info.id} is streaming; close the stream first")
        number = settings.channel
        states = codec.parse_channels(self._query(codec.CHANNELS))
        state = states[number - 1] if number <= len(states) else codec.ABSENT
        if state != codec.PRESENT:
            what = "gives a mathematical function" if state == codec.MATHS else "is not there"
            raise InstrumentError(
                f"{self.address}: expected a sensor at channel {number}; it {what}. "
                f"States of the channels: {', '.join(map(str, states))}"
            )
        channel = codec.parse_channel(number, self._query(codec.channel_request(number)))
        _check_range(settings.measuring_range, channel, number)
        average = self._average(settings)
        time_of_sample = self._sample_time(settings)
        self._channel, self.settings = channel, settings
        self._rate = 1 / (time_of_sample * average)

    def read(self) -> float:
        """Return one reading now, m; NaN where the sensor has none, with the reason in ``no_value``.

        Raises
        ------
        InstrumentTimeoutError
            No answer or no value within the time limit.
        InstrumentError
            The controller refuses, or does not send this channel.
        """
        channel = self._ready()
        if self._streaming:
            raise InstrumentError(f"{self.info.id} is streaming; close the stream first")
        block = self._requested_block()
        if not block.intact:
            raise ProtocolError(f"{self.address}: the block of a reading broke off, or stray bytes follow; read again")
        values, codes = scale(column(block, self.settings.channel)[-1:], channel.offset, channel.measuring_range)
        self.no_value = REASONS[int(codes[0])]
        self._data.report_delivered(1)
        return float(values[0])

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of readings until the caller stops.

        Parameters
        ----------
        block : int, optional
            Readings in a block; default: half a second.

        Yields
        ------
        Samples
            ``values`` (1, block) in m; ``invalid`` counts the NaN by `blocks.REASONS`, ``dropped`` those that are lost.

        Raises
        ------
        InstrumentTimeoutError
            No values within the time limit.
        InstrumentError
            The controller refuses or does not send this channel; the connection is lost.
        """
        sequence = Sequence(self.settings.channel, self._ready())
        if self._streaming:
            raise InstrumentError(f"{self.info.id} is streaming already")
        size = block or max(1, round(BLOCK_SECONDS * self.rate))
        self._refresh()
        self._streaming = self._stale = True
        try:
            self._query(f"{codec.TRIGGER}{codec.CONTINUOUS}")
            yield from self._blocks(sequence, size)
        except BaseException as error:
            self._failed = isinstance(error, InstrumentError)
            raise
        finally:
            self._streaming = False
            if self._transport is not None and not self._failed:
                self._query(f"{codec.TRIGGER}{codec.ON_REQUEST}")

    def _blocks(self, sequence: Sequence, size: int) -> Iterator[Samples]:
        decoder = BlockDecoder()
        first, limit = 0, self.settings.timeout
        until = time.monotonic() + limit
        while True:
            while sequence.waiting < size:
                data = self._data.read(timeout=max(until - time.monotonic(), 0.0))
                blocks = decoder.feed(data)
                for each in blocks:
                    sequence.add_block(each)
                if blocks:
                    until = time.monotonic() + limit
            values, codes = sequence.take(size)
            invalid = reasons(codes)
            yield Samples(
                values[np.newaxis],
                first,
                self.rate,
                time.monotonic(),
                dropped=int((codes == LOST).sum()),
                invalid={reason: count for reason, count in invalid.items() if reason != REASONS[LOST]},
            )
            first += size
            self._data.report_delivered(first)
            until = time.monotonic() + limit

    # ------------------------------------------------------------------ commands

    @property
    def _data(self) -> Transport:
        lines = self.transport
        assert isinstance(lines, ManyLines)
        return lines.line(DATA)

    def _ready(self) -> codec.Channel:
        self.transport  # noqa: B018 - an error before it was opened
        if self._channel is None:
            raise InstrumentError(f"{self.address}: the controller has not been set up")
        return self._channel

    def _query(self, command: str) -> str:
        """Send a command and return its answer; lines that answer another one are skipped."""
        with self.exchange() as line:
            line.write(codec.encode(command))
            for _ in range(MAX_OTHER_LINES):
                answer = line.read_until(codec.LINE_END, limit=codec.MAX_LINE_BYTES)
                if codec.echoes(command, answer):
                    break
            else:
                raise ProtocolError(
                    f"{self.address}: expected an answer to '${command}'; found {MAX_OTHER_LINES} other lines"
                )
        return codec.answer_to(command, answer)  # a refusal is an answer as well

    def _refresh(self) -> bool:
        """Make sure that the next values on the data line are new ones; return whether it was opened again."""
        if not self._stale:
            return False
        self._query(f"{codec.TRIGGER}?")  # earlier requests have been carried out by now
        self._data.reopen()
        self._query(f"{codec.TRIGGER}?")  # meanwhile the controller accepts the connection
        self._stale = False
        return True

    def _requested_block(self) -> Block:
        reopened = self._refresh()
        self._stale = True  # until the value has come
        self._query(codec.ONE_READING)
        if reopened:
            with suppress(InstrumentTimeoutError):  # the request was ahead of the new connection
                block = self._one_block(min(PAUSE_OF_REQUEST, self.settings.timeout / 2))
                self._stale = False
                return block
            self._query(codec.ONE_READING)
            return self._one_block(self.settings.timeout)  # two may come: the line is opened again for the next one
        block = self._one_block(self.settings.timeout)
        self._stale = False
        return block

    def _one_block(self, limit: float) -> Block:
        decoder = BlockDecoder()
        until = time.monotonic() + limit
        while True:
            data = self._data.read(timeout=max(until - time.monotonic(), 0.0))
            if blocks := decoder.feed(data, last=True):
                return blocks[-1]

    def _average(self, settings: CapaSettings) -> int:
        """Set the averaging; return of how many samples a reading is made."""
        if settings.averaging is not None:
            self._query(f"{codec.AVERAGING}{codec.AVERAGINGS[settings.averaging]}")
        if settings.averaging_number is not None:
            self._query(f"{codec.AVERAGING_NUMBER}{settings.averaging_number}")
        request = f"{codec.AVERAGING}?"
        if codec.parse_number(request, self._query(request)) != codec.AVERAGINGS["arithmetic"]:
            return 1
        request = f"{codec.AVERAGING_NUMBER}?"
        return max(1, codec.parse_number(request, self._query(request)))

    def _sample_time(self, settings: CapaSettings) -> float:
        """Set the sample time; return the actual one, s."""
        asked = "?" if settings.rate is None else f"{round(1e6 / settings.rate)}"
        request = f"{codec.SAMPLE_TIME}{asked}"
        return codec.parse_sample_time(request, self._query(request))

    # ------------------------------------------------------------------ opening and closing

    def _connect(self) -> Transport:
        from errormotion.instruments.transports.lines import open_lines

        return open_lines(
            self.address,
            {DATA: codec.DATA_PORT},
            simulator=self.info.simulator,
            record=self._record,
            timeout=self.settings.timeout,
        )

    def _start_session(self) -> None:
        self._channel, self._failed = None, False
        self._data.report_delivered(0)
        request = f"{codec.TRIGGER}?"
        self._trigger = codec.parse_number(request, self._query(request))
        self._stale = self._trigger == codec.CONTINUOUS
        self._query(f"{codec.TRIGGER}{codec.ON_REQUEST}")
        self.configure(self.settings)

    def _end_session(self) -> None:
        if self._trigger is not None and not self._failed:
            self._query(f"{codec.TRIGGER}{self._trigger}")


def _check_range(stated: float | None, channel: codec.Channel, number: int) -> None:
    found = channel.measuring_range
    if stated is not None and abs(stated - found) > RANGE_TOLERANCE * found:
        raise InstrumentError(
            f"The setting 'measuring_range' is {stated * 1e3:g} mm; the controller states {found * 1e3:g} mm at "
            f"channel {number}. Change the setting, or assign the sensor in the controller"
        )
