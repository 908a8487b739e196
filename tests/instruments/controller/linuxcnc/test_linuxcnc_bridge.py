"""The bridge with a fake LinuxCNC: faults, and requests."""

import asyncio
import json
import os
import signal
import socket
import warnings
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from linuxcnc_fakes import FakeHAL, FakeLinuxCNC

from errormotion.instruments.controller.linuxcnc import bridge as module
from errormotion.instruments.controller.linuxcnc.bridge import Bridge, Client

TOKEN = "0123456789abcdef" * 4
HELLO = {"id": 0, "op": "hello", "token": TOKEN, "control": True, "client": "one"}


class Inline:
    """Sends commands without a separate process."""

    def __init__(self, fake: FakeLinuxCNC) -> None:
        self.fake = fake

    def send(self, name: str, *arguments: Any) -> asyncio.Future[int]:
        done: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        try:
            getattr(self.fake, name)(*arguments)
        except Exception as error:  # noqa: BLE001 - as the process does
            done.set_exception(module.RefusedError(f"{type(error).__name__}: {error}"))
            done.exception()
        else:
            done.set_result(self.fake.serial)
        return done


def made(fake: FakeLinuxCNC, folder: Path, pins: tuple[str, ...] = ("ball",), hal: Any = None) -> Bridge:
    sender: Any = Inline(fake)
    return Bridge(fake, hal or FakeHAL(), sender, sender, folder, pins, "load", token=TOKEN)


class Wire:
    """A client's end: what the bridge writes, line by line."""

    def __init__(self, bridge: Bridge, *, greets: bool = True, **hello: Any) -> None:
        self.answers: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self.beats = 0
        self.closed = False
        self.bridge = bridge
        self.client = Client(bridge)
        self.client.connection_made(self)
        if greets:
            self.feed(json.dumps({**HELLO, **hello}).encode() + b"\n")
            self.welcome = self.answers.get_nowait()

    def feed(self, data: bytes) -> None:
        """Send bytes to the bridge."""
        if not self.closed:
            self.client.data_received(data)

    def write(self, data: bytes) -> None:
        message = json.loads(data)
        if "beat" in message:
            self.beats += 1
        else:
            self.answers.put_nowait(message)

    def get_write_buffer_size(self) -> int:
        return 0

    def is_closing(self) -> bool:
        return self.closed

    def pause_reading(self) -> None:
        pass

    def resume_reading(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True

    abort = close

    def send(self, op: Any, **arguments: Any) -> None:
        self.feed(json.dumps({**arguments, "id": 7, "op": op}).encode() + b"\n")

    async def ask(self, op: Any, **arguments: Any) -> Any:
        """Return the result, or the text of the refusal."""
        self.send(op, **arguments)
        answer = await asyncio.wait_for(self.answers.get(), 10)
        assert answer["id"] == 7
        return answer["result"] if answer["ok"] else answer["error"]

    async def disconnect(self) -> None:
        self.close()
        self.client.connection_lost(None)
        while self.bridge.job or self.bridge.program:
            await asyncio.sleep(0.001)


Test = Callable[[Wire, FakeLinuxCNC, Bridge], Coroutine[Any, Any, None]]


@pytest.fixture
def play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Test], None]:
    """Return a function that runs a test with a client of a bridge; time limits of LinuxCNC are shorter than in use."""
    monkeypatch.setattr(module, "ACCEPT_TIMEOUT", 0.2)
    monkeypatch.setattr(module, "CHANGE_TIMEOUT", 0.1)
    monkeypatch.setattr(module, "TEXT_TIMEOUT", 0.05)

    def run(test: Test) -> None:
        async def session() -> None:
            fake = FakeLinuxCNC()
            bridge = made(fake, tmp_path)
            wire = Wire(bridge)
            await test(wire, fake, bridge)
            await wire.disconnect()
            for client in list(bridge.clients):
                client.connection_lost(None)
            assert not bridge.clients

        asyncio.run(session())

    return run


def moving_to(fake: FakeLinuxCNC, place: tuple[float, ...]) -> Callable[[str], None]:
    def arrive(line: str) -> None:
        fake.values.position = (*place, *(0.0,) * 6)

    return arrive


@pytest.mark.parametrize(
    "line",
    [
        b"hello",
        b"\xff\xfe",
        b"[]",
        b"{}",
        b'{"id": 1}',
        b'{"id": 1, "op": []}',
        b"null",
        b"[" * 60000,
        b'{"a":' * 10000,
        b"7",
        b"",
        b'{"id": 1, "op": "move_to", "position": [0, 0, NaN]}',
        b'{"id": 1, "op": "elapse", "seconds": Infinity}',
        b'{"id": true, "op": "state"}',
        b'{"id": "' + b"x" * 65 + b'", "op": "state"}',
        b"POST / HTTP/1.1",
    ],
)
def test_the_first_line_that_is_no_request_ends_the_connection_and_not_the_bridge(
    play: Callable[[Test], None], line: bytes
) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        other = Wire(bridge)
        other.feed(line + b"\n" + b'{"id": 1, "op": "enable"}\n')
        await asyncio.sleep(0.05)
        assert other.closed
        assert other.client not in bridge.clients
        assert not fake.lines
        assert (await wire.ask("state"))["enabled"] is True

    play(test)


@pytest.mark.parametrize("data", [b"G", b"POST / HT", b"\x16\x03\x01", b"OPTIONS * HTTP/1.1\r\n", b"\n"])
def test_another_protocol_is_refused_without_waiting(play: Callable[[Test], None], data: bytes) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        browser = Wire(bridge, greets=False)
        browser.feed(data)
        assert browser.closed
        assert browser.answers.empty()

    play(test)


def test_a_web_page_moves_nothing(play: Callable[[Test], None]) -> None:
    """A POST with requests as its body, as any page in a browser of this computer can send it."""
    body = b"".join(json.dumps({"id": 1, "op": op}).encode() + b"\n" for op in ("reset", "enable", "home"))
    head = b"POST / HTTP/1.1\r\nHost: 127.0.0.1:5007\r\nContent-Type: text/plain\r\n\r\n"

    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        browser = Wire(bridge, greets=False)
        browser.feed(head + json.dumps(HELLO).encode() + b"\n" + body)
        await asyncio.sleep(0.05)
        assert browser.closed
        assert not fake.lines

    play(test)


@pytest.mark.parametrize(
    "first",
    [
        {"id": 1, "op": "state"},
        {"id": 1, "op": "estop"},
        {**HELLO, "token": TOKEN[:-1]},
        {**HELLO, "token": ""},
        {**HELLO, "token": None},
        {**HELLO, "token": "\ud800" * 64},
        {**HELLO, "control": 1},
        {**HELLO, "client": "x" * 65},
        {"id": 0, "op": "hello"},
    ],
)
def test_without_the_token_nothing_is_answered(play: Callable[[Test], None], first: dict[str, Any]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        stranger = Wire(bridge, greets=False)
        stranger.feed(json.dumps(first).encode() + b'\n{"id": 2, "op": "enable"}\n')
        await asyncio.sleep(0.05)
        assert stranger.closed
        assert stranger.answers.get_nowait()["ok"] is False
        assert stranger.answers.empty()
        assert not fake.lines

    play(test)


def test_an_unauthorised_client_has_a_short_time_limit(
    play: Callable[[Test], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "HELLO_TIMEOUT", 0.05)

    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        stranger = Wire(bridge, greets=False)
        stranger.feed(b'{"id": 1')
        await asyncio.sleep(0.3)
        assert stranger.closed

    play(test)


def test_an_endless_request_ends_the_connection(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        other = Wire(bridge)
        for _ in range(9):
            other.feed(b"{" + b"x" * 8191)
        assert other.closed
        assert "65536 bytes" in other.answers.get_nowait()["error"]

    play(test)


def test_the_65th_client_is_refused_and_unauthorised_ones_are_not_counted(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        strangers = [Wire(bridge, greets=False) for _ in range(100)]
        assert sum(not each.closed for each in strangers) == module.MAX_STRANGERS
        clients = [Wire(bridge) for _ in range(module.MAX_CLIENTS)]
        assert [each.closed for each in clients] == [False] * (module.MAX_CLIENTS - 1) + [True]
        assert "64 clients" in clients[-1].welcome["error"]
        assert (await clients[0].ask("state"))["enabled"]
        for each in (*clients, *strangers):
            each.client.connection_lost(None)

    play(test)


def test_many_unauthorised_connections_leave_time_for_the_first_request(
    play: Callable[[Test], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STRANGER_TIME", 60.0)

    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        with socket.create_server(("127.0.0.1", 0), backlog=64) as line:
            line.setblocking(False)
            door = asyncio.ensure_future(module.admit(bridge, line))
            reader, writer = await asyncio.open_connection(*line.getsockname())
            burst = [await asyncio.open_connection(*line.getsockname()) for _ in range(2 * module.MAX_STRANGERS)]
            while not bridge.crowded():
                await asyncio.sleep(0.01)
            writer.write(json.dumps(HELLO).encode() + b"\n")
            assert json.loads(await asyncio.wait_for(reader.readline(), 30))["ok"]
            door.cancel()
            for _, each in [(reader, writer), *burst]:
                each.close()

    play(test)


# ---------------------------------------------------------------------- control


def test_one_client_controls_and_the_others_read_and_stop(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        other = Wire(bridge, client="two")
        assert wire.welcome["result"]["control"] is True
        expected = {
            "protocol": 2,
            "control": False,
            "controlled_by": "one",
            "compensate": False,
            "compensated_by": None,
        }
        assert other.welcome["result"] == expected
        reads = {"identify", "state", "elapse", "finish", "stop", "estop", "offset", "set_offset"}
        for op in sorted(bridge._work.keys() - reads):
            assert "only reads" in await other.ask(op)
        assert not fake.lines
        assert (await other.ask("state"))["enabled"]
        assert await other.ask("stop") is None
        assert await other.ask("estop") is None
        assert fake.values.task_state == fake.STATE_ESTOP
        await wire.disconnect()
        assert Wire(bridge, client="two").welcome["result"]["control"] is True

    play(test)


SECRET = "f" * 64
OTHER_SECRETS = [None, "", "e" + SECRET[1:], SECRET[:-1], SECRET + "f", SECRET.upper()]


@pytest.mark.parametrize("secret", OTHER_SECRETS)
@pytest.mark.parametrize("right", ["control", "compensate"])
def test_the_name_of_the_holder_gives_no_right(play: Callable[[Test], None], secret: str | None, right: str) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        bridge.compensates = True
        rights = {"control": False, "compensate": False, right: True}
        await wire.disconnect()
        holder = Wire(bridge, client="the holder", secret=SECRET, **rights)
        assert holder.welcome["result"][right] is True
        for _ in range(2):
            reader = Wire(bridge, client="reader", control=False)
            told = reader.welcome["result"][{"control": "controlled_by", "compensate": "compensated_by"}[right]]
            assert told == "the holder"
            assert SECRET not in json.dumps(reader.welcome)
            copy = Wire(bridge, client=told, **rights, **({} if secret is None else {"secret": secret}))
            assert copy.welcome["result"][right] is False
            assert "does not compensate" in await copy.ask("set_offset", offset=[0, 0, 0])
            assert "only reads" in await copy.ask("enable")
            assert not holder.closed

    play(test)


def test_no_answer_contains_a_secret(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        bridge.compensates = True
        await wire.disconnect()
        holder = Wire(bridge, secret=SECRET, compensate=True)
        stranger = Wire(bridge, control=False, client="another")
        answers = [holder.welcome, stranger.welcome]
        for each in (holder, stranger):
            answers += [await each.ask(op) for op in ("identify", "state", "offset", "enable", SECRET[:8])]
        assert stranger.welcome["result"]["controlled_by"]
        assert SECRET not in json.dumps(answers)
        assert TOKEN not in json.dumps(answers)

    play(test)


@pytest.mark.parametrize("right", ["control", "compensate"])
def test_a_client_that_lost_its_connection_takes_its_right_back(play: Callable[[Test], None], right: str) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        bridge.compensates = True
        await wire.disconnect()
        rights = {"control": False, "compensate": False, right: True}
        of_one = {**rights, "secret": SECRET}
        cut = Wire(bridge, session="a", **of_one)  # the bridge has not noticed the cut
        beside = Wire(bridge, session="b", **of_one)
        again = Wire(bridge, client="another name", session="a", **of_one)
        assert again.welcome["result"][right] is True
        assert (cut.closed, beside.closed) == (True, False)
        assert beside.welcome["result"][right] is True
        foreign = Wire(bridge, client="third", session="b")
        assert not beside.closed
        assert foreign.welcome["result"][right] is False
        third = Wire(bridge, client="third", secret="0" * 64, **rights)
        assert third.welcome["result"][right] is False

    play(test)


def test_a_motion_of_the_lost_connection_ends_when_its_client_returns(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        await wire.disconnect()
        fake.on_mdi = lambda *_: setattr(fake.values, "state", fake.RCS_EXEC)  # an endless motion
        cut = Wire(bridge, secret=SECRET, session="a")
        cut.send("move_to", position=[0.01, 0, 0])
        while not bridge.job:
            await asyncio.sleep(0.001)
        again = Wire(bridge, secret=SECRET, session="a")
        assert again.welcome["result"]["control"] is True
        assert "abort" in fake.lines

    play(test)


@pytest.mark.parametrize("secret", [7, None, "f" * 31, "f" * 257, ["f" * 64]])
def test_a_weak_secret_is_refused(play: Callable[[Test], None], secret: Any) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        other = Wire(bridge, client="two", secret=secret)
        assert other.closed
        assert "32 to 256 characters" in other.welcome["error"]

    play(test)


def test_a_client_without_control_only_reads(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        await wire.disconnect()
        reader = Wire(bridge, control=False)
        assert "only reads" in await reader.ask("enable")
        assert not fake.lines

    play(test)


def test_a_number_beyond_a_float_is_refused(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        wire.feed(b'{"id": 7, "op": "move_to", "position": [0, 0, 1e400]}\n')
        assert "expected a coordinate" in (await wire.answers.get())["error"]

    play(test)


# ---------------------------------------------------------------------- floods


class Flood(Wire):
    """A client that sends requests without end, as fast as the bridge reads them."""

    paused = False

    def pause_reading(self) -> None:
        self.paused = True

    def resume_reading(self) -> None:
        if self.paused:
            self.paused = False
            asyncio.get_running_loop().call_soon(self.refill)

    def refill(self) -> None:
        """Send as much as one read of a socket takes."""
        if not (self.paused or self.closed):
            self.feed(self.data)

    data = b'{"id": 7, "op": "state"}\n' * 10000


@pytest.mark.parametrize("op", ["state", "fly", "set_pins"])
def test_an_estop_waits_for_a_few_requests_of_others_only(play: Callable[[Test], None], op: str) -> None:
    """Counted, not timed: how many requests are answered between an e-stop and its answer."""

    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        floods = [Flood(bridge, control=False) for _ in range(module.MAX_CLIENTS - 1)]
        for each in floods:
            each.data = Flood.data.replace(b"state", op.encode())
            each.refill()
        for _ in range(200):
            await asyncio.sleep(0)
        before = sum(each.answers.qsize() for each in floods)
        assert before > 50
        await wire.ask("estop")
        assert fake.values.task_state == fake.STATE_ESTOP
        assert sum(each.answers.qsize() for each in floods) - before < 20
        for each in floods:
            await each.disconnect()

    play(test)


def test_many_stop_requests_are_one_stop(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        sent: list[str] = []
        under_way: asyncio.Future[int] = asyncio.get_running_loop().create_future()  # LinuxCNC is slow
        bridge.stops = SimpleNamespace(send=lambda name, *_: (sent.append(name), under_way)[1])  # type: ignore[assignment]
        flood = Flood(bridge, control=False)
        flood.data = Flood.data.replace(b"state", b"stop")
        flood.refill()
        for _ in range(200):
            await asyncio.sleep(0)
        assert sent == ["abort"]
        under_way.set_result(0)
        await flood.disconnect()

    play(test)


# ---------------------------------------------------------------------- commands


@pytest.mark.parametrize(
    ("op", "arguments", "said"),
    [
        ("fly", {}, "unknown operation: fly"),
        ("_take", {}, "unknown operation"),
        ("state", {"of": 1}, "TypeError"),
        ("move_to", {}, "TypeError"),
        ("move_to", {"position": "home"}, "expected a position"),
        ("move_to", {"position": [0, 0, True]}, "expected a coordinate"),
        ("move_to", {"position": [0, 0, 0.11]}, "Z travels from -0.1 to 0.1 m; found 0.11"),
        ("move_to", {"position": [0, 0, 0], "feed": -1}, "feed above 0"),
        ("probe", {"target": [0, 0, 0], "feed": 0.1}, "is already at the target"),
        ("probe", {"target": [0, 0, 0.01], "feed": None}, "expected a feed"),
        ("move_to", {"position": [0, 0, 0], "feed": 1e308}, "at most 10 m/s"),
        ("move_to", {"position": [0, 0, 0], "feed": 10**400}, "expected a feed"),
        ("move_to", {"position": [0, 0, 10**400]}, "expected a coordinate"),
        ("move_to", {"position": [0, 0, 0], "feed_limit": 0}, "feed above 0"),
        ("move_to", {"position": [0, 0, 0], "feed": 1e-13}, "at least 1e-6 mm/min"),
        ("probe", {"target": [0, 0, 0.01], "feed": 1e305}, "at most 10 m/s"),
        ("spindle", {"speed": 1e308}, "at most 1e+06"),
        ("spindle", {"speed": 10**400}, "expected spindle speed"),
        ("set_pins", {"pins": {"ball0.x": 10**400}}, "expected a value of the pin"),
        ("set_pins", {"pins": {"ball0.x": None}}, "expected a value of the pin"),
        ("spindle", {"speed": "fast"}, "expected spindle speed"),
        ("run_program", {"text": 5}, "expected the text"),
        ("elapse", {"seconds": -1}, "expected a time"),
        ("set_pins", {"pins": {"spindle.0.speed-in": 1}}, "not among those that clients may set"),
    ],
)
def test_wrong_commands_are_refused_with_a_text(
    play: Callable[[Test], None], op: str, arguments: dict[str, Any], said: str
) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        assert said in await wire.ask(op, **arguments)
        assert not [line for line in fake.lines if line.startswith(("G", "M", "run"))]
        assert bridge.job is None

    play(test)


def test_the_state_is_in_metres_whatever_the_ini_file_has(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.values.linear_units = 1 / 25.4
        fake.values.actual_position = (1.0, 2.0, 3.0, 0, 0, 0, 0, 0, 0)
        fake.values.current_vel = 2.0
        state = await wire.ask("state")
        assert state["position"] == pytest.approx([0.0254, 0.0508, 0.0762])
        assert state["feed"] == pytest.approx(0.0508)
        assert state["spindle_load"] is None
        bridge.hal.pins |= {"load": 0.4, "spindle.0.speed-in": 50.0}
        state = await wire.ask("state")
        assert (state["spindle_load"], state["spindle_speed"]) == (0.4, 3000.0)

    play(test)


def test_nothing_is_reported_while_linuxcnc_is_starting(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.values.linear_units = 0.0
        assert "still starting" in await wire.ask("state")

    play(test)


def test_messages_are_not_alarms_but_errors_are(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.texts = [(fake.OPERATOR_TEXT, "hello"), (fake.OPERATOR_ERROR, "joint 1 following error")]
        assert (await wire.ask("state"))["alarms"] == ["joint 1 following error"]
        await wire.ask("reset")
        assert (await wire.ask("state"))["alarms"] == []

    play(test)


def test_an_error_without_a_text_is_an_error_all_the_same(play: Callable[[Test], None]) -> None:
    """Another display may have read the text; the error follows from the position."""

    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        assert "stopped before its goal, at 0.0000, 0.0000, 0.0000 mm" in await wire.ask(
            "move_to", position=[0, 0, 0.1]
        )

    play(test)


def test_the_text_of_an_error_may_be_late(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.on_mdi = lambda line: asyncio.get_running_loop().call_later(0.02, fake.error, "too bad")  # type: ignore[assignment,return-value]
        assert (await wire.ask("move_to", position=[0, 0, 0.1])).endswith(
            "before its goal, at 0.0000, 0.0000, 0.0000 mm: too bad"
        )

    play(test)


def test_units_are_set_before_reading_and_restored(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.values.gcodes = (200, 910, 940)
        fake.on_mdi = moving_to(fake, (0.0, 0.0, 100.0))
        assert "duration" in await wire.ask("move_to", position=[0, 0, 0.1], feed=0.01)
        assert [line for line in fake.lines if line.startswith("G")] == [
            "G21 G90 G94",
            "G53 G1 F600.000000 X0.0000000 Y0.0000000 Z100.0000000",
            "G20 G91",
        ]

    play(test)


def test_probing_is_in_the_work_frame_and_its_result_is_not(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.values.g5x_offset = (10.0, 0.0, 0.0, *(0.0,) * 6)
        fake.values.rotation_xy = 90.0
        fake.values.tool_offset = (0.0, 0.0, 50.0, *(0.0,) * 6)
        fake.values.probed_position = (10.0, 3.0, 7.0, *(0.0,) * 6)
        fake.values.probe_tripped = True
        touch = await wire.ask("probe", target=[0.01, 0.005, 0.007], feed=0.001)
        assert fake.lines[-1] == "G38.3 F60.000000 X5.0000000 Y0.0000000 Z-43.0000000"
        assert touch["position"] == pytest.approx([0.01, 0.003, 0.007])

    play(test)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"task_state": FakeLinuxCNC.STATE_ESTOP}, "in e-stop"),
        ({"task_state": FakeLinuxCNC.STATE_OFF}, "is off"),
        ({"homed": (1, 0, 1)}, "not homed"),
        ({"joints": 0}, "not homed"),
        ({"interp_state": FakeLinuxCNC.INTERP_READING}, "this bridge has not started"),
        ({"probe_val": 1}, "tripped before it moves"),
        ({"spindle": ({"speed": 9.0, "direction": 1},)}, "spindle turns"),
    ],
)
def test_probes_with_a_machine_that_is_ready_only(
    play: Callable[[Test], None], change: dict[str, Any], said: str
) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        vars(fake.values).update(change)
        assert said in await wire.ask("probe", target=[0.01, 0.005, 0.007], feed=0.001)
        fake.values.interp_state = fake.INTERP_IDLE

    play(test)


def test_a_manual_emergency_stop_interrupts_a_move(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.on_mdi = lambda line: setattr(fake.values, "task_state", fake.STATE_ESTOP)
        assert "move to was aborted: e-stop" in await wire.ask("move_to", position=[0, 0, 0.1])
        fake.values.task_state = fake.STATE_ON
        fake.on_mdi = lambda line: setattr(fake.values, "task_state", fake.STATE_OFF)
        assert "switched off" in await wire.ask("move_to", position=[0, 0, 0.1])

    play(test)


def test_a_command_that_linuxcnc_never_accepts_is_aborted(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.deaf = True
        assert "does not respond: change of mode" in await wire.ask("move_to", position=[0, 0, 0.1])
        assert fake.lines[-1] == "abort"
        assert bridge.job is None

    play(test)


def test_the_e_stop_that_stays_pressed_is_reported(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.state = lambda state: fake._took("ignored")  # type: ignore[method-assign]
        fake.values.task_state = fake.STATE_ESTOP
        assert "check the buttons" in await wire.ask("reset")
        fake.values.task_state = fake.STATE_OFF
        assert "remains off" in await wire.ask("enable")

    play(test)


def test_a_failed_homing_has_a_reason(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.values.homed = (0, 0, 0)
        fake.home = lambda joint: fake.error("no home switch")  # type: ignore[method-assign]
        assert await wire.ask("home") == "homing failed: no home switch"

    play(test)


def test_a_command_sends_heartbeats_until_it_ends_and_others_wait(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.on_mdi = lambda line: setattr(fake.values, "interp_state", fake.INTERP_READING)
        await wire.ask("hello", token=TOKEN, control=True, client="one", secret=SECRET)
        wire.send("move_to", position=[0, 0, 0.1])
        other = Wire(bridge, secret=SECRET)
        while not (await other.ask("state"))["ordered"]:
            await asyncio.sleep(0.01)
        assert await other.ask("spindle", speed=1) == "the machine is busy: move to"
        assert await other.ask("stop") is None
        assert "aborted: it was stopped" in (await asyncio.wait_for(wire.answers.get(), 10))["error"]
        assert wire.beats >= 1
        assert "abort" in fake.lines
        await other.disconnect()

    play(test)


def test_a_client_that_disconnects_ends_its_motion(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        await wire.ask("hello", token=TOKEN, control=True, client="one", secret=SECRET)
        other = Wire(bridge, secret=SECRET)
        fake.on_run = lambda: setattr(fake.values, "interp_state", fake.INTERP_READING)
        assert (await other.ask("run_program", text="G4 P9"))["program"] == "errormotion-1.ngc"
        assert (await wire.ask("state"))["running"] is True
        await other.disconnect()
        assert fake.lines[-1] == "abort"
        assert "the connection of its client is lost" in await wire.ask("finish")
        assert not list(bridge.programs.iterdir())

    play(test)


@pytest.mark.parametrize(
    ("op", "arguments"),
    [
        ("move_to", {"position": [0, 0, 0.1]}),
        ("probe", {"target": [0, 0, 0.1], "feed": 0.01}),
        ("run_program", {"text": "G4 P9"}),
        ("spindle", {"speed": 100}),
    ],
)
def test_commands_aborted_before_their_start_do_not_start(
    play: Callable[[Test], None], op: str, arguments: dict[str, Any]
) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        change = fake.mode

        def interrupted(mode: int) -> None:
            change(mode)
            bridge._end_jobs("it was stopped", None)

        fake.mode = interrupted  # type: ignore[method-assign]
        assert "aborted: it was stopped" in await wire.ask(op, **arguments)
        assert "abort" in fake.lines
        assert not [line for line in fake.lines if line.startswith(("G", "M", "run"))]

    play(test)


def test_a_stop_ends_waiting(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        assert await wire.ask("elapse", seconds=0.01) is None
        wire.send("elapse", seconds=100)
        await asyncio.sleep(0.01)
        other = Wire(bridge)
        await other.ask("stop")
        assert (await asyncio.wait_for(wire.answers.get(), 10))["error"] == "waiting was stopped"
        await other.disconnect()

    play(test)


def test_an_error_of_the_linuxcnc_module_is_an_answer(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        def broken() -> None:
            raise OSError("emcStatus buffer invalid")

        fake.values.poll = broken
        assert await wire.ask("state") == "OSError: emcStatus buffer invalid"
        assert "OSError" in await wire.ask("move_to", position=[0, 0, 0])
        assert fake.lines[-1] == "abort"
        fake.values.poll = lambda: None
        assert (await wire.ask("state"))["enabled"]

    play(test)


@pytest.mark.parametrize("stated", ["", ",", "ball,", ",,ball", " , "])
def test_an_empty_prefix_allows_no_pin(tmp_path: Path, stated: str) -> None:
    async def test() -> None:
        hal = FakeHAL()
        bridge = made(FakeLinuxCNC(), tmp_path, tuple(stated.split(",")), hal)
        assert "not among those" in await Wire(bridge).ask("set_pins", pins={"spindle.0.speed-in": 1.0})
        assert not hal.pins

    asyncio.run(test())


def test_no_pin_is_set_where_one_is_refused(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        assert "not among those" in await wire.ask("set_pins", pins={"ball0.x": 1.0, "motion.enable": 1.0})
        assert not bridge.hal.pins

    play(test)


def test_a_long_program_is_received_in_parts(play: Callable[[Test], None], monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        texts: list[str] = []
        fake.on_run = lambda: texts.append(Path(fake.values.file).read_text())
        await wire.ask("program_part", text="forgotten\n")
        for part in ("", "G1 X1\n", "G1 X2\n"):
            assert await wire.ask("program_part", text=part) is None
        await wire.ask("run_program", text="M2")
        await wire.ask("finish")
        assert texts == ["G1 X1\nG1 X2\nM2\n"]
        monkeypatch.setattr(module, "MAX_PROGRAM_BYTES", 10)
        assert "at most 10 bytes" in await wire.ask("program_part", text="x" * 11)
        assert wire.client.program == []

    play(test)


@pytest.mark.parametrize("offset", ["g5x_offset", "g92_offset", "tool_offset", "rotation_xy"])
def test_a_program_in_machine_coordinates_does_not_run_with_an_offset(
    play: Callable[[Test], None], offset: str
) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        setattr(fake.values, offset, 1.0 if offset == "rotation_xy" else (0.0, 1.0, *(0.0,) * 7))
        assert "an offset" in await wire.ask("run_program", text="M2", machine_coordinates=True)
        assert "run" not in fake.lines
        assert "program" in await wire.ask("run_program", text="M2")
        await wire.ask("finish")

    play(test)


@pytest.mark.parametrize(
    ("limit", "line"),
    [(None, "G53 G0 "), (0.2, "G53 G0 "), (0.01, "G53 G1 F600.000000 ")],
)
def test_a_rapid_move_keeps_the_limit_of_the_feed(play: Callable[[Test], None], limit: float | None, line: str) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.values.max_velocity = 100.0  # mm/s
        fake.on_mdi = moving_to(fake, (0.0, 0.0, 100.0))
        await wire.ask("move_to", position=[0, 0, 0.1], feed_limit=limit)
        assert fake.lines[-1].startswith(line)
        assert "at most 0.1 m/s" in await wire.ask("move_to", position=[0, 0, 0.1], feed=0.11)

    play(test)


# ---------------------------------------------------------------------- token and socket


def test_the_token_is_created_once_and_only_its_user_can_read_it(tmp_path: Path) -> None:
    path = tmp_path / "own" / "token"
    token = module.own_token(path)
    assert len(token) == 64
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    assert module.own_token(path) == token
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o644])
def test_a_token_that_others_can_read_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "own" / "token"
    module.own_token(path)
    path.chmod(mode)
    with pytest.raises(PermissionError, match="no other user can read"):
        module.own_token(path)


def test_a_folder_that_others_can_write_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(PermissionError, match="only its user can write"):
        module.own_token(tmp_path / "token")
    with pytest.raises(PermissionError, match="only its user can write"):
        module.unix_socket(tmp_path / "socket")


def test_a_token_that_is_a_link_or_too_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "own" / "token"
    module.own_token(path)
    link = path.with_name("link")
    link.symlink_to(path)
    with pytest.raises(OSError, match="symbolic links"):
        module.own_token(link)
    path.write_text("short\n")
    with pytest.raises(ValueError, match="at least 32"):
        module.own_token(path)


def test_the_socket_is_its_users_and_one_bridge_listens(tmp_path: Path) -> None:
    path = tmp_path / "own" / "socket"
    with module.unix_socket(path) as line:
        assert path.stat().st_mode & 0o777 == 0o600
        line.listen()
        with pytest.raises(FileExistsError, match="another bridge"):
            module.unix_socket(path)
    module.unix_socket(path).close()  # left by a killed process
    path.unlink()
    path.write_text("no socket")
    with pytest.raises(FileExistsError, match="remove the file"):
        module.unix_socket(path)


# ---------------------------------------------------------------------- sending in separate processes


def test_commands_are_sent_by_another_process_and_a_lost_one_ends_the_bridge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "linuxcnc.py").write_text(
        "import time\n"
        "class command:\n"
        "    serial = 0\n"
        "    def mdi(self, line):\n"
        "        time.sleep(0.3)  # as LinuxCNC's module, which holds up its process\n"
        "        self.serial += 1\n"
        "    def abort(self):\n"
        "        raise OSError('no LinuxCNC')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)

    async def test() -> None:
        lost = asyncio.Event()
        await sender.connect(lost.set)
        slow, after = sender.send("mdi", "G0 X0"), sender.send("abort")
        await asyncio.sleep(0.05)
        assert not slow.done()  # and this loop continued meanwhile
        assert await slow == 1
        with pytest.raises(module.RefusedError, match="no LinuxCNC"):
            await after
        os.kill(sender.pid, signal.SIGKILL)
        with pytest.raises(module.RefusedError, match="has ended"):
            await sender.send("mdi", "G0 X0")
        await asyncio.wait_for(lost.wait(), 10)
        with pytest.raises(module.RefusedError, match="has ended"):
            await sender.send("mdi", "G0 X0")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other tests' threads, which the child does not use
        sender = module.Sender()
    try:
        asyncio.run(test())
    finally:
        os.waitpid(sender.pid, 0)


def test_a_bridge_only_permits_compensation_if_started_with_it(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        other = Wire(bridge, client="two", control=False, compensate=True)
        assert other.welcome["result"]["compensate"] is False
        assert "started without --compensate" in await other.ask("set_offset", offset=[0, 0, 0])
        assert "started without --compensate" in await wire.ask("set_offset", offset=[0, 0, 0])

    play(test)


def test_one_client_may_only_compensate(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        bridge.compensates = True
        first = Wire(bridge, client="two", control=False, compensate=True)
        second = Wire(bridge, client="three", control=False, compensate=True)
        assert first.welcome["result"]["compensate"] is True
        assert (second.welcome["result"]["compensate"], second.welcome["result"]["compensated_by"]) == (False, "two")
        assert "only reads" in await first.ask("move_to", position=[0, 0, 0])
        assert "only reads" in await first.ask("set_pins", pins={"ball0": 1.0})
        assert "has not loaded" in await first.ask("set_offset", offset=[0, 0, 0])
        for client in (wire, second):
            assert "does not compensate" in await client.ask("set_offset", offset=[0, 0, 0])
        await first.disconnect()
        third = Wire(bridge, client="three", control=False, compensate=True)
        assert third.welcome["result"]["compensate"] is True

    play(test)


def test_no_client_sets_the_pins_of_the_compensation_directly(tmp_path: Path) -> None:
    async def test() -> None:
        bridge = made(FakeLinuxCNC(), tmp_path, pins=("", "e"))
        wire = Wire(bridge)
        assert "not among those" in await wire.ask("set_pins", pins={"errormotion-source-x.in1": 1.0})
        await wire.disconnect()

    asyncio.run(test())


def test_positions_are_those_without_an_external_offset(tmp_path: Path) -> None:
    async def test() -> None:
        fake, hal = FakeLinuxCNC(), FakeHAL()
        hal.pins |= {"axis.x.eoffset": 0.02, "axis.y.eoffset": -0.01, "axis.z.eoffset": 0.0, "motion.motion-type": 5.0}
        hal.pins |= {"axis.x.pos-cmd": 10.0, "axis.y.pos-cmd": 20.0, "axis.z.pos-cmd": 30.0}
        wire = Wire(made(fake, tmp_path, hal=hal))
        fake.on_mdi = moving_to(fake, (10.02, 19.99, 30.0))
        fake.values.actual_position = (10.023, 19.99, 30.0, *(0.0,) * 6)
        fake.values.probe_tripped, fake.values.probed_position = True, (5.02, 4.99, 3.0, *(0.0,) * 6)
        assert "duration" in await wire.ask("move_to", position=[0.01, 0.02, 0.03])
        state = await wire.ask("state")
        assert state["position"] == pytest.approx([0.010003, 0.02, 0.03], abs=1e-12)
        assert state["commanded_position"] == pytest.approx([0.01, 0.02, 0.03])
        touch = await wire.ask("probe", target=[0.0, 0.0, 0.0], feed=0.001)
        assert touch["position"] == pytest.approx([0.005, 0.005, 0.003])
        await wire.disconnect()

    asyncio.run(test())


def test_an_offset_that_changes_after_the_state_was_read_moves_no_position(tmp_path: Path) -> None:
    """The state is some milliseconds old when the pins are read; at 20 um/s that is a micrometre in 50 ms."""

    async def test() -> None:
        fake, hal = FakeLinuxCNC(), FakeHAL()
        hal.pins |= {f"axis.{each}.eoffset": 0.0 for each in "xyz"} | {"motion.motion-type": 0.0}
        hal.pins |= {f"axis.{each}.pos-cmd": 10.0 for each in "xyz"}
        fake.on_mdi = moving_to(fake, (10.020, 10.0, 10.0))
        fake.values.actual_position = (10.020, 10.0, 10.0, *(0.0,) * 6)
        wire = Wire(made(fake, tmp_path, hal=hal))
        hal.pins["axis.x.eoffset"] = 0.0216
        assert "duration" in await wire.ask("move_to", position=[0.01, 0.01, 0.01])
        state = await wire.ask("state")
        assert state["position"] == state["commanded_position"] == pytest.approx([0.01] * 3, abs=1e-12)
        await wire.disconnect()

    asyncio.run(test())


def test_a_contact_has_the_offset_that_was_held_while_the_machine_probed(tmp_path: Path) -> None:
    async def test() -> None:
        fake, hal = FakeLinuxCNC(), FakeHAL()
        hal.pins |= {f"axis.{each}.pos-cmd": 10.0 for each in "xyz"} | {f"axis.{each}.eoffset": 0.0 for each in "xyz"}
        hal.pins |= {"axis.x.eoffset": 0.02, "motion.motion-type": 5.0}

        def probe(line: str) -> None:
            fake.values.interp_state = fake.INTERP_READING
            asyncio.get_running_loop().call_later(0.1, ended)

        def ended() -> None:  # the offset follows again before the contact is read
            hal.pins |= {"axis.x.eoffset": 0.03, "motion.motion-type": 0.0}
            fake.values.probe_tripped, fake.values.probed_position = True, (5.02, 4.0, 3.0, *(0.0,) * 6)
            fake.values.interp_state = fake.INTERP_IDLE

        fake.on_mdi = probe
        wire = Wire(made(fake, tmp_path, hal=hal))
        touch = await wire.ask("probe", target=[0.0, 0.0, 0.0], feed=0.001)
        assert touch["position"] == pytest.approx([0.005, 0.004, 0.003], abs=1e-12)
        await wire.disconnect()

    asyncio.run(test())
