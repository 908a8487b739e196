"""Motion of the axis, by a control that runs programs or by the operator, and the clock of the campaign.

A virtual machine has its own clock. It advances only by `elapse`.
"""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Any, Protocol

from errormotion.datasets import clock
from errormotion.datasets.clock import steady
from errormotion.errors import InstrumentError
from errormotion.plugins.virtual import is_virtual

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.crossbeam_scan.acquisition.programs import Program
    from errormotion.plugins import Bench

MOTION_POLL_INTERVAL = 0.1
"""Interval of the checks for the first motion, s."""
POLL_INTERVAL = 0.5
"""Longest sleep, and interval at which the state of a control is read, s."""
TIMEOUT_MARGIN = 30.0
"""Timeout of a program beyond 1.1 times its planned duration, s."""
OPERATOR_TIMEOUT = 180.0
"""Time in which the operator has to start a program after the confirmation, s."""
NOTICE_TIME = 30.0
"""Time before a pass is due at which the operator is notified, s."""
STALL_LIMIT = 4
"""Number of successive checks without progress of a virtual clock after which a program counts as ended."""


class Mover(Protocol):
    """What moves the axis: a control or the operator.

    Attributes
    ----------
    virtual : bool
        Whether the clock is that of a virtual machine.
    """

    virtual: bool

    def now(self) -> float:
        """Return the time, s: of the day (since 1970), or of the virtual machine."""

    def start(self, program: Program, *, listening: bool = False) -> float:
        """Start a program; return the time at which its motion started, where that is known.

        With ``listening`` it returns before the motion starts, so that the profiler can be ready.
        """

    def start_attrs(self) -> dict[str, Any]:
        """Return the attributes that state the beginning of a record on a virtual machine; none for a real one."""

    def return_to_start(self, done: xr.Dataset) -> None:
        """Set a virtual machine that was restarted to the beginning of a record."""

    def wait_until(self, when: float) -> None:
        """Wait until a time, s."""

    def may_still_move(self) -> bool:
        """Return whether a started program may still cause motion although the profiler has delivered no line yet."""

    def finish(self) -> None:
        """Wait until the program has ended."""


def mover(bench: Bench) -> Mover:
    """Return the control of a bench, or the operator where it has none that runs programs."""
    controller = bench.of_kind("controller") if bench.has_kind("controller") else None
    return Controlled(controller) if hasattr(controller, "run_program") else Operated(bench)


class Controlled:
    """A control that runs programs."""

    def __init__(self, controller: Any) -> None:
        self._control = controller
        self.virtual = is_virtual(controller)
        self._deadline = float("inf")
        self._checked_at, self._stalled = float("nan"), 0

    def now(self) -> float:
        """Return the time of the machine."""
        return float(self._control.state()["time"]) if self.virtual else steady()

    def start(self, program: Program, *, listening: bool = False) -> float:
        """Transfer a program and wait for its first motion; with ``listening`` return immediately."""
        self.finish()
        before = self._position()
        answer = self._control.run_program(program.text())
        lead_in = float(answer.get("longest_lead_in", 0.0))
        started = self.now()
        duration = float(answer.get("duration", program.seconds()))
        self._deadline = started + lead_in + duration * 1.1 + TIMEOUT_MARGIN
        self._checked_at, self._stalled = float("nan"), 0
        if listening:
            return started
        while self._position() == before:
            if self.now() > started + lead_in + MOTION_POLL_INTERVAL:
                return started + lead_in / 2  # the program starts with a dwell, or at its first position
            self._elapse(MOTION_POLL_INTERVAL)
        return self.now() - MOTION_POLL_INTERVAL / 2

    def wait_until(self, when: float) -> None:
        """Wait until a time, s."""
        while (remaining := when - self.now()) > 1e-6:
            self._elapse(remaining)

    def may_still_move(self) -> bool:
        """Return whether the program runs; False where the virtual clock no longer advances."""
        now = self.now()
        self._stalled = self._stalled + 1 if self.virtual and now == self._checked_at else 0
        self._checked_at = now
        return self._stalled < STALL_LIMIT and bool(self._control.state().get("running", True)) and now < self._deadline

    def finish(self) -> None:
        """Wait until no program runs.

        Raises
        ------
        InstrumentError
            The program runs much longer than planned.
        """
        while self._control.state().get("running", False):
            if self.now() > self._deadline:
                raise InstrumentError(
                    "The control still runs a program long after its planned end. Check whether it has stopped and "
                    "whether the feed override is reduced; let the program finish and resume the run.",
                    code="scan.program.not_ended",
                )
            self._elapse(POLL_INTERVAL)

    def _position(self) -> Any:
        return self._control.state().get("position")

    def start_attrs(self) -> dict[str, Any]:
        """Return the attributes that state the beginning of a record on a virtual machine; none for a real one."""
        if not self.virtual:
            return {}
        origin = self.now()
        if not hasattr(self._control, "snapshot"):
            return {clock.ORIGIN: origin}
        self.finish()  # the last program of an earlier test
        return {clock.ORIGIN: origin, clock.START: json.dumps(self._control.snapshot())}

    def return_to_start(self, done: xr.Dataset) -> None:
        """Set a virtual machine that was restarted to the beginning of a record."""
        if clock.START in done.attrs:
            self._control.restore(**json.loads(done.attrs[clock.START]))

    def _elapse(self, seconds: float) -> None:
        if self.virtual:
            self._control.elapse(seconds)
        else:
            time.sleep(min(seconds, POLL_INTERVAL))


class Operated:
    """An operator at a machine whose control is not connected."""

    virtual = False

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._running = ""
        self._deadline = 0.0

    def start_attrs(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def return_to_start(self, done: xr.Dataset) -> None:
        """Do nothing."""

    def now(self) -> float:
        """Return the time of the monotonic clock, s."""
        return steady()

    def start(self, program: Program, *, listening: bool = False) -> float:
        """Prompt the operator to start a program."""
        ended = f"When {self._running} has ended: " if self._running else ""
        what = f"{program.name} ({program.purpose}; {_duration(program.seconds())})"
        if listening:
            self._bench.ask(
                f"{ended}prepare {what}, confirm, and then start it within {OPERATOR_TIMEOUT / 60:.0f} minutes: the "
                "profiler waits for the motion."
            )
        else:
            self._bench.ask(
                f"{ended}start {what}, and confirm at the moment it starts to move. In a resumed campaign the "
                "program may be longer than this duration: stop it when this time has elapsed."
            )
        self._running = program.name
        self._deadline = steady() + OPERATOR_TIMEOUT + program.seconds()
        return steady()

    def wait_until(self, when: float) -> None:
        """Wait until `NOTICE_TIME` before a time, s."""
        while (remaining := when - NOTICE_TIME - steady()) > 0:
            time.sleep(min(remaining, POLL_INTERVAL))

    def may_still_move(self) -> bool:
        """Return whether the operator may still start the program, or it may still run."""
        return steady() < self._deadline

    def finish(self) -> None:
        """Do nothing: the next prompt states that the program has to end first."""


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"
