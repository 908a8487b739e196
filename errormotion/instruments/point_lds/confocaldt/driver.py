"""Driver of a confocalDT controller with one sensor."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.driver import Driver
from errormotion.instruments.point_lds.confocaldt import codec
from errormotion.instruments.point_lds.confocaldt.blocks import (
    LOST,
    REASONS,
    Block,
    BlockDecoder,
    Sequence,
    reasons,
    scale,
)
from errormotion.instruments.point_lds.confocaldt.settings import ConfocalSettings
from errormotion.instruments.point_lds.optoncdt.commands import setting
from errormotion.instruments.point_lds.optoncdt.dialogue import Dialogue
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.lines import ManyLines
from errormotion.plugins import Identity, InstrumentInfo, Samples

BLOCK_SECONDS = 0.5
DATA = "data"
"""Name of the data line, and of the parameter of the address that states its port."""
RANGE_TOLERANCE = 1e-3
"""Of the range: two statements of it that differ less are the same."""
ON, OFF = f"{codec.OUTPUT} ETHERNET", f"{codec.OUTPUT} NONE"


class ConfocalDT(Driver):
    """A confocal chromatic sensor at a Micro-Epsilon confocalDT IFC2451, IFC2461 or IFC2471.

    Readings are the distance from the start of the measuring range in m, larger for a more distant surface; NaN where
    the sensor has none.

    Opening switches the output of values off and selects one distance for Ethernet; closing restores both.

    Parameters
    ----------
    address : str
        ``tcp://host:23`` (``?data=1024`` for another data port), ``sim://cframe/X1?seed=3``, ``replay://file``.
    settings : ConfocalSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    no_value : str
        Reason of the last reading where it is NaN, one of `blocks.REASONS`; else empty.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="confocaldt",
        kind="point_lds",
        summary="Micro-Epsilon confocalDT 2451, 2461, 2471 confocal chromatic sensor, Ethernet",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.point_lds.confocaldt:SimulatedConfocal",
    )
    Settings: ClassVar[type[ConfocalSettings]] = ConfocalSettings
    settings: ConfocalSettings
    no_value: str = ""
    _dialogue: Dialogue | None = None
    _facts: dict[str, str]
    _sensor: dict[str, str]
    _range = float("nan")
    _rate = float("nan")
    _stale = False  # whether the data line may hold values of an earlier output
    _streaming = False
    _failed = False

    @property
    def rate(self) -> float:
        """Readings per second of a stream, as the controller states it; NaN before it was opened."""
        return self._rate

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m, as the controller states them."""
        self._ready()
        return 0.0, self._range

    @property
    def mid_range(self) -> float:
        """Reading in the middle of the range, m."""
        return sum(self.measuring_range) / 2

    def identify(self) -> Identity:
        """Return what the controller reports of itself and of its sensor."""
        self._ready()
        sensor = f"{self._sensor.get('name', '')} {self._sensor.get('serial', '')}".strip()
        details: dict[str, Any] = {"address": self.address, "sensor": sensor}
        return Identity(
            manufacturer="Micro-Epsilon",
            model=self._facts["name"],
            serial_number=self._facts.get("serial", "unknown"),
            firmware=self._facts.get("version", ""),
            simulated=self.transport.simulated,
            details=details,
        )

    def configure(self, settings: ConfocalSettings) -> None:
        """Compare the settings with the controller and send the rate where it is given.

        Raises
        ------
        InstrumentError
            Another measuring range; a master value is set; the controller refuses.
        """
        self._refuse_while_streaming()
        dialogue = self._commands()
        self._sensor = codec.facts_of(dialogue.command(codec.SENSOR))
        found = codec.range_of(self._sensor)
        _check_range(settings.measuring_range, found)
        master = setting(codec.MASTER, dialogue.command(codec.MASTER))
        if master not in ("", f"{codec.MASTER} NONE"):
            raise InstrumentError(
                f"{self.address}: a master value is set ('{master}'), so that values do not count from the start of "
                f"the range. Reset it: {codec.MASTER} NONE, or in the web page"
            )
        if settings.rate is not None:
            dialogue.command(codec.rate_request(settings.rate))
        self._rate = codec.rate_of(dialogue.command(codec.RATE))
        self._range, self.settings = found, settings

    def read(self) -> float:
        """Return one reading now, m; NaN where the sensor has none, with the reason in ``no_value``.

        Raises
        ------
        InstrumentTimeoutError
            No answer or no value within the time limit.
        InstrumentError
            The controller refuses, or sends other values.
        """
        self._ready()
        self._refuse_while_streaming()
        block = self._one_block()
        if not block.intact:
            raise ProtocolError(f"{self.address}: the block of a reading broke off, or stray bytes follow; read again")
        values, codes = scale(block.values[:1])
        self.no_value = REASONS[int(codes[0])]
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
            The controller refuses or sends other values; the connection is lost.
        """
        self._ready()
        self._refuse_while_streaming()
        size = block or max(1, round(BLOCK_SECONDS * self.rate))
        self._refresh()
        self._streaming = True
        try:
            self._switch_on()
            yield from self._blocks(Sequence(), size)
        except BaseException as error:
            self._failed = isinstance(error, InstrumentError)
            raise
        finally:
            self._streaming = False
            if self._transport is not None and not self._failed:
                self._commands().command(OFF)

    def _blocks(self, sequence: Sequence, size: int) -> Iterator[Samples]:
        decoder = BlockDecoder()
        first, limit = 0, self.settings.timeout
        until = time.monotonic() + limit
        while True:
            while sequence.waiting < size:
                blocks = decoder.feed(self._data.read(timeout=max(until - time.monotonic(), 0.0)))
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

    # ------------------------------------------------------------------ values

    @property
    def _data(self) -> Transport:
        lines = self.transport
        assert isinstance(lines, ManyLines)
        return lines.line(DATA)

    def _switch_on(self) -> None:
        self._stale = True
        self._commands().command(ON)

    def _refresh(self) -> None:
        """Switch the output off, and make sure that the next values on the data line are new ones."""
        if self._stale:
            self._commands().command(OFF)
            self._data.reopen()
            self._commands().command(codec.OUTPUT)  # meanwhile the controller accepts the connection
            self._stale = False

    def _one_block(self) -> Block:
        self._refresh()
        self._switch_on()
        decoder = BlockDecoder()
        until = time.monotonic() + self.settings.timeout
        while True:
            data = self._data.read(timeout=max(until - time.monotonic(), 0.0))
            if blocks := decoder.feed(data, last=True):
                self._data.report_delivered(1)
                self._refresh()
                return blocks[0]

    # ------------------------------------------------------------------ commands

    def _commands(self) -> Dialogue:
        self.transport  # noqa: B018 - an error before it was opened
        if self._dialogue is None:
            raise InstrumentError(f"{self.address}: the controller has not been set up")
        return self._dialogue

    def _ready(self) -> None:
        self._commands()

    def _refuse_while_streaming(self) -> None:
        if self._streaming:
            raise InstrumentError(f"{self.info.id} is streaming; close the stream first")

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
        self._failed = False
        self._data.report_delivered(0)
        dialogue = self._dialogue = Dialogue(self.exchange, self.settings.timeout)
        self._facts = codec.facts_of(dialogue.command(codec.INFO))
        codec.model_of(self._facts)
        self._stale = dialogue.remember(codec.OUTPUT) == ON
        dialogue.set(OFF)
        for name in (codec.ADDITIONAL, codec.STATISTICS):
            if dialogue.remember(name) != f"{name} NONE":
                dialogue.set(f"{name} NONE")
        if codec.reduction_of(dialogue.command(codec.REDUCTION)) != 1:
            dialogue.set(f"{codec.REDUCTION} 1 ETHERNET")
        self.configure(self.settings)

    def _end_session(self) -> None:
        dialogue, self._dialogue = self._dialogue, None
        if dialogue is not None:
            with suppress(InstrumentError):  # after a lost connection nothing can be restored
                dialogue.restore()


def _check_range(stated: float | None, found: float) -> None:
    if stated is not None and abs(stated - found) > RANGE_TOLERANCE * found:
        raise InstrumentError(
            f"The setting 'measuring_range' is {stated * 1e3:g} mm; the controller states {found * 1e3:g} mm. Change "
            "the setting, or select the sensor in the controller (SENSORHEAD)"
        )
