"""The reader thread and its bounded queue."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.streaming import Chunk, Reader
from errormotion.instruments.transports import Transport

OVERRUN = 9


class Tap(Transport):
    """A source of the bytes of a test; each byte is a sample of that value, capitals are text."""

    def __init__(self, flow_control: bool) -> None:
        super().__init__("tap://", timeout=1.0)
        self.flow_control = flow_control
        self.waiting: list[bytes] = []
        self.change = threading.Condition()
        self.reported: list[int] = []

    def put(self, data: bytes) -> None:
        with self.change:
            self.waiting.append(data)
            self.change.notify_all()

    def taken(self) -> None:
        """Wait until the thread reads again."""
        with self.change:
            assert self.change.wait_for(lambda: not self.waiting, 5.0)

    def report_delivered(self, samples: int) -> None:
        self.reported.append(samples)

    def _send(self, data: bytes) -> None:
        self.put(b"OK>")

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        with self.change:
            if not self.change.wait_for(lambda: bool(self.waiting), timeout):
                raise InstrumentTimeoutError("silent")
            data = self.waiting.pop(0)
            self.change.notify_all()
        if data == b"!":
            raise InstrumentError("the cable is cut")
        return data

    def close(self) -> None:
        pass


def decode(data: bytes) -> Chunk:
    if data.endswith(b"$"):
        return replace(decode(data[:-1]), end=ProtocolError("this was the last one"))
    if data == b"?":
        raise ProtocolError("these are no samples")
    numbers = np.frombuffer(bytes(byte for byte in data if byte < 32), dtype=np.uint8)
    return Chunk(numbers.astype(float), np.zeros(numbers.size, dtype=np.uint8), bytes(b for b in data if b >= 32))


@pytest.fixture
def tap(request: pytest.FixtureRequest) -> Tap:
    return Tap(getattr(request, "param", True))


@pytest.fixture
def reader(tap: Tap) -> object:
    thread = Reader(tap, decode, name="tap", limit=4, overrun=OVERRUN, prompt=b">")
    yield thread
    thread.abandon()


def fill(reader: Reader, size: int, timeout: float = 1.0) -> tuple[list[float], list[int]]:
    values, reasons = np.empty(size), np.empty(size, dtype=np.uint8)
    reader.fill(values, reasons, timeout)
    return values.tolist(), reasons.tolist()


def test_samples_are_in_order_whatever_the_pieces(tap: Tap, reader: Reader) -> None:
    for piece in (b"\1\2\3", b"\4", b"\5\6"):
        tap.put(piece)
    assert fill(reader, 2)[0] == [1, 2]
    assert fill(reader, 4)[0] == [3, 4, 5, 6]
    assert tap.reported == [2, 6]


def test_a_full_queue_holds_the_device_back(tap: Tap, reader: Reader) -> None:
    tap.put(b"\1\2\3\4")
    tap.put(b"\5")
    tap.taken()
    tap.put(b"\6")  # not read from the device: the thread waits with \5
    assert fill(reader, 6)[0] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("tap", [False], indirect=True)
def test_unread_samples_are_discarded_and_counted_at_their_position(tap: Tap, reader: Reader) -> None:
    for piece in (b"\1\2\3\4", b"\5\6", b"\7"):
        tap.put(piece)
    tap.put(b"\7")
    tap.taken()
    values, reasons = fill(reader, 7)
    assert values[:4] == [1, 2, 3, 4]
    assert np.isnan(values[4:]).all()
    assert reasons == [0] * 4 + [OVERRUN] * 3


def test_an_answer_gets_through_a_full_queue(tap: Tap, reader: Reader) -> None:
    for piece in (b"\1\2\3\4", b"\5\6", b"\7"):
        tap.put(piece)
    assert reader.query(b"hello", 2.0) == b"OK>"
    assert fill(reader, 7)[0] == [1, 2, 3, 4, 5, 6, 7]


def test_unrequested_bytes_are_counted(tap: Tap, reader: Reader) -> None:
    tap.put(b"AB\1C")
    assert fill(reader, 1)[0] == [1]
    assert reader.stray_bytes == 3


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [(b"!", InstrumentError, "tap: the cable is cut"), (b"?", ProtocolError, "tap: these are no samples")],
)
def test_an_error_in_the_thread_is_raised_after_the_previous_samples(
    tap: Tap, reader: Reader, data: bytes, error: type[InstrumentError], message: str
) -> None:
    tap.put(b"\1\2")
    tap.put(data)
    assert fill(reader, 2)[0] == [1, 2]
    with pytest.raises(error, match=message):
        fill(reader, 1)
    with pytest.raises(error, match=message):
        reader.query(b"hello", 1.0)


def test_silence_is_a_timeout_error(reader: Reader) -> None:
    with raises("instrument.no_answer"):
        fill(reader, 1, timeout=0.05)


def test_stopping_ends_the_thread_even_if_the_samples_are_not_read(tap: Tap, reader: Reader) -> None:
    for piece in (b"\1\2\3\4", b"\5\6", b"\7"):
        tap.put(piece)
    assert reader.stop(b"stop", 2.0) == b"OK>"
    assert not any(thread.name == "reader-tap" for thread in threading.enumerate())


def test_samples_may_have_any_shape(tap: Tap) -> None:
    def pairs(data: bytes) -> Chunk:
        rows = np.frombuffer(data, dtype=np.uint8).reshape(-1, 2).astype(np.uint32)
        return Chunk(rows, np.zeros(len(rows), dtype=np.uint8))

    reader = Reader(tap, pairs, name="tap", limit=4, overrun=OVERRUN)
    tap.put(b"\1\2\3\4")
    tap.put(b"\5\6")
    values, reasons = np.empty((3, 2), dtype=np.uint32), np.empty(3, dtype=np.uint8)
    reader.fill(values, reasons, 1.0)
    reader.abandon()
    assert values.tolist() == [[1, 2], [3, 4], [5, 6]]
    assert tap.reported == [3]


def test_a_stream_that_ends_unexpectedly_first_returns_its_last_samples(tap: Tap, reader: Reader) -> None:
    tap.put(b"\1\2$")
    assert fill(reader, 2)[0] == [1, 2]
    with raises("protocol.other"):
        fill(reader, 1)


def test_finishing_waits_for_the_end_of_the_stream_and_reports_its_reason(tap: Tap, reader: Reader) -> None:
    tap.put(b"\1\2")
    threading.Timer(0.1, tap.put, [b"\3$"]).start()
    ended = reader.finish(quiet=5.0, timeout=5.0)
    assert isinstance(ended, ProtocolError)
    assert "the last one" in str(ended)


def test_finishing_treats_silence_as_the_end(tap: Tap, reader: Reader) -> None:
    tap.put(b"\1\2")
    start = time.monotonic()
    assert reader.finish(quiet=0.1, timeout=60.0) is None
    assert time.monotonic() - start < 30.0
    assert not any(thread.name == "reader-tap" for thread in threading.enumerate())


def test_a_device_that_does_not_stop_is_a_timeout_error(tap: Tap, reader: Reader) -> None:
    def never_silent(max_bytes: int, timeout: float) -> bytes:
        time.sleep(0.01)
        return b"\1"

    tap._receive = never_silent  # type: ignore[method-assign]
    tap.put(b"\1")
    with raises("stream.not_stopped"):
        reader.finish(quiet=0.2, timeout=0.3)
    assert not any(thread.name == "reader-tap" for thread in threading.enumerate())
