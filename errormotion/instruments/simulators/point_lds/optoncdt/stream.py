"""The data stream of a simulated optoNCDT, from OUTPUT RS422 to OUTPUT NONE."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from errormotion.instruments.simulators.faults import Fault, stray_bytes
from errormotion.instruments.simulators.point_lds.optoncdt.values import (
    BAUD_OVERFLOW,
    BITS,
    BITS_ON_WIRE,
    FIRST_ERROR,
    LASER_OFF,
    NO_PEAK,
    NOT_CALCULABLE,
    encode,
    mastered,
    raw_distances,
)
from errormotion.instruments.transports.loopback.serving import Server

Array = np.ndarray[Any, Any]

_CONSTANTS = {"TEMP": 4 * 30, "SHUTTER": 1000, "INTENSITY": 32000, "DIST2": NOT_CALCULABLE, "THICK12": NOT_CALCULABLE}
"""Values that the virtual world does not simulate: 30 degC, an exposure time, an intensity, no second peak."""

_NO_PEAK_BIT, _GREEN = 1 << 2, 1 << 16


@dataclass
class Output:
    """Content of a stream, from the settings of the sensor.

    Attributes
    ----------
    names : sequence of str
        Values of a block, in order; empty: nothing is sent.
    measuring_range : float
        m.
    largest : int
        Last raw value of a distance.
    every : int
        Every n-th measurement is sent.
    hold : int or None
        Number of measurements for which a missing distance is replaced by the last one; None: no limit.
    average : tuple of (str, int)
        Method and depth.
    master : float or None
        m; None: not mastered.
    laser : bool
        Whether the laser is on.
    overflow : bool
        Whether the line is too slow for all values.
    microseconds : int
        Resolution of the time stamp.
    """

    names: tuple[str, ...]
    measuring_range: float
    largest: int
    every: int = 1
    hold: int | None = 0
    average: tuple[str, int] = ("NONE", 1)
    master: float | None = None
    laser: bool = True
    overflow: bool = False
    microseconds: int = 256

    @staticmethod
    def overflows(names: tuple[str, ...], rate: float, baudrate: float) -> bool:
        """Whether a line of this speed is too slow for the values at this rate."""
        return len(names) * BITS_ON_WIRE * rate > baudrate


@dataclass
class Counters:
    """State that a sensor keeps between streams.

    ``measured`` and ``seconds`` are the counter and the time stamp, ``gate`` is the remaining number of triggered
    values (None: all are sent), ``reference`` the distance that was mastered, ``low`` and ``high`` are the raw
    extremes, ``past`` are the preceding distances for the average, ``last`` is the raw value that has been held for
    ``held`` measurements.
    """

    measured: int = 0
    seconds: float = 0.0
    gate: int | None = None
    reference: float | None = None
    low: int = FIRST_ERROR
    high: int = -1
    past: Array = field(default_factory=lambda: np.empty(0))
    last: int = -1
    held: int = 0


class SensorStream:
    """One stream of a sensor: a `Stream` of the virtual world.

    Parameters
    ----------
    server : Server
        Of the line.
    fault : Fault
        Of the line.
    rng : numpy.random.Generator
        For stray bytes.
    channel : str
        Beam of the frame.
    rate : float
        Measurements per second.
    sync : str
        NONE, MASTER or SLAVE.
    output : Output
        Of the stream.
    counters : Counters
        Of the sensor.
    """

    def __init__(
        self,
        server: Server,
        fault: Fault,
        rng: np.random.Generator,
        *,
        channel: str,
        rate: float,
        sync: str,
        output: Output,
        counters: Counters,
    ) -> None:
        self.channel = channel
        self.rate = rate
        self.sync = sync
        self.start = self.position = 0
        self.taken: int | None = None
        self.ended = False
        self.sent = 0
        self.measuring_range = output.measuring_range
        self._server = server
        self._fault = fault
        self._rng = rng
        self._output = output
        self._counters = counters

    def push(self, distances: Array) -> None:
        """Send the next samples with the fault that is due; may wait for the reader."""
        first, size = self.sent, distances.size
        raws = self._processed(self._raws(distances, first), distances)
        blocks = self._blocks(raws)
        missing = self._lost(first, size)
        with self._server.lock:
            if self.ended:
                return
            self._counters.measured += size
            self._counters.seconds += size / self.rate
            data = self._bytes(blocks, missing, first)
            self.sent += size
            heard = all(self._server.send(piece) for piece in self._fault.pieces(data))
        if self._fault.kind == "disconnect" and self.sent > self._fault.at:
            self._server.disconnect()
            self.ended = True
        self.ended = self.ended or not heard

    # ------------------------------------------------------------------ distances

    def _raws(self, distances: Array, first: int) -> Array:
        output = self._output
        raws = raw_distances(self._averaged(distances), output.measuring_range, output.largest)
        if self._fault.kind == "out_of_range":
            raws[self._fault.affects("out_of_range", first + np.arange(raws.size))] = NO_PEAK
        if not output.laser:
            raws[:] = LASER_OFF
        if output.overflow:
            raws[:] = BAUD_OVERFLOW
        return raws

    def _averaged(self, distances: Array) -> Array:
        method, depth = self._output.average
        if method not in ("MOVING", "MEDIAN") or depth < 2:
            return distances
        counters = self._counters
        past = counters.past if counters.past.size else np.full(depth - 1, distances[0])
        joined = np.concatenate([past[-(depth - 1) :], distances])
        counters.past = joined[-(depth - 1) :]
        windows = np.lib.stride_tricks.sliding_window_view(joined, depth)
        averages = windows.mean(axis=1) if method == "MOVING" else np.median(windows, axis=1)
        return np.where(np.isnan(distances), np.nan, averages)

    def _processed(self, raws: Array, distances: Array) -> Array:
        output, counters = self._output, self._counters
        if output.master is not None:
            valid = np.flatnonzero(raws < FIRST_ERROR)
            if counters.reference is None and valid.size:
                counters.reference = float(distances[valid[0]])
            reference = counters.reference if counters.reference is not None else 0.0
            raws = mastered(raws, distances, reference, output.master, output.measuring_range)
        return raws if output.hold == 0 else self._held(raws)

    def _held(self, raws: Array) -> Array:
        """Return raw distances; missing ones are replaced by the last one while it is held."""
        counters, hold = self._counters, self._output.hold
        indices = np.where(raws < FIRST_ERROR, np.arange(raws.size), -1)
        indices = np.maximum.accumulate(indices)
        before = np.arange(raws.size) + 1 + counters.held  # since the last distance of the previous block
        since = np.where(indices < 0, before, np.arange(raws.size) - indices)
        source = np.where(indices < 0, counters.last, raws[indices])
        result = np.where((since > 0) & (source >= 0) & ((hold is None) | (since <= (hold or 0))), source, raws)
        counters.last, counters.held = int(source[-1]), int(since[-1])
        return result

    # ------------------------------------------------------------------ blocks

    def _blocks(self, raws: Array) -> Array:
        """Return the values of each measurement, shape (measurement, value)."""
        names, counters = self._output.names, self._counters
        blocks = np.empty((raws.size, len(names)), dtype=np.int64)
        for column, name in zip(blocks.T, names, strict=True):
            column[:] = self._values(name, raws)
        if {"MIN", "MAX", "PEAK2PEAK"} & set(names):
            counters.low, counters.high = int(self._lows(raws)[-1]), int(self._highs(raws)[-1])
        return blocks

    def _values(self, name: str, raws: Array) -> Any:
        """Return one value of each measurement, or the value of all."""
        match name:
            case "DIST1":
                return raws
            case "COUNTER":
                return self._counters.measured + np.arange(raws.size) & (1 << BITS) - 1
            case "TIMESTAMP":
                return self._stamps(raws.size) & (1 << BITS) - 1
            case "TIMESTAMP_LO":
                return self._stamps(raws.size) & 0xFFFF
            case "TIMESTAMP_HI":
                return self._stamps(raws.size) >> 16
            case "STATE":
                return np.where(raws < FIRST_ERROR, _GREEN, _NO_PEAK_BIT | _GREEN << 1)
            case "DIST_RAW":
                return np.where(raws < FIRST_ERROR, raws * 4, 0)
            case "MIN" | "MAX" | "PEAK2PEAK":
                return self._statistic(name, raws)
            case _:
                return _CONSTANTS[name]

    def _stamps(self, count: int) -> Array:
        """Return the time stamps of the next measurements."""
        seconds = self._counters.seconds + np.arange(count) / self.rate
        stamps = np.floor(seconds * 1e6 / self._output.microseconds + 1e-6)
        return np.asarray(stamps.astype(np.int64) & (1 << 32) - 1)

    def _lows(self, raws: Array) -> Array:
        return np.minimum.accumulate(np.minimum(raws, self._counters.low))

    def _highs(self, raws: Array) -> Array:
        return np.maximum.accumulate(np.maximum(np.where(raws < FIRST_ERROR, raws, -1), self._counters.high))

    def _statistic(self, name: str, raws: Array) -> Array:
        low, high = self._lows(raws), self._highs(raws)
        value = {"MIN": low, "MAX": high, "PEAK2PEAK": high - low}[name]
        return np.where(high < 0, NO_PEAK, value)

    def _lost(self, first: int, size: int) -> Array | None:
        """Return for each measurement whether it is omitted: by a fault or by the reduction; None: none is."""
        fault = self._fault
        if self._output.every == 1 and fault.kind not in ("silence", "disconnect", "drop"):
            return None
        numbers = first + np.arange(size)
        active = numbers >= fault.at
        lost = np.zeros(size, dtype=bool)
        if fault.kind in ("silence", "disconnect"):
            lost |= active
        elif fault.kind == "drop":
            lost |= active & ((numbers - fault.at) % fault.every == 0)
        lost |= numbers % self._output.every != 0
        return lost

    def _bytes(self, blocks: Array, lost: Array | None, first: int) -> bytes:
        sent = blocks if lost is None else blocks[~lost]
        gate = self._counters.gate
        if gate is not None:
            sent = sent[:gate]
            self._counters.gate = gate - len(sent)
        data = encode(sent) if sent.size else b""
        fault = self._fault
        if fault.kind == "garbage":
            numbers = first + np.arange(len(blocks))
            due = int(((numbers >= fault.at) & ((numbers - fault.at) % fault.every == 0)).sum())
            for position in sorted(self._rng.integers(0, len(data) + 1, due), reverse=True):
                data = data[:position] + stray_bytes(self._rng) + data[position:]
        return data


def depth_of(words: tuple[str, ...]) -> tuple[str, int]:
    """Return method and depth from the parameters of AVERAGE; the default depth is the method's smallest."""
    method = words[0]
    return method, int(words[1]) if len(words) > 1 else {"MOVING": 2, "MEDIAN": 3}.get(method, 1)
