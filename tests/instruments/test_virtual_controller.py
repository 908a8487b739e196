"""The controller of the virtual machine, over its line."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from armed import CONTROLLER
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.virtual import (
    ControllerSettings,
    VirtualController,
    decode_answer,
    encode_request,
    event_fields,
)
from errormotion.instruments.simulators import world
from errormotion.instruments.spindle_frame.five_sensor_frame import FiveSensorFrame, FrameSettings
from errormotion.twin import Event

ADDRESS = "sim://cframe/controller?seed=3"
QUICK = ControllerSettings(arm=True, timeout=0.3)


def test_a_request_is_a_line_of_json() -> None:
    assert encode_request(7, "mount", {"tool": "bar"}) == b'{"id": 7, "op": "mount", "tool": "bar"}\n'


def test_an_answer_is_checked_against_its_request() -> None:
    assert decode_answer(b'{"id": 7, "ok": true, "result": [1]}\n', 7).result == [1]
    with pytest.raises(InstrumentError, match="refuses: no such tool"):
        decode_answer(b'{"id": 7, "ok": false, "error": "no such tool"}\n', 7).result  # noqa: B018
    for line in (b'{"id": 8, "ok": true, "result": 1}', b"hello", b"[]", b'{"id": 7, "ok": true}', b"\xff"):
        with pytest.raises(ProtocolError, match="request 7"):
            decode_answer(line, 7)


@pytest.mark.parametrize(
    "event",
    [Event(60.0, spindle_speed=15000.0, compensation={"Z": False}), {"time": 60.0, "spindle_speed": 15000.0}],
)
def test_events_are_objects_or_mappings(event: object) -> None:
    fields = event_fields(event)
    assert (fields["time"], fields["spindle_speed"]) == (60.0, 15000.0)


@pytest.mark.parametrize("event", [{}, {"time": 1.0, "speed": 3}, "now"])
def test_invalid_events_are_refused(event: object) -> None:
    with raises("event.form"):
        event_fields(event)


def test_the_state_follows_the_schedule() -> None:
    with VirtualController(ADDRESS, CONTROLLER) as controller:
        controller.start([Event(0.0, spindle_speed=15000.0), Event(60.0, compensation={"Z": False})])
        assert controller.state() == {
            "time": 0.0,
            "position": [0.0, 0.0, 0.0],
            "commanded_position": [0.0, 0.0, 0.0],
            "spindle_speed": 0.0,  # it has only been reported to turn
            "commanded_spindle_speed": 15000.0,
            "spindle_load": 0.0,
            "feed": 0.0,
            "mode": "mdi",
            "program": "",
            "running": False,
            "homed": True,
            "enabled": True,
            "estop": False,
            "alarms": [],
            "compensation": {"X": True, "Y": True, "Z": True},
            "stepping": False,
            "tool": "bar",
        }
        controller.elapse(60.0)
        state = controller.read()
        assert state["compensation"]["Z"] is False
        assert state["spindle_speed"] == pytest.approx(15000.0, abs=1e-6)
        assert state["spindle_load"] == pytest.approx(1.0, abs=1e-9)
        controller.start([])
        assert controller.state()["time"] == 0.0


def test_the_identity_states_simulated() -> None:
    with VirtualController(ADDRESS, CONTROLLER) as controller:
        identity = controller.identify()
    assert (identity.model, identity.serial_number, identity.simulated) == ("cframe", "seed 3", True)


@pytest.mark.parametrize(
    ("order", "message"),
    [
        (lambda c: c.mount("hammer"), "Expected the tool 'bar', 'sphere' or 'probe'"),
        (lambda c: c.start([Event(0.0, spindle_speed=1e6)]), "refuses: The spindle turns at 0 to"),
        (lambda c: c.elapse(-1.0), "Expected a time of at least 0 s"),
        (lambda c: c.run_steps((0, 0, 0), (0, 1, 0), 20e-6, 5), "mount it first"),
        (lambda c: c._call("dance"), "unknown operation: dance"),
        (lambda c: c._call("mount"), "expected a request in JSON"),
    ],
)
def test_commands_that_the_machine_cannot_execute_are_refused_with_a_text(order: object, message: str) -> None:
    with VirtualController(ADDRESS, CONTROLLER) as controller:
        with pytest.raises(InstrumentError, match=message):
            order(controller)
        assert controller.state()["alarms"] == []


def ask_often(controller: VirtualController, times: int) -> None:
    for _ in range(times):
        controller.state()


def step_in_front_of_x1(frame: FiveSensorFrame, controller: VirtualController, count: int) -> np.ndarray:
    """Readings of X1 while the sphere moves along y in front of it in steps of 20 um."""
    controller.mount("sphere")
    geometry = frame.geometry
    centre = geometry.nominal_origin[0] + geometry.nominal_direction[0] * (1e-3 + 5e-3)
    program = controller.run_steps(
        centre - [0, (count - 1) / 2 * 20e-6, 0], (0, 1, 0), 20e-6, count, dwell=1.0, travel=0.1
    )
    seconds = program["duration"] + program["longest_lead_in"] + 0.5
    blocks = itertools.islice(frame.stream(["X1"]), int(seconds / 0.5) + 1)
    return np.concatenate([block.values[0] for block in blocks])


def test_a_stepped_sphere_is_measured_after_an_undeclared_lead_in() -> None:
    with (
        FiveSensorFrame("sim://cframe?seed=3", FrameSettings(rate=1500.0, timeout=10.0)) as frame,
        VirtualController(ADDRESS, CONTROLLER) as controller,
    ):
        readings = step_in_front_of_x1(frame, controller, 11)
        begin = world("cframe", 3).motion.begin
        assert not controller.state()["stepping"]
    assert 0.5 <= begin <= 2.5
    second = np.array([readings[int((begin + 0.55 + 1.1 * k) * 1500) :][:1300].mean() for k in range(11)])
    rests = np.array([readings[int((begin + 0.55 + 1.1 * k) * 1500) :][:1300].std() for k in range(11)])
    assert (rests < 0.4e-6).all()  # noise of 0.3 um only: the sphere rests
    # A parabola of curvature 1 / radius: over +-0.1 mm the sphere of 5 mm radius falls off by 1 um.
    curvature = np.polyfit(np.arange(-5, 6) * 20e-6, second, 2)[0] * 2
    assert curvature == pytest.approx(1 / 5e-3, abs=150)  # 0.5 um speckle over 0.1 mm


def test_two_lead_ins_differ_and_a_second_program_waits_for_the_first() -> None:
    with VirtualController(ADDRESS, CONTROLLER) as controller:
        controller.mount("sphere")
        begins = []
        for _ in range(2):
            program = controller.run_steps((0, 0, 0), (1, 0, 0), 20e-6, 2)
            begins.append(world("cframe", 3).motion.begin - world("cframe", 3).time)
            with pytest.raises(InstrumentError, match="still stepping"):
                controller.run_steps((0, 0, 0), (1, 0, 0), 20e-6, 2)
            assert controller.state()["stepping"]
            controller.elapse(program["duration"] + program["longest_lead_in"])
            assert not controller.state()["stepping"]
    assert begins[0] != begins[1]


def test_a_sphere_that_is_mounted_but_not_set_up_is_not_measured() -> None:
    with (
        FiveSensorFrame("sim://cframe?seed=3", FrameSettings(rate=1500.0, timeout=10.0)) as frame,
        VirtualController(ADDRESS, CONTROLLER) as controller,
    ):
        controller.mount("sphere")
        assert np.isnan(frame.read()).all()
        controller.mount("bar")
        assert np.isfinite(frame.read()).all()


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("silence", InstrumentTimeoutError),
        ("drop", InstrumentTimeoutError),
        ("garbage", ProtocolError),
        ("disconnect", InstrumentError),
    ],
)
@pytest.mark.parametrize("at", [0, 2])
def test_each_fault_becomes_a_typed_error(fault: str, error: type[InstrumentError], at: int) -> None:
    controller = VirtualController(f"{ADDRESS}&fault={fault}&fault_at={at}", QUICK)
    with pytest.raises(error), controller:
        ask_often(controller, 3)
    controller.close()


def test_split_answers_have_no_effect() -> None:
    with VirtualController(f"{ADDRESS}&fault=split", CONTROLLER) as controller:
        assert controller.state()["tool"] == "bar"


def test_a_recorded_session_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "controller.rec"

    def session(address: str, record: Path | None) -> dict[str, object]:
        with VirtualController(address, CONTROLLER, record=record) as controller:
            controller.mount("sphere")
            controller.elapse(5.0)
            return controller.state()

    assert session(ADDRESS, path) == session(f"replay://{path}", None)
