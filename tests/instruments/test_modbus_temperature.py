"""Thermometers with Modbus: a foreign server, a foreign client, and all faults."""

import asyncio
import math
import os
import re
import select
import shutil
import subprocess
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from coded import raises
from pymodbus.framer import FramerType
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.thermometer.modbus import SimulatedModbus
from errormotion.instruments.thermometer.modbus_temperature import ModbusTemperature
from errormotion.instruments.thermometer.registers import ModbusSettings, encode_number
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.modbus.client import ModbusLine
from errormotion.instruments.transports.modbus.codec import ModbusRefusal, crc16

LOGGER = "sim://cframe/logger?seed=3&map=logger-16"
# long enough for the pauses of a garbage collection (0.3 s on a slow computer), during which no simulator answers
QUICK = ModbusSettings(map="logger-16", timeout=0.7, retry=0.05, retries=0)
TWO = ("air", "bed")


# ---------------------------------------------------------------------- a foreign server


@contextmanager
def served(make: Callable[[SimDevice], Any], device: SimDevice) -> Iterator[int]:
    """Run a server of pymodbus in a thread; yield its port, 0 on a serial line."""
    loop, ready, end = asyncio.new_event_loop(), threading.Event(), asyncio.Event()
    ports: list[int] = []

    async def serve() -> None:
        server = make(device)
        await server.serve_forever(background=True)
        sockets = getattr(server.transport, "sockets", None)
        ports.append(sockets[0].getsockname()[1] if sockets else 0)
        ready.set()
        await end.wait()
        await server.shutdown()
        await asyncio.sleep(0.01)

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
    thread.start()
    try:
        assert ready.wait(10)
        yield ports[0]
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join()
        loop.close()


@contextmanager
def null_modem() -> Iterator[tuple[str, str]]:
    """Yield the two ends of a serial line."""
    pairs = [os.openpty(), os.openpty()]
    for near, far in pairs:
        tty.setraw(near)
        tty.setraw(far)
    stop_read, stop_write = os.pipe()

    def pump() -> None:
        other = {pairs[0][0]: pairs[1][0], pairs[1][0]: pairs[0][0]}
        while stop_read not in (ready := select.select([*other, stop_read], [], [])[0]):
            for end in ready:
                os.write(other[end], os.read(end, 4096))

    thread = threading.Thread(target=pump)
    thread.start()
    try:
        yield os.ttyname(pairs[0][1]), os.ttyname(pairs[1][1])
    finally:
        os.write(stop_write, b".")
        thread.join()
        for descriptor in (*pairs[0], *pairs[1], stop_read, stop_write):
            os.close(descriptor)


def two_floats(function: int) -> SimDevice:
    words = [*encode_number(20.25, "f32"), *encode_number(-3.5, "f32")]
    blocks: list[list[SimData]] = [[SimData(0, values=[0], datatype=DataType.REGISTERS)] for _ in range(4)]
    for block in blocks[:2]:
        block[0] = SimData(0, values=[True], datatype=DataType.BITS)
    blocks[function % 4 if function == 3 else 2] = [SimData(0, values=[0], datatype=DataType.REGISTERS)]
    blocks[2 if function == 3 else 3] = [SimData(100, values=words, datatype=DataType.REGISTERS)]
    return SimDevice(7, simdata=(blocks[0], blocks[1], blocks[2], blocks[3]))


@pytest.mark.parametrize("function", [3, 4])
@pytest.mark.parametrize(("framer", "scheme"), [(FramerType.SOCKET, "modbus+tcp"), (FramerType.RTU, "modbus+rtu-tcp")])
def test_reads_a_pymodbus_server_over_tcp(function: int, framer: FramerType, scheme: str) -> None:
    settings = ModbusSettings(channels=TWO, function=function, first=100, type="f32", unit=7)
    make = lambda device: ModbusTcpServer(device, framer=framer, address=("127.0.0.1", 0))  # noqa: E731
    with (
        served(make, two_floats(function)) as port,
        ModbusTemperature(f"{scheme}://127.0.0.1:{port}", settings) as thermometer,
    ):
        assert thermometer.read() == {"air": 20.25, "bed": -3.5}
        assert not thermometer.identify().simulated
        thermometer.configure(ModbusSettings(channels=TWO, function=function, first=200, unit=7))
        with raises("modbus.refused"):
            thermometer.read()
        assert set(thermometer.flags.values()) == {"no answer"}


def test_reads_a_pymodbus_server_on_a_serial_line() -> None:
    settings = ModbusSettings(channels=TWO, first=100, type="f32")
    with null_modem() as (near, far):
        make = lambda device: ModbusSerialServer(device, framer=FramerType.RTU, port=near, baudrate=9600)  # noqa: E731
        with (
            served(make, two_floats(3)),
            ModbusTemperature(f"modbus+rtu://{far}?baudrate=9600&unit=7", settings) as thermometer,
        ):
            assert [thermometer.read() for _ in range(5)] == [{"air": 20.25, "bed": -3.5}] * 5


# ---------------------------------------------------------------------- a foreign client


@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed (Debian package mbpoll)")
@pytest.mark.parametrize("wire", ["tcp", "pty"])
@pytest.mark.parametrize("function", [3, 4])
def test_another_client_reads_the_simulator(wire: str, function: int) -> None:
    device = SimulatedModbus(parse_address(f"{LOGGER}&wire={wire}&unit=5&noise=0&function={function}&open=1"))
    try:
        place = parse_address(device.url)
        where = ["-m", "rtu", "-b", "9600", "-P", "none", place.path]
        if wire == "tcp":
            where = ["-m", "tcp", "-p", str(place.port), "127.0.0.1"]
        table = "4" if function == 3 else "3"
        command = ["mbpoll", "-a", "5", "-0", "-r", "32", "-c", "5", "-t", table, "-1", "-o", "2", *where]
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
        truth = twin_temperatures()
    finally:
        device.close()
    assert done.returncode == 0, done.stdout + done.stderr
    counts = [int(count) for count in re.findall(r"\[\d+\]:\s+(\d+)", done.stdout)]
    expected = [round(10 * truth[name]) for name in ("frame", "ambient", "spindle_front", "spindle_rear", "column")]
    expected[1] = 10000
    assert counts == expected


# ---------------------------------------------------------------------- the simulator


def read_often(thermometer: ModbusTemperature, times: int) -> None:
    for _ in range(times):
        try:
            thermometer.read()
        except InstrumentError as error:
            last = error
    raise last


def twin_temperatures() -> dict[str, float]:
    twin = world("cframe", 3).machine
    return dict(zip(twin.temperature_sensors, map(float, twin.temperatures([0.0])[0]), strict=True))


@pytest.mark.parametrize("wire", ["framing=tcp", "framing=rtu", "wire=pty"])
@pytest.mark.parametrize(
    ("shape", "settings", "step"),
    [
        ("map=logger-16", {"map": "logger-16"}, 0.1),
        ("map=adam-6018&thermocouples=T", {"map": "adam-6018", "thermocouples": ("T",)}, 0.008),
        ("type=f32&word_order=little", {"type": "f32", "word_order": "little"}, 1e-5),
        ("type=i32&scale=0.001&stride=4&function=4", {"type": "i32", "scale": 0.001, "stride": 4, "function": 4}, 1e-3),
    ],
)
def test_temperatures_are_the_twins(wire: str, shape: str, settings: dict[str, Any], step: float) -> None:
    with ModbusTemperature(f"sim://cframe/logger?seed=3&noise=0&{wire}&{shape}", ModbusSettings(**settings)) as found:
        reading = found.read()
        truth = twin_temperatures()
        assert set(found.flags.values()) == {""}
        assert found.identify().simulated
    assert list(reading) == ["frame", "ambient", "spindle_front", "spindle_rear", "column"]
    for name, value in reading.items():
        assert value == pytest.approx(truth[name], abs=0.51 * step)  # half of the last digit


def test_open_and_shorted_sensors_are_nan_with_a_flag() -> None:
    address = "sim://cframe/logger?seed=3&type=i16&scale=0.1&open_from=10000&open=0,3&shorted=1&shorted_code=-9999"
    settings = ModbusSettings(scale=0.1, open_from=10000, shorted_codes=(-9999,))
    with ModbusTemperature(address, settings) as thermometer:
        assert set(thermometer.flags.values()) == {"not read"}
        reading = thermometer.read()
        assert [name for name, value in reading.items() if math.isnan(value)] == ["frame", "ambient", "spindle_rear"]
        assert list(thermometer.flags.values()) == ["open", "shorted", "", "open", ""]
        assert thermometer.open_sensors == ("frame", "ambient", "spindle_rear")


def test_positions_are_settings_with_units() -> None:
    settings = ModbusSettings.model_validate({"channels": TWO, "places": {"bed": ("0.4 m", "-20 mm", 0.0)}})
    assert ModbusTemperature("modbus+tcp://host", settings).places == {"air": None, "bed": (0.4, -0.02, 0.0)}


def test_another_unit_does_not_answer() -> None:
    device = SimulatedModbus(parse_address(LOGGER))
    try:
        port = parse_address(device.url).port
        with pytest.raises(InstrumentTimeoutError, match="unit 9 did not answer"):
            ModbusTemperature(f"modbus+tcp://127.0.0.1:{port}?unit=9", QUICK).open()
    finally:
        device.close()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("tcp://127.0.0.1:502", "Expected an address for Modbus"),
        ("modbus+rtu-tcp://127.0.0.1", "Expected modbus.rtu-tcp://HOST:PORT"),
        ("modbus+rtu://", "Expected modbus.rtu:///dev/NAME"),
        ("modbus+tcp://127.0.0.1:9?unit=300", "'unit' .* from 0 to 255; found 300"),
        ("modbus+tcp://127.0.0.1:9", "No connection to modbus.tcp://127.0.0.1:9"),
        (f"{LOGGER}&wire=pty&framing=tcp", "'rtu' on a pty"),
        (f"{LOGGER}&sensors=coffee", "found coffee"),
        (f"{LOGGER}&open=7", "inputs from 0 to 4; found '7'"),
        (f"{LOGGER}&type=f64", "register map .* is invalid"),
    ],
)
def test_the_message_for_a_wrong_address_states_the_expected_form(address: str, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        ModbusTemperature(address, QUICK).open()


# ---------------------------------------------------------------------- faults


@pytest.mark.parametrize("wire", ["framing=tcp", "framing=rtu", "wire=pty"])
@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("silence", InstrumentTimeoutError, "unit 1 did not answer within 0.7 s"),
        ("drop", InstrumentTimeoutError, "unit 1 did not answer"),
        ("unplugged", InstrumentTimeoutError, "unit 1 did not answer"),
        ("exception&code=6", ModbusRefusal, r"exception 6 \(server device busy\)"),
        ("garbage", ProtocolError, "(?i)expected"),
        ("short", ProtocolError, "more bytes within 0.7 s"),
        ("unit", ProtocolError, "answer of unit 1; found that of unit 3"),
    ],
)
def test_each_fault_has_its_own_state(wire: str, fault: str, error: type[InstrumentError], message: str) -> None:
    with ModbusTemperature(f"{LOGGER}&{wire}&fault={fault}&fault_at=2", QUICK) as thermometer:
        thermometer.read()
        with pytest.raises(error, match=message) as raised:
            thermometer.read()
        assert type(raised.value) is error
        assert set(thermometer.flags.values()) == {"no answer"}


@pytest.mark.parametrize("wire", ["framing=rtu", "wire=pty"])
def test_a_wrong_checksum_is_reported_from_silence(wire: str) -> None:
    with (
        ModbusTemperature(f"{LOGGER}&{wire}&fault=checksum&fault_at=1", QUICK) as thermometer,
        raises("protocol.checksum"),
    ):
        thermometer.read()


def test_a_damaged_answer_is_requested_again_and_counted() -> None:
    settings = QUICK.model_copy(update={"retries": 1})
    address = f"{LOGGER}&framing=rtu&fault=checksum&fault_at=1&fault_every=2"
    with ModbusTemperature(address, settings) as thermometer:
        for _ in range(3):
            assert all(math.isfinite(value) for value in thermometer.read().values())
        assert thermometer.repeated == 3


def test_answers_in_pieces_are_whole() -> None:
    with ModbusTemperature(f"{LOGGER}&fault=split", QUICK) as thermometer:
        assert all(math.isfinite(value) for value in thermometer.read().values())


@pytest.mark.parametrize("wire", ["framing=tcp", "framing=rtu", "wire=pty"])
def test_an_unplugged_thermometer_is_received_again_automatically(wire: str) -> None:
    address = f"{LOGGER}&{wire}&fault=unplugged&fault_at=2&unplugged_for=1.6"
    with ModbusTemperature(address, QUICK) as thermometer:
        before = thermometer.read()
        gaps = 0
        end = time.monotonic() + 20
        while time.monotonic() < end:
            try:
                after = thermometer.read()
                break
            except InstrumentError:
                gaps += 1
                time.sleep(0.02)
        assert gaps >= 2
        assert after == pytest.approx(before, abs=0.3)  # noise of 0.02 K and a last digit of 0.1 K
        assert set(thermometer.flags.values()) == {""}


def test_a_lost_connection_is_retried_at_a_limited_rate() -> None:
    settings = QUICK.model_copy(update={"retry": 60.0})
    with ModbusTemperature(f"{LOGGER}&fault=disconnect&fault_at=2", settings) as thermometer:
        thermometer.read()
        with raises("connection.lost"):
            thermometer.read()
        for _ in range(3):
            with pytest.raises(InstrumentError, match=r"the next attempt is in (60|5\d)\.\d s"):
                thermometer.read()


def test_a_server_that_restarts_at_its_port_is_read_again() -> None:
    settings = ModbusSettings(channels=TWO, first=100, type="f32", unit=7, timeout=0.5, retry=0.0)
    at = lambda port: lambda device: ModbusTcpServer(device, address=("127.0.0.1", port))  # noqa: E731
    with served(at(0), two_floats(3)) as port:
        thermometer = ModbusTemperature(f"modbus+tcp://127.0.0.1:{port}", settings)
        thermometer.open()
        thermometer.read()
    try:
        with raises("connection.not_opened"):
            read_often(thermometer, 2)  # the first may find the connection still closing
        with served(at(port), two_floats(3)):
            assert thermometer.read() == {"air": 20.25, "bed": -3.5}
    finally:
        thermometer.close()


# ---------------------------------------------------------------------- recordings


@pytest.mark.parametrize("wire", ["framing=tcp", "framing=rtu", "wire=pty"])
def test_a_recorded_session_plays_back(wire: str, tmp_path: Path) -> None:
    path = tmp_path / "logger.rec"
    with ModbusTemperature(f"{LOGGER}&{wire}&unit=4", QUICK, record=path) as thermometer:
        readings = [thermometer.read() for _ in range(3)]
    with ModbusTemperature(f"replay://{path}", QUICK) as thermometer:
        assert [thermometer.read() for _ in range(3)] == readings
        assert thermometer.line.simulated
        assert thermometer.line.unit == 4  # as in the recorded address


def test_a_session_with_gaps_plays_back_with_the_same_gaps(tmp_path: Path) -> None:
    path = tmp_path / "logger.rec"
    address = f"{LOGGER}&fault=drop&fault_at=2&fault_every=2"
    settings = QUICK.model_copy(update={"retry": 0.0})
    sessions: list[list[Any]] = []
    for where, record in ((address, path), (f"replay://{path}", None)):
        found: list[Any] = []
        with ModbusTemperature(where, settings, record=record) as thermometer:
            for _ in range(4):
                try:
                    found.append(thermometer.read())
                except InstrumentError:
                    found.append("gap")
        sessions.append(found)
    assert sessions[0] == sessions[1]
    assert sessions[0].count("gap") == 2


class Answering(Transport):
    """A serial line; a function of the request returns the answers."""

    def __init__(self, answer: Callable[[int], list[bytes]]) -> None:
        super().__init__("serial://test", 0.1)
        self.counts: list[int] = []
        self._answer, self._waiting = answer, b""

    def _send(self, data: bytes) -> None:
        self.counts.append(int.from_bytes(data[4:6], "big"))
        self._waiting += b"".join(self._answer(self.counts[-1]))

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        if not self._waiting:
            time.sleep(timeout)
            raise InstrumentTimeoutError("nothing")
        data, self._waiting = self._waiting[:max_bytes], self._waiting[max_bytes:]
        return data

    def close(self) -> None:
        """Nothing to close."""


def rtu(*values: int) -> bytes:
    frame = bytes((1, 3, 2 * len(values))) + b"".join(value.to_bytes(2, "big") for value in values)
    return frame + crc16(frame)


@pytest.mark.parametrize("count", [1, 2])
def test_an_answer_that_waits_for_the_next_request_is_not_taken_for_its_answer(count: int) -> None:
    held: list[bytes] = []

    def answer(n: int) -> list[bytes]:
        frame = rtu(*[len(device.counts)] * n)
        if len(device.counts) == 2:
            held.append(frame)
            return []
        found = [*held, frame]
        held.clear()
        return found

    device = Answering(answer)
    line = ModbusLine(device, "rtu", 1)
    assert line.registers(3, 0, count) == [1] * count
    with pytest.raises(InstrumentTimeoutError):
        line.registers(3, 0, count)
    assert line.registers(3, 0, count) == [4] * count  # the third request is that with an answer of another length
    assert device.counts == [count, count, 3 - count, count]
    assert line.registers(3, 0, count) == [5] * count


def test_a_device_that_is_silent_at_the_other_length_is_read_again() -> None:
    device = Answering(lambda n: [rtu(*[7] * n)] if n == 2 and len(device.counts) != 2 else [])
    line = ModbusLine(device, "rtu", 1)
    assert line.registers(3, 0, 2) == [7, 7]
    for _ in range(2):
        with pytest.raises(InstrumentTimeoutError):
            line.registers(3, 0, 2)
    assert line.registers(3, 0, 2) == [7, 7]
    assert device.counts == [2, 2, 1, 2]
