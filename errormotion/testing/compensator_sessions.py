"""A session with a compensator under test and the simulated machine that takes its offsets."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

from errormotion.instruments.transports import load_simulator, parse_address
from errormotion.plugins import CompensatorSubject
from errormotion.plugins.subjects import with_query
from errormotion.testing.kit import require

ARRIVAL = 5.0
"""Real time within which something written is seen at the other end, s."""
POLL = 0.005
"""s"""
STEPS = 20
"""Instants at which a ramp is looked at."""


@contextmanager
def started(subject: CompensatorSubject, fault: str = "") -> Iterator[Any]:
    """Start the simulated machine; without one, stand in for it with the address of the real one."""
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
    """Return a new compensator for a machine, not yet opened."""
    if device is None:
        return subject.build(subject.address)
    where = getattr(device, "driver_url", None) or device.url
    return subject.build(where, getattr(device, "driver_settings", None))


@contextmanager
def armed(subject: CompensatorSubject, device: Any) -> Iterator[Any]:
    """Give an open and armed compensator."""
    with closing(made(subject, device)) as compensator:
        compensator.open()
        compensator.arm(subject.limit)
        yield compensator


def wait_for(condition: Callable[[], bool], message: str | Callable[[], str]) -> None:
    """Wait until a condition holds; fail with a message where it does not."""
    end = time.monotonic() + ARRIVAL
    while not condition():
        if time.monotonic() >= end:
            require(False, message if isinstance(message, str) else message())
        time.sleep(POLL)


def write(compensator: Any, device: Any, offset: tuple[float, float, float]) -> None:
    """Write, and wait until the machine has it."""
    before = device.machine.orders
    compensator.write(offset)
    wait_for(lambda: device.machine.orders > before, f"the machine got nothing after write({offset})")


def near(one: Any, other: Any, tolerance: float) -> bool:
    """Return whether two offsets agree, m."""
    return all(math.isfinite(a) and abs(a - b) <= tolerance for a, b in zip(one, other, strict=True))


def require_offset(subject: CompensatorSubject, found: Any, expected: Any, what: str) -> None:
    """Fail unless an offset is the expected one, to the resolution of the subject."""
    require(near(found, expected, subject.resolution), f"{what}: expected {um(expected)}, found {um(found)}")


def um(offset: Any) -> str:
    """Return an offset as text."""
    return f"{', '.join(f'{value * 1e6:.4f}' for value in offset)} um"


def follow(subject: CompensatorSubject, compensator: Any, device: Any) -> None:
    """Write the offset of the subject until it is in effect."""
    machine = device.machine
    ramp = max(map(abs, subject.offset)) / machine.slew
    for _ in range(math.ceil(ramp / (0.4 * machine.watchdog)) + 1):
        write(compensator, device, subject.offset)
        machine.elapse(0.4 * machine.watchdog)
    require_offset(subject, machine.offset, subject.offset, "the offset in effect after it was written")


def require_ramp(device: Any, what: str) -> None:
    """Let the time of the watchdog and of a ramp pass; fail where the offset jumps or does not reach zero."""
    machine = device.machine
    before = machine.offset
    # until the watchdog ends it, the offset may still move towards the last order
    slowest = 2 * machine.watchdog + max(map(abs, before)) / machine.slew
    step = 1.05 * slowest / STEPS
    for _ in range(STEPS):
        machine.elapse(step)
        now = machine.offset
        change = max(abs(a - b) for a, b in zip(now, before, strict=True))
        # a clock that runs by itself has moved on a little as well
        require(change <= machine.slew * (step + 1.0), f"{what}: the offset jumped by {change * 1e6:.4f} um")
        before = now
    require(not any(before), f"{what}: expected a ramp to zero within {slowest:g} s, found {um(before)}")
