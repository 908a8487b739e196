"""Discarding of unread bytes before a request, so that the next bytes are its answer."""

from __future__ import annotations

import time
from contextlib import suppress

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError, ReplayError
from errormotion.instruments.transports.base import CHUNK, Transport

MAX_STRAY_BYTES = 1 << 20
"""Largest number of unread bytes that can be late answers; with more, the device sends without a request."""
MAX_INTERVALS = 10
"""Time after which a line that is not quiet is an error, as a multiple of the interval."""


def discard_input(line: Transport) -> bytes:
    """Discard and return the unread bytes of a line, such as late answers; detect a lost connection."""
    old = b""
    with suppress(InstrumentError):  # a timeout is expected; the next write opens a lost connection again
        while len(old) < MAX_STRAY_BYTES and (data := line.read(CHUNK, timeout=0.0)):
            old += data
    return old


def await_quiet(line: Transport, interval: float, since: float | None = None) -> int:
    """Discard input until none has arrived for an interval; return the number of discarded bytes.

    Parameters
    ----------
    line : Transport
    interval : float
        Time without data, s.
    since : float, optional
        Start of the interval by time.monotonic(); default: now. Unread bytes restart the interval.

    Raises
    ------
    ProtocolError
        The device does not stop sending.
    InstrumentError
        The connection is lost.
    """
    start = time.monotonic()
    end, count = (start if since is None else since) + interval, 0
    while True:
        try:
            count += len(line.read(CHUNK, timeout=max(end - time.monotonic(), 0.0)))
        except (InstrumentTimeoutError, ReplayError):  # ReplayError: the recording ends here
            return count
        now = time.monotonic()
        end = now + interval
        if count > MAX_STRAY_BYTES or now - start > MAX_INTERVALS * interval:
            raise ProtocolError(
                f"{line.url}: {count} bytes arrived in {now - start:.1f} s without a request; expected a line without "
                f"data for {interval:g} s. Stop the output of the device, and open it again",
                code="protocol.unrequested",
            )


def after_others(error: InstrumentTimeoutError, count: int, what: str) -> InstrumentTimeoutError:
    """Return the error of a missing answer, with the number of answers to other requests that came instead.

    Parameters
    ----------
    error : InstrumentTimeoutError
    count : int
        Number of answers that were read and discarded while this one was awaited; 0: the error is returned unchanged.
    what : str
        The request.
    """
    if not count:
        return error
    discarded = "1 answer to other requests was" if count == 1 else f"{count} answers to other requests were"
    return InstrumentTimeoutError(
        f"{error}. No answer to {what} came, but {discarded} discarded: the device answers late, or other requests",
        code="instrument.no_answer",
    )
