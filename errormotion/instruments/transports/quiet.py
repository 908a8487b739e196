"""A line without unread bytes: what is done ahead of a request, so that the next bytes are its answer."""

from __future__ import annotations

import time
from contextlib import suppress

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError, ReplayError
from errormotion.instruments.transports.base import CHUNK, Transport

MOST_STRAY_BYTES = 1 << 20
"""More unread bytes than this are no late answer: the device sends without a request."""
MOST_INTERVALS = 10
"""A line that is not quiet after this many times the interval is given up."""


def discard_input(line: Transport) -> bytes:
    """Discard and return the unread bytes of a line, such as late answers; detect a connection that was lost."""
    old = b""
    with suppress(InstrumentError):  # a timeout is expected; the next write opens a lost connection again
        while len(old) < MOST_STRAY_BYTES and (data := line.read(CHUNK, timeout=0.0)):
            old += data
    return old


def await_quiet(line: Transport, interval: float, since: float | None = None) -> int:
    """Discard what arrives until nothing has arrived for an interval; return the number of discarded bytes.

    Parameters
    ----------
    line : Transport
    interval : float
        Time without data, s.
    since : float, optional
        Start of the interval, of time.monotonic(); default: now. Unread bytes start the interval again.

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
        if count > MOST_STRAY_BYTES or now - start > MOST_INTERVALS * interval:
            raise ProtocolError(
                f"{line.url}: {count} bytes arrived in {now - start:.1f} s without a request; expected a line without "
                f"data for {interval:g} s. Stop the output of the device, and open it again"
            )
