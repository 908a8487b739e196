"""MTConnect agents: states, sequence numbers, lost observations, restarts, faults."""

import math
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path

import pytest
from armed import CONTROLLER
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.mtconnect import MTConnect, MTConnectSettings
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.simulators import world
from errormotion.instruments.transports.http.serving import HttpServer

ADDRESS = "sim://cframe/mtconnect?seed=3"
QUICK = MTConnectSettings(timeout=0.3)


def read_often(agent: MTConnect) -> None:
    for _ in range(4):
        agent.read()


def test_a_state_is_that_of_the_machine() -> None:
    with MTConnect(ADDRESS) as agent, VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control:
        assert agent.identify().model == "cframe"
        assert agent.identify().simulated
        control.spindle(6000.0)
        control.move_to((0.1, 0.05, 0.2), 0.05)
        reported, true = agent.state(), control.state()
    assert reported["time"] == pytest.approx(true["time"], abs=1e-5)  # the agent reports microseconds
    assert reported["position_time"] == reported["time"]
    for key in ("position", "commanded_position"):
        assert reported[key] == pytest.approx(true[key], abs=0.6e-7)  # half the last digit, 0.1 um
    assert reported["spindle_speed"] == pytest.approx(true["spindle_speed"], abs=0.06)
    assert reported["spindle_load"] == pytest.approx(true["spindle_load"], abs=1e-4)
    assert reported["mode"] == "mdi"
    assert reported["enabled"]
    assert not reported["running"]
    assert reported["homed"] is None
    assert reported["alarms"] == []
    assert reported["unavailable"] == ["program"]


def test_a_program_and_its_feed_are_reported_while_it_runs() -> None:
    program = "(there and back)\nG1 X100 F600\nG1 X0\nM30\n"
    with MTConnect(ADDRESS) as agent, VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control:
        control.run_program(program)
        control.elapse(5.0)
        state = agent.state()
    assert state["running"]
    assert state["mode"] == "automatic"
    assert state["program"] == "there and back"
    assert state["feed"] == pytest.approx(0.01, abs=1e-6)
    assert 0 < state["position"][0] < 0.1


def test_alarms_and_emergency_stop_are_reported() -> None:
    with MTConnect(ADDRESS) as agent, VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control:
        control.press_estop()
        state = agent.state()
        assert state["estop"]
        assert not state["enabled"]
        assert state["alarms"] == ["SYSTEM 1104: emergency stop"]
        control.reset()
        assert agent.state()["alarms"] == []


def test_a_machine_that_is_off_is_unknown_and_not_zero() -> None:
    with MTConnect(f"{ADDRESS}&fault=unavailable") as agent:
        state = agent.state()
        reading = agent.read()
    assert all(math.isnan(x) for x in [*state["position"], state["spindle_speed"], state["feed"]])
    assert not state["enabled"]
    assert {"position", "spindle_speed", "mode", "availability"} <= set(state["unavailable"])
    assert "homed" not in reading


def test_samples_are_new_observations() -> None:
    with MTConnect(ADDRESS) as agent:
        first = agent.sample()
        numbers = [each.sequence for each in first.observations]
        assert numbers == sorted(set(numbers))
        assert {each.item for each in first.observations} == set(agent.items)
        assert first.next == numbers[-1] + 1
        assert agent.sample().observations == ()
        world("cframe", 3).move_to((0.1, 0.0, 0.0))
        moved = agent.sample()
        assert [each.item for each in moved.observations] == ["Xact", "Xcom"]
        assert moved.observations[0].sequence == first.next
        assert (agent.lost, agent.restarts) == (0, 0)


def test_a_small_count_is_requested_until_all_have_been_received() -> None:
    with MTConnect(ADDRESS, MTConnectSettings(count=1)) as agent:
        agent.sample()
        world("cframe", 3).move_to((0.1, 0.0, 0.0))
        assert [agent.sample().observations[0].item for _ in range(2)] == ["Xact", "Xcom"]


@pytest.mark.parametrize("fault", ["overrun", "jump"])
@pytest.mark.parametrize("streaming", [False, True])
def test_observations_that_were_overwritten_are_counted(fault: str, streaming: bool) -> None:
    with MTConnect(f"{ADDRESS}&fault={fault}&fault_at=4&buffer=50") as agent:
        before = agent.sample().next
        source = agent.observations(0.01) if streaming else iter(agent.sample, None)
        hole = next(each for each in source if each.lost)
        assert hole.observations[0].sequence == before + hole.lost
        assert len(hole.observations) == 50
        assert hole.next == before + 101  # twice the size of the buffer, and then the actual load
        assert agent.lost == hole.lost == 101 - 50
        assert next(source).lost == 0
        if streaming:
            source.close()
        assert agent.state()["enabled"]


@pytest.mark.parametrize("streaming", [False, True])
def test_a_restarted_agent_is_detected_and_read_from_its_start(streaming: bool) -> None:
    with MTConnect(f"{ADDRESS}&fault=restart&fault_at=5") as agent:
        before = agent.sample()
        source = agent.observations(0.01) if streaming else iter(agent.sample, None)
        after = next(each for each in source if each.restarted)
        assert after.observations[0].sequence == 1
        last = {each.item: each.value for each in after.observations}
        assert last == {each.item: each.value for each in before.observations}
        assert agent.restarts == 1
        if streaming:
            source.close()


def test_a_restart_without_a_listener_is_detected_too() -> None:
    agent = MTConnect(ADDRESS)
    with agent:
        agent.sample()
    agent._instance = 1  # as before: a simulated agent always starts with the same
    with agent:
        assert agent.restarts == 1
        assert agent.sample().restarted
        assert not agent.sample().restarted


@pytest.mark.parametrize(
    ("status", "head", "message"),
    [
        (
            "301 Moved Permanently",
            "Location: http://10.0.0.7:5000/agent\r\n",
            r"redirects .*301.* to 'http://10.0.0.7:50",
        ),
        ("302 Found", "Location: /login\r\n", r"redirects .*302.* to '/login'"),
        ("401 Unauthorized", "", "HTTP status 401 without a document of MTConnect"),
        ("503 Service Unavailable", "", "HTTP status 503 without a document of MTConnect"),
    ],
)
def test_the_status_of_a_server_is_named_and_not_its_page(status: str, head: str, message: str) -> None:
    page = b"<html><body>Moved<br></body></html>"

    def respond(path: str, query: Mapping[str, str]) -> Iterator[bytes]:
        lines = f"HTTP/1.1 {status}\r\nContent-Type: text/html\r\n{head}Content-Length: {len(page)}\r\n\r\n"
        yield lines.encode() + page

    server = HttpServer("site", respond)
    try:
        with pytest.raises(InstrumentError, match=message) as caught:
            MTConnect(server.url.replace("tcp://", "http://")).open()
    finally:
        server.close()
    assert "XML" not in str(caught.value)


def test_a_stream_continues_from_the_end_of_the_last_one() -> None:
    with MTConnect(ADDRESS) as agent:
        stream = agent.observations(0.01)
        first = next(stream)
        assert {each.item for each in first.observations} == set(agent.items)
        assert next(stream).observations == ()
        stream.close()
        world("cframe", 3).move_to((0.1, 0.0, 0.0))
        moved = next(agent.observations(0.01))
        assert [each.item for each in moved.observations] == ["Xact", "Xcom"]


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("silence", InstrumentTimeoutError),
        ("drop", InstrumentTimeoutError),
        ("garbage", ProtocolError),
        ("disconnect", InstrumentError),
    ],
)
@pytest.mark.parametrize("at", [0, 3])
def test_each_fault_becomes_a_typed_error(fault: str, error: type[InstrumentError], at: int) -> None:
    agent = MTConnect(f"{ADDRESS}&fault={fault}&fault_at={at}", QUICK)
    with pytest.raises(error), agent:
        read_often(agent)


@pytest.mark.parametrize(("fault", "error"), [("silence", InstrumentTimeoutError), ("disconnect", InstrumentError)])
def test_a_fault_in_the_middle_of_a_stream_is_a_typed_error(fault: str, error: type[InstrumentError]) -> None:
    with (
        MTConnect(f"{ADDRESS}&fault={fault}&fault_at=6", QUICK) as agent,
        pytest.raises(error),
    ):
        list(islice(agent.observations(0.01), 30))


def test_splitting_has_no_effect() -> None:
    readings = []
    for fault in ("", "&fault=split"):
        with MTConnect(ADDRESS + fault) as agent:
            readings.append((agent.read(), agent.sample(), list(islice(agent.observations(0.01), 2))))
    assert readings[0] == readings[1]


def test_a_document_that_is_too_large_is_refused() -> None:
    with raises("protocol.reply.too_long"):
        MTConnect(ADDRESS, MTConnectSettings(most_bytes=1024)).open()


def test_a_recorded_session_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "agent.rec"

    def session(agent: MTConnect) -> tuple[object, ...]:
        with agent:
            reading, first = agent.read(), agent.sample()
            stream = agent.observations(0.01)
            streamed = next(stream)
            stream.close()
            return reading, first, streamed, agent.identify().serial_number

    recorded = session(MTConnect(ADDRESS, record=path))
    assert session(MTConnect(f"replay://{path}")) == recorded
