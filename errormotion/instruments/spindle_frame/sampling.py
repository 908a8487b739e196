"""Samples of several point sensors at the same instants.

Synchronised sensors sample on their own clock. The first one is the master: it is started after the others, so that
sample 0 is the same instant for all. Other sensors are read simultaneously, by one thread each, at instants of this
computer's clock.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.streaming import count_reasons
from errormotion.plugins import Samples

STOP_TIMEOUT = 1.0
"""Time in which all sensors must have stopped, s."""
LOST = "lost"
NO_VALUE = "no value"


def synchronised(sensors: Mapping[str, Any], size: int, rate: float) -> Iterator[Samples]:
    """Yield blocks of samples, ``values`` (channel, size), m, of sensors with the capability `kinds.Synchronised`."""
    master, *slaves = sensors.values()
    first = 0
    try:
        for slave in slaves:
            slave.start(size, "SLAVE")
        master.start(size, "MASTER" if slaves else "NONE")
        while True:
            values = np.empty((len(sensors), size))
            reasons = np.empty((len(sensors), size), dtype=np.uint8)
            for row, sensor in enumerate(sensors.values()):
                sensor.fill(values[row], reasons[row])
            invalid: dict[str, int] = {}
            for (name, sensor), why in zip(sensors.items(), reasons, strict=True):
                invalid |= count_reasons(why, sensor.reasons, f"{name} ")
            dropped = int(np.isin(reasons, master.lost).any(axis=0).sum()) if invalid else 0
            yield Samples(values, first, rate, max(each.host_time for each in sensors.values()), dropped, invalid)
            first += size
    finally:
        stop(list(sensors.values()))


def stop(sensors: Sequence[Any]) -> None:
    """Stop synchronised sensors, the master first; a full queue does not delay any of them."""
    for sensor in sensors:
        sensor.drain()
    end = time.monotonic() + STOP_TIMEOUT
    for sensor in sensors:
        sensor.stop(max(end - time.monotonic(), 0.05))


def polled(sensors: Mapping[str, Any], size: int, rate: float) -> Iterator[Samples]:
    """Yield blocks of readings, ``values`` (channel, size), m, of any point sensors.

    An instant at which the preceding readings are not complete is lost: NaN in all channels, and counted.

    Raises
    ------
    InstrumentError
        An error of a sensor; the message names its channel.
    """
    with ThreadPoolExecutor(len(sensors), thread_name_prefix="frame") as pool:
        start, number = time.monotonic(), 0
        while True:
            values = np.full((len(sensors), size), np.nan)
            invalid: Counter[str] = Counter()
            dropped = 0
            for column in range(size):
                now = time.monotonic() - start
                if now > (number + column + 1) / rate:
                    dropped += 1
                    invalid.update(f"{name} {LOST}" for name in sensors)
                    continue
                time.sleep(max(0.0, (number + column) / rate - now))
                for row, (value, reason) in enumerate(pool.map(_read, sensors.items())):
                    values[row, column] = value
                    invalid.update([reason] if reason else [])
            yield Samples(values, number, rate, time.monotonic(), dropped, dict(invalid))
            number += size


def _read(item: tuple[str, Any]) -> tuple[float, str]:
    """Return one reading of a channel, m, and the reason if it is NaN."""
    name, sensor = item
    try:
        value = float(sensor.read())
    except InstrumentError as error:
        raise error.restated(f"Channel {name}: {error}") from error
    return value, f"{name} {getattr(sensor, 'no_value', '') or NO_VALUE}" if np.isnan(value) else ""
