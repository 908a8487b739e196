"""The clock of a virtual world, and the thread that produces the samples of all channels in lockstep.

The clock advances only while samples stream, evenly spaced or triggered by a moving axis, or when it is set; unless it
is set to tick, for a monitor of a machine that receives no commands. The clock only waits for real time if a pace is
given: a block of samples is produced for every streaming channel, then sent, and sending waits for the readers. The
time of the world is that of the last sample that its readers have delivered, so that other readings (a temperature)
belong to this time, although later samples have already been produced; when the streams end, the world continues from
this time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.virtual_world.streams import Stream, TriggeredStream

Array = np.ndarray[Any, Any]

EPOCH = datetime(2025, 1, 1, tzinfo=UTC)
"""Date and time of day at the time 0 of a world."""

BLOCK = 4096  # samples produced at once when running freely
PACED_BLOCK = 0.01  # s of samples produced at once when running at a pace


class SampleClock:
    """The clock and the streams of a world.

    Attributes
    ----------
    name : str
        Name of the world.
    pace : float or None
        Simulated seconds per second; None: as fast as the readers.
    ticking : float or None
        Simulated seconds per second while nothing streams; None: the clock stops.
    """

    name: str

    def __init__(self) -> None:
        self.pace: float | None = None
        self.ticking: float | None = None
        self._wound = time.monotonic()  # real time at which the ticks were last counted
        self._front = 0.0  # time up to which samples have been produced
        self._making = 0.0  # time up to which samples are being produced
        self._settings_of_clock = 0
        self._streams: list[Stream] = []
        self._armed: list[Stream] = []  # slaves that wait for their master
        self._triggered: list[TriggeredStream] = []
        self._change = threading.Condition()
        self._thread: threading.Thread | None = None

    @property
    def time(self) -> float:
        """Simulated seconds since the start of the schedule."""
        with self._change:
            seen = [(each.start + each.taken) / each.rate for each in self._streams if each.taken is not None]
            seen += [each.seen for each in self._triggered if each.seen is not None]
            if not self.streaming:
                self._count_ticks()
            return min(seen, default=self._front)

    def _count_ticks(self) -> None:
        now = time.monotonic()
        if self.ticking is not None:
            self._front += (now - self._wound) * self.ticking
            self._making = self._front
        self._wound = now

    def tick(self, rate: float) -> None:
        """Advance the time continuously from now on, in simulated seconds per second."""
        with self._change:
            self._wound, self.ticking = time.monotonic(), rate

    def _set_clock(self, instant: float) -> None:
        self._front = self._making = instant
        self._wound = time.monotonic()
        self._settings_of_clock += 1

    def _next_instant(self) -> float:
        """Return the first time without a sample produced or in progress: commands take effect from then on."""
        return float(max(self._front, self._making, self.time))

    @property
    def streaming(self) -> bool:
        """Whether any channel streams."""
        return bool(self._streams or self._triggered)

    @property
    def following(self) -> bool:
        """Whether a device follows the axes: its profiles drive the clock."""
        return bool(self._triggered)

    def _refuse_while_streaming(self, what: str) -> None:
        names = [each.channel for each in self._streams] + [each.channel for each in self._triggered]
        if names:
            raise InstrumentError(
                f"Cannot {what} while {', '.join(names)} stream; stop the streams first",
                code="simulator.streams.running",
            )

    def _forget_streams(self) -> threading.Thread | None:
        """Remove all streams, so that the thread ends; return the thread for joining."""
        self._streams.clear()
        self._armed.clear()
        self._triggered.clear()
        thread, self._thread = self._thread, None
        self._change.notify_all()
        return thread

    # ------------------------------------------------------------------ streams

    def start_stream(self, stream: Stream) -> None:
        """Start producing samples: at once, for a slave when its master starts, for a master with all its slaves."""
        with self._change:
            if stream.sync == "SLAVE":
                self._armed.append(stream)
                return
            starting = [stream]
            if stream.sync == "MASTER":
                starting, self._armed = [*self._armed, stream], []
            now = self.time if not self.streaming else self._front
            for each in starting:
                each.start = each.position = _first_sample(now, each.rate)
                each.taken = None
            self._streams.extend(starting)
            if self._thread is None:
                self._thread = threading.Thread(target=self._generate, name=f"sim-world-{self.name}", daemon=True)
                self._thread.start()
            self._change.notify_all()

    def end_stream(self, stream: Stream) -> None:
        """Stop samples of this channel, and of the slaves of a master; a block in progress may still be sent."""
        with self._change:
            if stream in self._armed:
                self._armed.remove(stream)
            if stream in self._streams:
                seen = self.time
                self._streams.remove(stream)
                if stream.sync == "MASTER":
                    slaves = [each for each in self._streams if each.sync == "SLAVE"]
                    self._armed.extend(slaves)
                    self._streams = [each for each in self._streams if each not in slaves]
                if not self._streams:
                    self._set_clock(seen)

    def start_triggered(self, stream: TriggeredStream) -> float:
        """Register a device that the axes trigger; return the time from which it is triggered.

        Raises
        ------
        InstrumentError
            Devices with their own sample clock are streaming.
        """
        with self._change:
            if self._streams:
                self._refuse_while_streaming("follow the axes")
            now = self.time
            self._triggered.append(stream)
            return now

    def end_triggered(self, stream: TriggeredStream) -> None:
        """Remove the device, and stop the clock at the last sample that its reader has delivered; idempotent."""
        with self._change:
            if stream in self._triggered:
                seen = self.time
                self._triggered.remove(stream)
                if not self.streaming:
                    self._set_clock(seen)

    # ------------------------------------------------------------------ samples

    def _generate(self) -> None:
        wall, began = time.monotonic(), 0.0
        running = False
        while True:
            with self._change:
                if not self._streams:
                    running = False
                    self._change.wait_for(lambda: bool(self._streams) or self._thread is None)
                if self._thread is not threading.current_thread():
                    return
                if not running:
                    wall, began, running = time.monotonic(), self._front, True
                streams, setting, pace = tuple(self._streams), self._settings_of_clock, self.pace
                fastest = max(streams, key=lambda stream: stream.rate)
                size = BLOCK if pace is None else max(1, round(PACED_BLOCK * pace * fastest.rate))
                until = self._making = (fastest.position + size) / fastest.rate
            self._make(streams, until)
            with self._change:
                if self._settings_of_clock == setting:  # the clock was not set meanwhile
                    self._front = until
            if pace is not None:
                time.sleep(max(0.0, wall + (until - began) / pace - time.monotonic()))

    def _make(self, streams: Sequence[Stream], until: float) -> None:
        """Produce the samples of all streams before a time, of channels on one clock together."""
        groups: dict[tuple[float, int], list[Stream]] = {}
        for stream in streams:
            groups.setdefault((stream.rate, stream.position), []).append(stream)
        for (rate, first), group in groups.items():
            size = _first_sample(until, rate) - first
            if size <= 0:
                continue
            distances = self._distances(first, size, rate, group)
            for stream, values in zip(group, distances, strict=True):
                stream.position += size
                stream.push(values)
                if stream.ended:
                    self.end_stream(stream)

    def _distances(self, first: int, n: int, rate: float, streams: Sequence[Stream]) -> Array:
        """Return samples first .. first + n - 1 of streams on one clock, m, shape (stream, n)."""
        raise NotImplementedError


def _first_sample(time: float, rate: float) -> int:
    """Return the number of the first sample at or after a time, apart from rounding errors."""
    return int(np.ceil(time * rate - 1e-6))
