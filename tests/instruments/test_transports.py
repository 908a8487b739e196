"""Addresses and transports."""

import socket
from pathlib import Path

import pytest
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.transports import Transport, open_transport, parse_address, serial_line
from errormotion.instruments.transports.base import LINE_ENDS
from errormotion.instruments.transports.half_duplex import HalfDuplexTransport
from errormotion.instruments.transports.loopback.serving import Server, TcpServer, make_server


class Echo:
    """A device that returns received bytes in capitals."""

    def __init__(self, wire: str) -> None:
        self.server: Server = make_server(wire, "echo", self._answer)
        self.server.start()

    def _answer(self, data: bytes) -> None:
        self.server.send(data.upper())


@pytest.fixture(params=["tcp", "pty"])
def echo(request: pytest.FixtureRequest) -> object:
    device = Echo(request.param)
    yield device
    device.server.close()


@pytest.fixture
def line(echo: Echo) -> object:
    transport = open_transport(echo.server.url, timeout=1.0)
    yield transport
    transport.close()


@pytest.mark.parametrize(
    ("url", "scheme", "host", "port", "path"),
    [
        ("serial:///dev/ttyUSB0?baudrate=921600", "serial", "", None, "/dev/ttyUSB0"),
        ("tcp://192.168.0.2:23", "tcp", "192.168.0.2", 23, ""),
        ("sim://cframe/X1?seed=3", "sim", "cframe", None, "X1"),
        ("sim://", "sim", "", None, ""),
        ("replay://runs/a b?.rec", "replay", "", None, "runs/a b?.rec"),
        ("replay:///tmp/x.rec", "replay", "", None, "/tmp/x.rec"),
    ],
)
def test_an_address_is_parsed(url: str, scheme: str, host: str, port: int | None, path: str) -> None:
    address = parse_address(url)
    assert (address.scheme, address.host, address.port, address.path) == (scheme, host, port, path)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("/dev/ttyUSB0", "such as serial:///dev/ttyUSB0"),
        ("ftp://x:1", "such as"),
        ("tcp://host", "tcp://HOST:PORT"),
        ("tcp://host:abc", "cannot be read"),
        ("serial://", "serial:///dev/NAME"),
        ("replay://", "Expected the file of a recording"),
        ("sim://cframe/X1?seed", "cannot be read"),
    ],
)
def test_a_wrong_address_is_refused_with_an_example(url: str, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        parse_address(url)


def test_a_parameter_that_is_no_number_is_named() -> None:
    with pytest.raises(InstrumentError, match=r"'seed'.*expected a number; found 'three'"):
        parse_address("sim://cframe/X1?seed=three").number("seed", 0)


def test_bytes_are_sent_and_received(line: Transport) -> None:
    line.write(b"hello")
    assert line.read_until(b"O") == b"HELLO"


def test_bytes_after_a_terminator_are_kept_for_the_next_read(line: Transport) -> None:
    line.write(b"one;two;three")
    assert line.read_until(b";") == b"ONE;"
    assert line.read(1) == b"T"
    assert line.read_until(b";") == b"WO;"
    assert line.read_until(b"E", limit=100) == b"THRE"


def test_silence_becomes_a_timeout_error_with_the_received_bytes(line: Transport) -> None:
    line.write(b"half")
    with pytest.raises(InstrumentTimeoutError, match=r"received b'HALF'"):
        line.read_until(b";", timeout=0.2)
    with raises("instrument.no_answer"):
        line.read(timeout=0.05)


def test_a_number_of_bytes_is_read_whatever_the_pieces(line: Transport) -> None:
    line.write(b"one;two")
    assert line.read_until(b";") == b"ONE;"
    assert line.read_exactly(2) == b"TW"
    with pytest.raises(InstrumentTimeoutError, match=r"expected 4 bytes within 0\.2 s; received 1"):
        line.read_exactly(4, timeout=0.2)
    assert line.read_exactly(0) == b""


def test_an_endless_line_becomes_a_protocol_error(line: Transport) -> None:
    line.write(b"x" * 100)
    with raises("protocol.reply.too_long"):
        line.read_until(b";", limit=10)


def test_a_closed_transport_is_reported(line: Transport) -> None:
    line.close()
    line.close()
    with raises("connection.closed"):
        line.write(b"x")
    with raises("connection.closed"):
        line.read()


def test_a_broken_tcp_connection_is_an_instrument_error_and_can_be_opened_again() -> None:
    echo = Echo("tcp")
    first = open_transport(echo.server.url)
    first.write(b"a")
    assert first.read() == b"A"
    echo.server.disconnect()
    with raises("connection.lost"):
        first.read()
    first.close()
    second = open_transport(echo.server.url)
    second.write(b"b")
    assert second.read() == b"B"
    second.close()
    echo.server.close()


def test_an_address_without_a_server_is_an_instrument_error(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with raises("connection.not_opened"):
        open_transport(f"tcp://127.0.0.1:{port}")
    with raises("connection.not_opened"):
        open_transport(f"serial://{tmp_path}/none?baudrate=9600")


@pytest.mark.parametrize(
    ("simulator", "code"),
    [
        (None, "simulator.missing"),
        ("errormotion.nowhere:X", "simulator.not_loaded"),
        ("errormotion.errors:X", "simulator.not_loaded"),
    ],
)
def test_a_missing_simulator_is_named(simulator: str | None, code: str) -> None:
    with raises(code):
        open_transport("sim://cframe/X1", simulator=simulator)


def test_a_server_reports_whether_a_client_is_connected() -> None:
    server = TcpServer("quiet", lambda data: None)
    server.start()
    assert not server.await_connection(0.01)
    assert not server.send(b"lost")
    line = open_transport(server.url)
    assert server.await_connection(1.0)
    assert server.send(b"heard")
    assert line.read_exactly(5) == b"heard"
    line.close()
    server.close()


def test_an_unknown_wire_is_refused() -> None:
    with raises("simulator.wire.unknown"):
        make_server("smoke", "x", lambda data: None)


# ------------------------------------------------------------------ serial lines, two wires, ends of lines


def test_data_bits_and_flow_control_of_a_serial_line_are_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[dict[str, object]] = []
    monkeypatch.setattr(serial_line.serial, "Serial", lambda path, speed, **more: opened.append(more))
    for query in ("", "?databits=7&parity=E&stopbits=2&xonxoff=1"):
        open_transport(f"serial:///dev/ttyUSB0{query}")
    assert [each["bytesize"] for each in opened] == [8, 7]
    assert [each["xonxoff"] for each in opened] == [False, True]
    assert [each["parity"] for each in opened] == ["N", "E"]
    for query in ("databits=6", "databits=9", "xonxoff=2"):
        with pytest.raises(InstrumentError, match=query.partition("=")[0]):
            open_transport(f"serial:///dev/ttyUSB0?{query}")


class Pieces(Transport):
    """A line that returns the given pieces, one by one."""

    def __init__(self, *pieces: bytes) -> None:
        super().__init__("serial:///dev/test", 0.05)
        self.pieces, self.sent = list(pieces), b""

    def _send(self, data: bytes) -> None:
        self.sent += data

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        if not self.pieces:
            raise InstrumentTimeoutError("nothing")
        data = self.pieces.pop(0)
        if len(data) > max_bytes:
            self.pieces.insert(0, data[max_bytes:])
        return data[:max_bytes]

    def close(self) -> None:
        """Nothing to close."""


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
@pytest.mark.parametrize("size", [1, 2, 3, 100])
def test_each_of_several_ends_ends_a_line(end: bytes, size: int) -> None:
    data = b"one" + end + b"two" + end + end + b"three" + end
    line = Pieces(*(data[i : i + size] for i in range(0, len(data), size)))
    assert [line.read_until(LINE_ENDS).strip(b"\r\n") for _ in range(3)] == [b"one", b"two", b"three"]
    with pytest.raises(InstrumentTimeoutError):
        line.read_until(LINE_ENDS)


REQUEST, ANSWER = b"\x01\x03\x00", b"\x01\x05\x00\x00"


@pytest.mark.parametrize("size", [1, 2, 5, 100])
@pytest.mark.parametrize(
    ("received", "echo", "zeros"),
    [
        (REQUEST + ANSWER, True, False),
        (REQUEST + b"\0\0" + ANSWER, True, True),
        (b"\0" + REQUEST + b"\0" + ANSWER, True, True),
        (b"\0\0\0" + ANSWER, False, True),
        (ANSWER, False, True),
    ],
)
def test_echo_and_leading_zeros_are_removed(size: int, received: bytes, echo: bool, zeros: bool) -> None:
    line = Pieces(*(received[i : i + size] for i in range(0, len(received), size)))
    wires = HalfDuplexTransport(line, echo=echo, zeros=zeros)
    wires.write(REQUEST)
    assert line.sent == REQUEST
    assert wires.read_exactly(len(ANSWER)) == ANSWER


def test_another_byte_in_the_echo_and_a_missing_echo_are_errors() -> None:
    wires = HalfDuplexTransport(Pieces(b"\x01\x04"), echo=True, zeros=False)
    wires.write(REQUEST)
    with raises("protocol.echo"):
        wires.read()
    wires = HalfDuplexTransport(Pieces(b"\x01"), echo=True, zeros=False)
    wires.write(REQUEST)
    with pytest.raises(InstrumentTimeoutError, match="expected the echo 03 00"):
        wires.read()
