"""Attacks on the server: idle connections, slow and large bodies, abandoned work, forged control; the stop works."""

import asyncio
import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import pytest

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion.dashboard import door, planning
from errormotion.dashboard.access import CONTROL_HEADER
from errormotion.dashboard.door import Budget, most_connections
from errormotion.dashboard.load import AT_ONCE
from errormotion.dashboard.pages import compare, compensate, login
from errormotion.errors import RunError

SOON = 10.0
"""Time for an answer under attack, on a computer with other work, s."""
FORM = "application/x-www-form-urlencoded"


@pytest.fixture(scope="module")
def served(serving: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("attacked")
    return serving(folder / "runs", campaigns=folder, control=True)


def connected(served: Any) -> socket.socket:
    where = urlsplit(served.address)
    return socket.create_connection((str(where.hostname), int(where.port or 0)), timeout=SOON)


def head_of(served: Any, path: str, length: int = -1) -> bytes:
    """Return the header of a request of a known client: GET without a body, POST with one of a length."""
    host = urlsplit(served.address).netloc
    head = f"{'GET' if length < 0 else 'POST'} {path} HTTP/1.1\r\nHost: {host}\r\nCookie: {served.cookie}\r\n"
    if length >= 0:
        head += f"Origin: http://{host}\r\nContent-Type: application/json\r\nContent-Length: {length}\r\n"
    return f"{head}\r\n".encode()


def stop(served: Any, **headers: str) -> int:
    """Request the stop of a compensation that does not exist; 400 if the request was admitted."""
    own = {"Content-Type": FORM, "Origin": served.address.rstrip("/"), "Accept": "application/json", **headers}
    return int(served.ask("/compensate/stop", "POST", urlencode({"run": "none"}), **own)[0])


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + SOON
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def is_closed(line: socket.socket) -> bool:
    """Return whether the server has closed a connection."""
    line.setblocking(False)
    try:
        return line.recv(1 << 16) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def test_idle_connections_do_not_keep_the_stop_out(served: Any) -> None:
    with ExitStack() as stack:
        idle = [stack.enter_context(connected(served)) for _ in range(most_connections() + 50)]
        until(lambda: all(map(is_closed, idle[:40])))  # the process keeps files for others
        start = time.monotonic()
        assert stop(served) == 400
        assert served.ask("/compensate")[0] == 200
        assert time.monotonic() - start < SOON
        for k in range(60):  # and while more arrive
            stack.enter_context(connected(served))
            assert k % 20 or stop(served) == 400


def test_headers_that_never_end_do_not_keep_the_stop_out(served: Any) -> None:
    with ExitStack() as stack:
        lines = [stack.enter_context(connected(served)) for _ in range(most_connections() + 50)]
        for line in lines:
            with suppress(ConnectionError):  # it may be closed already
                line.sendall(b"POST /measure/plan.json HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ")
        until(lambda: all(map(is_closed, lines[:40])))
        assert stop(served) == 400


@pytest.mark.parametrize(
    "length", [b"Content-Length: 100000000", b"Content-Length: 900000", b"Transfer-Encoding: chunked"]
)
@pytest.mark.parametrize("path", [b"/measure/plan.json", b"/compensate/start", b"/nowhere"])
def test_a_body_without_the_session_is_refused_before_it_is_read(served: Any, path: bytes, length: bytes) -> None:
    origin = served.address.rstrip("/").encode()
    with connected(served) as line:
        line.sendall(b"POST %s HTTP/1.1\r\nHost: %s\r\nOrigin: %s\r\n%s\r\n\r\n" % (path, origin[7:], origin, length))
        answer = line.recv(1000)  # nothing of the body has been sent
        assert answer.split()[1] in (b"403", b"400")
        assert b"The token is required" in answer or b"400" in answer
        until(lambda: line.recv(1 << 16) == b"")


def test_large_bodies_of_strangers_are_not_stored(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    stored: list[int] = []
    inner = door._Request.data_received
    monkeypatch.setattr(
        door._Request, "data_received", lambda self, chunk: stored.append(self._answered) or inner(self, chunk)
    )
    origin = served.address.rstrip("/").encode()
    with connected(served) as line:
        head = b"POST /measure/save HTTP/1.1\r\nHost: %s\r\nOrigin: %s\r\nContent-Length: 60000\r\n\r\n"
        line.sendall(head % (origin[7:], origin) + b"x" * 60000)
        assert b" 403 " in line.recv(1000)
    assert all(stored)


def test_a_token_of_any_length_is_refused_without_reading_it(served: Any) -> None:
    with connected(served) as line:
        line.sendall(head_of(served, "/login", 5000))
        assert b" 400 " in line.recv(1000)


def test_many_wrong_tokens_do_not_keep_the_stop_out(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting: list[object] = []
    token = login.Login._token
    monkeypatch.setattr(login, "DELAY", 60.0)
    monkeypatch.setattr(login.Login, "_token", lambda self: waiting.append(self) or token(self))
    body = b'{"token": "wrong"}'
    with ExitStack() as stack:

        def attempts(count: int) -> list[socket.socket]:
            lines = [stack.enter_context(connected(served)) for _ in range(count)]
            for line in lines:
                with suppress(ConnectionError):  # it may be closed already
                    line.sendall(head_of(served, "/login", len(body)) + body)
            return lines

        lines = attempts(most_connections())
        until(lambda: len(waiting) >= AT_ONCE)  # more of one client are not served at a time
        assert stop(served) == 400
        attempts(40)
        until(lambda: sum(map(is_closed, lines)) >= 20)  # the first ones: those that wait occupy no place
        assert stop(served) == 400


def test_a_slow_body_of_a_known_client_ends(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert served.ask("/compensate")[0] == 200
    origin = served.address.rstrip("/").encode()
    with connected(served) as line:
        line.settimeout(30.0)
        head = (
            b"POST /measure/form.json HTTP/1.1\r\nHost: %s\r\nOrigin: %s\r\nCookie: %s\r\nContent-Length: 1000\r\n\r\n{"
        )
        line.sendall(head % (origin[7:], origin, served.cookie.encode()))
        assert line.recv(100) == b""  # closed after the time for a body


@pytest.mark.parametrize(
    "origin", ["https://{host}", "http://{host}1", "http://evil.example", "null", "", "ftp://{host}", "//{host}"]
)
def test_another_origin_scheme_or_port_is_refused(served: Any, origin: str) -> None:
    assert stop(served, Origin=origin.format(host=urlsplit(served.address).netloc)) == 403


def test_the_cookie_alone_reads_but_does_not_control(served: Any, serving: Callable[..., Any], tmp_path: Path) -> None:
    other = serving(tmp_path, control=True)
    foreign = ("", served.access.token, served.access.session, served.access.control_for("localhost"), other.control)
    for token in foreign:
        assert stop(served, **{CONTROL_HEADER: token}) == 403
        for path in ("/measure/save", "/measure/start", "/measure/resume", "/measure/stop", "/measure/answer"):
            headers = {"Origin": served.address.rstrip("/"), "Accept": "application/json", CONTROL_HEADER: token}
            assert served.ask(path, "POST", "{}", **headers)[0] == 403
    assert served.ask("/compensate")[0] == 200
    assert stop(served) == 400
    for path in ("/compensate", "/measure", "/login", "/compensate/state.json", "/static/screen.js"):
        assert served.control not in served.ask(path)[2]
        assert served.access.secret not in served.ask(path)[2]


def test_the_token_gives_the_token_for_control_once(served: Any) -> None:
    headers = {"Origin": served.address.rstrip("/"), "Content-Type": "application/json", "Accept": "application/json"}
    stranger = type(served)(served.address, served.access, served.stop)
    for wrong in ({}, [], {"token": 7}, {"token": served.access.token[:-1]}):
        assert stranger.ask("/login", "POST", json.dumps(wrong), **headers)[0] == 403
    status, answer, text = stranger.ask("/login", "POST", json.dumps({"token": served.access.token}), **headers)
    assert (status, json.loads(text)) == (200, {"control": served.control})
    assert served.control not in json.dumps(answer)


@pytest.fixture
def busy(served: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Occupy all threads for slow functions, by clients that have left."""
    free, begun = threading.Event(), threading.Semaphore(0)

    def compared(*_: Any) -> Any:
        begun.release()
        free.wait(60)
        raise RunError("free again")

    monkeypatch.setattr(compare, "_compared", compared)
    for _ in range(2):
        with connected(served) as line:
            line.sendall(head_of(served, "/compare/report.html?run=a&run=b"))
            assert begun.acquire(timeout=SOON)
    try:
        yield
    finally:
        free.set()


def test_abandoned_work_does_not_delay_the_page_with_the_stop(
    served: Any, busy: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compensate, "LISTS_TIMEOUT", 0.5)
    start = time.monotonic()
    status, _, text = served.ask("/compensate")
    assert (status, "running ones can be stopped" in text) == (200, True)
    assert served.ask("/compensate/state.json")[0] == 200
    assert stop(served) == 400
    assert time.monotonic() - start < SOON


def test_too_many_waiting_requests_are_refused_and_the_stop_is_not(
    served: Any, busy: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("errormotion.dashboard.pages.page.MAX_QUEUED", 1)
    with ExitStack() as stack:
        lines = [stack.enter_context(connected(served)) for _ in range(4)]
        for line in lines:
            line.sendall(head_of(served, "/compare/report.html?run=a&run=b"))
        refused = [line for line in lines if b" 503 " in _received(line)]
        assert refused
        assert stop(served) == 400


def _received(line: socket.socket) -> bytes:
    line.settimeout(1.0)
    try:
        return line.recv(1000)
    except TimeoutError:
        return b""


def test_the_process_of_an_abandoned_plan_is_killed(
    serving: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = serving(tmp_path / "runs", campaigns=tmp_path)
    started: list[asyncio.subprocess.Process] = []

    async def endless() -> asyncio.subprocess.Process:
        pipe = asyncio.subprocess.PIPE
        words = (sys.executable, "-c", "import time; time.sleep(600)")
        started.append(await asyncio.create_subprocess_exec(*words, stdin=pipe, stdout=pipe))
        return started[-1]

    monkeypatch.setattr(planning, "_started", endless)
    body = json.dumps({"file": "a.toml", "text": ""}).encode()
    for number in range(3):  # more than are made at a time
        with connected(served) as line:
            line.sendall(head_of(served, "/measure/plan.json", len(body)) + body)
            until(lambda number=number: len(started) == number + 1)  # type: ignore[misc]
        until(lambda: started[-1].returncode is not None)


class _Stream:
    def __init__(self) -> None:
        self.ended = False

    def closed(self) -> bool:
        return self.ended

    def close(self) -> None:
        self.ended = True


def test_the_budget_closes_the_longest_idle_stranger_first() -> None:
    budget, streams = Budget(most=4), [_Stream() for _ in range(8)]
    made: list[Any] = list(streams)
    assert all(budget.arrive(each) for each in made[:4])
    assert not budget.arrive(made[4])  # the first requests of the others are still due
    for each in made[:4]:
        budget.settle(each)
    budget.begin(made[0], trusted=True)
    budget.end(made[0])  # a known client, idle
    budget.begin(made[1], trusted=False)  # a request in progress
    assert budget.arrive(made[4])
    assert [each.ended for each in streams[:5]] == [False, False, True, False, False]
    budget.settle(made[4])
    assert budget.arrive(made[5])
    assert budget.arrive(made[6])
    assert [each.ended for each in streams[:7]] == [False, False, True, True, True, False, False]
    for each in made:
        budget.begin(each, trusted=False)
    assert not budget.arrive(made[7])
    streams[5].ended = True
    assert budget.arrive(made[7])
