"""Base of drivers: settings, opening and closing, an error for use before opening."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

from errormotion.errors import InstrumentError, ReplayError
from errormotion.instruments.transports import Transport, open_transport
from errormotion.plugins import InstrumentInfo, PluginSettings


class Driver:
    """Base of drivers with one transport.

    A subclass has ``info`` and ``Settings``, starts the device in ``_start_session``, stops it in ``_end_session``, and
    uses
    ``self.transport``.

    Parameters
    ----------
    address : str
        URL of the device.
    settings : PluginSettings, optional
        The driver's ``Settings``; default: all defaults.
    record : Path, optional
        File to which every frame of the session is recorded.
    """

    info: ClassVar[InstrumentInfo]
    Settings: ClassVar[type[PluginSettings]] = PluginSettings

    def __init__(self, address: str, settings: Any = None, *, record: Path | None = None) -> None:
        self.address = address
        self.settings: Any = self.Settings() if settings is None else settings
        self._record = record
        self._transport: Transport | None = None

    @property
    def transport(self) -> Transport:
        """The open transport; InstrumentError before ``open``."""
        if self._transport is None:
            raise InstrumentError(
                f"The {self.info.id} at {self.address} is not open: use it in a 'with' block, or call open() first"
            )
        return self._transport

    def open(self) -> None:
        """Open the connection and check the device; idempotent.

        Raises
        ------
        InstrumentError
            No device or another device answers.
        """
        if self._transport is not None:
            return
        self._transport = self._connect()
        try:
            self._start_session()
        except BaseException:
            self._drop()
            raise

    def close(self) -> None:
        """Close the connection and end every thread; idempotent."""
        if self._transport is None:
            return
        try:
            self._end_session()
        finally:
            transport, self._transport = self._transport, None
            transport.close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
            return
        with suppress(InstrumentError):  # the first error states the cause
            self.close()

    def _connect(self) -> Transport:
        return open_transport(self.address, simulator=self.info.simulator, recorder=self._record)

    def _start_session(self) -> None:
        """Check the device right after connecting."""

    def _end_session(self) -> None:
        """Stop the device right before closing."""

    def _drop(self) -> None:
        transport, self._transport = self._transport, None
        if transport is not None:
            with suppress(ReplayError):
                transport.close()
