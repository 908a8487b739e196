"""Compensators for machines under LinuxCNC, through the bridge and ``compensation.tcl`` in its servo thread.

``compensation.tcl`` limits the offset and its rate of change, holds it when required, and ramps it to zero when the
heartbeat stops, also when the bridge has ended. The bridge checks each offset again, and accepts offsets from one
client at a time.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from errormotion.datasets.units import Time
from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.linuxcnc import codec
from errormotion.instruments.controller.linuxcnc.driver import SECRET_BYTES, client_name, read_token
from errormotion.instruments.driver import Driver
from errormotion.instruments.interlock import OffsetInterlock
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.recording import RecordingTransport, ReplayTransport
from errormotion.plugins import Applied, CompensatorSubject, Identity, InstrumentInfo, PluginSettings

SIMULATOR = "errormotion.instruments.simulators.controller.linuxcnc:SimulatedLinuxCNC"


class LinuxCNCCompensatorSettings(PluginSettings):
    """Settings of ``linuxcnc_offset`` and ``linuxcnc_feedback``."""

    token_file: Path = Field(
        default=Path("~/.errormotion/linuxcnc.token"),
        description="file with the token of the bridge, which only its user may read",
    )
    timeout: Time = Field(default=1.0, description="time limit for an answer of the bridge", gt=0, le=10)


class LinuxCNCOffset(Driver):
    """Offsets as external offsets of LinuxCNC (``axis.L.eoffset``).

    Opening and reading change nothing. `arm` requests the right to set offsets from the bridge, which grants it to one
    program at a time; after a lost connection the next `write` requests it again.

    Parameters
    ----------
    address : str
        As that of the driver ``linuxcnc``: ``unix://~/.errormotion/linuxcnc.sock``, ``sim://cframe/linuxcnc?seed=3``.
    settings : LinuxCNCCompensatorSettings, optional
    record : Path, optional
        File to which every frame of the session is recorded.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="linuxcnc_offset",
        kind="compensator",
        summary="Offsets of LinuxCNC 2.9 (external offsets), with limits and watchdog in its servo thread.",
        status="simulated_only",
        simulator=SIMULATOR,
    )
    Settings: ClassVar[type[PluginSettings]] = LinuxCNCCompensatorSettings
    route: ClassVar[str] = "external"

    def __init__(self, address: str, settings: Any = None, *, record: Path | None = None) -> None:
        super().__init__(address, settings, record=record)
        self._interlock = OffsetInterlock(f"{self.info.id} at {address}")
        self._number = 0
        self._may_write = False
        self._secret = secrets.token_hex(SECRET_BYTES)

    @classmethod
    def conformance(cls) -> CompensatorSubject:
        """Return the subject of the conformance kit: a separate LinuxCNC with simulated joints."""
        return CompensatorSubject(
            cls,
            address=f"sim://cframe/linuxcnc?seed=3&route={cls.route}&slew=20&linger=60",
            dead_address="unix:///nonexistent/linuxcnc.sock",
        )

    def close(self) -> None:
        """Disconnect and disarm; the watchdog in the servo thread ramps the offset to zero. Idempotent."""
        self._interlock.disarm()
        super().close()

    def identify(self) -> Identity:
        """Return the machine."""
        details = {"address": self.address, "route": self.route}
        return codec.decode_identity(self._request("identify"), self.transport.simulated, details)

    def arm(self, limit: float) -> None:
        """Permit offsets up to a limit for each axis, m; request the right to set them from the bridge.

        Raises
        ------
        InstrumentError
            Another program has the right, the bridge refuses it, or its limit is below this one.
        """
        self._interlock.arm(limit)
        try:
            state = self._state()
            if state.limit < limit * (1 - 1e-6):
                raise InstrumentError(
                    f"{self.address}: expected [ERRORMOTION] LIMIT of at least {1e6 * limit:g} um in LinuxCNC's INI "
                    f"file; found {1e6 * state.limit:g} um",
                    code="linuxcnc.limit.too_small",
                )
            self._claim(self.transport)
        except BaseException:
            self._interlock.disarm()
            raise

    def read(self) -> Applied:
        """Return the offset in effect; busy: it is held in the servo thread; fault: LinuxCNC accepts none.

        Raises
        ------
        InstrumentError
            No answer; the connection is closed, and `open` opens another one.
        """
        state = self._state()
        fault = state.fault
        if not fault and state.by and not self._may_write:
            fault = f"another program compensates the machine: {state.by}"
        return Applied(state.offset, state.busy, fault)

    def write(self, offset: Sequence[float]) -> None:
        """Set the offset of X, Y, Z, m; also a heartbeat for the watchdog.

        Raises
        ------
        InstrumentError
            Not armed, beyond the limit, not three finite numbers; no answer; or the bridge refuses the offset: another
            program compensates, the machine is off, or the change is too large.
        """
        values, line = self._interlock.offset(offset), self.transport
        if not self._may_write:
            self._claim(line)
        self._request("set_offset", offset=list(values))

    # ------------------------------------------------------------------ connection

    def _start_session(self) -> None:
        self._number, self._may_write = 0, False
        if not isinstance(self.transport, ReplayTransport):
            codec.decode_welcome(self._hello(self.transport, compensate=False))

    def _state(self) -> codec.Offset:
        state = codec.decode_offset(self._request("offset"))
        if state.route != self.route:
            raise InstrumentError(
                f"{self.address}: expected ROUTE = {self.route} in LinuxCNC's INI file for {self.info.id}; found "
                f"{state.route}",
                code="linuxcnc.route.other",
            )
        return state

    def _claim(self, line: Transport) -> None:
        if not isinstance(line, ReplayTransport):
            granted, other = codec.decode_right(self._hello(line, compensate=True))
            if not granted:
                why = f"another program has it ({other})" if other else "start the bridge with --compensate"
                raise InstrumentError(
                    f"{self.address} refuses the right to set offsets: {why}", code="linuxcnc.right.refused"
                )
        self._may_write = True

    def _hello(self, line: Transport, *, compensate: bool) -> Any:
        """Send a first request, which no recording contains, and return its result."""
        token = "" if line.simulated else read_token(self.settings.token_file, self.address)
        hello = {"token": token, "secret": self._secret, "session": "offsets", "client": client_name()}
        within = line.unrecorded if isinstance(line, RecordingTransport) else line
        return self._exchange(within, 0, "hello", control=False, compensate=compensate, **hello)

    def _request(self, op: str, **arguments: Any) -> Any:
        """Return the result of a request; after a failure without an answer the connection is closed."""
        line = self.transport
        self._number += 1
        return self._exchange(line, self._number, op, **arguments)

    def _exchange(self, line: Transport, number: int, op: str, **arguments: Any) -> Any:
        request = codec.encode_request(number, op, arguments)
        try:
            line.write(request)
            answer = self._answer(line, number)
        except InstrumentError:
            self._drop()
            raise
        if not answer.ok:
            raise InstrumentError(
                f"{self.address} refuses '{op.replace('_', ' ')}': {answer.error}", code="linuxcnc.refused"
            )
        return answer.result

    def _answer(self, line: Transport, number: int) -> codec.Answer:
        try:
            message = codec.decode(line.read_until(codec.LINE_END, limit=codec.MAX_LINE))
        except InstrumentTimeoutError:
            raise InstrumentTimeoutError(
                f"{self.address}: the bridge of LinuxCNC did not answer within {self.settings.timeout:g} s",
                code="instrument.no_answer",
            ) from None
        if message.number is None and not getattr(message, "ok", True):
            raise InstrumentError(
                f"{self.address}: the bridge ends the connection: {getattr(message, 'error', '')}",
                code="connection.lost",
            )
        if message.number != number or not isinstance(message, codec.Answer):
            raise ProtocolError(
                f"{self.address}: expected the answer to request {number}; found {message}", code="protocol.reply.other"
            )
        return message


class LinuxCNCFeedback(LinuxCNCOffset):
    """Offsets in the feedback path of LinuxCNC: added to the motors' commands, subtracted from their feedback.

    The positions that LinuxCNC reports do not contain them. Otherwise as `LinuxCNCOffset`.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="linuxcnc_feedback",
        kind="compensator",
        summary="Offsets in the feedback path of LinuxCNC 2.9, with limits and watchdog in its servo thread.",
        status="simulated_only",
        simulator=SIMULATOR,
    )
    route: ClassVar[str] = "feedback"
