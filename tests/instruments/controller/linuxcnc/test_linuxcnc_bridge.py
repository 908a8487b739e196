"""The bridge with a LinuxCNC that is a fake: what goes wrong, and what comes in."""

import asyncio
import json
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from errormotion.instruments.controller.linuxcnc import bridge as module
from errormotion.instruments.controller.linuxcnc.bridge import Bridge

AXIS = {"min_position_limit": -100.0, "max_position_limit": 100.0}


class FakeLinuxCNC:
    """LinuxCNC's module, and the machine behind it: every line of MDI is carried out at once."""

    STATE_ESTOP, STATE_ESTOP_RESET, STATE_OFF, STATE_ON = 1, 2, 3, 4
    MODE_MANUAL, MODE_AUTO, MODE_MDI = 1, 2, 3
    INTERP_IDLE, INTERP_READING = 1, 2
    RCS_DONE, RCS_EXEC, RCS_ERROR = 1, 2, 3
    NML_ERROR, OPERATOR_ERROR, OPERATOR_TEXT = 1, 11, 12
    AUTO_RUN, SPINDLE_OFF = 0, 0
    version = "2.9.fake"

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.texts: list[tuple[int, str]] = []
        self.on_mdi: Callable[[str], None] = lambda line: None
        self.on_run: Callable[[], None] = lambda: None
        self.values = SimpleNamespace(
            **dict.fromkeys(("actual_position", "position", "g5x_offset", "g92_offset", "tool_offset"), (0.0,) * 9),
            axis=(AXIS,) * 3,
            linear_units=1.0,
            current_vel=0.0,
            ini_filename="/there/machine.ini",
            file="",
            gcodes=(210, 900, 940),
            homed=(1, 1, 1),
            joint=({"homing": 0},) * 3,
            joints=3,
            interp_state=self.INTERP_IDLE,
            state=self.RCS_DONE,
            task_state=self.STATE_ON,
            task_mode=self.MODE_MANUAL,
            echo_serial_number=0,
            queue=0,
            inpos=True,
            probe_val=0,
            probe_tripped=False,
            probed_position=(0.0,) * 9,
            rotation_xy=0.0,
            spindle=({"speed": 0.0, "direction": 0},),
        )
        self.values.poll = lambda: None
        self.deaf = False

    def stat(self) -> Any:
        return self.values

    def command(self) -> Any:
        return self

    def error_channel(self) -> Any:
        return SimpleNamespace(poll=lambda: self.texts.pop(0) if self.texts else None)

    def ini(self, file: str) -> Any:
        return SimpleNamespace(find=lambda section, name: None)

    @property
    def serial(self) -> int:
        return len(self.lines)

    def _took(self, text: str) -> None:
        self.lines.append(text)
        self.values.echo_serial_number = 0 if self.deaf else len(self.lines)

    def mode(self, mode: int) -> None:
        self._took(f"mode {mode}")
        self.values.task_mode = mode

    def state(self, state: int) -> None:
        self._took(f"state {state}")
        self.values.task_state = state

    def mdi(self, line: str) -> None:
        self._took(line)
        self.on_mdi(line)

    def abort(self) -> None:
        self._took("abort")
        self.values.interp_state = self.INTERP_IDLE

    def auto(self, what: int, line: int) -> None:
        self._took("run")
        self.on_run()

    def program_open(self, file: str) -> None:
        self._took("open")
        self.values.file = file

    def home(self, joint: int) -> None:
        self._took("home")

    def teleop_enable(self, on: int) -> None:
        self._took(f"teleop {on}")

    def spindle(self, what: int) -> None:
        self._took(f"spindle {what}")

    def error(self, text: str) -> None:
        self.texts.append((self.OPERATOR_ERROR, text))


class FakeHAL:
    def __init__(self) -> None:
        self.pins: dict[str, float] = {}

    def get_value(self, name: str) -> float:
        return self.pins[name]

    def pin_has_writer(self, name: str) -> bool:
        return name in self.pins

    def set_p(self, name: str, value: str) -> None:
        self.pins[name] = float(value)


class Wire:
    """A client's end: what the bridge writes, line by line."""

    def __init__(self, bridge: Bridge) -> None:
        self.reader = asyncio.StreamReader(limit=module.MAX_REQUEST_BYTES)
        self.answers: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self.beats = 0
        self.transport = SimpleNamespace(get_write_buffer_size=lambda: 0, abort=lambda: None)
        self.task = asyncio.ensure_future(bridge.serve(self.reader, self))  # type: ignore[arg-type]

    def write(self, data: bytes) -> None:
        message = json.loads(data)
        if "beat" in message:
            self.beats += 1
        else:
            self.answers.put_nowait(message)

    def is_closing(self) -> bool:
        return False

    def close(self) -> None:
        pass

    def send(self, op: Any, **arguments: Any) -> None:
        self.reader.feed_data(json.dumps({"id": 7, "op": op, **arguments}).encode() + b"\n")

    async def ask(self, op: Any, **arguments: Any) -> Any:
        """Return the result, or the text of the refusal."""
        self.send(op, **arguments)
        answer = await asyncio.wait_for(self.answers.get(), 10)
        assert answer["id"] == 7
        return answer["result"] if answer["ok"] else answer["error"]

    async def disconnect(self) -> None:
        self.reader.feed_eof()
        await self.task


Test = Callable[[Wire, FakeLinuxCNC, Bridge], Coroutine[Any, Any, None]]


@pytest.fixture
def play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Test], None]:
    """Return what runs a test with a client at a bridge; LinuxCNC is given less time than in earnest."""
    monkeypatch.setattr(module, "ACCEPT_TIMEOUT", 0.2)
    monkeypatch.setattr(module, "CHANGE_TIMEOUT", 0.1)
    monkeypatch.setattr(module, "TEXT_TIMEOUT", 0.05)

    def run(test: Test) -> None:
        async def session() -> None:
            fake = FakeLinuxCNC()
            bridge = Bridge(fake, FakeHAL(), tmp_path, ("ball",), "load")
            wire = Wire(bridge)
            await test(wire, fake, bridge)
            await wire.disconnect()
            assert not bridge.clients

        asyncio.run(session())

    return run


def moving_to(fake: FakeLinuxCNC, place: tuple[float, ...]) -> Callable[[str], None]:
    def arrive(line: str) -> None:
        fake.values.position = (*place, *(0.0,) * 6)

    return arrive


@pytest.mark.parametrize(
    "line",
    [b"hello", b"\xff\xfe", b"[]", b"{}", b'{"id": 1}', b'{"id": 1, "op": []}', b"null", b"[" * 100000, b"7", b""],
)
def test_nothing_that_comes_in_ends_it(play: Callable[[Test], None], line: bytes) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        wire.reader.feed_data(line + b"\n")
        assert "expected a request in JSON" in (await asyncio.wait_for(wire.answers.get(), 10))["error"]
        assert (await wire.ask("state"))["enabled"] is True

    play(test)


def test_a_request_without_end_is_hung_up_on(play: Callable[[Test], None], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_REQUEST_BYTES", 1000)

    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        wire.reader.feed_data(b"x" * 5000)
        await wire.task
        assert "1000 bytes" in wire.answers.get_nowait()["error"]
        assert not bridge.clients

    play(test)


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
        ("probe", {"target": [0, 0, 0], "feed": 0.1}, "is at the target"),
        ("probe", {"target": [0, 0, 0.01], "feed": None}, "expected a feed"),
        ("spindle", {"speed": "fast"}, "expected spindle speed"),
        ("run_program", {"text": 5}, "expected the text"),
        ("elapse", {"seconds": -1}, "expected a time"),
        ("set_pins", {"pins": {"spindle.0.speed-in": 1}}, "not among those that clients may set"),
    ],
)
def test_wrong_orders_are_refused_in_words(
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


def test_of_a_linuxcnc_that_is_starting_nothing_is_told(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.values.linear_units = 0.0
        assert "still starting" in await wire.ask("state")

    play(test)


def test_messages_are_no_alarms_but_errors_are(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.texts = [(fake.OPERATOR_TEXT, "hello"), (fake.OPERATOR_ERROR, "joint 1 following error")]
        assert (await wire.ask("state"))["alarms"] == ["joint 1 following error"]
        await wire.ask("reset")
        assert (await wire.ask("state"))["alarms"] == []

    play(test)


def test_an_error_without_a_text_is_an_error_all_the_same(play: Callable[[Test], None]) -> None:
    """Another display may have taken the text: it is the position that reports."""

    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        assert "stopped before its goal, at 0.0000, 0.0000, 0.0000 mm" in await wire.ask(
            "move_to", position=[0, 0, 0.1]
        )

    play(test)


def test_the_text_of_an_error_may_come_late(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.on_mdi = lambda line: asyncio.get_running_loop().call_later(0.02, fake.error, "too bad")  # type: ignore[assignment,return-value]
        assert (await wire.ask("move_to", position=[0, 0, 0.1])).endswith(
            "before its goal, at 0.0000, 0.0000, 0.0000 mm: too bad"
        )

    play(test)


def test_units_are_set_on_a_line_before_and_put_back(play: Callable[[Test], None]) -> None:
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
        ({"interp_state": FakeLinuxCNC.INTERP_READING}, "this bridge has not ordered"),
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


def test_an_e_stop_by_hand_breaks_a_move_off(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.on_mdi = lambda line: setattr(fake.values, "task_state", fake.STATE_ESTOP)
        assert "move to was aborted: e-stop" in await wire.ask("move_to", position=[0, 0, 0.1])
        fake.values.task_state = fake.STATE_ON
        fake.on_mdi = lambda line: setattr(fake.values, "task_state", fake.STATE_OFF)
        assert "switched off" in await wire.ask("move_to", position=[0, 0, 0.1])

    play(test)


def test_an_order_that_linuxcnc_never_takes_is_given_up(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.deaf = True
        assert "does not respond: change of mode" in await wire.ask("move_to", position=[0, 0, 0.1])
        assert fake.lines[-1] == "abort"
        assert bridge.job is None

    play(test)


def test_the_e_stop_that_stays_pressed_is_told(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.state = lambda state: fake._took("ignored")  # type: ignore[method-assign]
        fake.values.task_state = fake.STATE_ESTOP
        assert "check the buttons" in await wire.ask("reset")
        fake.values.task_state = fake.STATE_OFF
        assert "stays off" in await wire.ask("enable")

    play(test)


def test_a_homing_that_fails_says_why(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.values.homed = (0, 0, 0)
        fake.home = lambda joint: fake.error("no home switch")  # type: ignore[method-assign]
        assert await wire.ask("home") == "homing failed: no home switch"

    play(test)


def test_an_order_beats_until_it_ends_and_others_wait_their_turn(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        fake.on_mdi = lambda line: setattr(fake.values, "interp_state", fake.INTERP_READING)
        wire.send("move_to", position=[0, 0, 0.1])
        other = Wire(bridge)
        while not (await other.ask("state"))["ordered"]:
            await asyncio.sleep(0.01)
        assert await other.ask("spindle", speed=1) == "the machine is busy: move to"
        assert await other.ask("stop") is None
        assert "aborted: it was stopped" in (await asyncio.wait_for(wire.answers.get(), 10))["error"]
        assert wire.beats >= 1
        assert fake.lines.count("abort") == 1
        await other.disconnect()

    play(test)


def test_a_client_that_hangs_up_takes_its_motion_with_it(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        other = Wire(bridge)
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
def test_what_is_broken_off_before_it_began_does_not_begin(
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


def test_waiting_ends_by_a_stop(play: Callable[[Test], None]) -> None:
    async def test(wire: Wire, fake: FakeLinuxCNC, bridge: Bridge) -> None:
        assert await wire.ask("elapse", seconds=0.01) is None
        wire.send("elapse", seconds=100)
        await asyncio.sleep(0.01)
        other = Wire(bridge)
        await other.ask("stop")
        assert (await asyncio.wait_for(wire.answers.get(), 10))["error"] == "waiting was stopped"
        await other.disconnect()

    play(test)


def test_an_error_of_linuxcncs_own_module_is_an_answer(play: Callable[[Test], None]) -> None:
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
