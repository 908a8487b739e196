"""Session with an emScon server: the connection, its state, and commands through it."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, ClassVar

from errormotion.errors import InstrumentError
from errormotion.instruments.driver import Driver
from errormotion.instruments.laser_tracker.leica_emscon import codec, statuses
from errormotion.instruments.laser_tracker.leica_emscon.codec import Packet
from errormotion.instruments.laser_tracker.leica_emscon.link import Event, Link, RefusedError
from errormotion.instruments.laser_tracker.leica_emscon.settings import EmSconSettings


class EmSconSession(Driver):
    """A driver with a `Link`; a subclass has ``configure``."""

    Settings: ClassVar[type[EmSconSettings]] = EmSconSettings
    settings: EmSconSettings
    _connection: Link | None = None
    _streaming = False
    _refraction = math.nan
    _resets = 0
    _last: tuple[float, float, float] | None = None

    @property
    def beam_broken(self) -> bool:
        """Whether the beam has lost its reflector, as far as the tracker has reported."""
        return self._link.broken

    @property
    def events(self) -> tuple[Event, ...]:
        """Messages of the tracker that were not requested, oldest first: broken beams, changes of its status."""
        return tuple(self._link.events)

    def configure(self, settings: EmSconSettings) -> None:
        """Configure the server."""
        raise NotImplementedError

    @property
    def _link(self) -> Link:
        if self._connection is None or self._transport is None:
            self.transport  # noqa: B018 - raises before open
            raise InstrumentError(
                f"The connection to {self.address} is closed; open it again", code="connection.closed"
            )
        return self._connection

    def _query(self, number: int, /, *, limit: float | None = None, **values: Any) -> Packet:
        return self._link.query(number, limit=limit, **values)

    def _query_optional(self, number: int) -> dict[str, Any]:
        try:
            return dict(self._query(number).values)
        except RefusedError as error:
            if error.status not in (statuses.NOT_IMPLEMENTED, 27):
                raise
            return {}

    def _refuse_while_streaming(self) -> None:
        if self._streaming:
            raise InstrumentError(f"{self.info.id} is streaming; close the stream first", code="stream.running")

    def _start_session(self) -> None:
        self._last, self._resets = None, 0
        self._streaming = False
        self._connection = Link(self.transport, self.settings.timeout, self.settings.busy_timeout)
        self.configure(self.settings)

    def _end_session(self) -> None:
        link, self._connection = self._connection, None
        if link is not None and self._streaming:
            self._streaming = False
            with suppress(InstrumentError):
                link.query(codec.STOP_MEASUREMENT)
