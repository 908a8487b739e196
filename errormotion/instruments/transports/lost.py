"""Connections that are opened again after they were lost: one policy for all transports.

The exchange in which a connection is lost fails. The next exchange opens another connection, but two attempts are at
least an interval apart; until then every exchange fails with the reason of the loss.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Generic, TypeVar

from errormotion.errors import InstrumentError

Connection = TypeVar("Connection")


class Reopened(Generic[Connection]):
    """One connection, opened again after it was lost.

    Parameters
    ----------
    url : str
        For messages.
    connect : callable
        Opens a connection, or raises InstrumentError.
    interval : float
        Least time between two attempts to connect, s.

    Attributes
    ----------
    connection : Connection or None
        The open connection; None while it is lost, or closed.
    reason : str
        Why the connection was lost; empty while there is one.
    """

    def __init__(self, url: str, connect: Callable[[], Connection], interval: float) -> None:
        self.url = url
        self.connection: Connection | None = None
        self.reason = ""
        self._connect, self._interval = connect, interval
        self._last_attempt = 0.0
        self._closed = False

    def get(self) -> Connection:
        """Return the connection; open one where it was lost.

        Raises
        ------
        InstrumentError
                It is closed, it cannot be opened, or the interval since the last attempt has not passed.
        """
        if self._closed:
            raise InstrumentError(f"The connection to {self.url} is closed")
        if self.connection is None:
            now = time.monotonic()
            if self.reason and now < self._last_attempt + self._interval:
                left = self._last_attempt + self._interval - now
                raise InstrumentError(f"{self.reason}; the next attempt is in {left:.1f} s")
            self._last_attempt = now
            try:
                self.connection = self._connect()
            except InstrumentError as error:
                self.reason = str(error)
                raise
            self.reason = ""
        return self.connection

    def drop(self, reason: str) -> Connection | None:
        """Drop the connection, so that `get` opens another one; return it, to be closed."""
        lost, self.connection, self.reason = self.connection, None, reason
        return lost

    def close(self) -> Connection | None:
        """Open no further connection; return the present one, to be closed."""
        self._closed = True
        last, self.connection = self.connection, None
        return last
