"""The points of a continuous measurement, ordered by the tracker's clock."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from errormotion.errors import InstrumentTimeoutError, ProtocolError
from errormotion.instruments.laser_tracker.leica_emscon import codec, statuses
from errormotion.instruments.laser_tracker.leica_emscon.link import Link
from errormotion.instruments.laser_tracker.leica_emscon.settings import EmSconSettings
from errormotion.instruments.laser_tracker.leica_emscon.targets import BeamBrokenError
from errormotion.plugins import Samples

BLOCK_SECONDS = 0.5
MAX_GAP = 600.0  # s between two points
LOST, BROKEN = "lost", "beam broken"
_WARNINGS = frozenset({0, 1})


def points(link: Link, settings: EmSconSettings, block: int | None = None) -> Iterator[Samples]:
    """Yield blocks of distances from the packets of a link.

    The index of a point is its time since the first point divided by the interval. Indices without a point are NaN:
    ``lost``, or ``beam broken`` if the tracker has reported this since the last point.

    Raises
    ------
    InstrumentTimeoutError
        No data for the settings' ``timeout``.
    BeamBrokenError
        No data for this time after a broken beam.
    ProtocolError
        The tracker's clock decreases or jumps.
    """
    size = block or max(1, round(BLOCK_SECONDS * settings.rate))
    interval = 1000 * settings.interval  # us
    waiting: deque[tuple[float, str]] = deque()  # value, and the reason if it is missing
    start: int | None = None
    expected = first = 0
    breaks = link.breaks
    while True:
        for point in _next_points(link, settings.timeout):
            clock = 1_000_000 * int(point["seconds"]) + int(point["microseconds"])
            start = clock if start is None else start
            index = round((clock - start) / interval)
            if not 0 <= index - expected <= MAX_GAP * settings.rate:
                raise ProtocolError(
                    f"The tracker's clock jumps from point {expected - 1} to point {index}: expected steps of one, "
                    f"{settings.interval} ms apart. Check that no other client is measuring",
                    code="protocol.counter.jump",
                )
            waiting.extend([(np.nan, BROKEN if link.breaks > breaks else LOST)] * (index - expected))
            expected, breaks = index + 1, link.breaks
            status = int(point["status"])
            if status in _WARNINGS:
                waiting.append((float(point["val3"]), ""))
            else:
                waiting.append((np.nan, statuses.POINTS.get(status, f"status {status}")))
        while len(waiting) >= size:
            taken = [waiting.popleft() for _ in range(size)]
            invalid = Counter(reason for _, reason in taken if reason)
            values = np.array([[value for value, _ in taken]])
            yield Samples(values, first, settings.rate, time.monotonic(), invalid[LOST], dict(invalid))
            first += size


def _next_points(link: Link, timeout: float) -> Sequence[Mapping[str, Any]]:
    if link.early:
        return link.early.popleft().points
    end = time.monotonic() + timeout
    while (packet := link.next_packet(max(end - time.monotonic(), 0.0))) is not None:
        if packet.kind in codec.POINTS:
            return packet.points
    if link.broken:
        raise BeamBrokenError(f"The beam has been broken for {timeout:g} s")
    raise InstrumentTimeoutError(
        f"No points of a continuous measurement for {timeout:g} s", code="instrument.no_answer"
    )
