"""The point sensor of the virtual machine: triangulation, range, warm-up, and its targets."""

from dataclasses import replace

import numpy as np
import pytest
from coded import raises

from errormotion.datasets import validate
from errormotion.kinematics.beams import tilt, tilt_vector
from errormotion.kinematics.fits import fit_plane
from errormotion.methods.beam_direction import simulation
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.planes import CheckBar, Plane
from errormotion.twin.sensors.point_sensor import PointSensor, seeded_point_sensor
from errormotion.twin.sensors.triangulation import key_of, speckle

SEEDS = range(5)
DEG = np.radians(1.0)


@pytest.fixture(scope="module")
def machine() -> VirtualMachine:
    return VirtualMachine("cframe", seed=3)


@pytest.fixture(scope="module")
def sensor(machine: VirtualMachine) -> PointSensor:
    return machine.point_sensor


def slope(sensor: PointSensor, alpha: float, beta: float) -> float:
    """Error of the reading per depth at angles in deg."""
    return float(sensor.slope(tilt_vector(alpha * DEG, beta * DEG)))


# ---------------------------------------------------------------------- the beam


def test_seed_selects_an_individual() -> None:
    one, again, other = (VirtualMachine("cframe", seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.point_sensor.true_direction, again.point_sensor.true_direction)
    assert np.abs(one.point_sensor.true_direction - other.point_sensor.true_direction).max() > 1e-5
    assert one.check_bar.radius == again.check_bar.radius != other.check_bar.radius


@pytest.mark.parametrize("seed", SEEDS)
def test_the_beam_is_off_its_drawing_by_tenths_of_a_degree_and_of_a_millimetre(seed: int) -> None:
    sensor = VirtualMachine("cframe", seed=seed).point_sensor
    np.testing.assert_allclose(sensor.nominal_direction, [np.sin(20 * DEG), 0.0, -np.cos(20 * DEG)])
    off = np.arccos(sensor.true_direction @ sensor.nominal_direction)
    assert 0 < off < 0.3 * DEG * 2 * np.sqrt(2)  # each direction keeps within two sigmas
    assert 0 < np.abs(sensor.true_origin - sensor.nominal_origin).max() <= 0.2e-3
    assert np.linalg.norm(sensor.true_direction) == pytest.approx(1.0, abs=1e-12)
    assert abs(sensor.triangulation_normal @ sensor.true_direction) < 1e-12


def test_a_sensor_may_be_mounted_in_another_direction() -> None:
    straight = seeded_point_sensor(np.random.default_rng(0), lean=0.0)
    aside = seeded_point_sensor(np.random.default_rng(0), lean=np.pi / 2, azimuth=np.pi)
    np.testing.assert_allclose(straight.nominal_direction, [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(aside.nominal_direction, [-1, 0, 0], atol=1e-15)


def test_the_truth_is_an_error_dataset_that_takes_the_nominal_beam_to_the_true_one(machine: VirtualMachine) -> None:
    ds = simulation.truth_beam(machine)
    validate(ds)
    assert ds.attrs["component"] == "beam"
    sensor = machine.point_sensor
    shift, rotation = np.split(np.array([float(ds[name][0]) for name in ("EX", "EY", "EZ", "EA", "EB", "EC")]), 2)
    np.testing.assert_allclose(sensor.nominal_origin + shift, sensor.true_origin, atol=1e-15)
    there = sensor.nominal_direction + np.cross(rotation, sensor.nominal_direction)
    there += np.cross(rotation, np.cross(rotation, sensor.nominal_direction)) / 2
    np.testing.assert_allclose(there, sensor.true_direction, atol=1e-6)  # third order of 0.8 deg
    np.testing.assert_array_equal(ds["beam_direction"][0], sensor.true_direction)


# ---------------------------------------------------------------------- planes and bar


@pytest.mark.parametrize("angles", [(0.0, 0.0), (20.0, 0.0), (20.0, 90.0), (30.0, 200.0)])
def test_the_gradient_of_the_reading_is_minus_the_normal_over_its_part_along_the_beam(
    sensor: PointSensor, machine: VirtualMachine, angles: tuple[float, float]
) -> None:
    face = machine.sine_gauge.face(angles[0] * DEG, angles[1] * DEG)
    places = machine.home() + np.random.default_rng(0).uniform(-4e-3, 4e-3, (20, 3))
    reading = sensor.still(face, places, inclination_error=False)
    spots = places + sensor.true_origin + reading[:, None] * sensor.true_direction
    np.testing.assert_allclose((spots - face.point) @ face.normal, 0.0, atol=1e-15)
    gradient = np.linalg.lstsq(np.column_stack([places, np.ones(20)]), reading)[0][:3]
    np.testing.assert_allclose(gradient, -face.normal / (face.normal @ sensor.true_direction), atol=1e-11)
    assert gradient @ sensor.true_direction == pytest.approx(-1.0, abs=1e-11)


def test_readings_on_the_bar_lie_on_a_cylinder(sensor: PointSensor, machine: VirtualMachine) -> None:
    bar = machine.check_bar
    places = simulation.raw_check_bar(machine, seed=0)["bar_stage"].values
    reading = sensor.still(bar, places, inclination_error=False)
    spots = places + sensor.true_origin + reading[:, None] * sensor.true_direction - bar.point
    across = spots - (spots @ bar.axis)[:, None] * bar.axis
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), bar.radius, atol=1e-12)
    assert (across @ sensor.true_direction < 0).all()  # the near side
    _, normals = bar.meet(sensor.true_origin + places, sensor.true_direction)
    np.testing.assert_allclose(normals, across / bar.radius, atol=1e-12)


def test_gauge_deviates_from_its_setting_by_arcseconds_and_a_micrometre(machine: VirtualMachine) -> None:
    gauge = machine.sine_gauge
    nominal = gauge.nominal_normal(20 * DEG, 30 * DEG)
    assert np.degrees(np.arccos(nominal[2])) == pytest.approx(20.0)
    assert np.degrees(np.arctan2(nominal[1], nominal[0])) == pytest.approx(30.0)
    faces = [gauge.plane(20 * DEG, 30 * DEG, setting) for setting in range(200)]
    angles = np.array([np.linalg.norm(np.cross(normal, nominal)) for normal, _ in faces])
    heights = np.array([(point - gauge.pivot) @ normal for normal, point in faces])
    # the mean of a square over 200 (400) normal numbers is known to a tenth (7 %): three of them allowed
    assert np.mean(angles**2) / (2 * gauge.angle_uncertainty**2) == pytest.approx(1.0, abs=0.21)
    assert np.mean(heights**2) / gauge.point_uncertainty**2 == pytest.approx(1.0, abs=0.3)
    np.testing.assert_array_equal(gauge.plane(0.1, 0.2)[0], gauge.plane(0.1, 0.2)[0])
    with raises("virtual.plane.inclination"):
        gauge.plane(61 * DEG, 0.0)


def test_missed_target_has_no_reading(sensor: PointSensor) -> None:
    u = sensor.true_direction
    start = -sensor.true_origin[None]  # the stage that has the zero point at the machine's origin
    across = np.array([u[2], 0.0, -u[0]]) / np.hypot(u[0], u[2])
    behind = Plane(u, np.zeros(3))
    grazed = Plane(np.cos(80 * DEG) * -u + np.sin(80 * DEG) * across, np.zeros(3))
    beside = Plane(-u, 0.05 * across, radius=0.04)
    bar = CheckBar(0.03 * across, np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 0.0]), 25e-3)
    above = replace(bar, point=np.array([0.0, 0.2, 0.0]) + 0.02 * u, length=0.1)
    for target in (behind, grazed, beside, bar, above):
        assert np.isnan(sensor.still(target, start)).all()
        assert np.isnan(sensor.still(target, start, inclination_error=False)).all()
        assert np.isnan(sensor.still(target, start, beyond=True)).all()
    for target in (replace(beside, radius=0.06), replace(above, length=0.5)):
        assert np.isfinite(sensor.still(target, start)).all()


def test_no_reading_out_of_range_and_its_side_can_be_requested(sensor: PointSensor) -> None:
    face = Plane(-sensor.true_direction, np.zeros(3))
    depths = 1e-3 * np.array([-10.1, -9.9, 0.0, 9.9, 10.1])
    stage = -sensor.true_origin - depths[:, None] * sensor.true_direction
    np.testing.assert_array_equal(np.isnan(sensor.still(face, stage)), [True, False, False, False, True])
    reported = sensor.still(face, stage, beyond=True)
    assert reported[0] == -np.inf
    assert reported[-1] == np.inf


def test_sensor_with_readings_from_the_start_of_its_range_measures_the_same_surface(
    sensor: PointSensor, machine: VirtualMachine
) -> None:
    face = machine.sine_gauge.face(20 * DEG, 0.0)
    places = machine.home() + np.outer([-2e-3, 0.0, 2e-3], [1.0, 0.0, 1.0])
    middle, start = sensor.still(face, places), sensor.from_start(30e-3).still(face, places)
    np.testing.assert_allclose(start, middle + 15e-3, atol=1e-15)
    assert sensor.from_start(30e-3).mid_range == 15e-3
    assert np.isnan(sensor.from_start(2e-3).still(face, places)[0])
    twice = sensor.from_start(30e-3).from_start(20e-3)
    np.testing.assert_allclose(twice.still(face, places), middle + 10e-3, atol=1e-15)


# ---------------------------------------------------------------------- the tilt of the surface


def test_the_error_is_linear_in_depth_and_nothing_at_mid_range(sensor: PointSensor, machine: VirtualMachine) -> None:
    face = machine.sine_gauge.face(20 * DEG, 0.0)
    down = np.outer(np.linspace(-9e-3, 9e-3, 7), sensor.true_direction)
    places = machine.home() - down
    true, read = (sensor.still(face, places, inclination_error=error) for error in (False, True))
    k = float(sensor.slope(tilt(sensor.true_direction, sensor.triangulation_normal, face.normal)))
    assert abs(k) > 1e-3
    np.testing.assert_allclose(read - true, k * true, atol=1e-15)
    shifted = sensor.from_start(20e-3)
    from_start = [shifted.still(face, places, inclination_error=error) for error in (False, True)]
    np.testing.assert_allclose(from_start[1] - from_start[0], k * (from_start[0] - 10e-3), atol=1e-15)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_error_is_as_large_as_published_and_least_across_the_triangulation_plane(seed: int) -> None:
    sensor = VirtualMachine("cframe", seed=seed).point_sensor
    at_10_mm = {beta: 10e-3 * slope(sensor, 40.0, beta) for beta in (0, 10, 45, 90, 135, 170, 180)}
    assert 20e-6 < abs(at_10_mm[0]) < 65e-6
    assert at_10_mm[0] * at_10_mm[180] < 0
    sizes = np.abs(list(at_10_mm.values()))
    assert np.argmin(sizes) == 3  # 90 deg
    assert sizes[3] < 10e-6
    assert (np.diff(sizes[:4]) < 0).all()
    assert (np.diff(sizes[3:]) > 0).all()


def test_the_error_grows_faster_than_the_tilt(sensor: PointSensor) -> None:
    k = np.array([slope(sensor, alpha, 0.0) for alpha in (0, 10, 20, 30, 40)])
    assert (np.diff(k) > 0).all()
    assert k[4] - k[0] > 1.5 * 4 * (k[1] - k[0])
    assert abs(k[0]) <= 1e-4  # at right angles only the sensor's own scale


def test_tilts_to_either_side_of_the_triangulation_plane_have_the_same_effect(sensor: PointSensor) -> None:
    for alpha, beta in ((20.0, 30.0), (40.0, 90.0), (35.0, 140.0)):
        assert slope(sensor, alpha, beta) == pytest.approx(slope(sensor, alpha, -beta), abs=1e-12)
        assert slope(sensor, -alpha, beta) == pytest.approx(slope(sensor, alpha, beta + 180.0), abs=1e-12)


def test_error_surface_is_no_cubic_but_near_a_polynomial(sensor: PointSensor) -> None:
    """A calibration therefore has a model error: part of the noise at the ends of the range, little of the error."""
    alpha, beta = np.meshgrid(np.linspace(-45, 45, 31) * DEG, np.linspace(0, 180, 37) * DEG)
    q = tilt_vector(alpha, beta).reshape(-1, 2)
    k = sensor.slope(q)

    def left(order: int) -> float:
        powers = [(i, j) for i in range(order + 1) for j in range(0, order + 1 - i, 2)]
        basis = np.column_stack([q[:, 0] ** i * q[:, 1] ** j for i, j in powers])
        return float(10e-3 * np.std(k - basis @ np.linalg.lstsq(basis, k)[0]))

    assert left(3) > 0.5e-6
    assert left(6) < 0.5e-6


def test_no_reading_with_the_receiver_in_the_shade_of_the_surface(sensor: PointSensor) -> None:
    """It is at 28 deg to the beam: a surface inclined away from it by more than 62 deg hides the spot."""
    assert np.isfinite(slope(sensor, 60.0, 0.0))
    assert np.isnan(slope(sensor, 63.0, 0.0))
    assert np.isfinite(slope(sensor, 63.0, 180.0))
    assert np.isnan(slope(sensor, 76.0, 180.0))
    assert np.isnan(sensor.slope(np.array([np.nan, np.nan])))


# ---------------------------------------------------------------------- noise, speckle, warm-up


def test_speckle_has_its_variance_and_loses_its_correlation_over_its_length() -> None:
    length, lags = 50e-6, 1e-6 * np.array([0.0, 10.0, 25.0, 50.0, 100.0, 300.0])
    along = np.array([0.6, 0.0, 0.8])
    fields = np.array([speckle(key_of(1, field), np.outer(lags, along) + 0.1, length) for field in range(4000)])
    correlation = np.mean(fields * fields[:, :1], axis=0)
    # each is a mean over 4000 independent products of spread below 1.5: one sigma 0.024, four allowed
    np.testing.assert_allclose(correlation, np.exp(-lags / length), atol=0.1)
    assert np.var(fields[:, -1]) == pytest.approx(1.0, abs=0.1)
    assert abs(np.mean(fields)) < 0.05


def test_speckle_depends_on_the_position_only() -> None:
    places = np.outer(np.arange(300) * 7e-6, [1.0, 0.3, 0.0])
    whole = speckle(5, places, 50e-6)
    blocks = np.concatenate([speckle(5, part, 50e-6) for part in np.split(places, [1, 50, 222])])
    np.testing.assert_allclose(blocks, whole, atol=1e-12)
    assert np.abs(speckle(6, places, 50e-6) - whole).max() > 0.1


def test_readings_contain_noise_and_speckle_as_stated(machine: VirtualMachine) -> None:
    sensor, face = machine.point_sensor, machine.sine_gauge.face(20 * DEG, 90 * DEG)
    n = 4000
    places = machine.home() + np.outer(np.linspace(-8e-3, 8e-3, n), [1.0, 0.0, 0.0])  # 80 lengths either way
    times = np.full(n, 100.0)
    still = sensor.still(face, places) + sensor.warm_up_offset(machine.sensors_on_for + 100.0)
    off = machine.point_readings(times, places, face) - still
    resting = machine.point_readings(times, places[0], face)
    # n independent numbers: 1.1 %; 320 lengths of texture: 4 %; four sigmas each
    assert np.std(resting) == pytest.approx(sensor.noise, rel=0.045)
    assert np.std(off) == pytest.approx(np.hypot(sensor.noise, sensor.speckle), rel=0.16)


def test_readings_are_the_same_whatever_the_block_size(machine: VirtualMachine) -> None:
    face = machine.sine_gauge.face(20 * DEG, 0.0)
    times = np.arange(100) * 1e-3
    places = machine.home() + np.outer(times, [0.01, 0.0, 0.0])
    whole = machine.point_readings(times, places, face, first=7)
    blocks = [
        machine.point_readings(times[part], places[part], face, first=7 + part.start)
        for part in (slice(0, 1), slice(1, 64), slice(64, 100))
    ]
    np.testing.assert_allclose(np.concatenate(blocks), whole, atol=1e-15)
    assert np.abs(machine.point_readings(times, places, face, first=8) - whole).max() > 0.1e-6


def test_a_cold_sensor_warms_up() -> None:
    cold = VirtualMachine("cframe", seed=3, warm=False)
    sensor, face = cold.point_sensor, cold.sine_gauge.face(0.0, 0.0)
    hours = 3600.0 * np.array([0.0, 0.4, 2.0])
    drift = cold.point_readings(hours, cold.home(), face) - sensor.still(face, cold.home()[None])
    drift = drift - drift[-1]
    assert drift[0] == pytest.approx(-sensor.warm_up, abs=0.6e-6)  # four sigmas of two readings' noise
    assert drift[1] == pytest.approx(-sensor.warm_up / np.e, abs=0.7e-6)  # 0.4 h is the time constant
    assert 9.9e-6 < sensor.warm_up < 11.1e-6


def test_plane_fitted_to_compensated_readings_is_the_face(machine: VirtualMachine) -> None:
    """With a known beam and slope, the readings determine the face."""
    sensor, face = machine.point_sensor, machine.sine_gauge.face(20 * DEG, 0.0)
    places = simulation.strokes(machine, 20 * DEG, 0.0)
    reading = machine.point_readings(np.zeros(len(places)), places, face)
    k = float(sensor.slope(tilt(sensor.true_direction, sensor.triangulation_normal, face.normal)))
    spots = places + sensor.true_origin + (reading / (1 + k))[:, None] * sensor.true_direction
    found = fit_plane(spots)
    normal = found.normal * np.sign(found.normal[2])
    assert np.linalg.norm(normal - face.normal) < 2e-5  # 0.3 um over strokes of centimetres, a few of them
    assert abs((face.point - found.point) @ face.normal) < 0.5e-6
