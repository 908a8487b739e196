"""Simulated hours of a compensation that writes to a simulated PLC, with a fault every few minutes.

The time of the program and that of the PLC are simulated; the registers travel over a real connection. Every order that
arrives at the PLC, and the offset in effect every tenth of a second, are compared with the limits.
"""

import math
import random
from collections import Counter
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from simulated_clock import SimulatedClock

from errormotion.campaign.compensation.compensating import Compensation
from errormotion.campaign.files import BenchCompensator, BenchInstrument, parse_bench
from errormotion.compensation.online.follower import MAX_STEP, State
from errormotion.compensation.online.settings import Limits
from errormotion.compensation.thermal_model import ThermalModel
from errormotion.compensation.thermal_model.features import Feature
from errormotion.compensation.thermal_model.model import Parts
from errormotion.errors import CompensationError, InstrumentError
from errormotion.instruments.compensator.modbus_registers import ModbusRegisters
from errormotion.instruments.simulators.compensator.plc import SimulatedPlc
from errormotion.instruments.transports import parse_address
from errormotion.plugins import Identity, InstrumentInfo, PluginSettings

MACHINE = "Mill 5"
LIMITS = Limits(limit="30 um", slew="0.5 um/s", period="1 s", hold="20 s", settle="5 s")
SLEW, WATCHDOG = 1e-6, 3.0
"""Of the PLC, m/s and s."""
STEADY = 20.0
"""degC"""
SLICE = 0.1
"""Interval at which the offset in effect is looked at, s."""
MAX_FAULT = 0.6
"""Of the interval between two faults."""
FAULTS = (
    *("silent", "unknown", "outside", "wild"),  # temperatures
    *("busy", "stop", "link", "refused", "other program"),  # the PLC and the line
    *("killed", "suspended"),  # the program
)


class _Heat:
    """One thermometer: a slow course, or what a fault makes of it."""

    info = InstrumentInfo("heat", "thermometer", "for tests", "simulated_only")
    Settings = PluginSettings
    channels = ("spindle",)
    clock: Any
    fault = ""

    def __init__(self, address: str, settings: Any) -> None:
        del address, settings

    def open(self) -> None:
        """Do nothing."""

    close = open

    def identify(self) -> Identity:
        return Identity("tests", "thermometer", "1", simulated=True)

    def read(self) -> dict[str, float]:
        if _Heat.fault == "silent":
            raise InstrumentError("silent")
        course = STEADY + 4 * math.sin(_Heat.clock.now() / 900)
        wrong = {"unknown": math.nan, "outside": STEADY + 40, "wild": STEADY + random.uniform(-9, 9)}
        return {"spindle": wrong.get(_Heat.fault, course)}


@dataclass
class Found:
    """What happened, and the extremes."""

    rows: int = 0
    hours: float = 0.0
    orders: int = 0
    starts: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    largest: float = 0.0
    """Offset in effect, m."""
    fastest: float = 0.0
    """Change of the offset in effect, m/s."""
    largest_order: float = 0.0
    """m"""
    longest_step: float = 0.0
    """Change between two orders of one program, in periods at the slew limit."""


def model() -> xr.Dataset:
    """Return a model: E of X, Y, Z are 5, -4 and 2 um/K times the temperature, trained to 10 K."""
    coefficient = np.zeros((6, 1))
    coefficient[:3, 0] = 5e-6, -4e-6, 2e-6
    one, spread = np.ones(6), np.full((6, 1, 1), 1e-16)
    ends = np.array([-10.0]), np.array([10.0])
    parts = Parts((Feature("spindle"),), coefficient, spread, np.full(6, 1e-7), one, one, *ends)
    attrs = {"component": "spindle", "frame": "machine", "machine": MACHINE, "reference": "start"}
    attrs |= {"functional_point": [0.0, 0.0, 0.0], "variant": "lagged"}
    return ThermalModel.of(parts, attrs, {}).dataset


class Hours:
    """Follows for some hours.

    Parameters
    ----------
    runs : Path
    hours : float
    interval : float
        Between two faults, s.
    seed : int
    """

    def __init__(self, runs: Path, hours: float, interval: float, seed: int) -> None:
        self.runs, self.until, self.interval = runs, 1000.0 + 3600 * hours, interval
        self.found = Found()
        self._random = random.Random(seed)
        self._clock = SimulatedClock(1000.0)
        self._clock.watch = self._elapse
        self._kind, self._ends, self._next = "", 0.0, 1000.0 + interval
        self._last: tuple[float, ...] | None = None
        self._menu: list[str] = []
        _Heat.clock, _Heat.fault = self._clock, ""

    def run(self) -> Found:
        """Return what happened."""
        address = f"sim://cframe/plc?clock=0&watchdog={WATCHDOG}&slew={SLEW}&limit={LIMITS.limit}"
        with closing(SimulatedPlc(parse_address(address))) as self.plc:
            self._before = np.zeros(3)
            self._order, self.plc.machine.order = self.plc.machine.order, self._ordered  # type: ignore[method-assign]
            while self._clock.time < self.until:
                self._follow()
        self.found.hours = (self._clock.time - 1000.0) / 3600
        return self.found

    def _follow(self) -> None:
        """Follow until the program is killed, or a person has to start it again."""
        plan = parse_bench(
            f'schema = "errormotion.bench/1"\nname = "Shop"\nmachine = "{MACHINE}"\n', Path("bench.toml")
        )
        settings = ModbusRegisters.Settings(**self.plc.driver_settings, timeout=5.0, retry=0.0)
        compensator = BenchCompensator(ModbusRegisters, self.plc.driver_url, settings, LIMITS)
        instruments = (BenchInstrument("heat", _Heat, "", PluginSettings()),)
        plan = replace(plan, instruments=instruments, compensator=compensator)
        self._last = None
        with ExitStack() as stack:
            compensation = Compensation(plan, model(), self.runs, arm=MACHINE, clock=self._clock)
            try:
                stack.enter_context(compensation)
            except (CompensationError, InstrumentError):
                self._clock.sleep(5.0)
                self._disturb()
                return
            self.found.starts += 1
            for moment in compensation.follow():
                self.found.rows += 1
                self.found.states[str(moment.step.state)] += 1
                lost = moment.step.state is State.FAULT and "stop" not in (self._kind, moment.step.cause)
                if self._clock.time >= self.until or self._disturb() or (lost and self._random.random() < 0.1):
                    return

    def _disturb(self) -> bool:
        """End or start a fault; return whether the program is killed."""
        now = self._clock.time
        if self._kind and now >= self._ends:
            self._kind = _Heat.fault = self.plc.machine.busy = self.plc.machine.fault = ""
        if self._kind == "link":
            self.plc._server.disconnect()
        if self._kind == "other program":
            self._order((1.0, -1.0, 0.0))
        if self._kind or now < self._next:
            return False
        self._next += self.interval
        if not self._menu:
            self._menu = self._random.sample(FAULTS, len(FAULTS))
        self._kind = self._menu.pop()
        self._ends = now + self._random.uniform(2.0, MAX_FAULT * self.interval)
        self.found.faults[self._kind] += 1
        match self._kind:
            case "silent" | "unknown" | "outside" | "wild":
                _Heat.fault = self._kind
            case "busy":
                self.plc.machine.busy = "a thread"
            case "stop":
                self.plc.machine.fault = "emergency stop"
            case "suspended":
                self._clock.sleep(self._random.uniform(10.0, 900.0))
            case "killed":
                return True
        return False

    def _ordered(self, offset: Any, *, alive: bool = True) -> None:
        """Take an order, and compare it with the limits."""
        found, values = self.found, np.asarray(offset, dtype=float)
        if self._kind == "refused":  # it is lost on the way to the program of the PLC
            return
        found.orders += 1
        found.largest_order = max(found.largest_order, float(np.abs(values).max()))
        if self._last is not None:
            change = float(np.abs(values - self._last).max())
            found.longest_step = max(found.longest_step, change / (LIMITS.slew * LIMITS.period))
        self._last = tuple(values)
        self._order(offset, alive=alive)

    def _elapse(self, seconds: float) -> None:
        """Let time pass on the PLC, and look at its offset."""
        while seconds > 0:
            step = min(seconds, SLICE)
            self.plc.machine.elapse(step)
            now = np.asarray(self.plc.machine.offset)
            self.found.largest = max(self.found.largest, float(np.abs(now).max()))
            self.found.fastest = max(self.found.fastest, float(np.abs(now - self._before).max()) / step)
            self._before = now
            seconds -= step


def limits_kept(found: Found) -> list[str]:
    """Return what was beyond a limit."""
    rounding, count = 1 + 1e-6, 1e-9 / (LIMITS.slew * LIMITS.period)
    checks = {
        f"offset in effect {found.largest * 1e6:.3f} um": found.largest <= LIMITS.limit * rounding,
        f"change in effect {found.fastest * 1e6:.3f} um/s": found.fastest <= SLEW * rounding,
        f"ordered offset {found.largest_order * 1e6:.3f} um": found.largest_order <= LIMITS.limit * rounding,
        f"change of {found.longest_step:.3f} periods": found.longest_step <= MAX_STEP * rounding + 2 * count,
    }
    return [text for text, kept in checks.items() if not kept]


def follow(runs: Path, hours: float, interval: float, seed: int) -> Found:
    """Follow for some hours with a fault at an interval, s."""
    return Hours(runs, hours, interval, seed).run()
