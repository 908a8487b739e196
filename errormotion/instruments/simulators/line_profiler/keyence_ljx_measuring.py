"""Measurement of a simulated LJ-X8000A: profiles of its feed are stored in its memory, and sent while a stream runs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.faults import Fault, stray_bytes
from errormotion.instruments.simulators.line_profiler import keyence_ljx_wire as wire
from errormotion.instruments.simulators.line_profiler.keyence_ljx_memory import Memory
from errormotion.instruments.simulators.line_profiler.keyence_ljx_wire import ProfileLayout
from errormotion.instruments.simulators.line_profiler.profile_sources import Feed, Lines
from errormotion.instruments.transports.loopback.stream_serving import NewestConnectionServer

POLL_INTERVAL = 0.01  # s between checks for a profile that is due
GRAB_TIMEOUT = 2.0  # s
SEND_TIMEOUT = 0.5  # s, for a connection whose client no longer reads

Array = np.ndarray[Any, Any]


class Measuring:
    """The measurement, the memory and the stream of one profiler.

    Parameters
    ----------
    name : str
    feed : Feed
    line : NewestConnectionServer
        Of the stream.
    fault : Fault
        Of the stream.
    trigger_start : int
        Trigger count of the first profile.
    notice_delay : float
        Delay of the notice that ends a stream, s.
    on_break : callable
        Called when the fault breaks the stream.
    rng : Generator
    """

    def __init__(
        self,
        name: str,
        feed: Feed,
        line: NewestConnectionServer,
        fault: Fault,
        *,
        trigger_start: int,
        notice_delay: float,
        on_break: Callable[[], None],
        rng: np.random.Generator,
    ) -> None:
        self.memory = Memory()
        self.feed = feed
        self._streaming = False
        self.laser = True
        self._name, self._line, self._fault, self._rng = name, line, fault, rng
        self._trigger_start, self._notice_delay, self._on_break = trigger_start, notice_delay, on_break
        self._position = 0  # number of the first profile of the run
        self._here = self._taken = 0  # profiles of the run: measured, and processed by the reader
        self._sent = 0  # profiles of the stream
        self._before = 0  # profiles of the stream before the run
        self._unsent: tuple[int, int] | None = None  # batch and number of the first unsent profile
        self._thread: threading.Thread | None = None
        self._notifying: threading.Thread | None = None  # ends a stream without a measurement
        self._starting, self._ending = threading.Lock(), threading.Lock()
        self._ended, self._stopping = threading.Event(), threading.Event()

    @property
    def trigger_count(self) -> int:
        """Present value of the trigger counter."""
        return int(self._trigger(self._position + self._here))

    @property
    def streaming(self) -> bool:
        """Whether the stream runs; False from the command to stop on, although data may still be sent."""
        return self._streaming and not self._stopping.is_set()

    @property
    def measuring(self) -> bool:
        """Whether a measurement is running or about to start."""
        thread = self._thread
        return thread is not None and not self._ended.is_set() and (thread.ident is None or thread.is_alive())

    def report_delivered(self, samples: int) -> None:
        """Set the number of profiles of the running stream that its reader has processed."""
        self._taken = max(0, samples - self._before)
        self.feed.report_delivered(self._taken)

    # ------------------------------------------------------------------ commands

    def has_unsent_or_kept(self) -> bool:
        """Whether the memory contains a profile."""
        return any(batch.kept for batch in self.memory.batches)

    def start_stream(self, layout: ProfileLayout, position: int, batches: bool) -> bool:
        """Start the stream; False if a measurement cannot start now.

        Position 0 starts after the last profile sent, 1 with the oldest one kept, 2 with the next one measured.
        """
        if self.measuring:  # a batch is running: start with its next profile
            self._sent = self._before = 0
            self._line.select()
            self._stopping.clear()
            self._streaming = True
            return True
        backlog = self._backlog(position)
        self._sent = 0
        return self._start(layout, 0, backlog, measure=not batches, streaming=True)

    def start_batch(self, layout: ProfileLayout, points: int) -> bool:
        """Start a batch; False if a measurement cannot start now."""
        started = self._start(layout, points, None, measure=True, streaming=self.streaming)
        if started:
            self.memory.open_batch()
        return started

    def stop_batch(self) -> None:
        """End the batch; without one, do nothing."""
        if self.measuring:
            self._ended.set()
            self.feed.end()

    def stop_stream(self, batches: bool) -> None:
        """End the stream with its notice; without one, do nothing."""
        if not self.streaming:
            return
        self._stopping.set()
        if not self.measuring:
            notifying = threading.Thread(target=self._end_stream, name=f"sim-{self._name}-end", daemon=True)
            notifying.start()
            self._notifying = notifying
        elif not batches:
            self._ended.set()
            self.feed.end()

    def start_pending(self) -> None:
        """Start the measurement of a command after its answer, so that a stream fault does not affect the answer."""
        with self._starting:
            if self._thread is not None and self._thread.ident is None:
                self._thread.start()

    def grab(self, layout: ProfileLayout) -> None:
        """Measure one block of profiles while no other measurement runs."""
        self.join()
        self.feed.begin()
        deadline = time.monotonic() + GRAB_TIMEOUT
        for lines in self.feed.lines(layout):
            if lines is not None:
                self._record(layout, lines)
                break
            if time.monotonic() > deadline:
                break
            time.sleep(POLL_INTERVAL)
        self.feed.end()
        self._position, self._here = self._position + self._here, 0

    def close(self) -> None:
        """End everything."""
        self._ended.set()
        self._line.disconnect()
        self.join()
        if self._notifying is not None:
            self._notifying.join()

    def reset(self) -> None:
        """End measurement and stream without a notice, and clear the memory."""
        self._streaming = False
        self._ended.set()
        self.feed.end()
        self.join()
        self.clear()

    def clear(self) -> None:
        """Clear the memory."""
        self.memory.clear()
        self._unsent = None

    # ------------------------------------------------------------------ the thread

    def _start(
        self, layout: ProfileLayout, limit: int, backlog: Array | None, *, measure: bool, streaming: bool
    ) -> bool:
        self.join()
        if streaming and not self.streaming:
            self._line.select()
        try:
            if measure:
                self.feed.begin()
        except InstrumentError:
            return False
        self._before = self._sent
        self._ended.clear()
        self._stopping.clear()
        self._streaming = streaming
        self._thread = threading.Thread(
            target=self._run, args=(layout, limit, backlog, measure), name=f"sim-{self._name}-profiles", daemon=True
        )
        return True

    def join(self) -> None:
        """Wait for the end of a measurement that is ending."""
        with self._starting:  # a thread that is not yet started cannot be joined
            thread, self._thread = self._thread, None
        if thread is None or thread is threading.current_thread():
            return
        if thread.ident is not None:
            thread.join(SEND_TIMEOUT)
            for unblock in (self._line.drop_older, self._line.disconnect):
                if thread.is_alive():  # it sends on a connection whose client does not read
                    unblock()
                    thread.join(SEND_TIMEOUT)
            thread.join()
        self._position += self._taken or self._here
        self._here = self._taken = 0

    def _run(self, layout: ProfileLayout, limit: int, backlog: Array | None, measure: bool) -> None:
        try:
            unbroken = backlog is None or self._send(backlog.astype("<u4").tobytes())
            if backlog is not None:
                self._sent += len(backlog)
                self._before = self._sent
            if not measure or not unbroken:
                return
            if self._measure(layout, limit):
                if limit and self.memory.newest is not None:
                    self.memory.newest.committed = True
                self._ended.set()  # before the notice: after it, the client may start the next batch
                if limit and self._streaming:
                    self._send(wire.notice(wire.BATCH_ENDED))
                if self._stopping.is_set() or not limit:
                    self._end_stream()
        finally:
            if measure:
                self.feed.end()

    def _measure(self, layout: ProfileLayout, limit: int) -> bool:
        """Measure until it is stopped or the batch is complete; False if the stream breaks."""
        for lines in self.feed.lines(layout):
            if lines is None:
                self._ended.wait(POLL_INTERVAL)
            if self._ended.is_set():
                break
            if limit and self._stopping.is_set() and self._streaming:
                self._end_stream()
            if lines is None:
                continue
            left = limit - self._here if limit else lines.times.size
            if not self._deliver(layout, _first(lines, left)):
                return False
            if limit and self._here >= limit:
                break
        return True

    def _deliver(self, layout: ProfileLayout, lines: Lines) -> bool:
        fault, numbers = self._fault, self._sent + np.arange(lines.times.size)
        if fault.kind == "out_of_range" and lines.heights is not None:
            beyond = fault.affects("out_of_range", numbers)
            lines = Lines(lines.encoder, np.where(beyond[:, None], np.nan, lines.heights), lines.times)
        rows = self._record(layout, lines)
        if not self._streaming:
            return True
        if fault.kind:
            data = b"".join(self._faulty(row, int(number)) for row, number in zip(rows, numbers, strict=True))
        else:
            data = rows.astype("<u4", copy=False).tobytes()
        self._sent += len(rows)
        newest = self.memory.newest
        self._unsent = None if newest is None else (newest.number, newest.count)
        if not all(self._send(piece) for piece in fault.pieces(data)):
            return False
        if fault.kind in ("silence", "disconnect") and self._sent > fault.at:
            self._on_break()
            return False
        return True

    def _record(self, layout: ProfileLayout, lines: Lines) -> Array:
        """Store profiles in the memory; return them as words."""
        triggers = self._trigger(self._position + self._here + np.arange(lines.times.size, dtype=np.int64))
        heights = lines.heights if self.laser else None
        rows = wire.packed(layout, heights, triggers, lines.encoder % (1 << 32))
        self._here += len(rows)
        self.memory.add(rows)
        return rows

    def _backlog(self, position: int) -> Array | None:
        """Return the profiles of the memory with which a stream starts."""
        if position == 2:
            return None
        parts = []
        for batch in self.memory.batches:
            first = batch.oldest
            if position == 0 and self._unsent is not None:
                first = max(first, self._unsent[1]) if batch.number == self._unsent[0] else first
                first = batch.count if batch.number < self._unsent[0] else first
            if first < batch.count:
                parts.append(batch.rows(first, batch.count - first))
        return np.concatenate(parts) if parts else None

    def _end_stream(self) -> None:
        with self._ending:
            streamed, self._streaming = self._streaming, False
        if streamed:
            time.sleep(self._notice_delay)
            self._send(wire.notice(wire.STOPPED))

    def _send(self, data: bytes) -> bool:
        return self._line.send(data)

    def _trigger(self, number: Any) -> Any:
        return (self._trigger_start + number) % (1 << 32)

    def _faulty(self, words: Array, number: int) -> bytes:
        """Return the bytes of one profile with the fault that is due at it."""
        fault = self._fault
        if (fault.kind in ("silence", "disconnect") and number >= fault.at) or fault.hits("drop", number):
            return b""
        if fault.hits("checksum", number):
            words = words.copy()
            words[-1] ^= 1
        data = words.astype("<u4", copy=False).tobytes()
        if fault.hits("garbage", number):
            position = int(self._rng.integers(0, len(data)))
            data = data[:position] + stray_bytes(self._rng) + data[position:]
        return data


def _first(lines: Lines, count: int) -> Lines:
    if count >= lines.times.size:
        return lines
    heights = None if lines.heights is None else lines.heights[:count]
    return Lines(lines.encoder[:count], heights, lines.times[:count])
