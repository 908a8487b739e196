"""Commands of the LJ-X8000A's driver: late, repeated, split and missing replies."""

import struct
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from coded import raises

from errormotion.errors import InstrumentTimeoutError
from errormotion.instruments.line_profiler.keyence_ljx import KeyenceLJX, LJXSettings
from errormotion.instruments.transports.loopback.serving import TcpServer

TIMEOUT = 0.3  # s


def answer(command: int, data: bytes = b"", *, program: int = 0, echo: bool = True) -> bytes:
    """A reply as the device's page describes it, written without the codec."""
    head = bytearray(28)
    struct.pack_into("<I", head, 0, 24 + len(data))
    struct.pack_into("<I", head, 12, 12 + len(data))
    head[16], head[24] = command * echo, program
    return bytes(head) + data


class Controller:
    """Answers with the count of its requests; the answer to one request may be different."""

    def __init__(self) -> None:
        self.requests: list[int] = []
        self.echo = True
        self.otherwise: dict[int, Callable[[bytes], None]] = {}  # by the number of the request
        self._rest = b""
        self.commands = TcpServer("commands", self._receive)
        self.stream = TcpServer("stream", lambda _: None)
        self.commands.start()
        self.stream.start()
        self.address = f"{self.commands.url}?stream={self.stream.url.rpartition(':')[2]}"

    def _receive(self, data: bytes) -> None:
        self._rest += data
        while len(self._rest) >= 20:
            size = struct.unpack_from("<I", self._rest)[0] + 4
            frame, self._rest = self._rest[:size], self._rest[size:]
            opcode = frame[16]
            number = len(self.requests)
            self.requests.append(opcode)
            reply = answer(opcode, struct.pack("<IiII", number, -number, 0, 0), program=number % 16, echo=self.echo)
            self.otherwise.get(number, self.commands.send)(reply)

    def close(self) -> None:
        self.commands.close()
        self.stream.close()


@pytest.fixture
def controller() -> Iterator[Controller]:
    device = Controller()
    yield device
    device.close()


def opened(controller: Controller) -> KeyenceLJX:
    profiler = KeyenceLJX(controller.address, LJXSettings(timeout=TIMEOUT))
    profiler.open()
    return profiler


def test_a_late_reply_is_not_taken_for_the_next_one(controller: Controller) -> None:
    profiler = opened(controller)
    held: list[bytes] = []
    number = len(controller.requests)
    controller.otherwise[number] = held.append
    with raises("instrument.no_answer"):
        profiler.counts()
    controller.otherwise[number + 1] = lambda reply: [controller.commands.send(part) for part in (*held, reply)]
    assert profiler.counts().trigger == number + 2  # its own request; number + 1 was the one that synchronises
    assert controller.requests[number + 1] != controller.requests[number]
    assert profiler.counts().trigger == number + 3
    profiler.close()


def test_a_reply_that_breaks_off_is_completed_later(controller: Controller) -> None:
    profiler = opened(controller)
    number = len(controller.requests)
    rest: list[bytes] = []

    def half(reply: bytes) -> None:
        controller.commands.send(reply[:10])
        rest.append(reply[10:])

    controller.otherwise[number] = half
    with raises("instrument.no_answer"):
        profiler.counts()
    controller.otherwise[number + 1] = lambda reply: [controller.commands.send(part) for part in (*rest, reply)]
    assert profiler.counts().trigger == number + 2
    profiler.close()


def test_a_reply_sent_twice_shifts_no_later_one(controller: Controller) -> None:
    profiler = opened(controller)
    number = len(controller.requests)
    for i in (0, 2):
        controller.otherwise[number + i] = lambda reply: controller.commands.send(2 * reply)
    assert profiler.counts().trigger == number
    assert profiler.program() == (number + 1) % 16
    assert profiler.counts().trigger == number + 2
    time.sleep(0.1)  # the second copy has arrived
    assert profiler.counts().trigger == number + 3
    profiler.close()


def test_a_device_that_misses_two_requests_is_connected_again(controller: Controller) -> None:
    profiler = opened(controller)
    number = len(controller.requests)
    for i in range(2):
        controller.otherwise[number + i] = lambda reply: None
    with pytest.raises(InstrumentTimeoutError):
        profiler.counts()
    assert profiler.counts().trigger == len(controller.requests) - 1
    assert profiler.program() == (len(controller.requests) - 1) % 16
    profiler.close()


def test_a_device_that_stays_silent_gives_typed_errors_until_it_answers(controller: Controller) -> None:
    profiler = opened(controller)
    number = len(controller.requests)
    for i in range(4):
        controller.otherwise[number + i] = lambda reply: None
    for _ in range(3):  # the command; another one and the start of a session; the start of the next session
        with raises("instrument.no_answer"):
            profiler.counts()
    assert profiler.counts().trigger == len(controller.requests) - 1
    profiler.close()


def test_a_reply_that_comes_after_the_next_one_is_not_taken_for_it(controller: Controller) -> None:
    """Later than the driver's synchronisation request: the answer is lost with its connection."""
    profiler = opened(controller)
    number = len(controller.requests)
    held: list[bytes] = []
    controller.otherwise[number] = held.append
    controller.otherwise[number + 1] = held.append
    with pytest.raises(InstrumentTimeoutError):
        profiler.counts()
    controller.otherwise[number + 2] = lambda reply: [controller.commands.send(part) for part in (*held, reply)]
    for _ in range(3):
        assert profiler.counts().trigger == len(controller.requests) - 1
    profiler.close()


def test_without_the_number_of_the_command_a_missed_reply_is_lost_with_its_connection(controller: Controller) -> None:
    controller.echo = False
    profiler = opened(controller)
    number = len(controller.requests)
    assert profiler.counts().trigger == number
    controller.otherwise[number + 1] = lambda reply: None
    with pytest.raises(InstrumentTimeoutError):
        profiler.counts()
    for _ in range(3):
        assert profiler.counts().trigger == len(controller.requests) - 1
    profiler.close()


def test_endless_replies_to_other_commands_are_a_protocol_error(controller: Controller) -> None:
    profiler = opened(controller)
    controller.otherwise[len(controller.requests)] = lambda reply: controller.commands.send(20 * answer(0x06))
    with raises("protocol.reply.stale"):
        profiler.counts()
    profiler.close()


def test_no_thread_is_left(controller: Controller) -> None:
    before = set(threading.enumerate())
    opened(controller).close()
    assert set(threading.enumerate()) <= before | {controller.commands._thread, controller.stream._thread}


def test_a_long_gap_in_a_stream_is_counted_and_the_next_block_starts_after_it(controller: Controller) -> None:
    layout = bytearray(28)
    struct.pack_into("<i", layout, 4, 1)
    struct.pack_into("<HHii", layout, 16, 8, 10, 0, 1000)

    def packed(trigger: int) -> bytes:
        words = (0, trigger, 0, 0, 0, 0, *([0] * 5))
        return struct.pack("<12I", *words, sum(words))

    def react(reply: bytes) -> None:
        if reply[16] == 0x47:
            reply = answer(0x47, bytes(layout))
        controller.commands.send(reply)
        if reply[16] == 0xA0:
            controller.stream.send(b"".join(packed(count) for count in (7, 8, 5008, 5009, 5010, 5011, 5012)))
        if reply[16] == 0x48:
            controller.stream.send(struct.pack("<II", 0xFFFFFFFF, 1))

    profiler = opened(controller)
    controller.otherwise = dict.fromkeys(range(1000), react)
    stream = profiler.stream(4)
    first, second = next(stream), next(stream)
    stream.close()
    profiler.close()
    assert (first.first, first.dropped, first.trigger.tolist()) == (0, 4999, [7, 8, 9, 10])
    assert (second.first, second.dropped, second.trigger.tolist()) == (5001, 0, [5008, 5009, 5010, 5011])
    assert first.values[0].tolist()[:2] == [0.0, 0.0]
    assert all(value != value for value in first.values[0][2:])  # NaN
