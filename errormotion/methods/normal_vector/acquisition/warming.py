"""The warm-up between the cycles: spindle speeds and moves of the axes, and standstill for the probe."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.clock import age as record_age
from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.normal_vector.acquisition import cycle
from errormotion.plugins.virtual import wait

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.normal_vector.settings import NormalVectorSettings

log = logging.getLogger(__name__)

STATE_INTERVAL = 10.0
"""Longest interval of the checks of the machine's state, s."""
PROGRAM_STATE_INTERVAL = 1.0
"""Interval of these checks while a program is executed, s."""


class Warming:
    """A machine that warms up according to a schedule.

    Parameters
    ----------
    control : controller
        With ``state``, ``move_to``, ``spindle`` and ``stop``.
    settings : NormalVectorSettings
    done : Dataset, optional
        Cycles of an interrupted run.

    Attributes
    ----------
    origin : float
        Clock of the machine at the start of the cold cycle, s.
    warm_from : float or None
        Start of the warm-up, s since ``origin``: the end of the cold cycle.
    repeats : bool
        Whether the recorded cycles have to be repeated, because the virtual machine was restarted. It reaches the same
        state in this way, and the following data are those of a run without interruption.

    Raises
    ------
    InstrumentError
        The machine is in alarm or emergency stop, or not homed.
    """

    def __init__(self, control: Any, settings: NormalVectorSettings, done: xr.Dataset | None) -> None:
        self.control, self.settings = control, settings
        self.warm_from: float | None = None
        self.repeats = False
        self._turned = self._path = 0.0  # 1/min s, and m, since the previous cycle
        state = self._ready_state()
        self._speed = math.nan  # unknown: the first speed is always commanded
        self.origin = float(state["time"])
        self._since = 0.0
        if done is not None:
            self._resume(done, float(state["time"]))

    @property
    def now(self) -> float:
        """Time since the start of the cold cycle, s."""
        return float(self.control.state()["time"]) - self.origin

    def warm_until(self, time: float) -> None:
        """Warm up until a time since the start of the cold cycle, s; does nothing before the cold cycle."""
        if self.warm_from is None or time - self.now < cycle.MIN_STEP:
            return
        self.change_tool(self.settings.to_warm_up)
        moves = 0
        while time - (now := self.now) >= cycle.MIN_STEP:
            speed, change = cycle.speed_at(self.settings, now - self.warm_from)
            self.turn(speed)
            moves = self._one_step(moves, min(time, change + self.warm_from) - now, time - now)
            self._check_state("during the warm-up")
            self._turned += self._speed * (self.now - now)

    def _one_step(self, moves: int, until_change: float, remaining: float) -> int:
        """Make the next move if there is time for it, else wait; return the number of moves made."""
        if self.settings.moves:
            target = self.settings.moves[moves % len(self.settings.moves)]
            distance = math.dist(target, self.control.state()["commanded_position"])
            seconds = distance / self.settings.moves_feed
            if cycle.MIN_STEP < seconds <= remaining:
                self.control.move_to(target, self.settings.moves_feed)
                self._path += distance
                return moves + 1
            if seconds <= cycle.MIN_STEP and len(set(self.settings.moves)) > 1:
                return moves + 1
        wait(self.control, min(until_change, STATE_INTERVAL))
        return moves

    def turn(self, speed: float) -> None:
        """Set the spindle speed, 1/min, if it differs from the current one."""
        if speed != self._speed:
            self.control.spindle(speed)
            self._speed = speed

    def rest(self) -> None:
        """Stop the spindle, insert the probe, and let the machine settle."""
        turned = self._speed != 0
        self.turn(0.0)
        self.change_tool(self.settings.to_probe)
        if turned and self.settings.settle:
            wait(self.control, self.settings.settle)

    def change_tool(self, lines: Sequence[str]) -> None:
        """Change the tool by program lines, if there are any."""
        if not lines:
            return
        if not hasattr(self.control, "run_program"):
            raise MethodError(
                "to_probe, to_warm_up: the controller of this bench executes no programs; remove these settings.",
                code="probing.programs.none",
            )
        run(self.control, "\n".join(["%", "(change of the tool)", *lines, "M30", "%", ""]))

    def history(self) -> tuple[float, float]:
        """Return mean spindle speed (1/min) and mean feed (m/s) since the last call."""
        now = self.now
        seconds = now - self._since
        means = (self._turned / seconds, self._path / seconds) if seconds > cycle.MIN_STEP else (0.0, 0.0)
        self._since, self._turned, self._path = now, 0.0, 0.0
        return means

    def stop(self, *, reconnect: bool = True) -> str:
        """Stop axes and spindle, if necessary over a new connection; return the cause of a failure, empty if none."""
        try:
            self.control.stop(spindle=True)
        except InstrumentError as error:
            if not reconnect:
                return str(error)
            try:
                self.control.close()
                self.control.open()
                self.control.stop(spindle=True)
            except InstrumentError as again:
                log.error("axes and spindle could not be stopped: %s", again)
                return str(again)
        return ""

    def _ready_state(self) -> dict[str, Any]:
        state: dict[str, Any] = self.control.state()
        cause = fault(state) or ("not homed" if state["homed"] is False else "")
        cause = cause or ("" if state["enabled"] else "not enabled")
        if cause:
            raise InstrumentError(f"The machine is {cause}; nothing was moved", code="machine.not_ready")
        return state

    def _check_state(self, when: str) -> None:
        if cause := fault(self.control.state()):
            raise InstrumentError(f"The machine is {cause}; this occurred {when}", code="machine.not_ready")

    # ------------------------------------------------------------------ after an interruption

    def _resume(self, done: xr.Dataset, clock: float) -> None:
        """Continue the clock of an interrupted run."""
        recorded_origin, cold = float(done.attrs["clock_origin"]), float(done.attrs["cold_cycle_seconds"])
        if not self.control.identify().simulated:
            self.origin = clock - age(done)
        elif clock - recorded_origin >= _ends(done)[-1] - cycle.MIN_STEP:
            self.origin = recorded_origin  # the same virtual machine, still running
        else:
            log.info("the virtual machine repeats %d cycles", done.sizes["time"])
            self.repeats = True
            return
        self.warm_from = cold
        self._since = float(done["time"].values[-1])


def run(control: Any, text: str) -> None:
    """Execute a program to its end.

    Raises
    ------
    InstrumentError
        The controller refuses it, or goes into alarm or emergency stop.
    """
    control.run_program(text)
    while True:
        state = control.state()
        if cause := fault(state):
            raise InstrumentError(
                f"The machine is {cause}; this occurred while its program was executed", code="machine.not_ready"
            )
        if not state["running"]:
            return
        wait(control, PROGRAM_STATE_INTERVAL)


def fault(state: dict[str, Any]) -> str:
    """Return the emergency stop or the alarms in a controller's state; empty if there are none."""
    if state["estop"]:
        return "in emergency stop"
    return f"in alarm: {'; '.join(state['alarms'])}" if state["alarms"] else ""


def age(done: xr.Dataset) -> float:
    """Return the time since the start of the cold cycle of an interrupted run, s.

    If the duration of the interruption is unknown, it is the time of the last touch.

    Raises
    ------
    MethodError
        The run does not state its start.
    """
    try:
        seconds = record_age(done)
    except ValueError:
        raise MethodError(
            "The interrupted run does not state its start (attribute start); start a new run.", code="run.start.missing"
        ) from None
    return float(_ends(done)[-1]) if math.isnan(seconds) else seconds


def _ends(done: xr.Dataset) -> Array:
    """Return the time of the last touch of each cycle, s; its start if unknown."""
    starts = done["time"].values.astype(float)
    if "touch_time" not in done:
        return starts
    times = done["touch_time"].values.reshape(len(starts), -1)
    return np.asarray(np.fmax(np.fmax.reduce(times, axis=1), starts))
