"""A session with a compensator under test and the simulated machine for its offsets."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from errormotion.instruments.transports import load_simulator, parse_address
from errormotion.plugins import CompensatorSubject, InstrumentSubject
from errormotion.plugins.subjects import with_query
from errormotion.testing.kit import require

ARRIVAL = 5.0
"""Real time within which the machine receives written values, s."""
POLL = 0.005
"""s"""
STEPS = 20
"""Number of instants at which a ramp is examined."""


@contextmanager
def started(subject: CompensatorSubject, fault: str = "") -> Iterator[Any]:
    """Start the simulated machine, or yield the address of the real one in the same form."""
    if not subject.simulated:
        yield None
        return
    address = with_query(subject.address, f"fault={fault}") if fault else subject.address
    if subject.start is not None:
        device = subject.start(address)
    else:
        device = load_simulator(subject.plugin.info.simulator, address)(parse_address(address))
    with closing(device):
        yield device


def made(subject: CompensatorSubject, device: Any) -> Any:
    """Return a new compensator for a machine, not open."""
    if device is None:
        return subject.build(subject.address)
    where = getattr(device, "driver_url", None) or device.url
    return subject.build(where, getattr(device, "driver_settings", None))


@contextmanager
def armed(subject: CompensatorSubject, device: Any) -> Iterator[Any]:
    """Yield an open and armed compensator."""
    with closing(made(subject, device)) as compensator:
        compensator.open()
        compensator.arm(subject.limit)
        yield compensator


def wait_for(condition: Callable[[], bool], message: str | Callable[[], str]) -> None:
    """Wait until a condition is true; fail with a message at the time limit."""
    end = time.monotonic() + ARRIVAL
    while not condition():
        if time.monotonic() >= end:
            require(False, message if isinstance(message, str) else message())
        time.sleep(POLL)


def write(compensator: Any, device: Any, offset: tuple[float, float, float]) -> None:
    """Write, and wait until the machine has received it."""
    before = device.machine.orders
    compensator.write(offset)
    wait_for(lambda: device.machine.orders > before, f"the machine received nothing after write({offset})")


def near(one: Any, other: Any, tolerance: float) -> bool:
    """Return whether two offsets, m, agree."""
    return all(math.isfinite(a) and abs(a - b) <= tolerance for a, b in zip(one, other, strict=True))


def require_offset(subject: CompensatorSubject, found: Any, expected: Any, what: str) -> None:
    """Fail if an offset differs from the expected one by more than the resolution of the subject."""
    require(near(found, expected, subject.resolution), f"{what}: expected {um(expected)}, found {um(found)}")


def um(offset: Any) -> str:
    """Return an offset as text."""
    return f"{', '.join(f'{value * 1e6:.4f}' for value in offset)} um"


def follow(subject: CompensatorSubject, compensator: Any, device: Any) -> None:
    """Write the offset of the subject until it is active."""
    machine = device.machine
    ramp = max(map(abs, subject.offset)) / machine.slew
    for _ in range(math.ceil(ramp / (0.4 * machine.watchdog)) + 1):
        write(compensator, device, subject.offset)
        machine.elapse(0.4 * machine.watchdog)
    require_offset(subject, machine.offset, subject.offset, "the offset in effect after it was written")


def require_ramp(device: Any, what: str) -> None:
    """Advance by the time of the watchdog and of a ramp; fail if the offset jumps or does not reach zero."""
    machine = device.machine
    before = machine.offset
    # until the watchdog acts, the offset may still change towards the last command
    slowest = 2 * machine.watchdog + max(map(abs, before)) / machine.slew
    step = 1.05 * slowest / STEPS
    for _ in range(STEPS):
        machine.elapse(step)
        now = machine.offset
        change = max(abs(a - b) for a, b in zip(now, before, strict=True))
        # a clock in real time has advanced a little more
        require(change <= machine.slew * (step + 1.0), f"{what}: the offset jumped by {change * 1e6:.4f} um")
        before = now
    require(not any(before), f"{what}: expected a ramp to zero within {slowest:g} s, found {um(before)}")


class Written:
    """A compensator as an instrument: it is armed when opened, and each reading is followed by a write.

    Parameters
    ----------
    subject : CompensatorSubject
    compensator : Compensator
    """

    def __init__(self, subject: CompensatorSubject, compensator: Any) -> None:
        self._subject, self._compensator = subject, compensator
        self.identify, self.close = compensator.identify, compensator.close

    def open(self) -> None:
        """Open and arm."""
        self._compensator.open()
        self._compensator.arm(self._subject.limit)

    def read(self) -> Any:
        """Return a reading, and write the offset of the subject."""
        found = self._compensator.read()
        self._compensator.write(self._subject.offset)
        return found


def as_instrument(subject: CompensatorSubject) -> InstrumentSubject:
    """Return a subject for the checks of instruments that record a session."""
    with started(subject) as device:
        settings = subject.plugin.Settings(**{**getattr(device, "driver_settings", {}), **subject.settings})

    def make(address: str, record: Path | None) -> Written:
        return Written(subject, subject.plugin(address, settings, record=record))

    return InstrumentSubject(
        subject.plugin, subject.address, make=make, time_limit=subject.time_limit, mutants=subject.mutants
    )
