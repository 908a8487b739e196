"""Requests over HTTP: lost connections, invalid answers, streams of parts, recordings."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import pytest
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.http import client
from errormotion.instruments.transports.http.client import HttpTransport
from errormotion.instruments.transports.http.serving import HttpServer

Respond = Callable[[str, Mapping[str, str]], Iterator[bytes] | None]
MULTIPART = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=x\r\n"


CHUNKED = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"


def answer(body: bytes, status: bytes = b"200 OK", head: bytes = b"") -> bytes:
    return b"HTTP/1.1 %s\r\nContent-Type: text/xml\r\n%sContent-Length: %d\r\n\r\n%s" % (status, head, len(body), body)


def part(body: bytes) -> bytes:
    return b"--x\r\nContent-type: text/xml\r\nContent-length: %d\r\n\r\n%s\r\n" % (len(body), body)


class Site:
    """A scripted server with an answer for each path."""

    def __init__(self) -> None:
        self.pages: dict[str, Iterable[bytes] | None] = {}
        self.asked: list[tuple[str, Mapping[str, str]]] = []
        self.server = HttpServer("site", self._respond)
        self.url = self.server.url.replace("tcp://", "http://")

    def _respond(self, path: str, query: Mapping[str, str]) -> Iterator[bytes] | None:
        self.asked.append((path, query))
        pieces = self.pages[path]
        return None if pieces is None else iter(pieces)


@pytest.fixture
def site() -> Iterator[Site]:
    made = Site()
    yield made
    made.server.close()


@pytest.fixture
def http(site: Site) -> Iterator[HttpTransport]:
    transport = HttpTransport(site.url, timeout=0.3)
    yield transport
    transport.close()


def test_an_address_has_a_host_and_perhaps_a_port_and_a_device() -> None:
    address = parse_address("http://agent:5000/vmc/")
    assert (address.scheme, address.host, address.port, address.path) == ("http", "agent", 5000, "vmc")
    assert parse_address("http://agent").port is None
    with pytest.raises(InstrumentError, match="http://HOST:PORT/PATH"):
        parse_address("http:///vmc")


def test_a_body_is_returned_with_its_status(site: Site, http: HttpTransport) -> None:
    site.pages["/current"] = [answer(b"<x/>")]
    site.pages["/a b"] = [answer(b"no", b"404 Not Found")]
    got = http.get("/current", {"path": "//Axes"})
    assert (got.status, got.content_type, got.body) == (200, "text/xml", b"<x/>")
    assert site.asked == [("/current", {"path": "//Axes"})]
    assert http.get("/a b").status == 404


def test_a_connection_that_the_server_ended_is_renewed(site: Site, http: HttpTransport) -> None:
    site.pages["/once"] = [answer(b"1", head=b"Connection: close\r\n")]
    site.pages["/gone"] = None
    assert [http.get("/once").body for _ in range(2)] == [b"1", b"1"]
    with raises("connection.lost"):
        http.get("/gone")
    assert len(site.asked) == 3  # a request on a new connection is not repeated
    assert http.get("/once").body == b"1"


def test_a_request_on_a_connection_that_ended_while_idle_is_repeated(site: Site, http: HttpTransport) -> None:
    site.pages["/kept"] = [answer(b"1")]
    site.pages["/gone"] = None
    http.get("/kept")
    with raises("connection.lost"):
        http.get("/gone")
    assert [path for path, _ in site.asked] == ["/kept", "/gone", "/gone"]


@pytest.mark.parametrize(
    ("page", "error", "message"),
    [
        ([b"\x00\xff" + answer(b"<x/>")], ProtocolError, "expected an HTTP answer"),
        ([b"* OK IMAP4 ready\r\n"], ProtocolError, "expected an HTTP answer"),
        ([answer(b"1")[:-5]], InstrumentTimeoutError, "sent no data"),
        ([], InstrumentTimeoutError, "sent no data"),
        ([answer(b"12345")[:-2], b""], ProtocolError, "incomplete: 2 bytes are missing"),
        ([answer(b"x" * 2000)], ProtocolError, "larger than 1000 bytes"),
        ([CHUNKED + b"zz\r\n"], ProtocolError, "damaged: expected a chunk size"),
        ([CHUNKED + b"5\r\nxxxxx\r\n", b""], ProtocolError, "ends between two chunks"),
        ([CHUNKED + b"5\r\nxxx", b""], ProtocolError, "ends within a chunk"),
        ([CHUNKED + b"-1\r\n" + b"x" * 50], ProtocolError, "expected a chunk size; found b'-1'"),
        ([CHUNKED + b"-5\r\n" + b"x" * 50], ProtocolError, "expected a chunk size; found b'-5'"),
        ([CHUNKED + b"0x5\r\nxxxxx\r\n0\r\n\r\n"], ProtocolError, "chunk size"),
        ([CHUNKED + b"1_0\r\n" + b"x" * 50], ProtocolError, "chunk size"),
        ([CHUNKED + b"fffffffff\r\n"], ProtocolError, "chunk size"),
        ([CHUNKED + b"5\r\nxxxxxxxxxx\r\n"], ProtocolError, "end of a chunk"),
        ([CHUNKED + b"ffffff\r\n" + b"x" * 3000], ProtocolError, "larger than 1000 bytes"),
        ([CHUNKED + b"0\r\n", *[b"X: 1\r\n"] * 200], ProtocolError, "more than 100 lines"),
        ([b"HTTP/1.1 200 OK\r\n", *[b"X: 1\r\n"] * 200], ProtocolError, "more than 100 lines"),
        ([b"HTTP/1.1 200 OK\r\nX: ", b"y" * 9000], ProtocolError, "longer than 8192 bytes"),
        ([b"HTTP/1.1 100 Continue\r\n\r\n"] * 20, ProtocolError, "only interim"),
        ([answer(b"1", head=b"Content-Length: 2\r\n")], ProtocolError, "two lengths"),
        ([b"HTTP/1.1 200 OK\r\nContent-Length: -1\r\n\r\n"], ProtocolError, "length of the body; found '-1'"),
        ([b"HTTP/1.1 200 OK\r\nTransfer-Encoding: gzip\r\n\r\n"], ProtocolError, "in chunks; found 'gzip'"),
        ([answer(b"1", head=b"Content-Encoding: gzip\r\n")], ProtocolError, "not compressed"),
    ],
)
def test_an_invalid_answer_is_an_error_and_the_next_one_is_correct(
    site: Site, http: HttpTransport, page: list[bytes], error: type[InstrumentError], message: str
) -> None:
    site.pages |= {"/bad": page, "/good": [answer(b"1")]}
    with pytest.raises(error, match=message):
        http.get("/bad", limit=1000)
    assert http.get("/good").body == b"1"


def slowly(head: bytes, piece: bytes, count: int) -> Iterator[bytes]:
    yield head
    for _ in range(count):
        time.sleep(0.02)
        yield piece


@pytest.mark.parametrize(
    ("head", "piece"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Length: 500\r\n\r\n", b"x"),
        (b"HTTP/1.1 200 OK\r\n\r\n", b"x"),
        (b"HTTP/1.1 200 OK\r\nX: ", b"y"),
        (CHUNKED, b"1\r\nx\r\n"),
        (CHUNKED + b"5;", b"x"),
        (b"H", b"T"),
    ],
)
@pytest.mark.parametrize("streamed", [False, True])
def test_a_slow_answer_ends_at_its_deadline(
    site: Site, head: bytes, piece: bytes, streamed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "_ANSWER_TIMEOUTS", 1.5)
    http = HttpTransport(site.url, timeout=0.3)
    site.pages["/slow"] = slowly(head, piece, 400)  # 8 s; the deadline is 0.45 s
    started = time.monotonic()
    with raises("instrument.no_answer"):
        list(http.parts("/slow")) if streamed else http.get("/slow")
    assert time.monotonic() - started < 6.0
    http.close()


def test_a_slow_part_ends_at_its_deadline(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "_ANSWER_TIMEOUTS", 1.5)
    http = HttpTransport(site.url, timeout=0.3)
    site.pages["/sample"] = slowly(MULTIPART + b"\r\n" + part(b"1") + b"--x\r\nContent-length: 999\r\n\r\n", b"x", 150)
    stream = http.parts("/sample")
    assert next(stream) == b"1"
    with raises("instrument.no_answer"):
        next(stream)
    http.close()


def test_a_stream_that_pauses_between_its_parts_has_no_deadline(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "_ANSWER_TIMEOUTS", 1.5)
    http = HttpTransport(site.url, timeout=0.3)
    site.pages["/sample"] = slowly(MULTIPART + b"\r\n", part(b"1"), 40)  # 0.8 s
    stream = http.parts("/sample")
    assert [next(stream) for _ in range(40)] == [b"1"] * 40
    http.close()


def test_bytes_after_an_answer_are_not_the_next_answer(site: Site, http: HttpTransport) -> None:
    site.pages |= {"/one": [answer(b"1") + answer(b"stale")], "/two": [answer(b"2")]}
    assert http.get("/one").body == b"1"
    assert http.get("/two").body == b"2"


@pytest.mark.parametrize("chunked", [False, True])
def test_parts_of_a_stream_are_returned_one_by_one(site: Site, http: HttpTransport, chunked: bool) -> None:
    parts = [part(body) for body in (b"<a/>", b"", b"<b>\r\n--y</b>")]
    if chunked:
        head = MULTIPART + b"Transfer-Encoding: chunked\r\n\r\n"
        whole = b"".join(b"%x\r\n%s\r\n" % (len(each), each) for each in parts) + b"0\r\n\r\n"
        site.pages["/sample"] = [head, whole]
    else:
        site.pages["/sample"] = [MULTIPART + b"Connection: close\r\n\r\n", *parts, b"--x--\r\n"]
    assert list(http.parts("/sample", {"interval": "10"})) == [b"<a/>", b"", b"<b>\r\n--y</b>"]
    site.pages["/current"] = [answer(b"1")]
    assert http.get("/current").body == b"1"


def test_an_answer_of_one_piece_is_a_stream_of_one_part(site: Site, http: HttpTransport) -> None:
    site.pages["/sample"] = [answer(b"<error/>")]
    assert list(http.parts("/sample")) == [b"<error/>"]


@pytest.mark.parametrize(
    ("rest", "code"),
    [
        (b"--other\r\n\r\n", "protocol.http.boundary"),
        (b"--x\r\nContent-length: 2000\r\n\r\n", "protocol.http.length"),
        (b"--x\r\nContent-length: -1\r\n\r\n", "protocol.http.length"),
        (b"--x\r\nContent-type: text/xml\r\n\r\n", "protocol.http.length"),
        (b"x" * 5000, "protocol.http.head"),
        (b"\r\n" * 40, "protocol.http.boundary"),
        (b"--x\r\n" + b"X: 1\r\n" * 200, "protocol.http.head"),
        (b"--x\r\nContent-length: 1_0\r\n\r\n", "protocol.http.length"),
    ],
)
def test_a_damaged_stream_is_an_error(site: Site, http: HttpTransport, rest: bytes, code: str) -> None:
    site.pages["/sample"] = [MULTIPART + b"\r\n", part(b"1"), rest]
    stream = http.parts("/sample", limit=1000)
    assert next(stream) == b"1"
    with raises(code):
        next(stream)


def test_a_silent_stream_is_a_timeout(site: Site, http: HttpTransport) -> None:
    site.pages["/sample"] = [MULTIPART + b"\r\n", part(b"1")]
    stream = http.parts("/sample")
    assert next(stream) == b"1"
    with pytest.raises(InstrumentTimeoutError):
        next(stream)


def test_a_session_plays_back_with_its_broken_connections(site: Site, tmp_path: Path) -> None:
    site.pages["/kept"] = [answer(b"1")]
    site.pages["/old"] = [b"HTTP/1.0 200 OK\r\n\r\nto the end", b""]
    site.pages["/gone"] = None
    path = tmp_path / "http.rec"

    def session(transport: HttpTransport) -> list[bytes]:
        with raises("connection.lost"):
            transport.get("/gone")
        bodies = [transport.get(page).body for page in ("/kept", "/old", "/kept")]
        transport.close()
        return bodies

    recorded = session(HttpTransport(site.url, recorder=path))
    assert recorded == [b"1", b"to the end", b"1"]
    assert session(HttpTransport(f"replay://{path}")) == recorded
    other = HttpTransport(f"replay://{path}")
    with raises("replay.write.differs"):
        other.get("/kept")


def test_other_addresses_are_refused() -> None:
    with raises("address.form"):
        HttpTransport("serial:///dev/ttyUSB0")
    with raises("connection.not_opened"):
        HttpTransport("http://127.0.0.1:9")
