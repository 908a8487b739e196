"""Who moves the axis: a control that takes programs, or the operator; and whose clock counts.

A virtual machine has a clock of its own, which stands still until somebody lets its time pass.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Protocol

from errormotion.errors import InstrumentError

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.acquisition.programs import Program
    from errormotion.plugins import Bench

STEP = 0.1
"""How closely the first motion is looked for, s."""
NAP = 0.5
"""Longest sleep at once, s, and how often a control is asked whether it is ready."""
SLACK = 30.0
"""A program may take this much longer than planned, s, and a tenth of its duration."""
OPERATOR_SECONDS = 180.0
"""The operator is given so long to start a program after saying so."""
WARNING = 30.0
"""So long before a pass is due the operator is told, s."""


STANDS = 4
"""So many times in a row a virtual machine may be listened to in vain; one that keeps a pace is slow to come."""


class Mover(Protocol):
    """What moves the axis.

    Attributes
    ----------
    virtual : bool
        Whether time can be let pass at will.
    """

    virtual: bool

    def now(self) -> float:
        """Return the time, s: of the day (since 1970), or of the virtual machine."""

    def begin(self, program: Program, *, listening: bool = False) -> float:
        """Have a program begun; return when its motion began, where that is known.

        With ``listening`` it returns before the motion begins, so that the profiler can be ready.
        """

    def wait_until(self, when: float) -> None:
        """Let time pass."""

    def may_still_come(self) -> bool:
        """Whether a program that was begun may still move, while the profiler has seen nothing of it yet."""

    def finish(self) -> None:
        """Wait until the program has ended."""


def mover(bench: Bench) -> Mover:
    """Return the control of a bench, or the operator where it has none that takes programs."""
    controller = bench.of_kind("controller") if bench.has_kind("controller") else None
    return Controlled(controller) if hasattr(controller, "run_program") else Operated(bench)


class Controlled:
    """A control that takes programs."""

    def __init__(self, controller: Any) -> None:
        self._control = controller
        self.virtual = hasattr(controller, "elapse")
        self._deadline = float("inf")
        self._asked, self._stood = float("nan"), 0

    def now(self) -> float:
        """Return the time of the machine."""
        return float(self._control.state()["time"]) if self.virtual else time.time()

    def begin(self, program: Program, *, listening: bool = False) -> float:
        """Hand a program over; wait for its first motion, unless somebody listens for it."""
        self.finish()
        before = self._place()
        answer = self._control.run_program(program.text())
        lead_in = float(answer.get("longest_lead_in", 0.0))
        begun = self.now()
        duration = float(answer.get("duration", program.seconds()))
        self._deadline = begun + lead_in + duration * 1.1 + SLACK
        self._asked, self._stood = float("nan"), 0
        if listening:
            return begun
        while self._place() == before:
            if self.now() > begun + lead_in + STEP:
                return begun + lead_in / 2  # it begins with a rest, or where it stands
            self._pass(STEP)
        return self.now() - STEP / 2

    def wait_until(self, when: float) -> None:
        """Let time pass."""
        while (left := when - self.now()) > 1e-6:
            self._pass(left)

    def may_still_come(self) -> bool:
        """Whether the program runs; a virtual machine whose time stands still again and again does not."""
        now = self.now()
        self._stood = self._stood + 1 if self.virtual and now == self._asked else 0
        self._asked = now
        return self._stood < STANDS and bool(self._control.state().get("running", True)) and now < self._deadline

    def finish(self) -> None:
        """Wait until no program runs.

        Raises
        ------
        InstrumentError
            It takes far longer than planned.
        """
        while self._control.state().get("running", False):
            if self.now() > self._deadline:
                raise InstrumentError(
                    "The control still runs a program long after it should have ended: has it stopped, is its feed "
                    "turned down? Let it finish and resume."
                )
            self._pass(NAP)

    def _place(self) -> Any:
        return self._control.state().get("position")

    def _pass(self, seconds: float) -> None:
        if self.virtual:
            self._control.elapse(seconds)
        else:
            time.sleep(min(seconds, NAP))


class Operated:
    """An operator at a machine whose control is not connected."""

    virtual = False

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._running = ""
        self._deadline = 0.0

    def now(self) -> float:
        """Return the time of the day."""
        return time.time()

    def begin(self, program: Program, *, listening: bool = False) -> float:
        """Ask the operator to start a program."""
        ended = f"When {self._running} has ended: " if self._running else ""
        what = f"{program.name} ({program.purpose}; {_duration(program.seconds())})"
        if listening:
            self._bench.ask(
                f"{ended}make {what} ready, confirm, and start it within {OPERATOR_SECONDS / 60:.0f} minutes after "
                "that: the profiler waits for the motion."
            )
        else:
            self._bench.ask(
                f"{ended}start {what}, and confirm at the moment it begins to move. In a campaign that goes on "
                "after an interruption the program may be longer than that: stop it when the time is over."
            )
        self._running = program.name
        self._deadline = time.time() + OPERATOR_SECONDS + program.seconds()
        return time.time()

    def wait_until(self, when: float) -> None:
        """Wait until the operator must get ready."""
        while (left := when - WARNING - time.time()) > 0:
            time.sleep(min(left, NAP))

    def may_still_come(self) -> bool:
        """Whether the operator may still be about to start."""
        return time.time() < self._deadline

    def finish(self) -> None:
        """Do nothing: the next question waits for it."""


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"
