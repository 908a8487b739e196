"""The compensators of LinuxCNC with the real one, by the record of its servo thread: each test breaks a safety clause.

LinuxCNC is started once for each route.
"""

import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from linuxcnc_watch import TRAVEL, Machine, until

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator.linuxcnc import LinuxCNCFeedback, LinuxCNCOffset
from errormotion.instruments.simulators.controller import linuxcnc_process
from errormotion.instruments.simulators.controller.linuxcnc_config import Compensated
from errormotion.plugins import CompensatorSubject
from errormotion.testing.kit import run_check
from errormotion.testing.run import checks_for

if reason := linuxcnc_process.why_not():
    pytest.skip(reason, allow_module_level=True)

pytestmark = pytest.mark.slow

LIMIT, SLEW, WATCHDOG = 20.0, 20.0, 1.0  # um, um/s, s
EXACT = 1e-6
"""Relative, of numbers that HAL prints with seven digits."""

one_route = pytest.mark.parametrize("started", ["external"], indirect=True)
"""For what is the same on both routes, or only on this one."""

FOLLOWER = """
import sys, time
from pathlib import Path
from errormotion.instruments.compensator import linuxcnc as module
kind, address, token = sys.argv[1:]
compensator = getattr(module, kind)(address, module.LinuxCNCCompensatorSettings(token_file=Path(token)))
compensator.open()
compensator.arm(20e-6)
x = 0.0
while True:
    x = min(x + 1e-6, 16e-6)
    compensator.write([x, 0.0, 0.0])
    time.sleep(0.05)
"""


@pytest.fixture(scope="module", params=["external", "feedback"])
def started(request: pytest.FixtureRequest) -> Iterator[Machine]:
    machine = Machine(Compensated(request.param, LIMIT * 1e-6, SLEW * 1e-6, WATCHDOG))
    yield machine
    machine.process.end()


@pytest.fixture
def machine(started: Machine) -> Iterator[Machine]:
    with started.control:
        started.rest()
        started.watch()
        yield started


@pytest.fixture
def compensator(machine: Machine) -> Iterator[LinuxCNCOffset]:
    with machine.compensator() as driver:
        driver.arm(LIMIT * 1e-6)
        yield driver


def follow(compensator: LinuxCNCOffset, x: float, seconds: float = 5.0) -> float:
    """Move the offset of X in small steps until it is x or the time limit is reached; return it, um."""
    end, step = time.monotonic() + seconds, 0.4 * SLEW * WATCHDOG
    while True:
        now = compensator.read().offset[0] * 1e6
        if abs(now - x) < 0.05 or time.monotonic() > end:
            return now
        compensator.write([(now + max(-step, min(step, x - now))) * 1e-6, 0.0, 0.0])
        time.sleep(0.05)


def test_it_moves_to_the_limit_at_the_slew_limit_and_no_further(machine: Machine, compensator: LinuxCNCOffset) -> None:
    assert follow(compensator, LIMIT) == pytest.approx(LIMIT, abs=0.1)
    with pytest.raises(InstrumentError, match="beyond the limit of 20 um"):
        compensator.write([20.1e-6, 0.0, 0.0])
    record = machine.record()
    assert record.highest <= LIMIT * (1 + EXACT)
    assert 0.9 * SLEW < record.fastest <= SLEW * (1 + EXACT)
    assert record.drive_moved == pytest.approx(record.highest, abs=0.1)
    assert record.drive_fastest <= SLEW * (1 + EXACT)


def test_positions_are_those_without_the_offset(machine: Machine, compensator: LinuxCNCOffset) -> None:
    follow(compensator, 10.0)
    machine.control.move_to([0.001, 0.0, 0.0])
    for name in ("position", "commanded_position"):
        assert machine.control.state()[name] == pytest.approx([1e-3, 0.0, 0.0], abs=1e-8)
    assert machine.pins("J0_mux.out")[0] > 1.001  # mm: the motor


@one_route
def test_the_servo_thread_limits_offsets_that_did_not_pass_the_bridge(machine: Machine) -> None:
    machine.hal("setp errormotion-source-x.in1 -1000")
    end, sign = time.monotonic() + 1.5 * LIMIT / SLEW, 0
    while time.monotonic() < end:
        sign = 1 - sign
        machine.hal(f"setp errormotion-sign.in0 {sign}")
        time.sleep(0.05)
    machine.hal("setp errormotion-source-x.in1 0")
    record = machine.record()
    assert -LIMIT * (1 + EXACT) <= record.lowest <= -0.99 * LIMIT
    assert record.fastest <= SLEW * (1 + EXACT)


@one_route
def test_a_jump_is_refused(compensator: LinuxCNCOffset) -> None:
    follow(compensator, 15.0)
    with pytest.raises(InstrumentError, match="is a change of 30 um; the slew limit permits 21 um"):
        compensator.write([-15e-6, 0.0, 0.0])


@one_route
def test_without_arming_or_a_write_nothing_is_requested(machine: Machine) -> None:
    until(lambda: machine.pins("errormotion-alive.out") == [0.0])
    with machine.compensator() as unarmed, machine.compensator() as other:
        with pytest.raises(InstrumentError, match="is not armed; it only reads"):
            unarmed.write([1e-6, 0.0, 0.0])
        other.arm(LIMIT * 1e-6)  # the right is released
        for _ in range(5):
            assert other.read().offset == pytest.approx((0.0, 0.0, 0.0), abs=1e-10)
    assert machine.pins("errormotion-alive.time-left", "errormotion-alive.out") == [0.0, 0.0]


@one_route
def test_a_limit_beyond_that_of_the_machine_is_refused(machine: Machine) -> None:
    with machine.compensator() as driver:
        with pytest.raises(InstrumentError, match="LIMIT of at least 50 um in LinuxCNC's INI file; found 20 um"):
            driver.arm(50e-6)
        with pytest.raises(InstrumentError, match="is not armed"):
            driver.write([0.0, 0.0, 0.0])


def test_the_kit_finds_nothing_wrong_without_writing(machine: Machine) -> None:
    kind = type(machine.compensator())
    dead = kind.conformance().dead_address
    subject = CompensatorSubject(
        kind, address=machine.address, settings={"token_file": machine.token}, dead_address=dead
    )
    for check in checks_for(subject):
        result = run_check(check, subject)
        assert result.ok, f"{check.claim}\n{result.message}\n{result.trace}"


@one_route
def test_a_second_compensator_is_refused(machine: Machine, compensator: LinuxCNCOffset) -> None:
    compensator.write([1e-6, 0.0, 0.0])
    with machine.compensator() as second:
        assert "another program compensates the machine: errormotion" in second.read().fault
        with pytest.raises(InstrumentError, match="another program has it"):
            second.arm(LIMIT * 1e-6)
        assert compensator.read().fault == ""
        compensator.close()
        until(lambda: not second.read().fault)
        second.arm(LIMIT * 1e-6)
        second.write([0.0, 0.0, 0.0])


def test_a_compensator_of_the_other_route_is_refused(machine: Machine) -> None:
    other = {"external": LinuxCNCFeedback, "feedback": LinuxCNCOffset}[machine.compensated.route]
    with (
        other(machine.address, machine.compensator().settings) as driver,
        pytest.raises(InstrumentError, match=rf"expected ROUTE = {driver.route} in LinuxCNC's INI file"),
    ):
        driver.read()


def test_a_killed_program_is_followed_by_zero_and_another_one_continues(machine: Machine) -> None:
    kind = type(machine.compensator()).__name__
    program = subprocess.Popen([sys.executable, "-c", FOLLOWER, kind, machine.address, str(machine.token)])
    try:
        until(lambda: machine.offset() > 15)
    finally:
        program.kill()
        program.wait()
    until(lambda: machine.offset() < 10)  # by the watchdog
    with machine.compensator() as next_one:
        next_one.arm(LIMIT * 1e-6)
        for _ in range(10):
            next_one.write(next_one.read().offset)
            time.sleep(0.05)
        assert machine.offset() > 0
    until(lambda: machine.offset() == 0)
    record = machine.record()
    assert record.fastest <= SLEW * (1 + EXACT)
    assert record.drive_fastest <= SLEW * (1 + EXACT)
    assert record.lowest >= -1e-6
    assert record.highest <= 16.0 * (1 + EXACT)


def test_a_killed_bridge_is_followed_by_zero(machine: Machine, compensator: LinuxCNCOffset) -> None:
    follow(compensator, 15.0)
    machine.kill_bridge()
    with pytest.raises(InstrumentError):
        compensator.write([15e-6, 0.0, 0.0])
    until(lambda: machine.offset() == 0)
    record = machine.record()
    assert record.drive_fastest <= SLEW * (1 + EXACT)
    compensator.open()
    assert compensator.read().offset == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    follow(compensator, 3.0)
    assert machine.offset() == pytest.approx(3.0, abs=0.1)


@one_route
def test_a_silent_link_is_followed_by_zero(machine: Machine, compensator: LinuxCNCOffset) -> None:
    follow(compensator, 10.0)
    until(lambda: machine.offset() == 0)  # the connection is still open
    assert machine.record().drive_fastest <= SLEW * (1 + EXACT)


def test_after_an_emergency_stop_nothing_moves_and_the_offset_is_zero(
    machine: Machine, compensator: LinuxCNCOffset
) -> None:
    for _ in range(5):  # on a busy computer the beginning of a record takes longer than the watchdog waits
        follow(compensator, 15.0)
        machine.watch()
        compensator.write([15e-6, 0.0, 0.0])
        if machine.record().drive_moved < 1e-4:
            break
    compensator.write([15e-6, 0.0, 0.0])
    machine.control.estop()
    assert compensator.read().fault == "the machine is off or in e-stop"
    with pytest.raises(InstrumentError, match="the machine is off or in e-stop"):
        compensator.write([15e-6, 0.0, 0.0])
    until(lambda: machine.offset() == 0)
    machine.control.reset()
    machine.control.enable()
    time.sleep(0.2)
    assert machine.pins("J0_mux.out")[0] == pytest.approx(15e-3, abs=1e-4)  # mm: the motor
    assert machine.control.state()["position"][0] == pytest.approx(15e-6, abs=1e-7)  # as reported by LinuxCNC
    assert machine.record().drive_moved < 1e-4


def test_the_machine_is_switched_on_again_during_the_ramp(machine: Machine, compensator: LinuxCNCOffset) -> None:
    follow(compensator, 15.0)
    machine.watch()
    machine.control.estop()
    machine.control.reset()
    machine.control.enable()
    until(lambda: machine.offset() == 0)
    record = machine.record()
    assert record.drive_fastest <= SLEW * (1 + EXACT)
    assert record.drive_moved < 15.0 * (1 + EXACT)
    until(lambda: abs(compensator.read().offset[0]) < 1e-9)
    assert compensator.read().fault == ""


@one_route
@pytest.mark.parametrize(
    ("program", "busy"),
    [
        ("M64 P0\nG4 P1.5\nM65 P0\n", "the program holds the offset"),
        ("G38.3 Z-2 F80\nG53 G0 Z0\n", "the machine probes"),
        ("M3 S600\nG4 P0.3\nG33 Z-8 K0.5\nM5\nG53 G0 Z0\n", "a thread is cut"),
        ("M3 S600\nG4 P0.3\nG33.1 Z-8 K0.5\nM5\nG53 G0 Z0\n", "a thread is cut"),
    ],
    ids=["hold", "probe", "thread", "tap"],
)
def test_nothing_changes_while_the_machine_must_not_be_disturbed(
    machine: Machine, compensator: LinuxCNCOffset, program: str, busy: str
) -> None:
    follow(compensator, 4.0)
    machine.control.run_program(f"G21 G90 G94\n{program}M2\n")
    end = time.monotonic() + 10
    while compensator.read().busy != busy:
        assert time.monotonic() < end, (compensator.read(), machine.control.state())
        compensator.write([4e-6, 0.0, 0.0])
    time.sleep(0.05)  # LinuxCNC's planner stops
    machine.watch()
    for _ in range(8):
        compensator.write([12e-6, 0.0, 0.0])
        time.sleep(0.05)
    assert compensator.read().busy == busy
    record = machine.record()
    assert record.fastest < 1e-3
    assert record.highest == pytest.approx(4.0, abs=0.1)
    machine.control.finish()
    follow(compensator, 12.0, seconds=10.0)
    assert machine.offset() == pytest.approx(12.0, abs=0.1)


@one_route
def test_the_offset_is_held_for_the_rest_of_a_thread_without_the_bridge(
    machine: Machine, compensator: LinuxCNCOffset
) -> None:
    follow(compensator, 4.0)
    machine.control.run_program("G21 G90 G94\nM3 S600\nG4 P0.3\nG33 Z-8 K0.5\nM5\nG53 G0 Z0\nM2\n")
    end = time.monotonic() + 10
    while compensator.read().busy != "a thread is cut":
        assert time.monotonic() < end, (compensator.read(), machine.control.state())
        compensator.write([4e-6, 0.0, 0.0])
    time.sleep(0.05)  # LinuxCNC's planner stops
    machine.watch()
    with machine.suspended_bridge():
        until(lambda: machine.pins("motion.debug-float-1", "errormotion-alive.out") == [0.0, 0.0])
        record = machine.record()  # until the end of the thread
    assert record.fastest < 1e-3
    assert record.lowest == pytest.approx(4.0, abs=0.1)
    until(lambda: machine.offset() == 0)


@one_route
def test_overtravel_does_not_accumulate(machine: Machine, compensator: LinuxCNCOffset) -> None:
    machine.control.move_to([TRAVEL, 0.0, 0.0])
    machine.watch()
    for _ in range(10):  # LinuxCNC's planner cannot move further
        compensator.write([10e-6, 0.0, 0.0])
        time.sleep(0.05)
    assert compensator.read().busy == "LinuxCNC limits the offset at an end of travel"
    machine.control.move_to([TRAVEL - 0.01, 0.0, 0.0])
    follow(compensator, 10.0)
    assert machine.offset() == pytest.approx(10.0, abs=0.1)
    machine.control.move_to([TRAVEL, 0.0, 0.0])
    until(lambda: machine.offset() == 0)  # by the watchdog, here as well
    machine.control.move_to([TRAVEL - 0.01, 0.0, 0.0])
    machine.watch()
    follow(compensator, 10.0)
    follow(compensator, 0.0)
    assert compensator.read().fault == ""
    record = machine.record()
    assert record.fastest <= SLEW * (1 + EXACT)
    assert record.lowest > -0.1
