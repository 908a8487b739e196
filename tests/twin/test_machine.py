"""The virtual machine as a whole: the demonstration's figures, determinism, truth in the error schema."""

import numpy as np
import pytest
from coded import raises

from errormotion.datasets import validate
from errormotion.errors import BenchError
from errormotion.methods.spindle_drift import simulation
from errormotion.twin import Event, VirtualMachine

ARCSEC = np.pi / 180 / 3600
MIN = 60.0
DEMO = [
    Event(0, spindle_speed=15000),
    Event(101 * MIN, compensation={"Z": False}),
    Event(102 * MIN, compensation={"Y": False}),
]


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 11, 12345])
def test_demonstration_shows_the_published_figures(seed):
    # a seed changes amplitudes by up to 1.5 % of 48.6 um and 1 % of 29.3 um; the air adds half a micrometre
    machine = VirtualMachine("cframe", seed)
    machine.start(DEMO)
    before_z, after_z, before_y, after_y, end = machine.spindle_twist(
        [101 * MIN, 101 * MIN + 1, 102 * MIN, 102 * MIN + 1, 104 * MIN]
    )
    assert before_z[2] == pytest.approx(19.3e-6, rel=0.1)
    assert (after_z - before_z)[2] == pytest.approx(29.3e-6, rel=0.03)
    assert (after_y - before_y)[1] == pytest.approx(9e-6, rel=0.03)
    assert end[3] == pytest.approx(25 * ARCSEC, rel=0.1)
    assert end[4] == pytest.approx(-12 * ARCSEC, rel=0.1)


def test_switching_compensation_moves_only_its_axis(warming):
    before, after = warming.spindle_twist([101 * MIN, 101 * MIN + 1])
    change = np.abs(after - before)
    assert change[2] > 25e-6
    assert np.all(np.delete(change, 2)[:2] < 5e-9)  # a second of warming: 5 um in half an hour
    assert np.all(change[3:] < 1e-7)


def test_cold_state_is_the_reference(warming):
    assert not warming.spindle_twist([0.0]).any()


def test_a_machine_at_rest_drifts_only_with_the_air(machine):
    twist = machine.spindle_twist(np.linspace(0, 4 * 3600, 50))
    assert 0 < np.max(np.abs(twist[:, :3])) < 3e-6


def test_same_seed_and_schedule_give_the_same_machine(warming):
    other = VirtualMachine("cframe", seed=3)
    other.distances(0, 100, 1000.0)  # what was asked before does not matter
    other.start(DEMO)
    t = np.linspace(0, 6240, 20)
    assert np.array_equal(other.spindle_twist(t), warming.spindle_twist(t))
    assert np.array_equal(other.temperatures(t), warming.temperatures(t))
    assert np.array_equal(other.distances(123456, 50, 20000.0), warming.distances(123456, 50, 20000.0))
    assert np.array_equal(other.frame.true_direction, warming.frame.true_direction)


def test_restart_removes_the_previous_schedule(warming):
    hot = warming.distances(20000, 100, 20000.0)
    warming.start()
    assert not np.array_equal(warming.distances(20000, 100, 20000.0), hot)
    warming.start(DEMO)
    assert np.array_equal(warming.distances(20000, 100, 20000.0), hot)


def test_other_seeds_are_other_machines(machine):
    for seed in (4, -3):
        other = VirtualMachine("cframe", seed)
        assert not np.array_equal(other.frame.true_origin, machine.frame.true_origin)
        assert other.bar.radius != machine.bar.radius


@pytest.mark.parametrize("seed", range(30))
def test_deviations_and_readings_of_every_machine_are_plausible(seed):
    machine = VirtualMachine("cframe", seed)
    beams = machine.frame.nominal_direction
    off = machine.frame.true_origin - machine.frame.nominal_origin
    along = np.sum(off * beams, axis=1)
    assert np.all(np.abs(along) <= 0.05e-3)
    assert np.all(np.abs(off - along[:, None] * beams) <= 0.15e-3 + 1e-12)
    assert np.linalg.norm(machine.frame.true_direction, axis=1) == pytest.approx(1, abs=1e-14)
    assert abs(machine.bar.radius - machine.bar_radius) < 1e-6
    machine.start(DEMO)
    readings = machine.still_readings(np.linspace(0, 6240, 30))
    assert np.all((readings > 0.8e-3) & (readings < 1.2e-3))
    assert not np.isnan(simulation.raw_beam_detection(machine, seed=0).distance).any()


def test_temperatures_are_plausible_and_named(warming):
    hot = dict(zip(warming.temperature_sensors, warming.temperatures([6000.0])[0], strict=True))
    assert {"frame", "ambient", "spindle_front", "spindle_rear", "column", "motor"} <= set(hot)
    assert 25 < hot["spindle_front"] < 40
    assert hot["spindle_front"] > hot["head"] > hot["column_front"] > hot["bed"]
    assert hot["column"] == pytest.approx((hot["column_front"] + hot["column_rear"]) / 2)
    assert 0.3 < hot["frame"] - hot["ambient"] < 3


def test_truth_of_the_spindle_is_a_valid_error_dataset(warming):
    t = np.linspace(1, 6240, 7)
    truth = warming.truth_spindle(t)
    validate(truth)
    assert truth.attrs["component"] == "spindle"
    assert not truth.covariance.values.any()
    values = np.stack([truth[name].values for name in ("EX", "EY", "EZ", "EA", "EB", "EC")], axis=-1)
    assert np.array_equal(values, warming.spindle_twist(t))


def test_truth_moves_to_another_functional_point_as_a_rigid_body(warming):
    lever = np.array([0.0, 0.0, 0.04])
    here = warming.spindle_twist([6000.0])[0]
    there = warming.truth_spindle([6000.0], warming.spindle_functional_point + lever)
    assert there.EX.item() == pytest.approx(here[0] + here[4] * 0.04, abs=1e-15)
    assert there.EY.item() == pytest.approx(here[1] - here[3] * 0.04, abs=1e-15)
    assert there.EA.item() == here[3]


def test_axis_of_rotation_follows_the_twist(warming):
    twist = warming.spindle_twist([6000.0])[0]
    (point,), (axis,) = warming.spindle_axis([6000.0])
    assert point == pytest.approx(warming.spindle_functional_point + twist[:3], abs=1e-18)
    # small angles: what is left out is of second order, 1e-4 squared
    assert axis[:2] == pytest.approx(warming.bar.axis[:2] + twist[[4, 3]] * [1, -1], abs=2e-8)


def test_twist_is_continuous_where_nothing_is_switched(warming):
    t = np.arange(0, 6000, 0.5)
    assert np.max(np.abs(np.diff(warming.spindle_twist(t)[:, :3], axis=0))) < 0.1e-6


def test_unknown_machine_is_refused_with_the_known_ones():
    with raises("virtual.machine.unknown"):
        VirtualMachine("lathe")


def test_an_offset_of_the_commands_displaces_the_tool() -> None:
    """Linear between its times; commands keep it, and a restart takes it off."""
    machine = VirtualMachine("cframe", seed=3)
    machine.start([Event(0.0, 12000.0)])
    times, point = np.array([600.0, 1200.0, 1800.0]), [0.1, 0.0, 0.2]
    before = machine.truth_probing(times, point).em.twist().values
    machine.compensate([600.0, 1800.0], [[0.0, 0.0, 0.0], [1e-6, -2e-6, 30e-6]])
    machine.command(Event(3000.0, 0.0))
    moved = machine.truth_probing(times, point).em.twist().values - before
    np.testing.assert_allclose(moved[:, :3], np.outer([0, 0.5, 1], [1e-6, -2e-6, 30e-6]), atol=1e-15)
    np.testing.assert_array_equal(moved[:, 3:], 0)
    machine.start([Event(0.0, 12000.0)])
    np.testing.assert_array_equal(machine.truth_probing(times, point).em.twist().values, before)


@pytest.mark.parametrize(
    ("times", "offsets"),
    [([0.0], [[0.0, 0.0]]), ([1.0, 1.0], np.zeros((2, 3))), ([0.0], [[np.nan] * 3]), ([], np.zeros((0, 3)))],
)
def test_invalid_offsets_are_refused(times: list[float], offsets: list[list[float]]) -> None:
    with pytest.raises(BenchError, match="offsets"):
        VirtualMachine("cframe").compensate(times, offsets)
