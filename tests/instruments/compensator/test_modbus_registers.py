"""Offsets in registers: published frames, a foreign server and client, a killed program."""

import asyncio
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import pairwise

import pytest
from coded import raises
from pydantic import ValidationError
from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator.modbus_registers import ModbusRegisters
from errormotion.instruments.compensator.register_map import RegisterSettings, runs
from errormotion.instruments.simulators.compensator.plc import SimulatedPlc
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.modbus import codec

UNIT, LIMIT = 7, 50e-6
OFFSET = (12.345e-6, -50e-6, 1e-9)
STATES = {"applied": (30, 32, 34), "stop": 36, "busy": 37}


def named(layer: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors("modbus_registers", layer), ids=str)


@named("write pdu")
def test_requests_and_answers_of_the_specification(vector: Vector) -> None:
    given = [vector.expected[name] for name in ("function", "register", "values")]
    frame = codec.encode_write("tcp", 1, *given, 9)
    assert frame == bytes.fromhex(f"00090000{len(vector.data) + 1:04x}01") + vector.data
    answer = bytes.fromhex(vector.expected["answer"])
    header = bytes.fromhex(f"00090000{len(answer) + 1:04x}01")
    assert codec.decode_written("tcp", header + answer, 1, *given, 9) == vector.expected["values"]
    assert codec.decode_written("tcp", header + answer, 1, *given, 10) is None  # a late one
    other = answer[:-1] + bytes((answer[-1] ^ 1,))
    with raises("protocol.modbus.confirmation"):
        codec.decode_written("tcp", header + other, 1, *given, 9)


@named("rtu write")
def test_frames_on_a_serial_line(vector: Vector) -> None:
    given = [vector.expected[name] for name in ("unit", "function", "register", "values")]
    assert codec.encode_write("rtu", *given) == vector.data
    answer = bytes.fromhex(vector.expected["answer"])
    assert codec.decode_written("rtu", answer, *given) == vector.expected["values"]
    assert [codec.missing("rtu", answer[:n]) for n in (0, 3, 8)] == [5, 5, 0]


def test_a_refused_write_is_named() -> None:
    with raises("modbus.refused"):
        codec.decode_written("tcp", bytes.fromhex("000100000003019002"), 1, 16, 1, [1], 1)


@pytest.mark.parametrize(("function", "count"), [(16, 0), (16, 124), (6, 2), (3, 1)])
def test_no_other_number_of_registers_is_written(function: int, count: int) -> None:
    with pytest.raises(ValueError, match=f"function {function} does not write {count} registers"):
        codec.encode_write("tcp", 1, function, 0, [0] * count)


# ---------------------------------------------------------------------- a foreign server


@contextmanager
def served() -> Iterator[int]:
    """A server of pymodbus with 40 holding registers, in a thread; its port."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    async def start() -> ModbusTcpServer:
        data = SimData(0, values=[0] * 40, datatype=DataType.REGISTERS)
        server = ModbusTcpServer(SimDevice(UNIT, [data]), address=("127.0.0.1", 0))
        assert await server.listen()
        return server

    server = asyncio.run_coroutine_threadsafe(start(), loop).result()
    try:
        yield server.transport.sockets[0].getsockname()[1]  # type: ignore[attr-defined]
    finally:
        asyncio.run_coroutine_threadsafe(server.shutdown(), loop).result()
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, [0, 12345, 0xFFFF, 0x3CB0, 0, 1, 1]),
        ({"word_order": "little"}, [12345, 0, 0x3CB0, 0xFFFF, 1, 0, 1]),
        ({"type": "i16", "scale": 1e-8, "offset": (0, 1, 2), "heartbeat": 3}, [1234, 0xEC78, 0, 1]),
        ({"type": "i16", "scale": 1e-8, "offset": (0, 1, 2), "heartbeat": 3, "function": 6}, [1234, 0xEC78, 0, 1]),
        ({"offset": (10, 12, 20), "heartbeat": 5}, [*[0] * 5, 1, *[0] * 4, 0, 12345, 0xFFFF, 0x3CB0, *[0] * 6, 0, 1]),
    ],
    ids=["i32", "little", "i16", "one by one", "apart"],
)
def test_a_foreign_server_receives_the_offset(settings: dict, words: list[int]) -> None:
    with served() as port:
        settings = {"unit": UNIT, "timeout": 5.0, **settings}
        compensator = ModbusRegisters(f"modbus+tcp://127.0.0.1:{port}", RegisterSettings(**settings))
        with compensator, ModbusTcpClient("127.0.0.1", port=port, timeout=5.0) as client:
            compensator.arm(LIMIT)
            compensator.write(OFFSET)
            assert client.read_holding_registers(0, count=len(words), device_id=UNIT).registers == words
            scale = compensator.settings.scale
            assert compensator.read().offset == pytest.approx([round(x / scale) * scale for x in OFFSET])
            compensator.write(OFFSET)
            beat = compensator.settings.heartbeat
            assert client.read_holding_registers(beat, count=1, device_id=UNIT).registers == [2]


def test_it_reads_what_the_plc_states() -> None:
    with served() as port:
        settings = RegisterSettings(unit=UNIT, timeout=5.0, heartbeat=6, **STATES)
        with (
            ModbusRegisters(f"modbus+tcp://127.0.0.1:{port}", settings) as compensator,
            ModbusTcpClient("127.0.0.1", port=port, timeout=5.0) as client,
        ):
            found = compensator.read()
            assert (found.offset, found.busy, found.fault) == ((0.0, 0.0, 0.0), "", "")
            client.write_registers(30, [0, 5000, 0xFFFF, 0xFFFF, 0, 0, 3, 1], device_id=UNIT)
            found = compensator.read()
            assert found.offset == pytest.approx((5e-6, -1e-9, 0.0))
            assert found.fault == "the PLC states stop (register 36 is 3)"
            assert found.busy == "the PLC states busy (register 37 is 1)"


def test_registers_that_do_not_exist_are_named_when_it_is_opened() -> None:
    settings = RegisterSettings(unit=UNIT, timeout=5.0, applied=(50, 52, 54))
    with served() as port:
        compensator = ModbusRegisters(f"modbus+tcp://127.0.0.1:{port}", settings)
        with raises("modbus.refused"):
            compensator.open()


def test_the_heartbeat_continues_from_that_of_the_plc_and_wraps() -> None:
    with served() as port, ModbusTcpClient("127.0.0.1", port=port, timeout=5.0) as client:
        client.write_register(6, 65534, device_id=UNIT)
        beats = []
        with ModbusRegisters(f"modbus+tcp://127.0.0.1:{port}", RegisterSettings(unit=UNIT, timeout=5.0)) as found:
            found.arm(LIMIT)
            for _ in range(3):
                found.write((0.0, 0.0, 0.0))
                beats += client.read_holding_registers(6, count=1, device_id=UNIT).registers
        assert beats == [65535, 0, 1]


# ---------------------------------------------------------------------- the simulated PLC


@contextmanager
def plc(query: str = "clock=0") -> Iterator[SimulatedPlc]:
    with closing(SimulatedPlc(parse_address(f"sim://cframe/plc?{query}"))) as device:
        yield device


@contextmanager
def connected(query: str) -> Iterator[tuple[SimulatedPlc, ModbusRegisters]]:
    with plc(query) as device:
        settings = RegisterSettings(**device.driver_settings)
        with ModbusRegisters(device.driver_url, settings) as compensator:
            yield device, compensator


def test_a_foreign_client_writes_to_the_simulated_plc() -> None:
    with plc("clock=0&slew=1e-6&watchdog=2") as device:
        place = parse_address(device.url)
        with ModbusTcpClient("127.0.0.1", port=place.port, timeout=5.0) as client:
            client.write_registers(0, [0, 3000, 0, 0, 0, 0, 1], device_id=1)
            device.machine.elapse(1.5)
            assert client.read_holding_registers(7, count=2, device_id=1).registers == [0, 1500]
            client.write_registers(0, [0, 3000, 0, 0, 0, 0, 1], device_id=1)  # the heartbeat does not change
            device.machine.elapse(1.5)
            assert device.machine.offset[0] == pytest.approx(1e-6)  # 0.5 s up, 1 s down
            assert client.write_registers(7, [1], device_id=1).exception_code == 2  # what the PLC writes itself
            assert client.read_holding_registers(0, count=40, device_id=1).exception_code == 2


def test_the_heartbeat_is_written_with_the_last_register() -> None:
    """A partly written offset is not a heartbeat."""
    written: list[tuple[int, int]] = []
    with connected("clock=0") as (_, compensator):
        compensator.line.write_registers = (  # type: ignore[method-assign]
            lambda first, values, function: written.append((first, len(values)))
        )
        compensator.arm(LIMIT)
        for heartbeat, offset in ((0, (1, 3, 5)), (0, (2, 4, 10)), (6, (0, 2, 10))):
            compensator.settings = RegisterSettings(heartbeat=heartbeat, offset=offset)
            compensator.write(OFFSET)
    assert written == [(0, 7), (2, 4), (10, 2), (0, 1), (0, 4), (10, 2), (6, 1)]


def test_a_limit_that_the_registers_cannot_hold_is_refused() -> None:
    with connected("clock=0&type=i16&scale=1e-9") as (_, compensator):
        with raises("offset.range.too_small"):
            compensator.arm(50e-6)
        with raises("instrument.not_armed"):
            compensator.write((0.0, 0.0, 0.0))
        compensator.arm(32e-6)
        compensator.write((32e-6, 0.0, 0.0))


def test_rounding_does_not_exceed_the_limit() -> None:
    with connected("clock=0&scale=7e-7&limit=1") as (device, compensator):
        compensator.arm(20e-6)  # 28.57 counts
        compensator.write((20e-6, -20e-6, 0.0))
        assert device._words[1] == 28
        assert device._map.count([device._words[2], device._words[3]]) == -28


def test_after_a_lost_connection_it_connects_again() -> None:
    with connected("clock=0&watchdog=2") as (device, compensator):
        compensator.arm(LIMIT)
        compensator.write((1e-6, 0.0, 0.0))
        device._server.disconnect()
        for _ in range(20):  # the loss is detected now or at the next request
            try:
                compensator.open()
                compensator.write((1e-6, 0.0, 0.0))
            except InstrumentError:
                time.sleep(0.1)
            else:
                break
        device.machine.elapse(1.0)
        assert compensator.read().offset == pytest.approx((1e-6, 0.0, 0.0))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"offset": (0, 1, 2)}, "register 1 is used twice"),
        ({"heartbeat": 5}, "register 5 is used twice"),
        ({"stop": 6}, "register 6 is used twice"),
        ({"offset": (0, 2, 65535)}, "expected a register from 0 to 65534; found 65535"),
        ({"busy": -1}, "expected a register from 0 to 65535; found -1"),
        ({"function": 6}, "6 writes one register"),
        ({"scale": "2 um"}, "less than or equal"),
        ({"scale": 0.0}, "greater than 0"),
    ],
)
def test_invalid_registers_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        RegisterSettings(**settings)


def test_adjacent_registers_form_runs() -> None:
    assert list(runs({5: 1, 3: 2, 4: 3, 9: 4}, 125)) == [(3, [2, 3, 1]), (9, [4])]
    assert list(runs({1: 1, 2: 2, 3: 3}, 2)) == [(1, [1, 2]), (3, [3])]
    assert list(runs({}, 2)) == []


PROGRAM = """
import sys, time
from errormotion.instruments.compensator.modbus_registers import ModbusRegisters
with ModbusRegisters(sys.argv[1], ModbusRegisters.Settings(applied=(7, 9, 11))) as compensator:
    compensator.arm(50e-6)
    while True:
        compensator.write((10e-6, 0.0, -5e-6))
        time.sleep(0.02)
"""


def test_a_killed_program_leaves_a_machine_that_ramps_to_zero() -> None:
    with plc("watchdog=0.5&slew=20e-6") as device:
        program = subprocess.Popen([sys.executable, "-c", PROGRAM, device.driver_url])
        try:
            _wait(lambda: device.machine.offset == (10e-6, 0.0, -5e-6))
        finally:
            program.send_signal(signal.SIGKILL)
            program.wait()
        orders, course = device.machine.orders, list[tuple[float, float, float]]()
        while not course or course[-1][1]:
            course.append((time.monotonic(), device.machine.offset[0], time.monotonic()))
            assert course[-1][0] - course[0][0] < 20.0
            time.sleep(0.005)
        assert device.machine.orders - orders <= 1
        assert not any(device.machine.offset)
        steps = [(new[2] - old[0], old[1] - new[1]) for old, new in pairwise(course)]
        assert len(steps) > 10
        assert all(0 <= change <= 20e-6 * seconds + 1e-12 for seconds, change in steps)


def _wait(condition) -> None:
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
