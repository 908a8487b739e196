"""One program writes the offsets of a machine: the machine states its owner, on whatever computer it is."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest
from coded import raises

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator import owner
from errormotion.instruments.compensator.modbus_registers import ModbusRegisters
from errormotion.instruments.compensator.owner import Owner
from errormotion.instruments.compensator.register_map import RegisterSettings
from errormotion.instruments.simulators.compensator.plc import SimulatedPlc
from errormotion.instruments.transports import parse_address

LIMIT, WATCHDOG = 50e-6, 1.0
ADDRESS = f"sim://cframe/machine?owner=1&clock=0&watchdog={WATCHDOG}"


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(owner, "SETTLING", 0.0)


def modbus() -> tuple[Any, Any]:
    plc = SimulatedPlc(parse_address(ADDRESS))
    return plc, lambda **more: ModbusRegisters(plc.driver_url, ModbusRegisters.Settings(**plc.driver_settings, **more))


def opcua() -> tuple[Any, Any]:
    pytest.importorskip("asyncua", reason="the package asyncua is not installed")
    from errormotion.instruments.compensator.opcua_nodes import OpcUaNodes
    from errormotion.instruments.simulators.compensator.nodes import SimulatedNodes

    server = SimulatedNodes(parse_address(ADDRESS))
    return server, lambda **more: OpcUaNodes(server.url, OpcUaNodes.Settings(**server.driver_settings, **more))


@pytest.fixture(params=[modbus, opcua], ids=["modbus", "opcua"])
def machine(request: pytest.FixtureRequest) -> Iterator[tuple[Any, Any]]:
    """Return a machine with an owner, and a function that makes a compensator of it."""
    device, make = request.param()
    with closing(device):
        yield device, make


@contextmanager
def opened(make: Any) -> Iterator[Any]:
    with make() as compensator:
        yield compensator


def killed(compensator: Any) -> None:
    """End a compensator as a kill of its program does: the connection is closed, nothing more is sent."""
    compensator._transport, line = None, compensator._transport
    line.close()


def test_a_second_program_is_refused_until_the_first_has_ended(machine: tuple[Any, Any]) -> None:
    device, make = machine
    first, second = make(), make()
    assert first.note == ""
    first.open()
    first.arm(LIMIT)
    first.write((1e-6, 0.0, 0.0))
    assert device.machine.orders == 1
    killed(first)
    with second:
        with pytest.raises(InstrumentError, match=f"their owner is {first._owner.number}, this program is"):
            second.arm(LIMIT)
        with raises("instrument.not_armed"):
            second.write((2e-6, 0.0, 0.0))
        assert device.machine.orders == 1
        device.machine.elapse(2 * WATCHDOG)  # the watchdog ends the compensation and the right of the first
        second.arm(LIMIT)
        second.write((2e-6, 0.0, 0.0))
    assert device.machine.orders == 2
    with make() as third:  # the second has given its right back
        third.arm(LIMIT)


def test_the_right_is_taken_again_after_the_watchdog_has_ended_it(machine: tuple[Any, Any]) -> None:
    device, make = machine
    with make() as compensator:
        compensator.arm(LIMIT)
        compensator.write((1e-6, 0.0, 0.0))
        device.machine.elapse(2 * WATCHDOG)
        compensator.write((1e-6, 0.0, 0.0))
        assert compensator._read_owner() == compensator._owner.number


def test_a_program_that_has_lost_the_right_writes_no_offset(machine: tuple[Any, Any]) -> None:
    device, make = machine
    with make() as compensator:
        compensator.arm(LIMIT)
        other = compensator._owner.number % owner.LARGEST + 1
        compensator._write_owner(other)  # as by another program
        with pytest.raises(InstrumentError, match=f"their owner is {other}"):
            compensator.write((1e-6, 0.0, 0.0))
        assert device.machine.orders == 0
    with make() as watching:
        assert watching._read_owner() == other  # the right of the other one is not given back


def test_of_two_programs_that_found_no_owner_one_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    number = [0]
    first, second = (Owner("PLC", lambda: number[0], lambda each: number.__setitem__(0, each)) for _ in range(2))
    monkeypatch.setattr(owner.time, "sleep", lambda seconds: number.__setitem__(0, second.number))
    with pytest.raises(InstrumentError, match=f"their owner is {second.number}"):
        first.take()
    second.take()
    second.release()
    assert number == [0]


def test_a_machine_without_an_owner_works_as_before_and_says_so() -> None:
    with closing(SimulatedPlc(parse_address("sim://cframe/plc?clock=0"))) as plc:
        with ModbusRegisters(plc.driver_url, ModbusRegisters.Settings(**plc.driver_settings)) as compensator:
            compensator.arm(LIMIT)
            compensator.write((1e-6, 0.0, 0.0))
            assert "a compensation on another computer is not refused" in compensator.note
        assert plc.machine.orders == 1


def test_the_register_of_the_owner_is_its_own() -> None:
    with pytest.raises(ValueError, match="register 6 is used twice"):
        RegisterSettings(owner=6)
