"""Base of drivers of controllers that answer commands on one port and send counted values on another port."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.driver import Driver
from errormotion.instruments.point_lds.blocks import Block, BlockDecoder
from errormotion.instruments.point_lds.counted import LOST, CountedReadings
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.lines import ManyLines
from errormotion.plugins import Samples

BLOCK_SECONDS = 0.5
DATA = "data"
"""Name of the data line, and of the parameter of the address that states its port."""
RANGE_TOLERANCE = 1e-3
"""Relative difference below which two statements of the measuring range agree."""


class CountingDriver(Driver):
    """Base of drivers of displacement sensors whose controller sends numbered values on a separate line.

    A subclass states ``data_port``, starts and stops the values in ``_start_values`` and ``_stop_values``, ensures in
    ``_refresh`` that no earlier value is waiting on the data line, and returns decoder and readings from ``_decoder``
    and ``_readings``.

    Attributes
    ----------
    no_value : str
        Why the last reading is NaN; empty if it is valid.
    """

    data_port: ClassVar[int]
    no_value: str = ""
    _rate = float("nan")
    _stale = False  # whether earlier values may wait on the data line
    _streaming = False
    _failed = False

    @property
    def rate(self) -> float:
        """Readings per second of a stream, as the controller states it; NaN before ``open``."""
        return self._rate

    @property
    @abstractmethod
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m, as the controller states them."""

    @property
    def mid_range(self) -> float:
        """Reading in the middle of the range, m."""
        return sum(self.measuring_range) / 2

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of readings until the caller stops.

        Parameters
        ----------
        block : int, optional
            Readings in a block; default: half a second.

        Yields
        ------
        Samples
            ``values`` (1, block) in m; ``invalid`` counts the NaN by reason, ``dropped`` the lost readings.

        Raises
        ------
        InstrumentTimeoutError
            No values within the time limit.
        InstrumentError
            The controller refuses or sends other values; the connection is lost.
        """
        readings = self._readings()
        self._refuse_while_streaming()
        size = block or max(1, round(BLOCK_SECONDS * self.rate))
        self._refresh()
        self._streaming = True
        try:
            self._start_values()
            yield from self._blocks(readings, size)
        except BaseException as error:
            self._failed = isinstance(error, InstrumentError)
            raise
        finally:
            self._streaming = False
            if self._transport is not None and not self._failed:
                self._stop_values()

    def _blocks(self, readings: CountedReadings, size: int) -> Iterator[Samples]:
        decoder = self._decoder()
        first, limit = 0, self.settings.timeout
        until = time.monotonic() + limit
        while True:
            while readings.waiting < size:
                blocks = decoder.feed(self._data.read(timeout=max(until - time.monotonic(), 0.0)))
                for each in blocks:
                    readings.add(each)
                if blocks:
                    until = time.monotonic() + limit
            values, codes = readings.take(size)
            invalid = readings.counts(codes)
            dropped = invalid.pop(LOST, 0)
            yield Samples(values[np.newaxis], first, self.rate, time.monotonic(), dropped=dropped, invalid=invalid)
            first += size
            self._data.report_delivered(first)
            until = time.monotonic() + limit

    def _next_blocks(self, limit: float) -> list[Block]:
        """Return the next blocks of the data line, after which none follow."""
        decoder = self._decoder()
        until = time.monotonic() + limit
        while True:
            data = self._data.read(timeout=max(until - time.monotonic(), 0.0))
            if blocks := decoder.feed(data, last=True):
                return blocks

    # ------------------------------------------------------------------ by the device

    @abstractmethod
    def _decoder(self) -> BlockDecoder:
        """Return a decoder of what the controller sends."""

    @abstractmethod
    def _readings(self) -> CountedReadings:
        """Return an empty collection of readings; InstrumentError if the controller has not been set up."""

    @abstractmethod
    def _start_values(self) -> None:
        """Make the controller send values continuously."""

    @abstractmethod
    def _stop_values(self) -> None:
        """Make the controller stop sending values."""

    @abstractmethod
    def _refresh(self) -> bool:
        """Ensure that the next values on the data line are new ones; return whether it was opened again."""

    # ------------------------------------------------------------------ the line

    @property
    def _data(self) -> Transport:
        lines = self.transport
        assert isinstance(lines, ManyLines)
        return lines.line(DATA)

    def _refuse_while_streaming(self) -> None:
        if self._streaming:
            raise InstrumentError(f"{self.info.id} is streaming; close the stream first", code="stream.running")

    def _connect(self) -> Transport:
        from errormotion.instruments.transports.lines import open_lines

        return open_lines(
            self.address,
            {DATA: self.data_port},
            simulator=self.info.simulator,
            record=self._record,
            timeout=self.settings.timeout,
        )


def check_range(stated: float | None, actual: float, where: str, remedy: str) -> None:
    """Compare the range of the settings, m, with that of the controller; InstrumentError if they differ."""
    if stated is not None and abs(stated - actual) > RANGE_TOLERANCE * actual:
        raise InstrumentError(
            f"The setting 'measuring_range' is {stated * 1e3:g} mm; the controller states {actual * 1e3:g} mm{where}. "
            f"Change the setting, or {remedy}",
            code="sensor.range.differs",
        )
