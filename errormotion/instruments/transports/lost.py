"""Connections that are opened again after they were lost, in the same way for all transports.

The exchange in which a connection is lost fails. The next exchange opens another connection, but with a minimum
interval between two attempts; until then every exchange fails with the reason of the loss.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Generic, TypeVar

from errormotion.errors import InstrumentError

Connection = TypeVar("Connection")


class Reopened(Generic[Connection]):
    """A connection that is opened again after it was lost.

    Parameters
    ----------
    url : str
        Address, for messages.
    connect : callable
        Opens a connection, or raises InstrumentError.
    interval : float
        Minimum interval between two attempts to connect, s.

    Attributes
    ----------
    connection : Connection or None
        The open connection; None while it is lost, or closed.
    reason : str
        Why the connection was lost; empty while it is open.
    """

    def __init__(self, url: str, connect: Callable[[], Connection], interval: float) -> None:
        self.url = url
        self.connection: Connection | None = None
        self.reason = ""
        self._connect, self._interval = connect, interval
        self._last_attempt = 0.0
        self._closed = False

    def get(self) -> Connection:
        """Return the connection; open one if it was lost.

        Raises
        ------
        InstrumentError
            The connection is closed or cannot be opened, or the interval since the last attempt has not passed.
        """
        if self._closed:
            raise InstrumentError(f"The connection to {self.url} is closed", code="connection.closed")
        if self.connection is None:
            now = time.monotonic()
            if self.reason and now < self._last_attempt + self._interval:
                left = self._last_attempt + self._interval - now
                raise InstrumentError(f"{self.reason}; the next attempt is in {left:.1f} s", code="connection.lost")
            self._last_attempt = now
            try:
                self.connection = self._connect()
            except InstrumentError as error:
                self.reason = str(error)
                raise
            self.reason = ""
        return self.connection

    def drop(self, reason: str) -> Connection | None:
        """Drop the connection, so that `get` opens another one; return it for closing."""
        lost, self.connection, self.reason = self.connection, None, reason
        return lost

    def close(self) -> Connection | None:
        """Open no further connection; return the present one for closing."""
        self._closed = True
        last, self.connection = self.connection, None
        return last
