"""Driver of a machine under LinuxCNC, through the bridge on its computer."""

from __future__ import annotations

import math
import os
import secrets
import stat
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.linuxcnc import codec
from errormotion.instruments.controller.linuxcnc.settings import LinuxCNCSettings
from errormotion.instruments.driver import Driver
from errormotion.instruments.interlock import Interlock
from errormotion.instruments.nc_limits import check_program
from errormotion.instruments.transports import Transport, open_transport
from errormotion.instruments.transports.quiet import after_others
from errormotion.instruments.transports.recording import Recorder, RecordingTransport
from errormotion.plugins import Identity, InstrumentInfo, MachineLimits, lazy
from errormotion.state import open_itself

ESTOP_TIMEOUT = 2.0  # s
ESTOP_INTERVAL = 0.01  # s between two queries of the state
SECRET_BYTES = 32
"""Length of a secret, by which a bridge knows the connections of one client."""


class LinuxCNC(Driver):
    """A machine under LinuxCNC.

    Positions are in machine coordinates (G53), m, independent of the offsets of work and tool.

    Without ``arm`` in the settings the driver only reads the state, and can stop the machine.

    A command is sent once. If the connection is lost or no answer arrives, an InstrumentError is raised, the bridge
    aborts the motion, and nothing is repeated; the next call connects again. `stop` may be called from another thread.

    Parameters
    ----------
    address : str
        ``unix://~/.errormotion/linuxcnc.sock``, ``tcp://127.0.0.1:5007``, ``sim://gantry/linuxcnc?seed=3``,
        ``replay://file``.
    settings : LinuxCNCSettings, optional
    record : Path, optional
        Recording of the session. A recorded session does not connect again.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="linuxcnc",
        kind="controller",
        summary="Machines under LinuxCNC 2.9, through a bridge beside it: state, moves, probing, spindle, NC programs",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.controller.linuxcnc:SimulatedLinuxCNC",
    )
    Settings: ClassVar[type[LinuxCNCSettings]] = LinuxCNCSettings
    doctor = lazy("errormotion.instruments.simulators.controller.linuxcnc_process:DOCTOR")
    settings: LinuxCNCSettings

    def __init__(self, address: str, settings: Any = None, *, record: Any = None) -> None:
        super().__init__(address, settings, record=record)
        self._interlock = Interlock(self.info.id, address)
        self._exchange_lock = threading.Lock()
        self._number = 0
        self._unawaited: set[int] = set()
        self._lost = False

    # ------------------------------------------------------------------ state

    @property
    def virtual(self) -> bool:
        """Whether the machine is simulated, with its own clock."""
        return self.transport.simulated

    def identify(self) -> Identity:
        """Request the identity of the machine."""
        facts = self._query("identify")
        return codec.decode_identity(facts, self.transport.simulated, {"address": self.address}, "travel")

    def configure(self, settings: LinuxCNCSettings) -> None:
        """Use other settings from now on; ``arm`` and the token take effect with the next connection."""
        self.settings = settings

    def bound(self, limits: MachineLimits) -> None:
        """Apply limits to every command from now on."""
        self._interlock.limits = limits

    def read(self) -> dict[str, Any]:
        """Return the present state."""
        return self.state()

    def state(self) -> dict[str, Any]:
        """Return the state of the machine.

        ``time`` (s since the start of the bridge, or of the virtual world if simulated), ``position`` (X, Y, Z as
        measured, m), ``commanded_position`` (m), ``spindle_speed`` (1/min; as measured, if HAL has an encoder),
        ``spindle_load`` (1 = rated; NaN unless the bridge has its HAL pin), ``feed`` (m/s), ``mode`` (``manual``,
        ``mdi``, ``automatic``), ``program`` (name of the file, or empty), ``running``, ``homed``, ``enabled``,
        ``estop``, ``alarms`` (LinuxCNC's error texts since the last command or `reset`).
        """
        return codec.decode_state(self._query("state"))

    # ------------------------------------------------------------------ commands

    def reset(self) -> None:
        """Release the e-stop and clear the alarms; then `enable`."""
        self._change("reset")

    def enable(self) -> None:
        """Switch the machine on.

        Raises
        ------
        InstrumentError
            LinuxCNC is in e-stop, or the machine remains off.
        """
        self._change("enable")

    def estop(self) -> None:
        """Set LinuxCNC's e-stop; return when it is in e-stop. It does not replace the emergency stop button.

        Raises
        ------
        InstrumentError
            LinuxCNC is not in e-stop after ESTOP_TIMEOUT.
        """
        self._send("estop")
        until = time.monotonic() + ESTOP_TIMEOUT
        while not self.state()["estop"]:
            if time.monotonic() > until:
                raise InstrumentError(
                    f"{self.address}: LinuxCNC is not in e-stop after {ESTOP_TIMEOUT:g} s", code="linuxcnc.not_in_estop"
                )
            time.sleep(ESTOP_INTERVAL)

    def home(self) -> None:
        """Home all axes; return when all are homed."""
        self._change("home")

    def move_to(self, position: Sequence[float], feed: float | None = None) -> dict[str, Any]:
        """Move in a straight line; return when the machine has arrived.

        Parameters
        ----------
        position : (3,)
            X, Y, Z, m.
        feed : float, optional
            m/s; default: rapid. LinuxCNC limits the feed to that of its axes.

        Returns
        -------
        dict
            ``duration``, s.

        Raises
        ------
        InstrumentError
            The machine is not homed, off or in e-stop, the position is out of travel; or a stop, an error of LinuxCNC
            or a lost connection ended the move. The message contains the text of LinuxCNC.
        """
        goal, limit = self._interlock.position(position), self._interlock.limits.feed
        extra = {} if feed is not None or limit is None else {"feed_limit": limit}
        feed = None if feed is None else self._interlock.feed(feed)
        return dict(self._change("move_to", position=goal, feed=feed, **extra))

    def probe(self, target: Sequence[float], feed: float) -> dict[str, Any]:
        """Move in a straight line until the probe trips; return when the machine is at rest.

        LinuxCNC latches the position in the servo cycle in which it detects the trip: up to one cycle of travel, 1 ms x
        feed, after the contact, plus the delay of the probe's signal (`LinuxCNCSettings.trip_delay`).

        Parameters
        ----------
        target : (3,)
            X, Y, Z, m.
        feed : float
            m/s.

        Returns
        -------
        dict
            ``tripped``; ``position`` of the trip, m, or None; ``time`` on the machine's clock, s. Without a trip the
            machine is at the target.

        Raises
        ------
        InstrumentError
            The probe is tripped before it moves; for other errors see `move_to`.
        """
        goal, feed = self._interlock.position(target, "target"), self._interlock.feed(feed)
        start = self.state()["commanded_position"] if self.settings.trip_delay else goal
        touch = codec.decode_touch(self._change("probe", target=goal, feed=feed))
        length = math.dist(goal, start)
        if touch["tripped"] and length > 0:
            back = self.settings.trip_delay * feed / length
            touch["position"] = [x - back * (g - s) for x, g, s in zip(touch["position"], goal, start, strict=True)]
        return touch

    def spindle(self, speed: float) -> None:
        """Turn the spindle at a speed in 1/min, negative for reverse, 0 to stop it; return at once."""
        self._change("spindle", speed=self._interlock.speed(speed))

    def stop(self, spindle: bool = False) -> None:
        """Abort all motion. LinuxCNC's abort stops the spindle, whatever the value of ``spindle``.

        From another thread it ends a waiting call with an InstrumentError.
        """
        if self._exchange_lock.acquire(blocking=False):
            self._exchange_lock.release()
            self._send("stop", spindle=bool(spindle))
            return
        self._number += 1
        self._unawaited.add(self._number)
        self.transport.write(codec.encode_request(self._number, "stop", {"spindle": bool(spindle)}))

    def elapse(self, seconds: float) -> None:
        """Wait; `stop` ends this with an InstrumentError. A simulation skips the time, unless a program runs."""
        self._send("elapse", seconds=self._interlock.duration(seconds))

    def run_program(self, text: str) -> dict[str, Any]:
        """Run an NC program; return when it has started. ``state()["running"]`` states whether it runs; `finish` waits.

        The program ends with the connection: LinuxCNC aborts when the driver is closed.

        Returns
        -------
        dict
            ``program``, the name of its file, and ``longest_lead_in``, 0 s.
        """
        check_program(str(text), self._interlock)
        extra = {"machine_coordinates": True} if self._interlock.limits.spans else {}
        *parts, last = codec.parts_of(str(text))
        for number, part in enumerate(parts):
            if number == 0:
                self._change("program_part", text="")
            self._change("program_part", text=part)
        return dict(self._change("run_program", text=last, **extra))

    def finish(self) -> dict[str, Any]:
        """Wait for the end of the program.

        Returns
        -------
        dict
            ``duration`` of the program, s.

        Raises
        ------
        InstrumentError
            The program ended early; the message contains the text of LinuxCNC.
        """
        return dict(self._send("finish"))

    # ------------------------------------------------------------------ connection

    def _query(self, op: str) -> Any:
        """Send a request; if the connection is lost, repeat it once over a new one."""
        try:
            return self._send(op)
        except InstrumentTimeoutError:
            raise
        except InstrumentError:
            if not (self._lost and self._may_reconnect):
                raise
            return self._send(op)

    @property
    def _may_reconnect(self) -> bool:
        return self._record is None and not self.address.startswith("replay://")

    def _change(self, op: str, **arguments: Any) -> Any:
        """Send a command that moves or changes the machine."""
        words = ", ".join(f"{name} {value}" for name, value in arguments.items())
        self._interlock.require_armed(self.settings.arm, f"{op.replace('_', ' ')} {words}")
        return self._send(op, **arguments)

    def _send(self, op: str, **arguments: Any) -> Any:
        """Send a request, once, and wait for its answer."""
        with self._exchange_lock:
            line = self.transport
            if self._lost and self._may_reconnect:
                line = self._reconnect()
            self._number += 1
            request = codec.encode_request(self._number, op, arguments)
            try:
                line.write(request)
                answer = self._await(line, self._number)
            except InstrumentError as error:
                self._cut(line)
                raise error.restated(f"{error}; during the command '{op.replace('_', ' ')}'") from None
            except BaseException:  # an interrupted wait: the bridge aborts a command without a waiting client
                self._cut(line)
                raise
        if not answer.ok:
            raise InstrumentError(
                f"{self.address} refuses '{op.replace('_', ' ')}': {answer.error}", code="linuxcnc.refused"
            )
        return answer.result

    def _await(self, line: Transport, number: int) -> codec.Answer:
        others = 0
        while True:
            try:
                message = codec.decode(
                    line.read_until(codec.LINE_END, limit=codec.MAX_LINE, timeout=self.settings.timeout)
                )
            except InstrumentTimeoutError:
                error = InstrumentTimeoutError(
                    f"{self.address}: the bridge of LinuxCNC did not answer within {self.settings.timeout:g} s",
                    code="instrument.no_answer",
                )
                raise after_others(error, others, f"request {number}") from None
            if message.number is None and not getattr(message, "ok", True):
                raise InstrumentError(
                    f"{self.address}: the bridge ends the connection: {message.error}; {_WHERE}", code="connection.lost"
                )
            if message.number in self._unawaited:
                self._unawaited.discard(message.number)
                others += 1
                continue
            if isinstance(message.number, int) and message.number < number:  # late: of a command that has failed
                others += 1
                continue
            if message.number != number:
                raise ProtocolError(
                    f"{self.address}: expected the answer to request {number}; found {message}",
                    code="protocol.reply.other",
                )
            if isinstance(message, codec.Answer):
                return message

    def _cut(self, line: Transport) -> None:
        """Send an abort to the bridge and drop the connection; the next call opens another one."""
        self._lost = True
        self._number += 1
        with suppress(InstrumentError):
            line.write(codec.encode_request(self._number, "stop", {}))

    def _reconnect(self) -> Transport:
        """Open another connection, then close the lost one: a simulated machine ends with its last connection."""
        self._transport, lost = self._connect(), self._transport
        self._lost = False
        self._unawaited.clear()
        if lost is not None:
            with suppress(InstrumentError):
                lost.close()
        return self._transport

    def _connect(self) -> Transport:
        """Connect and send the first request, which no recording contains."""
        line = open_transport(self.address, simulator=self.info.simulator, timeout=self.settings.timeout)
        try:
            if not self.address.startswith("replay://"):
                self._greet(line)
            if self._record is None:
                return line
            recorder = self._record if isinstance(self._record, Recorder) else Recorder(self._record, self.address)
        except BaseException:
            line.close()
            raise
        return RecordingTransport(line, recorder)

    def _greet(self, line: Transport) -> None:
        token = "" if line.simulated else read_token(self.settings.token_file, self.address)
        own = {"secret": own_secret(os.getpid()), "session": f"{id(self):x}", "client": client_name()}
        line.write(codec.encode_request(0, "hello", {"token": token, "control": self.settings.arm, **own}))
        answer = self._await(line, 0)
        if not answer.ok and "unknown operation" in answer.error:
            raise InstrumentError(
                f"{self.address}: the bridge is of an earlier version, without access control; copy bridge.py of this "
                "version to the machine",
                code="linuxcnc.version",
            )
        if not answer.ok:
            raise InstrumentError(
                f"{self.address} refuses the connection: {answer.error}; {_WHERE}", code="linuxcnc.connection.refused"
            )
        control, other = codec.decode_welcome(answer.result)
        if self.settings.arm and not control:
            raise InstrumentError(
                f"{self.address}: another client controls the machine ({other}); end it, or only read (arm = false)",
                code="linuxcnc.controlled_by_other",
            )

    def _start_session(self) -> None:
        self._number, self._lost = 0, False
        self._unawaited.clear()
        self.identify()


def client_name() -> str:
    """Return the name of this process in messages of a bridge."""
    return f"errormotion {os.getpid()}"


@cache
def own_secret(pid: int) -> str:  # noqa: ARG001 - a forked process has another secret
    """Return the secret of this process, whose drivers share the control of a machine."""
    return secrets.token_hex(SECRET_BYTES)


_WHERE = (
    "the bridge writes its token to ~/.errormotion/linuxcnc.token of the user that runs it. Copy this file to the "
    "user of this program, with mode 0600, and state it as 'token_file'"
)


def read_token(path: Path, address: str) -> str:
    """Return the token in a file that only the user can read.

    Raises
    ------
    InstrumentError
        The file does not exist, others can read it, or it has no token.
    """
    path = path.expanduser()
    try:
        handle = open_itself(path, os.O_RDONLY)
        with os.fdopen(handle, encoding="ascii", errors="replace") as file:
            status = os.fstat(handle)
            owned = os.geteuid() in (0, status.st_uid)
            if not (stat.S_ISREG(status.st_mode) and owned) or status.st_mode & 0o077:
                raise InstrumentError(
                    f"{address}: expected a token in {path} that only this user can read; found the mode "
                    f"{stat.S_IMODE(status.st_mode):04o} of user {status.st_uid}. Use 'chmod 600 {path}', and a new "
                    "token if others have seen it",
                    code="linuxcnc.token.not_private",
                )
            token = file.read(4096).strip()
    except OSError as error:
        raise InstrumentError(
            f"{address}: expected the token of the bridge in {path}; found none ({error.strerror}); {_WHERE}",
            code="linuxcnc.token.missing",
        ) from None
    if not token:
        raise InstrumentError(
            f"{address}: expected the token of the bridge in {path}; the file is empty; {_WHERE}",
            code="linuxcnc.token.missing",
        )
    return token
