"""What the machine does between the cycles: turn the spindle, move the axes, and stand still for the probe."""

from __future__ import annotations

import logging
import math
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.normal_vector import cycle

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.normal_vector.settings import Settings

log = logging.getLogger(__name__)

SHORTEST = 1e-3
"""Waits below this are none, s."""


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
        self._speed = 0.0
        self._moves = 0
        self._turned = self._way = 0.0  # revolutions per minute times seconds, and metres, since the cycle before
        state = self._fit_state()
        self.origin = float(state["time"])
        if done is not None:
            self._go_on(done)
        self._since = self.now

    @property
    def now(self) -> float:
        """Time since the cold cycle began, s."""
        return float(self.control.state()["time"]) - self.origin

    def warm_until(self, time: float) -> None:
        """Warm up until a time since the cold cycle began, s; nothing before there was one."""
        if self.warm_from is None:
            return
        while True:
            now = self.now
            if time - now < SHORTEST:
                return
            speed, change = cycle.speed_at(self.settings, now - self.warm_from)
            self.turn(speed)
            self._one_step(min(time, change + self.warm_from) - now, time - now)
            self._refuse_alarm()

    def _one_step(self, until_change: float, left: float) -> None:
        """Make one move, where there is time for it, or wait for what comes next."""
        before = self.now
        if self.settings.moves:
            place = self.settings.moves[self._moves % len(self.settings.moves)]
            way = math.dist(place, self.control.state()["commanded_position"])
            if SHORTEST < way / self.settings.moves_feed <= left:
                self._moves += 1
                self.control.move_to(place, self.settings.moves_feed)
                self._way += way
                self._turned += self._speed * (self.now - before)
                return
            if way / self.settings.moves_feed <= SHORTEST and len(set(self.settings.moves)) > 1:
                self._moves += 1
                return
        self.control.elapse(until_change)
        self._turned += self._speed * (self.now - before)

    def turn(self, speed: float) -> None:
        """Turn the spindle at a speed, 1/min, if it does not already."""
        if speed != self._speed:
            self.control.spindle(speed)
            self._speed = speed

    def rest(self) -> None:
        """Stop the spindle, and let the machine come to rest; touches begin from a safe height."""
        turned = self._speed > 0
        self.turn(0.0)
        if turned and self.settings.settle:
            self.control.elapse(self.settings.settle)
        self._rise()

    def _rise(self) -> None:
        """Go up above all balls before anything goes across."""
        high = max(ball.centre[2] + ball.radius for ball in self.settings.balls) + self.settings.clearance
        high += 2 * (self.settings.tip_radius or cycle.TIP_RADIUS) + self.settings.approach
        x, y, z = self.control.state()["commanded_position"]
        if z < high:
            top = (self.settings.travel or {}).get("Z", (0.0, math.inf))[1]
            self.control.move_to((x, y, min(high, max(z, top))), self.settings.positioning_feed)

    def history(self) -> tuple[float, float]:
        """Return mean spindle speed (1/min) and mean feed (m/s) since this was last asked, and begin anew."""
        now = self.now
        seconds = now - self._since
        means = (self._turned / seconds, self._way / seconds) if seconds > SHORTEST else (0.0, 0.0)
        self._since, self._turned, self._way = now, 0.0, 0.0
        return means

    def halt(self) -> None:
        """Stop axes and spindle, whatever else may be wrong."""
        with suppress(InstrumentError):
            self.control.stop(spindle=True)

    def _fit_state(self) -> dict[str, Any]:
        state: dict[str, Any] = self.control.state()
        if state["estop"] or state["alarms"] or not state["enabled"] or state["homed"] is False:
            why = (
                "in emergency stop"
                if state["estop"]
                else "in alarm: " + "; ".join(state["alarms"])
                if state["alarms"]
                else "not homed"
                if state["homed"] is False
                else "not enabled"
            )
            raise InstrumentError(f"The machine is {why}; nothing was moved")
        return state

    def _refuse_alarm(self) -> None:
        state = self.control.state()
        if state["estop"] or state["alarms"]:
            why = "; ".join(state["alarms"]) or "emergency stop"
            raise InstrumentError(f"The machine went into alarm while it warmed up: {why}")

    def _go_on(self, done: xr.Dataset) -> None:
        """Take up the clock of an interrupted run."""
        last = float(done["time"].values[-1])
        ended = float(done.attrs["cold_cycle_seconds"])
        if self.control.identify().simulated:  # a machine that began anew, cold: what it went through comes first
            self.warm_from = ended
            self.control.elapse(ended)
            log.info("the virtual machine is warmed up anew, to %.0f s", last)
            self.warm_until(last)
            return
        try:
            began = datetime.fromisoformat(str(done.attrs["start"]))
        except (KeyError, ValueError):
            raise MethodError(
                "The interrupted run does not say when it began (attribute start); start a new one."
            ) from None
        self.origin -= (datetime.now(UTC) - began).total_seconds()
        self.warm_from = ended
