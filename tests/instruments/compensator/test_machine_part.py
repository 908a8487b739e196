"""The machine's part bounds offset and change at every instant, and ramps to zero without a heartbeat."""

import math

import numpy as np
import pytest

from errormotion.instruments.simulators.compensator.machine import MachinePart
from errormotion.instruments.transports import parse_address

LIMIT, SLEW, WATCHDOG = 30e-6, 2e-6, 3.0


def part() -> MachinePart:
    return MachinePart(parse_address(f"sim://cframe/plc?clock=0&limit={LIMIT}&slew={SLEW}&watchdog={WATCHDOG}"))


@pytest.mark.parametrize("seed", range(5))
def test_for_any_commands_it_stays_within_its_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    machine = part()
    before = np.array(machine.offset)
    for _ in range(3000):
        match rng.integers(8):
            case 0:
                machine.order(rng.choice([0.0, 1.0, -1e300, math.nan, math.inf, -math.inf, 10e-6], 3))
            case 1:
                machine.order(rng.normal(0, 40e-6, 3), alive=bool(rng.integers(2)))
            case 2:
                machine.fault = "stop" if rng.integers(2) else ""
        dt = float(rng.exponential(0.5))
        machine.elapse(dt)
        now = np.array(machine.offset)
        assert (np.abs(now) <= LIMIT).all()
        assert (np.abs(now - before) <= SLEW * dt * (1 + 1e-9)).all()
        before = now


def test_it_follows_commands_and_returns_without_them() -> None:
    machine = part()
    machine.order((4e-6, 0.0, -1e-6))
    course = []
    for _ in range(8):
        machine.elapse(1.0)
        course.append(round(machine.offset[0] * 1e6, 6))
    assert course == [2.0, 4.0, 4.0, 2.0, 0.0, 0.0, 0.0, 0.0]


def test_one_long_interval_is_the_sum_of_short_ones() -> None:
    short, long = part(), part()
    for machine in (short, long):
        machine.order((5e-6, -1e-6, 20e-6))
    for _ in range(1000):
        short.elapse(0.0042)
    long.elapse(4.2)
    assert short.offset == pytest.approx(long.offset, abs=1e-15)


def test_after_a_stop_a_new_heartbeat_is_needed() -> None:
    machine = part()
    machine.order((4e-6, 0.0, 0.0))
    machine.elapse(2.0)
    machine.fault = "emergency stop"
    machine.elapse(0.5)
    machine.fault = ""
    machine.elapse(0.5)
    assert machine.offset[0] == pytest.approx(2e-6)
    machine.order((4e-6, 0.0, 0.0))
    machine.elapse(0.5)
    assert machine.offset[0] == pytest.approx(3e-6)
