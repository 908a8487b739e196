"""Foreign Modbus implementations: clients against the simulator, the server of libmodbus against the driver."""

import struct
from collections.abc import Iterator

import minimalmodbus
import pytest
import serial
from libmodbus import Client, installed, served
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from wire_vectors import Vector, vectors

from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.thermometer.modbus import SimulatedModbus
from errormotion.instruments.thermometer.modbus_temperature import ModbusTemperature
from errormotion.instruments.thermometer.registers import ModbusSettings
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.modbus import codec

UNIT, FIRST = 5, 32
NAMES = ("frame", "ambient", "spindle_front", "spindle_rear", "column")
TIMEOUT = 10.0  # s


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator[SimulatedModbus]:
    found = SimulatedModbus(
        parse_address(f"sim://cframe/logger?seed=3&map=logger-16&noise=0&unit={UNIT}&{request.param}")
    )
    yield found
    found.close()


def truth() -> list[int]:
    twin = world("cframe", 3).machine
    found = dict(zip(twin.temperature_sensors, twin.temperatures([0.0])[0], strict=True))
    return [round(10 * found[name]) for name in NAMES]


on = pytest.mark.parametrize
needs_libmodbus = pytest.mark.skipif(not installed(), reason="libmodbus is not installed (Debian package libmodbus5)")
TCP, LINE = "wire=tcp", "wire=pty"


@needs_libmodbus
@on("device", [TCP, LINE], indirect=True)
def test_libmodbus_reads_the_simulator(device: SimulatedModbus) -> None:
    place = parse_address(device.url)
    tcp = device.url.startswith("tcp")
    client = Client(port=place.port, unit=UNIT) if tcp else Client(path=place.path, unit=UNIT)
    try:
        assert client.read(FIRST, 5) == truth()
        assert client.read(FIRST + 2, 1) == truth()[2:3]
        assert client.read(FIRST, 6) == -2
        assert client.read(FIRST, 1, function=4) == -1
        assert client.write(FIRST, 7) == -1
        assert client.read(FIRST, 5) == truth()
        for count in (0, 126):
            answer = client.raw(bytes((UNIT, 3, 0, FIRST, 0, count)))
            assert answer[-2:] == b"\x83\x03" if tcp else answer[:3] == bytes((UNIT, 0x83, 3))
    finally:
        client.close()


@on("device", [LINE], indirect=True)
def test_minimalmodbus_reads_the_simulator(device: SimulatedModbus) -> None:
    with serial.Serial(
        parse_address(device.url).path, 9600, timeout=1.0
    ) as line:  # awaits whole answers, also refusals
        client = minimalmodbus.Instrument(line, UNIT)
        assert client.read_registers(FIRST, 5) == truth()
        assert client.read_register(FIRST, 1) == pytest.approx(truth()[0] / 10)
        with pytest.raises(minimalmodbus.IllegalRequestError, match="illegal data address"):
            client.read_register(FIRST + 5)
        with pytest.raises(minimalmodbus.IllegalRequestError, match="illegal function"):
            client.read_register(FIRST, functioncode=4)


@on("device", [TCP, LINE], indirect=True)
def test_pymodbus_reads_the_simulator(device: SimulatedModbus) -> None:
    place = parse_address(device.url)
    client: ModbusTcpClient | ModbusSerialClient
    if device.url.startswith("tcp"):
        client = ModbusTcpClient("127.0.0.1", port=place.port, timeout=TIMEOUT)
    else:
        client = ModbusSerialClient(place.path, baudrate=9600, timeout=TIMEOUT)
    with client:
        assert client.read_holding_registers(FIRST, count=5, device_id=UNIT).registers == truth()
        refused = client.read_holding_registers(FIRST, count=6, device_id=UNIT)
        assert (refused.function_code, refused.exception_code) == (0x83, 2)
        refused = client.read_coils(0, count=1, device_id=UNIT)
        assert (refused.function_code, refused.exception_code) == (0x81, 1)
        assert client.read_holding_registers(FIRST, count=5, device_id=UNIT).registers == truth()


@needs_libmodbus
@pytest.mark.parametrize("function", [3, 4])
def test_the_driver_reads_a_server_of_libmodbus(function: int) -> None:
    words = [*struct.unpack(">2H", struct.pack(">f", 20.25)), *struct.unpack(">2H", struct.pack(">f", -3.5))]
    settings = ModbusSettings(
        channels=("air", "bed"), function=function, first=100, type="f32", unit=7, timeout=TIMEOUT
    )
    with (
        served(words, first=100, unit=7) as port,
        ModbusTemperature(f"modbus+tcp://127.0.0.1:{port}", settings) as thermometer,
    ):
        assert thermometer.read() == {"air": 20.25, "bed": -3.5}
        thermometer.configure(ModbusSettings(channels=("air", "bed"), function=function, first=200, unit=7))
        with pytest.raises(codec.ModbusRefusal, match="illegal data address"):
            thermometer.read()


# ------------------------------------------------------------------ the client's frames against the specification


def named(layer: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors("modbus_temperature", layer), ids=str)


@named("request pdu")
def test_requests_of_the_specification(vector: Vector) -> None:
    expected = vector.expected
    frame = codec.encode_request("tcp", 1, expected["function"], expected["first"], expected["count"])
    assert frame[7:] == vector.data


@named("answer pdu")
def test_answers_of_the_specification(vector: Vector) -> None:
    function, registers = vector.expected["function"], vector.expected["registers"]
    body = b"\x01" + vector.data
    assert codec.decode_answer("rtu", body + codec.crc16(body), 1, function, len(registers)) == registers


@named("exception pdu")
def test_exceptions_of_the_specification(vector: Vector) -> None:
    body = b"\x01" + vector.data
    with pytest.raises(codec.ModbusRefusal) as refused:
        codec.decode_answer("rtu", body + codec.crc16(body), 1, vector.expected["function"], 1)
    assert refused.value.code == vector.expected["code"]


@named("checksum")
def test_checksum_of_the_guide(vector: Vector) -> None:
    assert codec.crc16(vector.data).hex() == vector.expected["checksum"]


@pytest.mark.parametrize("framing", ["tcp", "rtu"])
def test_whole_requests_and_answers(framing: str) -> None:
    for vector in vectors("modbus_temperature", f"{framing} request"):
        expected = vector.expected
        where = (expected["unit"], expected["function"])
        number = expected.get("number", 0)
        frame = codec.encode_request(framing, *where, expected["first"], expected["count"], number)  # type: ignore[arg-type]
        assert frame == vector.data
        answer = bytes.fromhex(expected["answer"])
        assert codec.decode_answer(framing, answer, *where, expected["count"], number) == expected["registers"]  # type: ignore[arg-type]
