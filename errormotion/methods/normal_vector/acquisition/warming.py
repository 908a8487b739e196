"""What the machine does between the cycles: turn the spindle, move the axes, and stand still for the probe."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.normal_vector.acquisition import cycle

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.normal_vector.settings import Settings

log = logging.getLogger(__name__)

LOOK = 10.0
"""Longest time without a look whether the machine is still well, s."""
LOOK_AT_PROGRAM = 1.0
"""The same while it runs a program, s."""


class Warming:
    """A machine that warms up by a schedule.

    Parameters
    ----------
    control : controller
        With ``state``, ``move_to``, ``spindle``, ``stop`` and ``elapse``.
    settings : Settings
    done : Dataset, optional
        What an interrupted run holds: time went on since. A virtual machine that began anew is warmed up again first.

    Attributes
    ----------
    origin : float
        What the machine's clock showed when the cold cycle began, s.
    warm_from : float or None
        When the warm-up began, s since ``origin``: when the cold cycle was over.

    Raises
    ------
    InstrumentError
        The machine is in alarm or emergency stop, or not homed.
    """

    def __init__(self, control: Any, settings: Settings, done: xr.Dataset | None) -> None:
        self.control, self.settings = control, settings
        self.warm_from: float | None = None
        self._turned = self._way = 0.0  # revolutions per minute times seconds, and metres, since the cycle before
        state = self._fit_state()
        self._speed = math.nan  # whatever it does now, it is told
        self.origin = float(state["time"])
        self._since = 0.0
        if done is not None:
            self._go_on(done, float(state["time"]))

    @property
    def now(self) -> float:
        """Time since the cold cycle began, s."""
        return float(self.control.state()["time"]) - self.origin

    def warm_until(self, time: float) -> None:
        """Warm up until a time since the cold cycle began, s; nothing before there was one."""
        if self.warm_from is None or time - self.now < cycle.SHORTEST:
            return
        self.put_in(self.settings.to_warm_up)
        moves = 0
        while time - (now := self.now) >= cycle.SHORTEST:
            speed, change = cycle.speed_at(self.settings, now - self.warm_from)
            self.turn(speed)
            moves = self._one_step(moves, min(time, change + self.warm_from) - now, time - now)
            self._refuse_alarm("while it warmed up")
            self._turned += self._speed * (self.now - now)

    def _one_step(self, moves: int, until_change: float, left: float) -> int:
        """Make the next move, where there is time for it, or wait a while; return how many moves were made."""
        if self.settings.moves:
            place = self.settings.moves[moves % len(self.settings.moves)]
            way = math.dist(place, self.control.state()["commanded_position"])
            seconds = way / self.settings.moves_feed
            if cycle.SHORTEST < seconds <= left:
                self.control.move_to(place, self.settings.moves_feed)
                self._way += way
                return moves + 1
            if seconds <= cycle.SHORTEST and len(set(self.settings.moves)) > 1:
                return moves + 1
        self.control.elapse(min(until_change, LOOK))
        return moves

    def turn(self, speed: float) -> None:
        """Turn the spindle at a speed, 1/min, if it does not already."""
        if speed != self._speed:
            self.control.spindle(speed)
            self._speed = speed

    def rest(self) -> None:
        """Stop the spindle, put the probe in, and let the machine come to rest."""
        turned = self._speed != 0
        self.turn(0.0)
        self.put_in(self.settings.to_probe)
        if turned and self.settings.settle:
            self.control.elapse(self.settings.settle)

    def put_in(self, lines: Sequence[str]) -> None:
        """Change the tool by lines of a program, if there are any."""
        if not lines:
            return
        if not hasattr(self.control, "run_program"):
            raise MethodError("to_probe, to_warm_up: the controller of this bench runs no programs; leave them out.")
        run(self.control, "\n".join(["%", "(change of the tool)", *lines, "M30", "%", ""]))

    def history(self) -> tuple[float, float]:
        """Return mean spindle speed (1/min) and mean feed (m/s) since this was last asked, and begin anew."""
        now = self.now
        seconds = now - self._since
        means = (self._turned / seconds, self._way / seconds) if seconds > cycle.SHORTEST else (0.0, 0.0)
        self._since, self._turned, self._way = now, 0.0, 0.0
        return means

    def halt(self, *, anew: bool = True) -> str:
        """Stop axes and spindle, ``anew`` over a new connection if need be; return why that failed, if it did."""
        try:
            self.control.stop(spindle=True)
        except InstrumentError as error:
            if not anew:
                return str(error)
            try:
                self.control.close()
                self.control.open()
                self.control.stop(spindle=True)
            except InstrumentError as again:
                log.error("axes and spindle could not be stopped: %s", again)
                return str(again)
        return ""

    def _fit_state(self) -> dict[str, Any]:
        state: dict[str, Any] = self.control.state()
        why = trouble(state) or ("not homed" if state["homed"] is False else "")
        why = why or ("" if state["enabled"] else "not enabled")
        if why:
            raise InstrumentError(f"The machine is {why}; nothing was moved")
        return state

    def _refuse_alarm(self, when: str) -> None:
        if why := trouble(self.control.state()):
            raise InstrumentError(f"The machine is {why}; it went so {when}")

    # ------------------------------------------------------------------ after an interruption

    def _go_on(self, done: xr.Dataset, clock: float) -> None:
        """Take up the clock of an interrupted run."""
        begins, ends = done["time"].values.astype(float), _ends(done)
        cold = float(done.attrs["cold_cycle_seconds"])
        if not self.control.identify().simulated:
            self.origin = clock - age(done)
            self.warm_from = cold
        elif (
            clock - float(done.attrs["clock_origin"]) >= ends[-1] - cycle.SHORTEST
        ):  # the same virtual machine, still there
            self.origin = float(done.attrs["clock_origin"])
            self.warm_from = cold
        else:
            log.info("the virtual machine is warmed up anew, to %.0f s", ends[-1])
            for begin, end in zip(begins, ends, strict=True):
                self.warm_until(begin)
                self.turn(0.0)  # it stood still for the probe
                self.control.elapse(max(end - self.now, 0.0))
                self.warm_from = cold
        self._since, self._turned, self._way = float(begins[-1]), 0.0, 0.0


def run(control: Any, text: str) -> None:
    """Run a program to its end.

    Raises
    ------
    InstrumentError
        The control refuses it, or goes into alarm or emergency stop meanwhile.
    """
    control.run_program(text)
    while True:
        state = control.state()
        if why := trouble(state):
            raise InstrumentError(f"The machine is {why}; it went so while its program ran")
        if not state["running"]:
            return
        control.elapse(LOOK_AT_PROGRAM)


def trouble(state: dict[str, Any]) -> str:
    """Return what a controller's state says against moving on: emergency stop or alarms; empty if nothing."""
    if state["estop"]:
        return "in emergency stop"
    return f"in alarm: {'; '.join(state['alarms'])}" if state["alarms"] else ""


def age(done: xr.Dataset) -> float:
    """Return how long ago the cold cycle of an interrupted run began, s.

    Raises
    ------
    MethodError
        The run does not say when that was.
    """
    try:
        began = datetime.fromisoformat(str(done.attrs["start"]))
    except (KeyError, ValueError):
        raise MethodError(
            "The interrupted run does not say when it began (attribute start); start a new one."
        ) from None
    return (datetime.now(UTC) - began).total_seconds()


def _ends(done: xr.Dataset) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return when the last touch of each cycle was, s; its begin where that is not known."""
    begins = done["time"].values.astype(float)
    if "touch_time" not in done:
        return begins
    times = done["touch_time"].values.reshape(len(begins), -1)
    return np.asarray(np.fmax(np.fmax.reduce(times, axis=1), begins))
