"""Foreign Modbus implementations: clients against the simulator, the server of libmodbus against the driver."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager

import minimalmodbus
import pytest
import serial
from coded import raises
from libmodbus import Client, installed, served
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ModbusIOException
from pymodbus.framer import FramerRTU, FramerType
from pymodbus.pdu import DecodePDU
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.thermometer.modbus import SimulatedModbus
from errormotion.instruments.thermometer.modbus_temperature import ModbusTemperature
from errormotion.instruments.thermometer.registers import ModbusSettings
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.loopback.serving import TcpServer
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
        with raises("modbus.refused"):
            thermometer.read()


# ------------------------------------------------------------------ why pymodbus is not the client: decision 7

FRAME = codec.encode_answer("rtu", 0x50, 3, [1, 2])
DAMAGED = FRAME[:-1] + bytes((FRAME[-1] ^ 1,))


@contextmanager
def answering(answer: bytes) -> Iterator[int]:
    """Answer everything with the same bytes; yield the port."""
    server = TcpServer("modbus", lambda data: server.send(answer) if answer else None)
    server.start()
    try:
        yield parse_address(server.url).port
    finally:
        server.close()


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b"", "unit 80 did not answer"),
        (DAMAGED, "has the checksum"),
        (codec.encode_answer("rtu", 0x51, 3, [1, 2]), "answer of unit 80; found that of unit 81"),
        (b"\0" + FRAME, "expected"),
    ],
    ids=["silence", "checksum", "another unit", "a stray byte"],
)
def test_the_client_of_pymodbus_reports_faults_as_silence_or_passes_over_them(answer: bytes, message: str) -> None:
    with answering(answer) as port:
        theirs = ""
        with ModbusTcpClient("127.0.0.1", port=port, framer=FramerType.RTU, timeout=0.3, retries=0) as client:
            try:
                client.read_holding_registers(0, count=2, device_id=0x50)
            except ModbusIOException as error:
                theirs = str(error)
        assert not theirs if answer[:1] == b"\0" else "No response received" in theirs
        ours = ModbusTemperature(
            f"modbus+rtu-tcp://127.0.0.1:{port}?unit=80", ModbusSettings(channels=("a", "b"), timeout=0.3)
        )
        with pytest.raises(InstrumentError, match=f"(?i){message}"):
            ours.open()


@pytest.mark.parametrize("zeros", [0, 1, 3])
@pytest.mark.parametrize("echo", [False, True])
def test_two_wires_with_echo_and_zeros_are_read(echo: bool, zeros: int) -> None:
    def reply(data: bytes) -> None:
        answer = codec.encode_answer("rtu", 1, 3, [201, 202][: data[5]])
        server.send((data if echo else b"") + bytes(zeros) + answer)

    server = TcpServer("modbus", reply)
    server.start()
    url = f"modbus+rtu-tcp://127.0.0.1:{parse_address(server.url).port}?unit=1"
    settings = ModbusSettings(channels=("a", "b"), scale=0.1, timeout=2.0, echo=echo, leading_zeros=bool(zeros))
    try:
        with ModbusTemperature(url, settings) as thermometer:
            assert [thermometer.read() for _ in range(2)] == [pytest.approx({"a": 20.1, "b": 20.2})] * 2
        if echo and not zeros:
            plain = settings.model_copy(update={"echo": False})
            with pytest.raises(ProtocolError, match="The line returns the request: set 'echo' to true"):
                ModbusTemperature(url, plain).open()
    finally:
        server.close()


def test_the_framers_of_pymodbus_pass_over_stray_bytes_and_other_units() -> None:
    framer = FramerRTU(DecodePDU(is_server=False))
    assert framer.decode(b"\0" + FRAME)[3] == FRAME[1:-2]
    assert framer.handleFrame(FRAME, 0x51, 0) == (len(FRAME), None)
    with pytest.raises(ProtocolError, match="checksum"):
        codec.decode_answer("rtu", b"\0" + FRAME, 0x50, 3, 2)
    with raises("protocol.modbus.unit"):
        codec.decode_answer("rtu", FRAME, 0x51, 3, 2)


def test_answers_to_other_requests_are_named_where_none_came_to_this_one() -> None:
    old = codec.encode_answer("tcp", 1, 3, [1, 2], 65535)
    with answering(old) as port:
        thermometer = ModbusTemperature(
            f"modbus+tcp://127.0.0.1:{port}?unit=1", ModbusSettings(channels=("a", "b"), timeout=0.3)
        )
        with pytest.raises(InstrumentTimeoutError, match="but 1 answer to other requests was discarded"):
            thermometer.open()


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
    assert refused.value.number == vector.expected["code"]


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
