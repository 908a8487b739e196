"""Simulated raw datasets of beam calibrations."""

import numpy as np
import pytest
from coded import raises

from errormotion.datasets import validate
from errormotion.kinematics.beams import tilt, tilt_vector
from errormotion.methods.beam_direction import simulation
from errormotion.twin import VirtualMachine
from errormotion.twin.sensors.point_sensor import seeded_point_sensor

DEG = np.radians(1.0)


@pytest.fixture(scope="module")
def machine() -> VirtualMachine:
    return VirtualMachine("cframe", seed=3)


def gradients(distance: np.ndarray, stage: np.ndarray) -> np.ndarray:
    """Return the least-squares gradient of the readings of each plane, (plane, 3)."""
    columns = [np.column_stack([s, np.ones(len(s))]) for s in stage]
    return np.array([np.linalg.lstsq(a, d)[0][:3] for a, d in zip(columns, distance, strict=True)])


def direction(g: np.ndarray) -> np.ndarray:
    """Return the beam with g.u = -1 at three planes."""
    u = np.linalg.solve(g, -np.ones(3))
    return u / np.linalg.norm(u)


@pytest.mark.parametrize("options", [{}, {"speckle": True, "check_bar": True}])
def test_a_calibration_conforms_to_the_schema(machine: VirtualMachine, options: dict[str, bool]) -> None:
    raw = simulation.raw(machine, seed=1, **options)
    validate(raw)
    assert raw["distance"].shape == (3, 60)
    assert ("speckle" in raw) == ("bar_distance" in raw) == bool(options)
    assert "simulated" in raw.attrs["instruments"]


@pytest.mark.parametrize("seed", range(4))
def test_strokes_keep_within_range_and_travel(seed: int) -> None:
    machine = VirtualMachine("cframe", seed=seed)
    planes = [(inclination * DEG, rotation * DEG) for inclination in (0, 10, 20) for rotation in (0, 45, 90, 180)]
    raw = simulation.raw(machine, planes, seed=1)
    assert np.abs(raw["distance"].values).max() < 10e-3
    for axis, values in zip("XYZ", np.moveaxis(raw["stage"].values, -1, 0), strict=True):
        low, high = machine.travel[axis]
        assert low <= values.min() < values.max() <= high


def test_without_inclination_error_the_gradients_determine_the_true_beam(machine: VirtualMachine) -> None:
    raw = simulation.raw(machine, seed=1, inclination_error=False)
    g = gradients(raw["distance"].values, raw["stage"].values)
    u = machine.point_sensor.true_direction
    # 20 readings of 0.1 um noise along 40 mm: 2e-6 a gradient
    np.testing.assert_allclose(g @ u, -1.0, atol=4 * 5e-6)
    assert np.linalg.norm(direction(g) - u) < 5e-5


def test_the_inclination_error_rotates_the_beam_and_the_true_slopes_correct_it(machine: VirtualMachine) -> None:
    raw = simulation.raw(machine, seed=1)
    sensor = machine.point_sensor
    u, distance, stage = sensor.true_direction, raw["distance"].values, raw["stage"].values
    k = sensor.slope(tilt(u, sensor.triangulation_normal, raw["nominal_normal"].values))
    off = np.arccos(direction(gradients(distance, stage)) @ u)
    left = np.arccos(min(1.0, direction(gradients(distance / (1 + k)[:, None], stage)) @ u))
    assert off > 0.1 * DEG
    assert left < off / 50


def test_the_seed_affects_only_noise_and_setting(machine: VirtualMachine) -> None:
    one, again, other = (simulation.raw(machine, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one["distance"], again["distance"])
    np.testing.assert_array_equal(one["stage"], other["stage"])
    assert 0.1e-6 < np.abs(one["distance"] - other["distance"]).max() < 20e-6


def test_noise_is_as_stated(machine: VirtualMachine) -> None:
    planes = [(20 * DEG, 90 * DEG)] * 40
    stage = np.tile(machine.home(), (100, 1))
    raw = simulation.raw(machine, planes, stage, seed=1)
    spread = raw["distance"].std("reading", ddof=1)
    # 4000 numbers: their variance to 2.2 %, the spread to 1.1 %; four sigmas
    assert float(np.sqrt((spread**2).mean())) == pytest.approx(float(raw["distance_noise"]), rel=0.045)


def test_points_of_the_planes_have_the_stated_uncertainty(machine: VirtualMachine) -> None:
    sensor, plane = machine.point_sensor, (0.0, 0.0)
    heights = []
    for seed in range(200):
        raw = simulation.raw(machine, [plane], machine.home()[None], seed=seed, inclination_error=False)
        spot = sensor.true_origin + machine.home() + raw["distance"].item() * sensor.true_direction
        heights.append(spot[2] - raw["plane_point"].values[0, 2])
    expected = float(raw["plane_point_uncertainty"])
    assert np.sqrt(np.mean(np.square(heights))) == pytest.approx(expected, rel=0.2)  # 200 numbers: 5 %, four sigmas


def test_speckle_is_in_the_readings_when_it_is_stated(machine: VirtualMachine) -> None:
    plain, textured = (simulation.raw(machine, seed=1, speckle=speckle) for speckle in (False, True))
    added = (textured["distance"] - plain["distance"]).values
    assert np.std(added) == pytest.approx(float(textured["speckle"]), rel=0.25)  # 180 readings: 5 %, and M = 256 waves
    near = machine.home() + np.outer([0.0, 1e-7], [1.0, 0.0, 0.0])
    pair = [simulation.raw(machine, stage=near, seed=1, speckle=speckle)["distance"] for speckle in (False, True)]
    texture = (pair[1] - pair[0]).values
    assert np.abs(np.diff(texture)).max() < 0.15e-6 < np.abs(texture).max()  # a five-hundredth of the length


def test_a_stroke_out_of_range_has_no_readings_there(machine: VirtualMachine) -> None:
    stage = machine.home() + np.outer(np.linspace(-0.03, 0.03, 31), [0.0, 0.0, 1.0])
    raw = simulation.raw(machine, stage=stage, seed=1)
    lost = np.isnan(raw["distance"].values)
    assert lost[:, [0, -1]].all()
    assert not lost[:, 15].any()
    validate(raw)


def test_a_face_that_the_beam_does_not_meet_has_no_readings(machine: VirtualMachine) -> None:
    sensor = seeded_point_sensor(np.random.default_rng(0), lean=60 * DEG)
    raw = simulation.raw(machine, [(50 * DEG, 0.0), (50 * DEG, 180 * DEG)], seed=1, sensor=sensor)
    lost = np.isnan(raw["distance"].values)
    assert lost[0].all()
    assert not lost[1].any()


@pytest.mark.parametrize("shape", [(3,), (4, 2), (2, 5, 3)])
def test_stage_positions_of_another_shape_are_refused(machine: VirtualMachine, shape: tuple[int, ...]) -> None:
    with raises("simulation.stage.shape"):
        simulation.raw(machine, stage=np.zeros(shape), seed=1)


def test_a_cold_sensor_drifts_during_the_calibration() -> None:
    warm, cold = (VirtualMachine("cframe", seed=3, warm=warm) for warm in (True, False))
    lack = (simulation.raw(cold, seed=1)["distance"] - simulation.raw(warm, seed=1)["distance"]).values.ravel()
    assert lack[0] == pytest.approx(-warm.point_sensor.warm_up, abs=1e-9)  # of a warm one 0.5 nm are left
    assert (np.diff(lack) > 0).all()


# ---------------------------------------------------------------------- the check bar


def test_a_bar_is_measured_symmetrically_about_mid_range(machine: VirtualMachine) -> None:
    raw = simulation.raw_check_bar(machine, seed=1)
    reading = raw["bar_distance"].values
    assert reading.size == 20
    assert -5e-3 < reading.min() < 0 < reading.max() < 5e-3
    assert np.argmin(reading) in (9, 10)
    assert float(raw["bar_radius"]) == 25e-3
    steps = np.diff(raw["bar_stage"].values, axis=0)
    np.testing.assert_allclose(steps @ machine.point_sensor.nominal_direction, 0.0, atol=1e-15)
    np.testing.assert_allclose(steps @ raw["bar_axis"].values, 0.0, atol=1e-15)


def test_the_inclination_error_on_a_bar_is_tens_of_micrometres(machine: VirtualMachine) -> None:
    with_error, without = (
        simulation.raw_check_bar(machine, seed=1, inclination_error=error) for error in (True, False)
    )
    off = (with_error["bar_distance"] - without["bar_distance"]).values
    assert 5e-6 < np.abs(off).max() < 50e-6
    zero = np.argmin(np.abs(without["bar_distance"].values))
    assert np.abs(off[zero]) < np.abs(off).max() / 5


def test_a_stroke_beyond_the_bar_or_a_beam_along_it_is_refused(machine: VirtualMachine) -> None:
    with raises("simulation.bar.half_width"):
        simulation.raw_check_bar(machine, seed=1, half_width=26e-3)
    along = seeded_point_sensor(np.random.default_rng(0), lean=np.pi / 2, azimuth=np.pi / 2)
    with raises("simulation.bar.parallel"):
        simulation.raw_check_bar(machine, seed=1, sensor=along)


# ---------------------------------------------------------------------- against an interferometer


def test_an_inclination_calibration_conforms_to_the_schema_with_about_5000_groups(machine: VirtualMachine) -> None:
    raw = simulation.raw_inclination(machine, seed=1)
    validate(raw)
    assert 5000 < raw.sizes["group"] < 5500
    assert not np.isnan(raw["reading"]).any()


def test_its_errors_are_depth_times_slope_and_noise(machine: VirtualMachine) -> None:
    sensor = machine.point_sensor
    raw = simulation.raw_inclination(machine, seed=1, sensor=sensor.from_start(20e-3))
    depth = raw["reference"] - raw["mid_range"]
    k = sensor.slope(tilt_vector(raw["inclination"], raw["rotation"]))
    left = (raw["reading"] - raw["reference"] - depth * k).values
    assert np.std(left) == pytest.approx(float(raw["reading_noise"]), rel=0.04)  # 5187 numbers: 1 %, four sigmas


def test_beyond_the_range_there_is_no_reading(machine: VirtualMachine) -> None:
    raw = simulation.raw_inclination(machine, [0.0], [0.0], [-11e-3, 0.0, 11e-3], seed=1)
    np.testing.assert_array_equal(np.isnan(raw["reading"]), [True, False, True])
