"""Driver of one head at an LK-G or LK-H controller."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.driver import Driver
from errormotion.instruments.point_lds.keyence_lk.codec import (
    CONTROLLERS,
    DISPLAY_SETTING,
    DISPLAYS,
    ERROR,
    GARBLED,
    HEADS,
    MAX_LINE_BYTES,
    MEASURING,
    NO_OFFSET,
    OFFSET_SETTING,
    REASONS,
    SETTING,
    SIGNS,
    STATE_ERRORS,
    check_rate,
    decode,
    encode,
    error_code,
    parse_answer,
    parse_value,
)
from errormotion.instruments.point_lds.keyence_lk.settings import LKSettings
from errormotion.instruments.transports import Transport, open_transport, parse_address
from errormotion.instruments.transports.base import LINE_ENDS
from errormotion.instruments.transports.quiet import discard_input
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject, Samples

BLOCK_SECONDS = 0.5


class KeyenceLK(Driver):
    """A Keyence LK-G or LK-H laser displacement sensor over RS-232C.

    Readings are in m from the middle of the measuring range along the beam: negative nearer to the head, positive
    farther away, independent of the sign on the controller; NaN if the sensor has none.

    Parameters
    ----------
    address : str
        ``serial:///dev/ttyUSB0?baudrate=115200``, ``tcp://host:port``, ``sim://cframe/lk?seed=3``, ``replay://file``.
    settings : LKSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    no_value : str
        Why the last reading is NaN, one of `codec.REASONS`; empty if it is valid.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="keyence_lk",
        kind="point_lds",
        summary="Keyence LK-G/LK-H laser displacement sensor, RS-232C in ASCII",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.point_lds.keyence_lk:SimulatedKeyenceLK",
    )
    Settings: ClassVar[type[LKSettings]] = LKSettings
    settings: LKSettings
    no_value: str = ""
    _synchronised = False
    _streaming = False

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit, whose readings differ."""
        readings = ",".join(f"{0.1 * number - 1.5:.1f}" for number in range(30))
        return InstrumentSubject(cls, f"sim://cframe?seed=3&readings={readings}")

    @property
    def rate(self) -> float:
        """Readings per second of a stream."""
        return self.settings.rate

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m."""
        return HEADS[self.settings.head]

    @property
    def mid_range(self) -> float:
        """The reading in the middle of the range, m: readings are relative to it."""
        return 0.0

    def identify(self) -> Identity:
        """Check that a controller answers. Model and serial number are those of the settings: it reports none."""
        self._enter(MEASURING)
        settings = self.settings
        return Identity(
            manufacturer="Keyence",
            model=f"{settings.controller} with {settings.head}",
            serial_number=settings.serial_number or "unknown",
            simulated=self.transport.simulated,
            details={"address": self.address, **settings.model_dump(include={"output", "display", "positive"})},
        )

    def configure(self, settings: LKSettings) -> None:
        """Compare the settings with the line and the controller, or send them; see ``set_up``.

        Raises
        ------
        InstrumentError
            The rate exceeds the capacity of the line; the controller has another display unit or an offset, or refuses.
        """
        if self._streaming:
            raise InstrumentError(f"{self.info.id} is streaming; close the stream first", code="stream.running")
        self._line_speed(settings)
        output = CONTROLLERS[settings.controller].output.format(settings.output)
        unit = str(DISPLAYS[settings.display].number)
        if settings.set_up != "trust":
            self._enter(SETTING)
            try:
                if settings.set_up == "set":
                    for name, value in ((DISPLAY_SETTING, unit), (OFFSET_SETTING, NO_OFFSET)):
                        self._query(f"SW,{name},{output},{value}", header=f"SW,{name}")
                else:
                    self._check_controller(output, unit, settings)
            except InstrumentError:
                self._synchronised = False  # the next request leaves the setting mode first
                raise
            self._enter(MEASURING)
        if settings.set_up == "set":
            request = CONTROLLERS[settings.controller].zero_off_request(settings.output)
            self._query(request, header=request.split(",")[0])  # whether the answer contains the output is unknown
        self.settings = settings

    def read(self) -> float:
        """Return the present reading, m; NaN if the sensor has none, with the reason in ``no_value``.

        Raises
        ------
        InstrumentTimeoutError
            No answer within the time limit.
        InstrumentError
            The controller refuses, and the message states its error; or it uses another unit than the settings state.
        """
        value, reason = self._measure()
        self.no_value = REASONS[reason]
        return value

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of readings, requested one by one at ``rate``, until the caller stops.

        The clock is that of this computer. A simulated sensor, whose clock is virtual, is queried as fast as it
        answers.

        Parameters
        ----------
        block : int, optional
            Readings in a block; default: half a second.

        Yields
        ------
        Samples
            ``values`` (1, block) in m; ``invalid`` counts the NaN by reason, see `codec.REASONS`.

        Raises
        ------
        InstrumentTimeoutError
            No answer within the time limit.
        InstrumentError
            The controller refuses; or its answers are too slow for ``rate``.
        """
        size = block or max(1, round(BLOCK_SECONDS * self.rate))
        self._streaming = True
        try:
            first, start = 0, time.monotonic()
            while True:
                values = np.empty((1, size))
                invalid: Counter[str] = Counter()
                for k in range(size):
                    self._wait_for_interval(start, first + k)
                    values[0, k], reason = self._measure()
                    if reason:
                        invalid[REASONS[reason]] += 1
                yield Samples(values, first, self.rate, time.monotonic(), invalid=dict(invalid))
                first += size
        finally:
            self._streaming = False

    def _measure(self) -> tuple[float, int]:
        settings = self.settings
        try:
            text = self._query(CONTROLLERS[settings.controller].measure_request(settings.output))
        except ProtocolError:
            return float("nan"), GARBLED
        value, reason = parse_value(text, DISPLAYS[settings.display])
        self._synchronised = reason != GARBLED
        return SIGNS[settings.positive] * value, reason

    def _query(self, request: str, header: str | None = None) -> str:
        """Discard unread bytes, send a request and return the part of the answer after its header."""
        if self._synchronised:
            discard_input(self.transport)
        else:
            self._enter(MEASURING)
        self._synchronised = False
        self.transport.write(encode(request))
        text = decode(self.transport.read_until(LINE_ENDS, limit=MAX_LINE_BYTES))
        self._synchronised = error_code(request, text) is not None  # a refusal is also an answer
        answer = parse_answer(request, text, header)
        self._synchronised = True
        return answer

    def _enter(self, mode: str) -> None:
        """Set the mode of the controller.

        Late answers and remains of damaged answers are discarded: the next answer then belongs to the next request.
        """
        self._synchronised = False
        self.transport.write(encode(mode))

        def entered(line: bytes) -> bool | None:
            text = line.rstrip(b"\r\n").decode("ascii", errors="replace")
            # The error means that the controller was already in this mode.
            if text.endswith((mode, *(f"{ERROR},{mode},{code}" for code in STATE_ERRORS))):
                return True
            if error_code(mode, text) is not None:
                parse_answer(mode, text)
            return None

        self._synchronised = self.answer_line(self.transport, f"'{mode}'", entered, limit=MAX_LINE_BYTES)

    def _check_controller(self, output: str, unit: str, settings: LKSettings) -> None:
        request = f"SR,{DISPLAY_SETTING},{output}"
        if (answer := self._query(request)) != unit:
            names = {str(display.number): name for name, display in DISPLAYS.items()}
            raise InstrumentError(
                f"The setting 'display' is {settings.display}; the controller at {self.address} answers "
                f"'{request}' with {names.get(answer, answer)!r}. Change one of them, or use set_up = \"set\"",
                code="sensor.display.differs",
            )
        request = f"SR,{OFFSET_SETTING},{output}"
        if set(words := self._query(request)) & set("123456789"):
            raise InstrumentError(
                f"The controller at {self.address} has an offset of {words}, so that 0 is not the middle of the range. "
                'Clear it, or use set_up = "set"',
                code="sensor.offset.set",
            )

    def _wait_for_interval(self, start: float, number: int) -> None:
        if self.transport.simulated:
            return
        ahead = start + number / self.rate - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        elif -ahead > self.settings.timeout:
            raise InstrumentError(
                f"{self.address}: {self.rate:g} readings/s were requested, but {number} took "
                f"{number / self.rate - ahead:.1f} s; lower the rate",
                code="sensor.rate.too_high",
            )

    def _line_speed(self, settings: LKSettings) -> int:
        speed = int(parse_address(self.address).number("baudrate", settings.baudrate))
        check_rate(settings.rate, speed, CONTROLLERS[settings.controller])
        return speed

    def _connect(self) -> Transport:
        return open_transport(
            self.address,
            simulator=self.info.simulator,
            recorder=self._record,
            timeout=self.settings.timeout,
            baudrate=self._line_speed(self.settings),
        )

    def _start_session(self) -> None:
        self._enter(MEASURING)
        self.configure(self.settings)
