"""Points from a calibrated beam: positions, covariance, and compensation of the surface's tilt."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.errors import MethodError
from errormotion.kinematics.beams import tilt
from errormotion.methods.beam_direction import simulation
from errormotion.methods.beam_direction.identification.check_bar.measure import fit_bar, measure_bar
from errormotion.methods.beam_direction.identification.check_bar.scanning import (
    Points,
    along_curve,
    over_surface,
    points,
    round_bar,
)
from errormotion.methods.beam_direction.identification.inclination.calibrate import calibrate
from errormotion.twin import VirtualMachine

U = np.array([0.6, 0.0, -0.8])
ORIGIN = np.array([0.1, 0.2, 0.3])
STAGE = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 2e-3, 0.0]])
READING = np.array([1e-3, np.nan, -2e-3])
ACROSS = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def machine() -> VirtualMachine:
    return VirtualMachine("cframe", seed=3)


@pytest.fixture(scope="module")
def calibration(machine: VirtualMachine) -> InclinationCalibration:
    alphas, betas = np.radians(np.arange(-50, 51, 10)), np.radians(np.arange(0, 180, 22.5))
    return calibrate(simulation.raw_inclination(machine, alphas, betas, np.linspace(-10e-3, 10e-3, 5), seed=1))


@pytest.fixture(scope="module")
def bar(machine: VirtualMachine) -> xr.Dataset:
    return simulation.raw_check_bar(machine, seed=5)


@pytest.fixture(scope="module")
def scan(machine: VirtualMachine, calibration: InclinationCalibration, bar: xr.Dataset) -> Callable[..., Points]:
    sensor = machine.point_sensor

    def scan(normals: object = None) -> Points:
        return points(
            bar["bar_distance"].values,
            bar["bar_stage"].values,
            sensor.true_origin,
            sensor.true_direction,
            noise=float(bar["distance_noise"]),
            calibration=calibration,
            triangulation_normal=sensor.nominal_triangulation_normal,
            mid_range=float(bar["mid_range"]),
            normals=normals,
        )

    return scan


def true_normals(machine: VirtualMachine, scanned: Points) -> np.ndarray:
    away = scanned.points - machine.check_bar.point
    away = away - np.outer(away @ machine.check_bar.axis, machine.check_bar.axis)
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def degrees_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


def test_reading_is_a_point_on_the_beam() -> None:
    found = points(READING, STAGE, ORIGIN, U)
    np.testing.assert_allclose(found.points[[0, 2]], (STAGE + ORIGIN + READING[:, None] * U)[[0, 2]])
    assert np.isnan(found.points[1]).all()


def test_stage_that_carries_the_target_has_the_opposite_sign() -> None:
    found = points(READING, STAGE, ORIGIN, U, moves="target")
    np.testing.assert_allclose(found.points[2], ORIGIN - STAGE[2] + READING[2] * U)


def test_noise_is_along_the_beam_and_that_of_the_stage_is_added() -> None:
    found = points(READING, STAGE, ORIGIN, U, noise=3e-7, stage_noise=1e-7)
    np.testing.assert_allclose(found.covariance[0], 9e-14 * np.outer(U, U) + 1e-14 * np.eye(3))


def test_covariance_of_the_beam_is_shared_by_all_points() -> None:
    rng = np.random.default_rng(0)
    scale = np.array([5e-6, 5e-6, 5e-6, 1e-4, 1e-4, 1e-4])
    A = rng.normal(size=(6, 6)) * scale[:, None]
    found = points(READING, STAGE, ORIGIN, U, covariance=A @ A.T)
    shared = np.einsum("sni,smj->nimj", found.influence, found.influence)
    for n in (0, 2):
        for m in (0, 2):
            Jn, Jm = (np.hstack([np.eye(3), READING[k] * np.eye(3)]) for k in (n, m))
            np.testing.assert_allclose(shared[n, :, m], Jn @ A @ A.T @ Jm.T, rtol=1e-6, atol=1e-18)
    np.testing.assert_array_equal(found.covariance[0], 0)


def test_normals_of_a_curve_a_surface_and_a_bar() -> None:
    angle = np.linspace(-0.8, 0.8, 25)  # 1.7 mm apart on a bar of 25 mm
    radial = np.column_stack([-np.cos(angle), 0 * angle, np.sin(angle)])
    # A parabola through 7 points leaves the curve's fourth derivative; at the ends it looks one way.
    found = along_curve(ACROSS)(0.025 * radial)
    off = degrees_between(found * np.sign(np.sum(found * radial, axis=1))[:, None], radial)
    assert off[3:-3].max() < 0.05
    assert off.max() < 0.5
    found = round_bar(ACROSS)(0.025 * radial)
    np.testing.assert_allclose(found, radial, atol=1e-9)
    a, b = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.2, 0.2, 9), np.linspace(-0.2, 0.2, 9)))
    ball = np.column_stack([a, b, np.sqrt(1 - a**2 - b**2)])
    found = over_surface()(0.025 * ball)
    off = degrees_between(found * np.sign(np.sum(found * ball, axis=1))[:, None], ball)
    assert off.max() < 0.2


def test_neighbours_on_one_line_do_not_determine_a_normal() -> None:
    rows = np.array([[x, y, 0.0] for y in (0.0, 1.0) for x in np.linspace(0, 0.01, 30)])
    with raises("beam.scan.points_on_line"):
        over_surface()(rows)


def test_compensated_bar_is_round_and_has_its_radius(
    machine: VirtualMachine, calibration: InclinationCalibration, bar: xr.Dataset
) -> None:
    sensor = machine.point_sensor
    beam = (sensor.true_origin, sensor.true_direction)
    raw = measure_bar(bar, *beam)[1]
    scanned, found = measure_bar(bar, *beam, calibration=calibration)
    assert raw.systematic
    assert raw.rms > 2e-6  # the twin's inclination error: some um at a few mm of depth
    assert not found.systematic
    assert found.rms < 0.15e-6  # noise of 0.1 um
    assert abs(found.radius - machine.check_bar.radius) < 3 * found.radius_u
    assert abs(found.radius - machine.check_bar.radius) < 0.1 * abs(raw.radius - machine.check_bar.radius)
    np.testing.assert_array_equal(scanned.reading, bar["bar_distance"])
    assert np.abs(scanned.distance - scanned.reading).max() > 5e-6


@pytest.mark.parametrize("surface", [along_curve, round_bar])
def test_iterated_normals_are_those_of_the_bar(
    machine: VirtualMachine, bar: xr.Dataset, scan: Callable[..., Points], surface: Callable[..., object]
) -> None:
    found = scan(surface(bar["bar_axis"].values))
    # The bar leans by some 0.1 mrad from its nominal axis; the ends of a scan are seen from one side.
    assert degrees_between(found.normals, true_normals(machine, found))[2:-2].max() < 0.1
    assert found.iterations < 10
    assert fit_bar(found, bar["bar_axis"]).rms < 0.15e-6


def test_given_normals_are_oriented_towards_the_sensor(
    machine: VirtualMachine, bar: xr.Dataset, scan: Callable[..., Points]
) -> None:
    free = scan(round_bar(bar["bar_axis"].values))
    given = scan(-true_normals(machine, free))
    np.testing.assert_allclose(given.distance, free.distance, atol=5e-8)
    assert (given.normals @ given.direction < 0).all()


def test_scan_along_one_line_reports_the_undetermined_tilt(scan: Callable[..., Points], bar: xr.Dataset) -> None:
    assert "determines only the tilt in the plane of the scan" in scan().notes[0]
    assert scan(round_bar(bar["bar_axis"].values)).notes == ()


def test_scan_of_an_area_determines_the_tilt_in_both_directions(calibration: InclinationCalibration) -> None:
    u, t, N = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0]), np.array([0.3, -0.2, 1.0])
    N = N / np.linalg.norm(N)
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-8e-3, 8e-3, 9), np.linspace(-8e-3, 8e-3, 9)))
    stage = np.column_stack([x, y, 0 * x])
    m = calibration.mid_range
    depth = m + 1e-3 + stage @ N / N[2]  # of the plane N.p = N.(u (m + 1 mm)), seen along -z
    k = calibration.slope(tilt(u, t, N))[0]
    reading = depth + (depth - m) * k
    found = points(reading, stage, (0, 0, 0), u, calibration=calibration, triangulation_normal=t)
    assert found.notes == ()
    assert np.abs(reading - depth).max() > 2e-6
    np.testing.assert_allclose(found.distance, depth, atol=1e-9)
    np.testing.assert_allclose(found.normals, np.tile(N, (81, 1)), atol=1e-6)


def test_uncertainty_of_the_calibration_is_shared(scan: Callable[..., Points], bar: xr.Dataset) -> None:
    found = scan(round_bar(bar["bar_axis"].values))
    assert all(source.startswith("inclination calibration") for source in found.sources)
    shared = np.einsum("sni,sni->n", found.influence, found.influence)
    own = np.trace(found.covariance, axis1=1, axis2=2)
    # Nothing at mid-range, where the error vanishes; steep and deep ends know it worst.
    assert np.argmin(shared) in np.argsort(np.abs(found.distance - float(bar["mid_range"])))[:4]
    np.testing.assert_allclose(np.sqrt(own), float(bar["distance_noise"]), rtol=0.05)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"stage": STAGE[:2]}, "beam.scan.shape"),
        ({"reading": np.full(3, np.nan)}, "beam.scan.no_readings"),
        ({"origin": (np.nan, 0, 0)}, "beam.scan.origin"),
        ({"direction": (1, 1, 0)}, "beam.scan.direction"),
        ({"covariance": np.eye(3)}, "beam.scan.covariance"),
        ({"covariance": -np.eye(6)}, "beam.scan.covariance"),
        ({"moves": "table"}, "raw.moves.form"),
        ({"normals": np.ones((3, 3))}, "beam.scan.normals"),
        ({"normals": np.tile(ACROSS, (3, 1))}, "beam.scan.parallel"),
    ],
)
def test_wrong_input_is_reported(change: dict, code: str) -> None:
    given = {"reading": READING, "stage": STAGE, "origin": ORIGIN, "direction": U} | change
    with raises(code):
        points(**given)


def test_calibration_requires_the_triangulation_normal(calibration: InclinationCalibration) -> None:
    normals = np.tile(-U, (3, 1))
    with raises("beam.scan.triangulation_normal"):
        points(READING, STAGE, ORIGIN, U, calibration=calibration, normals=normals)


def test_tilt_beyond_the_calibration_is_refused(calibration: InclinationCalibration) -> None:
    steep = np.array([np.sin(np.radians(70)), 0, -np.cos(np.radians(70))])
    options = {"calibration": calibration, "triangulation_normal": (0, 1, 0), "normals": np.tile(-steep, (3, 1))}
    with raises("calibration.inclination.outside"):
        points(READING, STAGE, ORIGIN, (0, 0, -1), **options)
    allowed = points(READING, STAGE, ORIGIN, (0, 0, -1), **options, extrapolate=True)
    assert "2 of 2 points are at tilts" in " ".join(allowed.notes)  # the one without a reading is not counted


def test_normals_that_do_not_converge_are_reported(calibration: InclinationCalibration) -> None:
    turn = iter(range(1000))

    def restless(p: np.ndarray) -> np.ndarray:
        lean = 0.3 if next(turn) % 2 else -0.3
        return np.tile(np.array([lean, 0, 1]) / np.hypot(lean, 1), (len(p), 1))

    with pytest.raises(MethodError, match="do not converge: after 50 iterations"):
        points(
            READING, STAGE, ORIGIN, (0, 0, -1), calibration=calibration, triangulation_normal=ACROSS, normals=restless
        )


def test_stage_that_moves_along_the_beam_is_refused(calibration: InclinationCalibration) -> None:
    stage = np.outer(np.linspace(0, 1e-3, 5), U)
    with raises("beam.scan.along_beam"):
        points(np.zeros(5), stage, ORIGIN, U, calibration=calibration, triangulation_normal=ACROSS)
