"""Balls on the table of the virtual machine: contacts, and the errors behind them."""

import numpy as np
import pytest
from coded import raises

from errormotion import datasets
from errormotion.twin import Event, VirtualMachine
from errormotion.twin.artefacts.balls import FORM, LOBING, NOISE, PRETRAVEL, RADIUS_ERROR

ARCSEC = np.pi / 180 / 3600
HOURS = 3600.0 * np.array([0.0, 0.5, 1.0, 2.0, 3.0])


def warmed(kind: str, seed: int = 3) -> VirtualMachine:
    machine = VirtualMachine(kind, seed)
    machine.start([Event(0, spindle_speed=machine.top_speed), Event(2.5 * 3600, spindle_speed=4000)])
    return machine


@pytest.fixture(scope="module", params=["cframe", "gantry"])
def machine(request):
    return warmed(request.param)


@pytest.fixture(scope="module")
def gantry():
    return warmed("gantry")


@pytest.fixture(scope="module")
def cframe():
    return warmed("cframe")


# ---------------------------------------------------------------------- truth


def test_axes_that_carry_the_tool_follow_from_the_chain(cframe, gantry):
    assert (cframe.tool_axes, gantry.tool_axes) == ("Z", "XYZ")


def test_balls_on_a_gantry_appear_to_move_as_a_rigid_body(gantry):
    """M = I: the displacement of any ball follows from the twist at the functional point and the lever."""
    truth = gantry.truth_probing(HOURS)
    twist = np.asarray(truth.em.twist())
    lever = gantry.balls.centre - gantry.probing_functional_point
    rigid = twist[:, None, :3] + np.cross(twist[:, None, 3:], lever)
    error = np.array([gantry.probe_error(gantry.balls.centre, np.full(4, t)) for t in HOURS])
    np.testing.assert_allclose(rigid, error - error[0], atol=1e-15)


def test_only_the_lever_along_z_has_an_effect_on_a_c_frame(cframe):
    there = np.array([[0.2, -0.1, 0.1], [-0.2, 0.15, 0.1], [0.2, -0.1, 0.3]])
    cold = cframe.probe_error(there, np.zeros(3))
    low, beside, high = cframe.probe_error(there, np.full(3, HOURS[-1])) - cold
    truth = np.asarray(cframe.truth_probing(HOURS[-1:]).em.twist())[0]
    np.testing.assert_allclose(low, beside, atol=1e-18)  # the same height, the same error
    np.testing.assert_allclose(high - low, np.cross(truth[3:], [0, 0, 0.2]), atol=1e-18)
    assert abs((high - low)[1]) > 5e-6
    assert truth[5] != 0  # it turns about Z, and no ball shows it


def test_tilt_behind_the_last_axis_displaces_but_does_not_turn(machine):
    twist = machine.spindle_twist(HOURS)
    truth = np.asarray(machine.truth_probing(HOURS).em.twist())
    np.testing.assert_array_equal(truth[:, :3], twist[:, :3])  # at the end of the bar: all of the displacement
    behind = twist[-1, 3:] - truth[-1, 3:]
    assert np.abs(behind).max() > 1 * ARCSEC


def test_truth_at_another_point_is_the_error_there(machine):
    point = np.array([0.2, 0.1, 0.3])
    truth = np.asarray(machine.truth_probing(HOURS, point).em.twist())
    error = machine.probe_error(np.tile(point, (5, 1)), HOURS)
    np.testing.assert_allclose(truth[:, :3], error - error[0], atol=1e-18)


def test_truth_is_a_valid_error_dataset_of_the_tool(machine):
    truth = machine.truth_probing(HOURS)
    datasets.validate(truth)
    assert truth.attrs["component"] == "tool"
    assert not truth["covariance"].values.any()
    assert not truth.em.twist().values[0].any()


def test_geometric_errors_are_constant_and_cancel_between_cycles(machine):
    p = machine.balls.centre
    np.testing.assert_allclose(machine.probe_error(p, np.zeros(4)), machine.geometry.twist(p)[:, :3], atol=1e-18)


@pytest.mark.parametrize("seed", [0, 1, 2, 11])
def test_warm_up_of_the_gantry_has_a_measurable_size(seed):
    """Three hours at full speed: some 10 um, and several seconds of arc about every axis."""
    gantry = VirtualMachine("gantry", seed)
    gantry.start([Event(0, spindle_speed=gantry.top_speed)])
    twist = np.asarray(gantry.truth_probing([0.0, 3 * 3600.0]).em.twist())[1]
    assert np.linalg.norm(twist[:3]) > 20e-6
    assert np.all(np.abs(twist[3:]) > 1.5 * ARCSEC)
    assert np.all(np.abs(twist) < [50e-6] * 3 + [10 * ARCSEC] * 3)


# ---------------------------------------------------------------------- contacts


def test_the_probe_trips_where_the_gap_closes(machine):
    ball = machine.balls
    for n in ([1, 0, 0], [0, -1, 0], [0, 0, 1], [0.6, 0, 0.8]):
        start = ball.nominal[1] + 0.03 * np.array(n)
        place, way = machine.contact(start, ball.nominal[1], 5000.0, noise=False)
        assert abs(machine.probe_gap(place, 5000.0)[0]) < 1e-15
        assert way == pytest.approx(np.linalg.norm(place - start), abs=1e-15)
        assert machine.probe_gap(start, 5000.0)[0] == pytest.approx(way, abs=0.3e-3)  # aimed 0.1 mm beside the centre


def test_probe_trips_on_the_first_ball_of_the_path(machine):
    first, last = machine.balls.nominal[[0, 3]]
    way = (last - first) / np.linalg.norm(last - first)
    place, _ = machine.contact(first - 0.03 * way, last, 0.0)
    assert np.linalg.norm(place - first) < 0.016


def test_no_contact_on_a_free_path(machine):
    ball = machine.balls.nominal[0]
    place, way = machine.contact(ball + np.array([0.03, 0, 0.03]), ball + np.array([-0.03, 0, 0.03]), 0.0)
    assert place is None
    assert way == pytest.approx(0.06, abs=1e-15)
    short, _ = machine.contact(ball + np.array([0.03, 0, 0]), ball + np.array([0.017, 0, 0]), 0.0)
    assert short is None
    assert machine.contact(ball + np.array([0.03, 0, 0]), ball + np.array([0.03, 0, 0]), 0.0) == (None, 0.0)


def test_a_tip_that_grazes_a_ball_trips_or_passes(machine):
    balls = machine.balls
    aside = np.array([0, balls.radius[0] + machine.probe.tip_radius, 0])
    for off, trips in ((-50e-6, True), (50e-6, False)):
        beside = balls.centre[0] - machine.probe_error(balls.centre[0], 0.0)[0] + aside + [0, off, 0]
        place, _ = machine.contact(beside + np.array([0.03, 0, 0]), beside - np.array([0.03, 0, 0]), 0.0)
        assert (place is not None) == trips


def test_a_probe_inside_a_ball_is_tripped_at_the_start(machine):
    inside = machine.balls.centre[2] + [0.01, 0, 0]
    place, way = machine.contact(inside, inside + np.array([0.05, 0, 0]), 0.0)
    np.testing.assert_array_equal(place, inside)
    assert way == 0.0
    assert not machine.released(inside, 0.0)
    assert machine.contact(inside, inside + np.array([0.05, 0, 0]), 0.0, leaving=True)[0] is None
    assert machine.contact(inside, inside - np.array([0.005, 0, 0]), 0.0, leaving=True)[1] == 0.0


def test_pretravel_has_three_lobes_around_the_stylus(machine):
    azimuth = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    around = machine.probe.pretravel(np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1))
    waves = np.abs(np.fft.rfft(around)) / 360
    assert waves[0] == pytest.approx(PRETRAVEL, rel=0.1)
    assert 2 * waves[3] == pytest.approx(LOBING, rel=0.1)
    assert np.delete(waves, [0, 3]).max() < 1e-15
    assert machine.probe.pretravel([0, 0, 1])[0] == machine.probe.mean


def test_balls_have_the_stated_deviations(machine):
    balls = machine.balls_on_table(8)
    assert np.abs(balls.radius - balls.nominal_radius).max() <= RADIUS_ERROR
    rng = np.random.default_rng(0)
    n = rng.normal(size=(20000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    for ball in range(8):
        height = balls.height(np.full(len(n), ball), n)
        assert 0.9 * FORM < np.ptp(height) <= FORM * (1 + 1e-12)
        assert height.mean() == pytest.approx(balls.radius[ball], abs=0.02 * FORM)


@pytest.mark.parametrize("kind", ["cframe", "gantry"])
@pytest.mark.parametrize("seed", range(5))
def test_every_touch_is_within_the_travel_and_balls_are_apart(kind, seed):
    machine = VirtualMachine(kind, seed)
    balls = machine.balls_on_table(8)
    low, high = np.array([machine.travel[axis] for axis in "XYZ"]).T
    assert np.all(balls.nominal - 0.025 > low)
    assert np.all(balls.nominal + 0.025 < high)
    apart = np.linalg.norm(balls.nominal[:, None] - balls.nominal, axis=2) + np.eye(8)
    assert apart.min() > 0.1
    heights = np.sort(balls.nominal[:4, 2])
    assert np.diff(heights).min() > 0.03  # a C-frame sees turns through heights alone
    assert np.abs(balls.centre - balls.nominal).max() < 0.31e-3


# ---------------------------------------------------------------------- determinism and noise


def test_scatter_of_a_touch_does_not_depend_on_previous_touches(machine):
    other = warmed(machine.kind)
    other.contact(other.balls.nominal[1] + [0.03, 0, 0], other.balls.nominal[1], 5.0)
    b = machine.balls.nominal
    ways = [(b[i] + [0, 0, 0.03], b[i], 600.0 * i) for i in range(4)]
    forwards = [machine.contact(*way)[0] for way in ways]
    backwards = [other.contact(*way)[0] for way in reversed(ways)][::-1]
    np.testing.assert_array_equal(forwards, backwards)
    assert not np.array_equal(machine.contact(b[0] + [0, 0, 0.03], b[0], 1.0)[0], forwards[0])


def test_triggers_scatter_along_the_normal_as_stated(cframe):
    ball = cframe.balls.nominal[0]
    still = cframe.contact(ball + np.array([0, 0, 0.03]), ball, 0.0, noise=False)[0]
    scatter = [cframe.contact(ball + np.array([0, 0, 0.03]), ball, 1e-6 * i)[0][2] - still[2] for i in range(400)]
    assert np.std(scatter) == pytest.approx(NOISE, rel=0.12)  # 400 of them: 3.5 % one sigma
    assert abs(np.mean(scatter)) < 4 * NOISE / 20


def test_slow_approach_has_the_error_at_the_time_of_contact(gantry):
    ball = gantry.balls.nominal[3]
    place, way = gantry.contact(ball + np.array([0.03, 0, 0]), ball, 1000.0, 1e-5, noise=False)  # 25 min on its way
    # some 10 um at first, and each of two more rounds leaves what the ball moves by the feed of it: 1e-8 / 1e-5
    assert abs(gantry.probe_gap(place, 1000.0 + way / 1e-5)[0]) < 1e-10
    assert abs(gantry.probe_gap(place, 1000.0)[0]) > 5e-6


def test_sensors_have_independent_temperature_noise(machine):
    t = np.arange(0, 3600.0, 10)
    off = machine.sensor_temperatures(t, seed=4) - machine.temperatures(t)
    assert np.std(off) == pytest.approx(0.02, rel=0.05)
    assert np.abs(np.corrcoef(off.T) - np.eye(off.shape[1])).max() < 0.25  # 360 of them: 5 % one sigma
    np.testing.assert_array_equal(machine.sensor_temperatures(t[7:8], seed=4)[0], (off + machine.temperatures(t))[7])


def test_balls_are_counted(cframe):
    with raises("virtual.ball.number"):
        cframe.balls.moved(4, (0, 0, 0))


# ---------------------------------------------------------------------- heat on command


def test_a_speed_commanded_later_heats_from_then_on_only():
    machine, scheduled = VirtualMachine("cframe", 3), VirtualMachine("cframe", 3)
    machine.start([Event(0, spindle_speed=8000), Event(5000, compensation={"Z": False})])
    before = machine.spindle_twist(np.arange(0, 3000, 100.0))
    machine.command(Event(3000, spindle_speed=15000))
    machine.command(Event(4000, spindle_speed=0))
    scheduled.start(
        [
            Event(0, spindle_speed=8000),
            Event(3000, spindle_speed=15000),
            Event(4000, spindle_speed=0),
            Event(5000, compensation={"Z": False}),
        ]
    )
    t = np.arange(0, 8000, 100.0)
    np.testing.assert_array_equal(machine.spindle_twist(t), scheduled.spindle_twist(t))
    np.testing.assert_array_equal(machine.temperatures(t), scheduled.temperatures(t))
    np.testing.assert_array_equal(machine.spindle_twist(t)[:30], before)


def test_an_impossible_command_changes_nothing():
    machine = VirtualMachine("cframe", 3)
    machine.start([Event(0, spindle_speed=8000)])
    with raises("virtual.spindle.too_fast"):
        machine.command(Event(10.0, spindle_speed=1e6))
    assert machine.spindle_speed(20.0)[0] == pytest.approx(8000, rel=1e-12)


def test_stop_of_the_spindle_removes_its_scheduled_speeds():
    machine = VirtualMachine("cframe", 3)
    machine.start([Event(0, spindle_speed=8000), Event(200, spindle_speed=15000, compensation={"Z": False})])
    machine.stop_spindle(100.0)
    np.testing.assert_allclose(machine.spindle_speed([99.0, 110.0, 300.0]), [8000, 0, 0], atol=1e-9)
    assert machine.state.schedule.compensation(np.array([300.0]))[0, 2] == 0
    assert machine.spindle_load(machine.spindle_speed(50.0))[0] == pytest.approx(
        machine.state.power(8000.0) / machine.state.power(15000.0), rel=1e-12
    )
