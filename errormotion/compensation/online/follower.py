"""The state machine of online compensation: from predictions and conditions to an offset that may be written.

===========  ==========================================================================================
``off``      nothing is written; the offset is zero
``armed``    enabled by an operator who named the machine; the offset is constant until the first valid target
``following``  the offset moves towards the target within the slew limit
``holding``  the offset does not change: the target is not valid, or the machine must not be disturbed
``ramping``  the offset moves to zero within the slew limit
``fault``    the machine does not accept offsets; its watchdog ramps to zero. Arm again.
===========  ==========================================================================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from errormotion.arrays import Array
from errormotion.compensation.online.settings import Limits
from errormotion.errors import CompensationError

MAX_STEP = 2.0
"""Maximum interval for the change of one step, in periods: no jump after a suspended program."""

ROUNDING = 1e-9


class State(StrEnum):
    """State of a compensation."""

    OFF = "off"
    ARMED = "armed"
    FOLLOWING = "following"
    HOLDING = "holding"
    RAMPING = "ramping"
    FAULT = "fault"


@dataclass(frozen=True)
class Conditions:
    """Conditions of one decision.

    Attributes
    ----------
    target : (3,), optional
        Offset required by the prediction, m; None without a valid prediction.
    cause : str
        Reason of a missing target.
    busy : str
        Why the offset must not change now: a probing cycle, a thread, a request of the program. Empty: it may change.
    fault : str
        Why the machine does not accept offsets. Empty: it does.
    """

    target: Array | None = None
    cause: str = ""
    busy: str = ""
    fault: str = ""


@dataclass(frozen=True)
class Step:
    """One decision.

    Attributes
    ----------
    state : State
    offset : (3,)
        Offset to be written, m.
    cause : str
        Why the offset does not follow the target; empty if it does.
    limited : tuple of int
        Axes whose target is beyond the limit.
    """

    state: State
    offset: Array
    cause: str = ""
    limited: tuple[int, ...] = ()


class Follower:
    """Decides which offset is written.

    Parameters
    ----------
    limits : Limits
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.state = State.OFF
        self.offset: Array = np.zeros(3)
        self._last: float | None = None
        self._invalid_since: float | None = None
        self._valid_since: float | None = None
        self.stopping = False
        """Whether it ramps to zero and then ends."""

    def arm(self, applied: Array) -> None:
        """Enable the output of offsets, beginning with the present offset of the machine, so that it does not jump.

        After a fault, an earlier stop remains in force.

        Parameters
        ----------
        applied : (3,)
            Present offset of the machine, m.

        Raises
        ------
        CompensationError
            It is armed already, or the offset of the machine is unknown or beyond the limit.
        """
        if self.state not in (State.OFF, State.FAULT):
            raise CompensationError(f"The compensation is {self.state} already.", code="compensation.state.other")
        values = np.asarray(applied, dtype=float)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise CompensationError(
                "The present offset of the machine is unknown; it is required before a change.",
                code="compensation.offset.unknown",
            )
        if (np.abs(values) > self.limits.limit * (1 + 1e-9)).any():
            raise CompensationError(
                f"The machine has an offset of {_um(values)} um, beyond the limit of {self.limits.limit * 1e6:g} um. "
                "Ramp it to zero first.",
                code="compensation.offset.beyond_limit",
            )
        self.stopping = self.stopping and self.state is State.FAULT
        self.state, self.offset = State.ARMED, np.clip(values, -self.limits.limit, self.limits.limit)
        self._last = self._invalid_since = self._valid_since = None

    def fail(self) -> None:
        """Write nothing until it is armed again: the machine did not accept an offset."""
        if self.state is not State.OFF:
            self.state = State.FAULT

    def stop(self) -> None:
        """Ramp to zero, then end."""
        self.stopping = True

    def step(self, now: float, conditions: Conditions) -> Step:
        """Return the decision for the present time.

        Parameters
        ----------
        now : float
            Steady time, s.
        conditions : Conditions
        """
        dt = 0.0 if self._last is None else min(max(now - self._last, 0.0), MAX_STEP * self.limits.period)
        self._last = now
        if self.state in (State.OFF, State.FAULT):
            return Step(self.state, self.offset.copy(), conditions.fault)
        if conditions.fault:
            self.fail()
            return Step(self.state, self.offset.copy(), conditions.fault)
        target, cause = self._valid(conditions)
        self._note(now, target is not None)
        self.state = self._next(now, target is not None, conditions.busy)
        if self.state is State.HOLDING:
            return Step(self.state, self.offset.copy(), conditions.busy or cause)
        limited: tuple[int, ...] = ()
        if self.state is State.FOLLOWING and target is not None:
            goal = np.clip(target, -self.limits.limit, self.limits.limit)
            limited = tuple(int(k) for k in np.flatnonzero(goal != target))
            self._move(goal, dt)
        elif self.state is State.RAMPING:
            self._move(np.zeros(3), dt)
            if not self.offset.any():
                self.state = State.OFF if self.stopping else State.ARMED
        return Step(self.state, self.offset.copy(), "stopped" if self.stopping else cause, limited)

    def _valid(self, conditions: Conditions) -> tuple[Array | None, str]:
        if conditions.target is None:
            return None, conditions.cause or "no prediction"
        target = np.asarray(conditions.target, dtype=float)
        if target.shape != (3,) or not np.isfinite(target).all():
            return None, "the prediction is not finite"
        return target, ""

    def _note(self, now: float, valid: bool) -> None:
        if valid:
            self._invalid_since = None
            self._valid_since = now if self._valid_since is None else self._valid_since
        else:
            self._valid_since = None
            self._invalid_since = now if self._invalid_since is None else self._invalid_since

    def _next(self, now: float, valid: bool, busy: str) -> State:
        """Return the state for this step."""
        if self.stopping:
            return State.HOLDING if busy else State.RAMPING
        if busy:
            return State.HOLDING if self.state is not State.ARMED or self.offset.any() else State.ARMED
        if valid:
            since = now if self._valid_since is None else self._valid_since
            if self.state is State.RAMPING and now - since < self.limits.settle:
                return State.RAMPING
            return State.FOLLOWING
        if not self.offset.any():
            return State.ARMED
        since = now if self._invalid_since is None else self._invalid_since
        if self.state is State.RAMPING or now - since >= self.limits.hold:
            return State.RAMPING
        return State.HOLDING

    def _move(self, goal: Array, dt: float) -> None:
        most, left = self.limits.slew * dt, goal - self.offset
        arrives = np.abs(left) <= most * (1 + ROUNDING)
        self.offset = np.where(arrives, goal, self.offset + np.clip(left, -most, most))


def _um(values: Array) -> str:
    return ", ".join("unknown" if math.isnan(v) else f"{v * 1e6:.2f}" for v in values)
