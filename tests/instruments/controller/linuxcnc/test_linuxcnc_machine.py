"""The driver and the bridge against the real LinuxCNC, without hardware.

A computer can only run one LinuxCNC. It is started once, continues between tests, and ends after the last one;
therefore the kit and the touch probe test this driver here, and not together with the others.
"""

import importlib.util
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion.errors import InstrumentError
from errormotion.instruments.controller.linuxcnc import LinuxCNC, LinuxCNCSettings
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.controller import linuxcnc, linuxcnc_process
from errormotion.instruments.touch_probe.controller_probe import ControllerProbe, ControllerProbeSettings
from errormotion.plugins import MachineLimits, Touch
from errormotion.testing.checks.instrument import INSTRUMENT_CHECKS
from errormotion.testing.kit import run_check
from errormotion.testing.run import subjects_of

ADDRESS = "sim://cframe/linuxcnc?seed=3&linger=30"
ARMED = LinuxCNCSettings(arm=True)
STOP_BENCHMARK = Path(__file__).parents[4] / "benchmarks" / "linuxcnc_stop.py"
CYCLE = 1e-3  # s, of the servo thread
TOUCH_FEED = 0.03 / 60  # m/s
FAST = 0.3  # m/s
# A position near the first ball, and one 60 mm from it.
HERE, THERE = [-0.24, -0.2, 0.12], [-0.18, -0.2, 0.12]

if reason := linuxcnc_process.why_not():
    pytest.skip(reason, allow_module_level=True)


@pytest.fixture(scope="module", autouse=True)
def ended() -> Iterator[None]:
    yield
    linuxcnc.end()


@pytest.fixture
def machine() -> Iterator[LinuxCNC]:
    with LinuxCNC(ADDRESS, ARMED) as driver:
        yield driver


def above(ball: int, height: float) -> list[float]:
    """Return a position at a height above the centre of a ball, m."""
    x, y, z = world("cframe", 3).machine.balls.nominal[ball]
    return [float(x), float(y), float(z) + height]


def wait_until_moving(driver: LinuxCNC) -> None:
    while driver.state()["feed"] == 0:
        time.sleep(0.02)


def run(driver: LinuxCNC, text: str) -> None:
    driver.run_program(text)
    driver.finish()


# ---------------------------------------------------------------------- what it states


def test_states_its_identity_and_state(machine: LinuxCNC) -> None:
    identity = machine.identify()
    assert (identity.manufacturer, identity.serial_number, identity.simulated) == ("LinuxCNC", "seed 3", True)
    assert identity.firmware.startswith("2.")
    state = machine.read()
    assert (state["homed"], state["enabled"], state["estop"], state["running"]) == (True, True, False, False)
    assert state["alarms"] == []
    assert math.isnan(state["spindle_load"])


def test_moves_to_a_position_before_the_call_returns(machine: LinuxCNC) -> None:
    machine.move_to([-0.23, -0.2, 0.12])
    reported = machine.move_to([-0.22, -0.18, 0.12], 0.05)
    state = machine.state()
    np.testing.assert_allclose(state["position"], [-0.22, -0.18, 0.12], atol=1e-9)
    np.testing.assert_allclose(state["commanded_position"], [-0.22, -0.18, 0.12], atol=1e-9)
    assert reported["duration"] > math.hypot(0.01, 0.02) / 0.05
    assert (state["feed"], state["running"], state["mode"]) == (0.0, False, "mdi")


def test_the_clock_of_the_world_advances_with_motion_and_jumps_by_waiting(machine: LinuxCNC) -> None:
    began = machine.state()["time"]
    reported = machine.move_to(HERE)
    moved = machine.state()["time"] - began
    assert moved == pytest.approx(reported["duration"], abs=0.2)  # there are five heartbeats per second
    machine.elapse(3600.0)
    assert machine.state()["time"] == pytest.approx(began + moved + 3600.0, abs=0.2)


def test_turns_the_spindle_which_heats_the_twin(machine: LinuxCNC) -> None:
    machine.spindle(3000.0)
    while machine.state()["spindle_speed"] < 2900.0:  # an encoder measures the acceleration
        time.sleep(0.05)
    machine.elapse(3600.0)
    assert world("cframe", 3).machine.spindle_speed([machine.state()["time"]])[0] == pytest.approx(3000.0)
    with pytest.raises(InstrumentError, match="the spindle turns; stop it"):
        machine.probe(above(0, 0.0), 0.001)
    machine.spindle(0.0)
    while machine.state()["spindle_speed"] > 10.0:
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("goal", "feed", "said"),
    [
        ([0.4, 0.0, 0.1], None, "X travels from -0.305"),
        ([0.0, 0.0, -0.1], 0.01, "Z travels from"),
        ([0.0, 0.0, 0.1], 0.0, "finite feed above 0"),
        ([0.0, 0.0, 0.1], 1.0, "feed above 0 and at most"),
        ([0.0, 0.0], None, "finite numbers X, Y, Z"),
        ([0.0, 0.0, math.nan], None, "finite"),
    ],
)
def test_refuses_impossible_commands_without_moving(
    machine: LinuxCNC, goal: list[float], feed: float | None, said: str
) -> None:
    before = machine.state()["position"]
    with pytest.raises(InstrumentError, match=said):
        machine.move_to(goal, feed)
    assert machine.state()["position"] == before


# ---------------------------------------------------------------------- touching


@pytest.mark.parametrize("feed", [0.01, 0.001, 0.0003])
def test_a_touch_is_at_most_one_cycle_of_travel_after_the_trip_of_the_twin(machine: LinuxCNC, feed: float) -> None:
    machine.move_to(above(0, 0.05))
    machine.move_to(above(0, 0.0157 + 0.05 * feed), FAST)
    start, goal = machine.state()["commanded_position"], above(0, 0.01)
    w = world("cframe", 3)
    contact, _ = w.machine.contact(start, goal, w.time, feed)
    touch = machine.probe(goal, feed)
    assert touch["tripped"]
    assert contact is not None
    late = contact[2] - touch["position"][2]
    # LinuxCNC latches the position of the cycle in which it sees the probe; 2 nm of rounding in its positions.
    assert -2e-9 <= late <= feed * CYCLE + 2e-9
    np.testing.assert_allclose(touch["position"][:2], goal[:2], atol=1e-9)
    assert touch["time"] == pytest.approx(machine.state()["time"])
    machine.move_to(above(0, 0.05), FAST)


def test_a_sideways_touch_and_the_setting_that_corrects_it() -> None:
    feed, delay = 0.005, 0.5 * CYCLE  # the mean of 0 to 1 cycle
    with LinuxCNC(ADDRESS, LinuxCNCSettings(arm=True, trip_delay=delay)) as machine:
        x, y, z = above(0, 0.0)
        machine.move_to([x, y, z + 0.05])
        machine.move_to([x - 0.05, y + 0.002, z + 0.05])
        machine.move_to([x - 0.05, y + 0.002, z])
        machine.move_to([x - 0.016, y + 0.002, z], FAST)
        start = machine.state()["commanded_position"]
        w = world("cframe", 3)
        contact, _ = w.machine.contact(start, [x, y + 0.002, z], w.time, feed)
        touch = machine.probe([x, y + 0.002, z], feed)
        assert contact is not None
        assert abs(touch["position"][0] - contact[0]) <= feed * delay + 2e-9
        machine.move_to([x - 0.05, y, z], FAST)
        machine.move_to([x - 0.05, y, z + 0.1], FAST)


def test_the_balls_move_as_the_machine_warms_up(machine: LinuxCNC) -> None:
    feed, places = 0.0005, []
    for heated in (False, True):
        if heated:
            machine.spindle(12000.0)
            machine.state()
            machine.elapse(7200.0)
            machine.spindle(0.0)
        machine.move_to(above(0, 0.05))
        machine.move_to(above(0, 0.0157), FAST)
        start, goal = machine.state()["commanded_position"], above(0, 0.01)
        w = world("cframe", 3)
        contact, _ = w.machine.contact(start, goal, w.time, feed)
        assert contact is not None
        touch = machine.probe(goal, feed)
        assert abs(touch["position"][2] - contact[2]) <= feed * CYCLE + 2e-9
        places.append(touch["position"][2])
        machine.move_to(above(0, 0.05), FAST)
    assert abs(places[1] - places[0]) > 5e-6  # the spindle has grown by tens of um


def test_without_a_ball_in_the_path_the_machine_stops_at_the_target(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    touch = machine.probe([-0.24, -0.2, 0.11], 0.02)
    assert (touch["tripped"], touch["position"]) == (False, None)
    np.testing.assert_allclose(machine.state()["position"], [-0.24, -0.2, 0.11], atol=1e-9)
    assert machine.state()["alarms"] == []


def test_refuses_to_probe_with_the_probe_tripped(machine: LinuxCNC) -> None:
    machine.move_to(above(0, 0.05))
    machine.move_to(above(0, 0.017), FAST)
    machine.probe(above(0, 0.01), 0.02)  # so fast that it stops far behind the contact
    before = machine.state()["position"]
    with pytest.raises(InstrumentError, match="tripped before it moves"):
        machine.probe(above(0, 0.01), 0.001)
    assert machine.state()["position"] == before
    machine.move_to(above(0, 0.05), FAST)


def test_running_into_a_ball_stops_the_machine(machine: LinuxCNC) -> None:
    machine.move_to(above(0, 0.05))
    machine.probe(above(0, 0.045), 0.02)  # so that the probe is in the spindle
    with pytest.raises(InstrumentError, match=r"stopped before its goal, at .*: Probe tripped during non-probe move"):
        machine.move_to(above(0, 0.005), 0.02)
    assert machine.state()["alarms"] == ["Probe tripped during non-probe move."]
    machine.move_to(above(0, 0.05), FAST)
    assert machine.state()["alarms"] == []


# ---------------------------------------------------------------------- faults


def test_an_e_stop_ends_a_move_and_has_to_be_released(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    with LinuxCNC(ADDRESS, ARMED) as other:
        stopper = threading.Thread(target=lambda: (wait_until_moving(other), other.estop()))
        stopper.start()
        with pytest.raises(InstrumentError, match="move to was aborted: e-stop"):
            machine.move_to(THERE, 0.05)
        stopper.join()
    state = machine.state()
    assert (state["estop"], state["enabled"]) == (True, False)
    assert HERE[0] < state["position"][0] < THERE[0]
    with pytest.raises(InstrumentError, match="in e-stop; reset it"):
        machine.move_to(HERE)
    with pytest.raises(InstrumentError, match="in e-stop; reset it"):
        machine.enable()
    machine.reset()
    with pytest.raises(InstrumentError, match="off; enable it"):
        machine.move_to(HERE)
    machine.enable()
    machine.move_to(HERE)


def test_stop_from_another_thread_ends_a_move(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    with LinuxCNC(ADDRESS, ARMED) as other:
        stopper = threading.Thread(target=lambda: (wait_until_moving(other), machine.stop()))
        stopper.start()
        with pytest.raises(InstrumentError, match="aborted: it was stopped"):
            machine.move_to(THERE, 0.05)
        stopper.join()
    place = machine.state()["position"]
    assert HERE[0] < place[0] < THERE[0]
    assert machine.state()["position"] == place
    machine.move_to(HERE)


def test_a_second_client_reads_but_does_not_interfere(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    refused = []
    with LinuxCNC(ADDRESS, ARMED) as other:

        def interfere() -> None:
            wait_until_moving(other)
            try:
                other.move_to([0.0, 0.0, 0.0])
            except InstrumentError as error:
                refused.append(str(error))

        second = threading.Thread(target=interfere)
        second.start()
        machine.move_to(THERE, 0.1)
        second.join()
        np.testing.assert_allclose(other.state()["position"], THERE, atol=1e-9)
    assert "the machine is busy: move to" in refused[0]


def test_without_arm_it_reads_and_may_stop_the_machine(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    with LinuxCNC(ADDRESS) as reader:
        stopper = threading.Thread(target=lambda: (wait_until_moving(reader), reader.stop()))
        stopper.start()
        with pytest.raises(InstrumentError, match="aborted: it was stopped"):
            machine.move_to(THERE, 0.05)
        stopper.join()
        with raises("instrument.not_armed"):
            reader.home()
        answer = reader._send  # without the check of the driver: the bridge refuses as well
        with pytest.raises(InstrumentError, match="this client only reads"):
            answer("move_to", position=THERE, feed=None)


def test_the_limits_of_the_bench_apply_to_each_command(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    machine.bound(MachineLimits({"X": (HERE[0] - 1e-3, HERE[0] + 1e-3)}, feed=0.01, spindle_speed=100.0))
    for order in (
        lambda: machine.move_to(THERE),
        lambda: machine.probe(THERE, 0.001),
        lambda: machine.move_to(HERE, 0.02),
        lambda: machine.spindle(-101.0),
        lambda: machine.spindle(math.inf),
    ):
        with pytest.raises(InstrumentError, match=r"limit|finite"):
            order()
    assert machine.state()["position"] == pytest.approx(HERE, abs=1e-9)
    near = [HERE[0] + 1e-3, *HERE[1:]]
    assert machine.move_to(near)["duration"] > 1e-3 / 0.01  # a rapid move keeps the limit of the feed


def test_an_estop_is_answered_while_others_flood(machine: LinuxCNC) -> None:
    """`benchmarks/linuxcnc_stop.py` measures it; here the shortest of a few, on a busy computer."""
    spec = importlib.util.spec_from_file_location("linuxcnc_stop", STOP_BENCHMARK)
    assert spec is not None
    assert spec.loader is not None
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    (control,) = [each for each in linuxcnc._controls.values() if each.process.running]
    where = control.process.socket, control.process.token
    with benchmark.flooded(*where, 20):
        found = benchmark.stop_times(*where, 20)
    deadline = time.monotonic() + 10
    while not machine.state()["estop"]:
        assert time.monotonic() < deadline
    machine.reset()
    machine.enable()
    assert min(found) < benchmark.LIMIT


def test_a_lost_connection_stops_the_move_which_is_not_repeated() -> None:
    with LinuxCNC(ADDRESS, ARMED) as witness, LinuxCNC(f"{ADDRESS}&fault=disconnect&fault_at=2", ARMED) as machine:
        witness.move_to(HERE)
        machine.state()  # after identity and state the connection breaks at the next answer, that of the stop
        ordered = threading.Thread(target=lambda: (wait_until_moving(witness), witness.stop()))
        ordered.start()
        with pytest.raises(InstrumentError, match="during the command 'move to'"):
            machine.move_to(THERE, 0.05)
        ordered.join()
        place = witness.state()["position"]
        assert HERE[0] < place[0] < THERE[0]
        assert machine.state()["position"] == place  # over a new connection
        assert machine.state()["running"] is False


def test_disconnecting_during_a_move_ends_it() -> None:
    with LinuxCNC(ADDRESS, ARMED) as witness:
        witness.move_to(HERE)
        machine = LinuxCNC(ADDRESS, ARMED)
        machine.open()

        def move() -> None:
            with pytest.raises(InstrumentError):
                machine.move_to(THERE, 0.05)

        mover = threading.Thread(target=move)
        mover.start()
        wait_until_moving(witness)
        machine.close()
        mover.join()
        while witness.state()["running"]:
            time.sleep(0.02)
        assert HERE[0] < witness.state()["position"][0] < THERE[0]
        witness.move_to(HERE)


def test_homes_a_machine_after_switch_on(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    machine.estop()
    machine.reset()
    with pytest.raises(InstrumentError, match="off; enable it"):
        machine.home()
    machine.enable()
    before = machine.state()["position"]
    machine.home()
    state = machine.state()
    assert state["homed"]
    np.testing.assert_allclose(state["position"], before, atol=1e-9)  # as with absolute encoders


# ---------------------------------------------------------------------- programs


def test_a_program_runs_while_its_state_is_followed(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    reported = machine.run_program("G21 G90 G94\nG1 X-230 F2000\nG4 P0.3\nG1 X-220\nM2\n")
    state = machine.state()
    assert (state["running"], state["mode"], state["program"]) == (True, "automatic", reported["program"])
    with pytest.raises(InstrumentError, match="busy: program"):
        machine.move_to([0.0, 0.0, 0.0])
    done = machine.finish()
    assert done["duration"] > 0.02 / (2.0 / 60) + 0.3
    assert machine.state()["running"] is False
    np.testing.assert_allclose(machine.state()["position"], [-0.22, -0.2, 0.12], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("G21 G90\nG1 X-238 F2000\nG1 X900\nM2\n", "exceed X's positive limit"),
        ("G21 G90\nG1 X-238 F2000\nthis is no line\nM2\n", "ended early"),
        ("", "text of a program"),
    ],
)
def test_a_program_with_an_error_is_reported(machine: LinuxCNC, text: str, said: str) -> None:
    machine.move_to(HERE)
    with pytest.raises(InstrumentError, match=said):
        run(machine, text)
    assert (machine.state()["alarms"] != []) == (text != "")
    assert machine.state()["running"] is False


def test_stop_ends_a_program(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    machine.run_program("G21 G90 G94\nG1 X-100 F3000\nM2\n")
    wait_until_moving(machine)
    machine.stop()
    assert machine.state()["running"] is False
    with pytest.raises(InstrumentError, match="aborted: it was stopped"):
        machine.finish()


def test_a_program_probes_the_balls_automatically(machine: LinuxCNC) -> None:
    machine.move_to(above(0, 0.05))
    machine.probe(above(0, 0.045), 0.02)  # the probe is in the spindle
    x, y, z = (1e3 * each for each in above(0, 0.0157))
    machine.run_program(
        f"G21 G90 G94\nG1 X{x:.4f} Y{y:.4f} Z{z:.4f} F15000\nG38.2 Z{z - 5:.4f} F60\nG1 X#5061 Y#5062 Z#5063 F60\nM2\n"
    )
    machine.finish()
    w = world("cframe", 3)
    contact, _ = w.machine.contact(above(0, 0.0157), above(0, 0.01), w.time, noise=False)
    assert contact is not None
    # with the mean pre-travel, so up to its lobes (1.5 um) and the ball's form (0.5 um) beside; 1 um of travel a cycle
    assert abs(machine.state()["position"][2] - contact[2]) < 4e-6
    machine.move_to(above(0, 0.05), FAST)


# ---------------------------------------------------------------------- offsets, units, recordings


def test_work_and_tool_offsets_and_operator_modes_have_no_effect(machine: LinuxCNC) -> None:
    machine.move_to(HERE)
    machine.run_program("G21 G90 G94\nG10 L2 P1 X11 Y-7 Z30 R30\nG54\nG92 X5 Y6 Z7\nG43.1 Z13\nG20 G91\nM0\nG4 P60\n")
    time.sleep(0.3)
    machine.stop()
    machine.move_to([-0.22, -0.21, 0.13], 0.1)
    np.testing.assert_allclose(machine.state()["position"], [-0.22, -0.21, 0.13], atol=2e-9)
    began = machine.state()["time"]
    machine.probe([-0.22, -0.21, 0.12], 0.02)
    assert machine.state()["time"] - began > 0.5  # at 20 mm/s, not at 20 inches/s
    np.testing.assert_allclose(machine.state()["position"], [-0.22, -0.21, 0.12], atol=2e-9)
    machine.run_program("G92.1\nG49\nG10 L2 P1 X0 Y0 Z0 R0\nG21 G90\nM2\n")
    machine.finish()


def test_a_session_is_replayed(machine: LinuxCNC, tmp_path: Path) -> None:
    def session(driver: LinuxCNC) -> list[object]:
        return [driver.move_to(HERE), driver.probe(THERE, 0.2), driver.state()["position"]]

    with LinuxCNC(ADDRESS, ARMED, record=tmp_path / "session.rec") as driver:
        seen = session(driver)
    with LinuxCNC(f"replay://{tmp_path / 'session.rec'}", ARMED) as driver:
        assert session(driver) == seen


@pytest.mark.parametrize("check", INSTRUMENT_CHECKS, ids=lambda check: check.name)
def test_passes_the_kit(check: object) -> None:
    (subject,) = subjects_of("instruments", "linuxcnc", address=ADDRESS)
    result = run_check(check, replace(subject, settings={"timeout": 1.0}))
    assert result.ok, f"{check.claim}\n{result.message}\n{result.trace}"


# ---------------------------------------------------------------------- another machine: these restart LinuxCNC


def test_a_ball_is_touched_through_linuxcnc() -> None:
    settings = ControllerProbeSettings(
        arm=True, controller="linuxcnc", repeats=2, touch_feed=TOUCH_FEED, clearance=18e-3
    )
    with ControllerProbe(ADDRESS, settings) as probe:
        here = world("cframe", 3)
        centre = here.machine.balls.nominal[0]
        reach = here.machine.balls.nominal_radius + here.machine.probe.nominal_tip_radius
        touches = [
            Touch(*(tuple(centre + (reach + way) * np.array(n)) for way in (1e-3, -0.5e-3)))
            for n in ((1, 0, 0), (0, 0, 1))
        ]
        nothing = Touch(*(tuple(centre + np.array([0.0, 0.0, height])) for height in (0.034, 0.032)), 1)
        contacts = list(probe.measure([*touches, nothing]))
        assert [contact.flag for contact in contacts] == ["", "", "no trip"]
        for touch, contact in zip(touches, contacts, strict=False):
            true, _ = here.machine.contact(touch.start, touch.target, contact.time, noise=False)
            off = np.subtract(contact.position, true)
            # latched up to two cycles late; the trigger scatters by 0.25 um, the mean of two by 0.18 um
            assert np.linalg.norm(off) < 2 * CYCLE * TOUCH_FEED + 5 * 0.18e-6
        assert probe.control.state()["alarms"] == []


def test_another_machine_is_refused_while_one_runs(machine: LinuxCNC) -> None:
    with raises("simulator.linuxcnc.used"):
        LinuxCNC("sim://cframe/linuxcnc?seed=4").open()
    assert machine.state()["enabled"]


@pytest.mark.slow
def test_an_ini_file_in_inches_switched_on_and_homed_manually_and_no_process_left() -> None:
    with LinuxCNC("sim://cframe/linuxcnc?seed=3&unit=inch&ready=0&linger=0", ARMED) as machine:
        (control,) = [each for each in linuxcnc._controls.values() if each.process.running]
        folder = control.process.folder
        assert folder.exists()
        state = machine.state()
        assert (state["estop"], state["enabled"], state["homed"]) == (True, False, False)
        machine.reset()
        machine.enable()
        with pytest.raises(InstrumentError, match="not homed"):
            machine.probe([0.1, 0.0, 0.0], 0.01)
        machine.home()
        assert machine.identify().details["travel"]["Z"][1] == pytest.approx(0.46, abs=2e-6)
        machine.move_to(HERE)
        np.testing.assert_allclose(machine.state()["position"], HERE, atol=2e-9)
        machine.move_to(above(0, 0.05), FAST)
        machine.move_to(above(0, 0.0157), FAST)
        start, goal, feed = machine.state()["commanded_position"], above(0, 0.01), 0.001
        w = world("cframe", 3)
        contact, _ = w.machine.contact(start, goal, w.time, feed)
        touch = machine.probe(goal, feed)
        assert contact is not None
        assert -2e-9 <= contact[2] - touch["position"][2] <= feed * CYCLE + 2e-9
    assert not control.process.running
    assert not folder.exists()
    running = {name for name, state in linuxcnc_process._processes().values() if state != "Z"}
    assert running.isdisjoint(linuxcnc_process.PROCESSES)
    assert not linuxcnc_process.LINUXCNC_LOCK.exists()
