"""The touch probe, the spindle, stops and alarms of the virtual controller, over its line."""

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from armed import CONTROLLER
from coded import raises

from errormotion.errors import InstrumentError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld
from errormotion.instruments.spindle_frame.five_sensor_frame import FiveSensorFrame, FrameSettings
from errormotion.twin import Event, VirtualMachine

ADDRESS = "sim://gantry/controller?seed=3"
SEARCH, SLOW = 10e-3, 1e-3  # m/s
BESIDE = np.array([0.03, 0.0, 0.0])
PROGRAM = "(TO AND FRO)\nG1 X1000 F6000\nG1 X0\nM30"


@pytest.fixture
def controller() -> Iterator[VirtualController]:
    with VirtualController(ADDRESS, CONTROLLER) as opened:
        yield opened


@pytest.fixture
def here(controller: VirtualController) -> VirtualWorld:
    return world("gantry", 3)


def ball(number: int = 0) -> np.ndarray:
    return VirtualMachine("gantry", 3).balls.nominal[number]


# ---------------------------------------------------------------------- the probe


def test_a_probe_trips_and_stops_at_the_position_of_the_twin(controller: VirtualController, here: VirtualWorld) -> None:
    controller.move_to(ball() + BESIDE)
    begin = controller.state()["time"]
    found = controller.probe(ball(), SLOW)
    place, way = here.machine.contact(ball() + BESIDE, ball(), begin, SLOW)
    assert found["tripped"]
    np.testing.assert_array_equal(found["position"], place)
    assert found["time"] == pytest.approx(begin + way / SLOW, abs=1e-9)
    state = controller.state()
    assert state["position"] == found["position"] == state["commanded_position"]
    assert state["time"] == found["time"]
    assert state["tool"] == "probe"


def test_a_probe_without_contact_ends_at_its_target(controller: VirtualController) -> None:
    above = ball() + np.array([0.0, 0.0, 0.05])
    controller.move_to(above)
    begin = controller.state()["time"]
    found = controller.probe(above + BESIDE, SEARCH)
    assert found == {"tripped": False, "position": None, "time": pytest.approx(begin + 3.0, abs=1e-9)}
    np.testing.assert_allclose(controller.state()["position"], above + BESIDE, atol=1e-15)


def test_a_probe_on_a_ball_is_tripped_before_it_moves(controller: VirtualController) -> None:
    controller.move_to(ball() + BESIDE)
    touched = controller.probe(ball(), SLOW)["position"]
    with pytest.raises(InstrumentError, match="The probe is tripped before it moves"):
        controller.probe(ball(), SLOW)
    assert controller.state()["position"] == touched
    controller.move_to(touched + BESIDE / 10)  # it may leave the ball
    again = controller.probe(ball(), SLOW)
    # two triggers of 0.25 um, five sigma of their difference
    assert np.linalg.norm(np.subtract(again["position"], touched)) < 1.8e-6
    assert controller.state()["alarms"] == []


def test_a_collision_of_the_probe_with_a_ball_stops_it_and_raises_an_alarm(controller: VirtualController) -> None:
    controller.mount("probe")
    controller.move_to(ball() + BESIDE)
    with pytest.raises(InstrumentError, match="the probe has tripped during a move"):
        controller.move_to(ball() - BESIDE)
    assert 0.015 < controller.state()["position"][0] - ball()[0] < 0.0158  # tip and ball, aimed 0.3 mm beside
    assert not controller.state()["enabled"]
    with pytest.raises(InstrumentError, match="in alarm: the probe has tripped"):
        controller.probe(ball(), SLOW)
    controller.reset()
    controller.move_to(ball() + BESIDE)
    assert controller.state()["alarms"] == []


def test_without_the_probe_balls_do_not_obstruct(controller: VirtualController) -> None:
    controller.move_to(ball() + BESIDE)
    controller.move_to(ball() - BESIDE)
    assert controller.state()["alarms"] == []


def test_more_balls_are_set_up_on_request() -> None:
    with VirtualController(f"{ADDRESS}&balls=6", CONTROLLER) as controller:
        sixth = VirtualMachine("gantry", 3).balls_on_table(6).nominal[5]
        controller.move_to(sixth + BESIDE)
        assert controller.probe(sixth, SLOW)["tripped"]


def test_a_displaced_ball_is_touched_at_its_new_position(controller: VirtualController, here: VirtualWorld) -> None:
    controller.move_to(ball() + BESIDE)
    before = controller.probe(ball(), SLOW)["position"]
    here.balls = here.balls.moved(0, (50e-6, 0.0, 0.0))
    controller.move_to(ball() + BESIDE)
    after = controller.probe(ball(), SLOW)["position"]
    assert after[0] - before[0] == pytest.approx(50e-6, abs=2e-6)


@pytest.mark.parametrize(
    ("order", "why"),
    [
        (lambda c: c.probe((5.0, 0.0, 0.0), SLOW), "X travels from 0 to 4 m"),
        (lambda c: c.probe((1.0, 0.0), SLOW), "three finite numbers"),
        (lambda c: c.probe((1.0, 0.0, 0.0), 0.0), "expected a finite feed above 0"),
        (lambda c: c.probe((1.0, 0.0, 0.0), 1.0), "Expected a feed above 0 and at most"),
        (lambda c: (c.spindle(3000.0), c.probe((1.0, 0.0, 0.0), SLOW)), "spindle turns at 3000 /min; stop it"),
        (lambda c: (c.run_program(PROGRAM), c.probe((1.0, 0.0, 0.0), SLOW)), "still running"),
        (lambda c: c.spindle(1e6), "spindle turns at 0 to"),
        (lambda c: c.spindle(-10.0), "spindle turns at 0 to"),
    ],
)
def test_an_impossible_command_moves_nothing(
    controller: VirtualController, order: Callable[[VirtualController], object], why: str
) -> None:
    with pytest.raises(InstrumentError, match=why):
        order(controller)
    assert controller.state()["position"] == [0.0, 0.0, 0.0]
    assert controller.state()["time"] == 0.0


def test_nothing_is_probed_while_sensors_stream() -> None:
    with (
        FiveSensorFrame("sim://cframe?seed=3", FrameSettings(rate=1500.0, timeout=10.0)) as frame,
        VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as controller,
    ):
        stream = frame.stream()
        next(stream)
        with pytest.raises(InstrumentError, match=r"Cannot probe while .*X1.* stream"):
            controller.probe((0.0, 0.0, 0.1), SLOW)
        stream.close()


# ---------------------------------------------------------------------- the spindle


def test_the_temperatures_of_the_machine_follow_the_commands_in_time(
    controller: VirtualController, here: VirtualWorld
) -> None:
    controller.start([])
    controller.elapse(600.0)
    controller.spindle(12000.0)
    controller.elapse(1800.0)
    controller.spindle(0.0)
    controller.elapse(900.0)
    scheduled = VirtualMachine("gantry", 3)
    scheduled.start([Event(600.0, spindle_speed=12000.0), Event(2400.0, spindle_speed=0.0)])
    t = np.arange(0.0, 3301.0, 60.0)
    np.testing.assert_array_equal(here.machine.spindle_twist(t), scheduled.spindle_twist(t))
    np.testing.assert_array_equal(here.machine.spindle_speed(t), scheduled.spindle_speed(t))


def test_the_heat_of_the_spindle_displaces_the_balls(controller: VirtualController, here: VirtualWorld) -> None:
    def touch() -> np.ndarray:
        controller.move_to(ball(1) + BESIDE)
        return np.array(controller.probe(ball(1), SLOW)["position"])

    controller.start([])
    cold = touch()
    controller.spindle(15000.0)
    assert controller.state()["tool"] == "bar"
    controller.elapse(7200.0)
    controller.spindle(0.0)
    warm = touch()
    error = here.machine.probe_error(cold, controller.state()["time"]) - here.machine.probe_error(cold, 0.0)
    assert abs(error[0, 0]) > 10e-6
    # two triggers, five sigma; and a contact a little aside on the ball: 60 um by 0.1 mm / 15 mm
    assert (warm - cold)[0] == pytest.approx(-error[0, 0], abs=2.2e-6)


def test_the_state_shows_the_spindle_as_it_turns(controller: VirtualController) -> None:
    controller.spindle(15000.0)
    controller.elapse(0.375)  # half of the acceleration time
    state = controller.state()
    assert state["spindle_speed"] == pytest.approx(7500.0, rel=1e-9)
    assert state["commanded_spindle_speed"] == 15000.0
    assert 0.0 < state["spindle_load"] < 0.5
    controller.elapse(1.0)
    assert controller.state()["spindle_load"] == pytest.approx(1.0, rel=1e-9)


def test_a_speed_commanded_in_a_stream_changes_no_sample_that_was_made() -> None:
    def session(*, faster: bool) -> tuple[np.ndarray, float]:
        with (
            FiveSensorFrame("sim://cframe?seed=3", FrameSettings(rate=1500.0, timeout=10.0)) as frame,
            VirtualController("sim://cframe/c?seed=3", CONTROLLER) as controller,
        ):
            controller.start([])
            stream = frame.stream(["X1"])
            blocks = [next(stream).values[0]]
            if faster:
                controller.spindle(15000.0)
            when = [e.time for e in world("cframe", 3).machine.state.schedule.events]
            blocks += [next(stream).values[0] for _ in range(int(2 * (when[0] if when else 0.0)) + 12)]
            stream.close()
            return np.concatenate(blocks), when[0] if when else np.inf

    turning, when = session(faster=True)
    still, _ = session(faster=False)
    same = min(int(when * 1500), still.size)
    # a block computed after the command is computed again up to the change: readings at rest agree to 0.5 nm
    np.testing.assert_allclose(turning[:same], still[:same], atol=1e-9)
    assert np.std(turning[int((when + 1.0) * 1500) :]) > 2 * np.std(still)  # runout


# ---------------------------------------------------------------------- stops and alarms


def test_a_stop_leaves_the_axes_where_they_are(controller: VirtualController) -> None:
    controller.spindle(5000.0)
    controller.run_program(PROGRAM)
    controller.elapse(8.0)  # started after 0.5 s to 2.5 s; 100 mm/s
    state = controller.state()
    assert (state["mode"], state["program"], state["running"]) == ("automatic", "TO AND FRO", True)
    assert state["feed"] == pytest.approx(0.1, rel=1e-9)
    controller.stop()
    stopped = controller.state()
    assert stopped["position"] == state["position"]
    assert 0.5 < stopped["position"][0] < 0.8
    assert (stopped["running"], stopped["feed"], stopped["mode"], stopped["program"]) == (False, 0.0, "mdi", "")
    assert stopped["commanded_spindle_speed"] == 5000.0
    controller.elapse(100.0)
    assert controller.state()["position"] == stopped["position"]
    controller.stop(spindle=True)
    assert controller.state()["commanded_spindle_speed"] == 0.0
    controller.move_to((0.0, 0.0, 0.0))  # a stop is not an alarm


def test_a_stop_before_a_program_starts_changes_nothing(controller: VirtualController) -> None:
    controller.run_program(PROGRAM)
    controller.stop()
    controller.elapse(60.0)
    assert controller.state()["position"] == [0.0, 0.0, 0.0]


def test_stepping_stops_at_the_present_step() -> None:
    with VirtualController("sim://cframe/c?seed=3", CONTROLLER) as controller:
        controller.mount("sphere")
        controller.run_steps((0.0, 0.0, 0.0), (1, 0, 0), 1e-3, 11, dwell=1.0, travel=0.1)
        controller.elapse(6.0)
        assert controller.state()["stepping"]
        place = controller.state()["position"]
        controller.stop()
        assert controller.state()["position"] == place
        assert not controller.state()["stepping"]


def test_after_a_refusal_the_next_request_is_sent_at_once(
    controller: VirtualController, monkeypatch: pytest.MonkeyPatch
) -> None:
    with raises("instrument.refused"):
        controller.mount("nothing like it")
    monkeypatch.setattr(controller, "resynchronise", lambda: pytest.fail("a refusal is an answer: nothing is late"))
    assert controller.state()["alarms"] == []


MOVES: dict[str, Callable[[VirtualController], object]] = {
    "move_to": lambda c: c.move_to((1.0, 0.0, 0.0)),
    "probe": lambda c: c.probe((1.0, 0.0, 0.0), SLOW),
    "run_program": lambda c: c.run_program(PROGRAM),
    "spindle": lambda c: c.spindle(1000.0),
    "mount": lambda c: c.mount("sphere"),
    "start": lambda c: c.start([Event(0.0, spindle_speed=1000.0)]),
}


@pytest.mark.parametrize("order", MOVES)
@pytest.mark.parametrize("fault", ["alarm", "estop"])
def test_in_alarm_nothing_moves_until_it_is_reset(fault: str, order: str) -> None:
    with VirtualController(f"{ADDRESS}&fault={fault}&fault_at=3", CONTROLLER) as controller:
        controller.spindle(2000.0)
        controller.run_program(PROGRAM)
        with pytest.raises(InstrumentError, match=r"in alarm: servo alarm|in emergency stop"):
            MOVES[order](controller)
        state = controller.state()
        assert state["estop"] == (fault == "estop")
        assert len(state["alarms"]) == 1
        assert not state["enabled"]
        assert not state["running"]
        assert state["commanded_spindle_speed"] == (0.0 if fault == "estop" else 2000.0)
        controller.elapse(60.0)
        assert controller.state()["position"] == [0.0, 0.0, 0.0]
        controller.reset()
        assert controller.state()["alarms"] == []
        assert controller.state()["enabled"]
        controller.spindle(0.0)
        MOVES[order](controller)


def test_an_emergency_stop_in_a_program_stops_axes_and_spindle(controller: VirtualController) -> None:
    controller.run_program("G1 X1000 F6000\nM3 S8000\nG1 X2000\nM30")
    controller.elapse(8.0)
    place = controller.state()["position"]
    controller.press_estop()
    controller.elapse(60.0)
    state = controller.state()
    assert state["position"] == place
    assert state["spindle_speed"] == 0.0
    assert state["alarms"] == ["emergency stop"]
    controller.stop(spindle=True)  # always allowed
    controller.reset()
    controller.elapse(60.0)
    assert controller.state()["spindle_speed"] == 0.0  # nothing starts automatically
    assert controller.state()["position"] == place


# ---------------------------------------------------------------------- faults of the probe


def test_a_probe_that_never_trips_continues_to_the_target() -> None:
    with VirtualController(f"{ADDRESS}&fault=no_trip&fault_at=4&fault_for=2", CONTROLLER) as controller:
        controller.move_to(ball() + BESIDE)
        assert controller.probe(ball(), SLOW)["tripped"]
        controller.move_to(ball() + BESIDE)
        assert not controller.probe(ball() + BESIDE / 2.2, SLOW)["tripped"]
        controller.move_to(ball() + BESIDE)
        assert controller.probe(ball(), SLOW)["tripped"]


def test_a_stuck_probe_does_not_start() -> None:
    with VirtualController(f"{ADDRESS}&fault=tripped&fault_at=2", CONTROLLER) as controller:
        controller.move_to(ball() + BESIDE)
        for _ in range(2):
            with pytest.raises(InstrumentError, match="tripped before it moves"):
                controller.probe(ball(), SLOW)
        np.testing.assert_allclose(controller.state()["position"], ball() + BESIDE, atol=1e-15)


# ---------------------------------------------------------------------- programs that probe


def skip_program(*numbers: int) -> str:
    lines = ["(BALLS)", "G21 G90 G94", "POPEN"]
    for number in numbers:
        x, y, z = 1e3 * ball(number)
        lines += [f"G0 Z{z + 30:.4f}", f"G0 X{x:.4f} Y{y:.4f}", f"G31 Z{z:.4f} F60", f"G1 Z{z + 30:.4f} F600"]
        lines += [f"DPRNT[B{number + 1}*X#5061[53]*Y#5062[53]*Z#5063[53]]"]
    return "\n".join([*lines, "PCLOS", "M30"])


def test_a_program_prints_where_the_probe_has_tripped(controller: VirtualController, here: VirtualWorld) -> None:
    program = controller.run_program(skip_program(0, 3))
    assert [line.split()[0] for _, line in here.printed] == ["B1", "B4"]
    for number, (when, line) in zip((0, 3), here.printed, strict=True):
        place = np.array([float(word[1:]) for word in line.split()[1:]]) * 1e-3
        # printed to a micrometre, tripped with a scatter of 0.25 um
        assert abs(here.machine.probe_gap(place, when, balls=here.balls)[0]) < 2e-6
        assert place[2] - ball(number)[2] == pytest.approx(15.5e-3, abs=0.35e-3)
    assert here.printed[-1][0] <= program["duration"] + program["longest_lead_in"]
    assert controller.state()["program"] == "BALLS"


def test_a_program_warms_the_spindle_and_stops_it_to_probe(controller: VirtualController, here: VirtualWorld) -> None:
    cold = skip_program(0).replace("M30", "M3 S15000\nG4 P3600\nM5\nG4 P1")
    program = controller.run_program(cold + skip_program(0).partition("POPEN")[2])
    controller.elapse(program["duration"] + program["longest_lead_in"])
    assert not controller.state()["running"]
    heights = [float(line.rpartition("Z")[2]) for _, line in here.printed]
    error = [here.machine.probe_error(ball(), t)[0, 2] for t, _ in here.printed]
    assert abs(error[1] - error[0]) > 4e-6
    assert (heights[1] - heights[0]) * 1e-3 == pytest.approx(error[0] - error[1], abs=2.5e-6)  # rounding and scatter


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        ("M3 S1000\nG31 X100 F100", r"Line 2 .*: the spindle turns at 1000 /min; M5 first"),
        ("M3 S99999", r"Line 1 .*: The spindle turns at 0 to"),
        ("DPRNT[Y#5062[53]]", "expected a skip move, G31, before its position is printed"),
        ("G31 X1 F100\nDPRNT[Y#100[53]]", "#100 is not supported; supported are #5061, #5062, #5063"),
        ("G31 X100", "a move with G31 before a feed"),
        ("G31 X1 F100\nG1 X400 Y-720 Z120", "the probe would trip on this path"),
        ("M3 S1000\nG1 X1", "a move with G1 before a feed"),
    ],
)
def test_a_program_that_cannot_run_sends_no_commands(
    controller: VirtualController, here: VirtualWorld, lines: str, why: str
) -> None:
    with pytest.raises(InstrumentError, match=why):
        controller.run_program(lines + "\nM30")
    assert here.machine.state.schedule.events == ()
    assert here.printed == []
    assert controller.state()["tool"] == "bar"
    assert not controller.state()["running"]


def test_a_stopped_program_sends_no_more_commands(controller: VirtualController, here: VirtualWorld) -> None:
    controller.start([Event(0.0, spindle_speed=500.0), Event(300.0, spindle_speed=1000.0)])
    controller.run_program("M3 S2000\nG4 P60\nM3 S3000\nG4 P60\nM30")
    controller.elapse(10.0)
    controller.stop()
    controller.elapse(100.0)
    assert controller.state()["commanded_spindle_speed"] == 2000.0
    controller.elapse(250.0)
    assert controller.state()["commanded_spindle_speed"] == 1000.0  # the schedule is not the program's


# ---------------------------------------------------------------------- blocks in progress


class Held:
    """A channel whose reader does not read: the samples of a block are in progress until it is released."""

    rate, sync, channel, measuring_range = 100.0, "NONE", "held", 10e-3
    start = position = 0
    taken: int | None = None
    ended = False

    def __init__(self) -> None:
        self.pushing, self.released = threading.Event(), threading.Event()

    def push(self, distances: np.ndarray) -> None:
        self.pushing.set()
        self.released.wait(10.0)


@pytest.mark.parametrize("order", ["run_program", "run_steps"])
def test_no_motion_starts_within_a_block_in_progress(order: str) -> None:
    """At 100 samples/s a block lasts 41 s; commands during it start after it."""
    here, stream = VirtualWorld("cframe", 5), Held()
    here.mount("sphere")
    here.start_stream(stream)
    assert stream.pushing.wait(10.0)
    if order == "run_program":
        begin = here.run_program("G1 X10 F600\nM30").begin
    else:
        begin = here.run_steps((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1e-5, 3, 1.0, 0.1).begin
    made = stream.position / stream.rate
    here.end_stream(stream)
    stream.released.set()
    here.end()
    assert made > 10.0
    assert begin >= made
