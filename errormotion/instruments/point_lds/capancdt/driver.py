"""Driver of one channel of a capaNCDT 6200 controller."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, ClassVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError, ReplayError
from errormotion.instruments.point_lds.blocks import Block, BlockDecoder
from errormotion.instruments.point_lds.capancdt import codec
from errormotion.instruments.point_lds.capancdt.blocks import REASONS, block_decoder, column, readings_of, scale
from errormotion.instruments.point_lds.capancdt.settings import CapaSettings
from errormotion.instruments.point_lds.counted import CountedReadings
from errormotion.instruments.point_lds.counting import CountingDriver, check_range
from errormotion.plugins import Identity, InstrumentInfo

REQUEST_INTERVAL = 0.3
"""Time after which a reading is requested again if the data line was just opened, s."""


class CapaNCDT(CountingDriver):
    """A capacitive displacement sensor at a channel of a Micro-Epsilon capaNCDT 6200 (DT6220, DT6230).

    Readings are the distance in m that the controller reports, larger for a more distant surface; NaN if the sensor has
    none.

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
        Why the last reading is NaN, one of `blocks.REASONS`; empty if it is valid.
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
    data_port: ClassVar[int] = codec.DATA_PORT
    _channel: codec.Channel | None = None
    _trigger: int | None = None  # mode of the controller before ``open``

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m, as the controller states them."""
        channel = self._ready()
        return channel.offset, channel.offset + channel.measuring_range

    def identify(self) -> Identity:
        """Return the identity that the controller reports, and the demodulator of the channel."""
        channel = self._ready()
        details: dict[str, Any] = {"address": self.address, "channel": self.settings.channel}
        try:
            fields = codec.parse_fields(codec.CONTROLLER, self._query(codec.CONTROLLER))
            name, number, version = (fields.get(field, "") for field in ("NAM", "SNO", "VER"))
        except ReplayError:
            raise
        except InstrumentTimeoutError:
            raise
        except InstrumentError:  # older controllers only report a version
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
        """Compare the settings with the controller and send those that are given, for all its channels.

        Raises
        ------
        InstrumentError
            The channel has no sensor, another measuring range or a mathematical function; or the controller refuses.
        """
        self._refuse_while_streaming()
        number = settings.channel
        states = codec.parse_channels(self._query(codec.CHANNELS))
        state = states[number - 1] if number <= len(states) else codec.ABSENT
        if state != codec.PRESENT:
            found = "a mathematical function" if state == codec.MATHS else "none"
            raise InstrumentError(
                f"{self.address}: expected a sensor at channel {number}; found {found}. "
                f"States of the channels: {', '.join(map(str, states))}",
                code="sensor.channel.missing",
            )
        channel = codec.parse_channel(number, self._query(codec.channel_request(number)))
        where, remedy = f" at channel {number}", "assign the sensor in the controller"
        check_range(settings.measuring_range, channel.measuring_range, where, remedy)
        average = self._average(settings)
        time_of_sample = self._sample_time(settings)
        self._channel, self.settings = channel, settings
        self._rate = 1 / (time_of_sample * average)

    def read(self) -> float:
        """Return the present reading, m; NaN if the sensor has none, with the reason in ``no_value``.

        Raises
        ------
        InstrumentTimeoutError
            No answer or no value within the time limit.
        InstrumentError
            The controller refuses, or does not send this channel.
        """
        channel = self._ready()
        self._refuse_while_streaming()
        block = self._requested_block()
        if not block.intact:
            raise ProtocolError(
                f"{self.address}: the block of a reading is incomplete, or stray bytes follow; read again",
                code="protocol.reading.damaged",
            )
        values, codes = scale(column(block, self.settings.channel)[-1:], channel.offset, channel.measuring_range)
        self.no_value = REASONS[int(codes[0])]
        self._data.report_delivered(1)
        return float(values[0])

    # ------------------------------------------------------------------ values

    def _decoder(self) -> BlockDecoder:
        return block_decoder()

    def _readings(self) -> CountedReadings:
        return readings_of(self.settings.channel, self._ready())

    def _start_values(self) -> None:
        self._stale = True
        self._query(f"{codec.TRIGGER}{codec.CONTINUOUS}")

    def _stop_values(self) -> None:
        self._query(f"{codec.TRIGGER}{codec.ON_REQUEST}")

    def _refresh(self) -> bool:
        """Ensure that the next values on the data line are new ones; return whether it was opened again."""
        if not self._stale:
            return False
        self._query(f"{codec.TRIGGER}?")  # earlier requests have been carried out by now
        self._data.reopen()
        self._query(f"{codec.TRIGGER}?")  # by its answer the controller has accepted the connection
        self._stale = False
        return True

    def _requested_block(self) -> Block:
        reopened = self._refresh()
        self._stale = True  # until the value has arrived
        self._query(codec.ONE_READING)
        if reopened:
            with suppress(InstrumentTimeoutError):  # the request preceded the new connection
                *_, block = self._next_blocks(min(REQUEST_INTERVAL, self.settings.timeout / 2))
                self._stale = False
                return block
            self._query(codec.ONE_READING)
            *_, block = self._next_blocks(self.settings.timeout)
            return block  # two may arrive: the line is opened again for the next one
        *_, block = self._next_blocks(self.settings.timeout)
        self._stale = False
        return block

    # ------------------------------------------------------------------ commands

    def _ready(self) -> codec.Channel:
        self.transport  # noqa: B018 - raises before open
        if self._channel is None:
            raise InstrumentError(f"{self.address}: the controller has not been set up", code="sensor.not_set_up")
        return self._channel

    def _query(self, command: str) -> str:
        """Send a command and return its answer; lines that answer other commands are skipped."""
        with self.exchange() as line:
            line.write(codec.encode(command))
            answer = self.answer_line(
                line,
                f"'${command}'",
                lambda text: text if codec.echoes(command, text) else None,
                limit=codec.MAX_LINE_BYTES,
            )
        return codec.answer_to(command, answer)  # a refusal is also an answer

    def _average(self, settings: CapaSettings) -> int:
        """Set the averaging; return the number of samples of a reading."""
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
        parameter = "?" if settings.rate is None else f"{round(1e6 / settings.rate)}"
        request = f"{codec.SAMPLE_TIME}{parameter}"
        return codec.parse_sample_time(request, self._query(request))

    # ------------------------------------------------------------------ opening and closing

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
