"""One reader thread for a streaming instrument, and a bounded queue.

The thread reads bytes from the transport, decodes them, and queues the samples. When the queue is full the thread
waits, if the transport has flow control; if it has none (a serial line), the samples are discarded, counted,
and marked as lost. No sample is lost without being counted.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.base import CHUNK

POLL_INTERVAL = 0.1
"""Interval at which the thread checks whether it has to end, s."""

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Chunk:
    """Samples as received.

    Attributes
    ----------
    values : ndarray, (n, ...)
        Distances (float64, NaN where missing), or packed profiles.
    reasons : ndarray, uint8, (n,)
        Code of the reason for a missing value; 0 for a value.
    text : bytes
        Bytes received between the values.
    end : InstrumentError, optional
        Reason why no samples follow.
    """

    values: Array
    reasons: Array
    text: bytes = b""
    end: InstrumentError | None = None


class Decoder(Protocol):
    """Converts bytes, however they are split, to samples without gaps."""

    def __call__(self, data: bytes) -> Chunk:
        """Return the samples that the next bytes complete."""


def count_reasons(reasons: Array, names: Sequence[str], prefix: str = "") -> dict[str, int]:
    """Return the number of samples without a value by the name of the reason; code 0 means a value."""
    if not reasons.any():
        return {}
    counts = np.bincount(reasons, minlength=len(names))
    return {prefix + names[code]: int(count) for code, count in enumerate(counts) if code and count}


class Reader:
    """The reader thread of one stream.

    Parameters
    ----------
    transport : Transport
    decode : Decoder
        Called in the thread.
    name : str
        Name of the instrument, for messages.
    limit : int
        Number of samples in the queue at which the thread waits.
    overrun : int
        Reason code of discarded samples.
    prompt : bytes
        End of an answer of the device; empty where answers use another line.
    """

    def __init__(
        self, transport: Transport, decode: Decoder, *, name: str, limit: int, overrun: int, prompt: bytes = b""
    ) -> None:
        self._transport = transport
        self._decode = decode
        self._name = name
        self._limit = limit
        self._overrun = overrun
        self._prompt = prompt
        self._queue: deque[_Entry] = deque()
        self._queued = 0
        self._delivered = 0
        self._text = b""
        self._reply: bytes | None = None
        self._listening = False
        self._final = False  # nothing is read after the next answer
        self._error: InstrumentError | None = None
        self._draining = False
        self._ended = False
        self._last_data = time.monotonic()
        self._change = threading.Condition()
        self.host_time = self._last_data
        self.stray_bytes = 0
        self._thread = threading.Thread(target=self._run, name=f"reader-{name}", daemon=True)
        self._thread.start()

    def fill(self, values: Array, reasons: Array, timeout: float) -> None:
        """Fill both arrays with the next samples; ``host_time`` is then the time of receipt of the last one.

        Raises
        ------
        InstrumentTimeoutError
            The device sent no data for ``timeout`` s while samples were missing.
        InstrumentError
            The error that ended the thread.
        """
        done, size = 0, len(values)
        while done < size:
            with self._change:
                self._await_samples(timeout)
                entry = self._queue[0]
                n = min(size - done, entry.size - entry.used)
                part = slice(entry.used, entry.used + n)
                entry.used += n
                if entry.used == entry.size:
                    self._queue.popleft()
                self._queued -= n
                self.host_time = entry.host_time
                if self._queued < self._limit:
                    self._change.notify_all()
            into = slice(done, done + n)
            if entry.chunk is None:
                values[into], reasons[into] = np.nan, self._overrun
            else:
                values[into], reasons[into] = entry.chunk.values[part], entry.chunk.reasons[part]
            done += n
        self._delivered += size
        self._transport.report_delivered(self._delivered)

    def _await_samples(self, timeout: float) -> None:
        start = time.monotonic()
        while not self._queue:
            if self._error is not None:
                raise self._error
            left = max(self._last_data, start) + timeout - time.monotonic()
            if left <= 0:
                raise InstrumentTimeoutError(
                    f"{self._name}: no data for {timeout:g} s; is it switched on and connected?",
                    code="instrument.no_answer",
                )
            self._change.wait(left)

    def drain(self) -> None:
        """Discard all samples from now on, so that the device need not wait."""
        with self._change:
            self._draining = True
            self._queue.clear()
            self._queued = 0
            self._change.notify_all()

    def query(self, request: bytes, timeout: float, *, final: bool = False) -> bytes:
        """Write a request and return the text of the answer with its prompt, which arrives between the data.

        With ``final`` nothing is read after the answer.

        Raises
        ------
        InstrumentTimeoutError
            No answer within ``timeout`` s.
        InstrumentError
            The error that ended the thread.
        """
        with self._change:
            self._text, self._reply, self._listening, self._final = b"", None, True, final
            self._change.notify_all()
        self._transport.write(request)
        with self._change:
            self._change.wait_for(lambda: self._reply is not None or self._error is not None, timeout)
            self._listening = False
            if self._reply is not None:
                return self._reply
            if self._error is not None:
                raise self._error
            partial = f"; received {self._text[:64]!r}, which is not complete" if self._text.strip() else ""
            raise InstrumentTimeoutError(
                f"{self._name}: no answer to {request!r} within {timeout:g} s{partial}", code="instrument.no_answer"
            )

    def stop(self, request: bytes, timeout: float) -> bytes:
        """Write the request that ends the stream, wait for its answer, end the thread; return the answer."""
        self.drain()
        try:
            return self.query(request, timeout, final=True)
        finally:
            self.abandon()

    def finish(self, quiet: float, timeout: float) -> InstrumentError | None:
        """Discard further samples until the stream ends or no data have arrived for ``quiet`` s; end the thread.

        Returns the error that ended the thread, None if the device stopped sending.

        Raises
        ------
        InstrumentTimeoutError
            It was still sending after ``timeout`` s.
        """
        self.drain()
        start = time.monotonic()
        try:
            with self._change:
                while self._error is None:
                    now = time.monotonic()
                    if now - max(self._last_data, start) >= quiet:
                        break
                    if now - start >= timeout:
                        raise InstrumentTimeoutError(
                            f"{self._name}: still sending {timeout:g} s after it was stopped", code="stream.not_stopped"
                        )
                    self._change.wait(POLL_INTERVAL)
        finally:
            self.abandon()
        return self._error

    def abandon(self) -> None:
        """End the thread, whatever the state of the device; idempotent."""
        with self._change:
            self._ended = True
            self._change.notify_all()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._ended:
                try:
                    data = self._transport.read(CHUNK, timeout=POLL_INTERVAL)
                except InstrumentTimeoutError:
                    continue
                now = time.monotonic()
                chunk = self._decode(data)
                self._accept(chunk, now)
                if chunk.end is not None:
                    raise chunk.end
        except InstrumentError as error:
            self._fail(error.restated(f"{self._name}: {error}"))
        except Exception as error:  # noqa: BLE001 - the caller must receive every error
            self._fail(
                InstrumentError(
                    f"{self._name}: the reader thread failed: {type(error).__name__}: {error}",
                    code="stream.reader.failed",
                )
            )

    def _fail(self, error: InstrumentError) -> None:
        with self._change:
            self._error = error
            self._change.notify_all()

    def _accept(self, chunk: Chunk, now: float) -> None:
        with self._change:
            if chunk.values.size:  # bytes without samples do not show that the stream works
                self._last_data = now
            if chunk.text:
                self._accept_text(chunk.text)
            size = len(chunk.values)
            if self._draining or not size:
                return
            if self._queued >= self._limit:
                if self._transport.flow_control:
                    self._change.wait_for(self._may_continue)
                    if self._draining:
                        return
                else:
                    self._discard(size, now)
                    return
            self._queue.append(_Entry(chunk, size, now))
            self._queued += size
            self._change.notify_all()

    def _may_continue(self) -> bool:
        """Whether the thread may continue: the queue has room, or an answer is expected after the data."""
        return self._queued < self._limit or self._listening or self._draining or self._ended

    def _accept_text(self, text: bytes) -> None:
        if not self._listening:
            self.stray_bytes += len(text)
            return
        self._text += text
        head, found, tail = self._text.partition(self._prompt)
        if found:
            self._reply, self._listening = head + found, False
            self.stray_bytes += len(tail)
            self._ended = self._ended or self._final
            self._change.notify_all()

    def _discard(self, size: int, now: float) -> None:
        last = self._queue[-1]
        if last.chunk is None:
            last.size += size
        else:
            self._queue.append(_Entry(None, size, now))
        self._queued += size


@dataclass
class _Entry:
    chunk: Chunk | None  # None: discarded
    size: int
    host_time: float
    used: int = 0
