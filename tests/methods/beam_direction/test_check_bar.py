"""Check bar: published measurements, and simulated bars with known true values."""

from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion import datasets
from errormotion.errors import FitError
from errormotion.methods.beam_direction.identification.check_bar.measure import BarFit, fit_bar, measure_bar
from errormotion.methods.beam_direction.identification.check_bar.scanning import points

TABLE_2 = Path(__file__).parents[3] / "examples" / "check_bar"
ALONG_Z = (0.0, 0.0, 1.0)
R = 25e-3
ACROSS = np.linspace(-20e-3, 18e-3, 20)


def published(name: str) -> BarFit:
    raw = datasets.load(TABLE_2 / f"{name}.csv")
    return measure_bar(raw, (0, 0, 0), raw["nominal_direction"], stage_noise=0.3e-6, radius_uncertainty=1.2e-6)[1]


def bar_points(noise: float, seed: int = 0, shape: np.ndarray | float = 0.0) -> np.ndarray:
    """Return 20 points across a bar whose axis is the z axis, with white radial errors and optional form errors."""
    angle = np.arcsin(ACROSS / R)
    r = R + noise * np.random.default_rng(seed).normal(size=angle.size) + shape
    return np.column_stack([-r * np.cos(angle), r * np.sin(angle), np.zeros_like(r)])


@pytest.mark.parametrize(
    ("name", "radius", "rms"),
    [
        ("scheme1", 25.0009, 3.4),
        ("scheme2_0deg_raw", 25.0122, 7.1),
        ("scheme2_0deg_compensated", 24.961, 13.8),
        ("scheme2_90deg_raw", 25.0142, 5.2),
        ("scheme2_90deg_compensated", 25.0022, 9.0),
        ("scheme3", 25.0018, 0.19),
    ],
)
def test_published_bar_has_this_radius_and_residual(name: str, radius: float, rms: float) -> None:
    bar = published(name)
    assert 1e3 * bar.radius == pytest.approx(radius, abs=1e-3)  # the last digit of the readings
    assert 1e6 * bar.rms == pytest.approx(rms, abs=0.1)


@pytest.mark.parametrize(("name", "centre"), [("scheme3", (5.603, -17.749)), ("scheme1", (176.420, -108.833))])
def test_published_centres(name: str, centre: tuple[float, float]) -> None:
    np.testing.assert_allclose(1e3 * published(name).centre[:2], centre, atol=1e-3)


def test_misprint_of_the_published_table_is_reported() -> None:
    bar = published("scheme2_0deg_compensated")
    assert bar.left_out == (8,)
    assert "Point 9 of 20 (index 8, reading 5.465 mm) is an outlier and was ignored: 130 um inside" in bar.notes[0]


def test_residual_of_the_published_compensation_is_reported_as_systematic() -> None:
    bar = published("scheme2_0deg_compensated")
    assert bar.systematic
    assert bar.exceeds_noise
    assert "systematic: residual rms 13.8 um" in bar.notes[1]


def test_only_the_misprint_of_the_published_table_is_ignored() -> None:
    names = ("scheme1", "scheme2_0deg_raw", "scheme2_90deg_raw", "scheme2_90deg_compensated", "scheme3")
    assert [published(name).left_out for name in names] == [()] * 5


def test_laser_at_reading_0_and_touch_probe_have_no_systematic_residual() -> None:
    assert not published("scheme1").systematic
    assert published("scheme3").notes == ()


@pytest.mark.slow
def test_clean_bars_cause_few_false_alarms_and_intervals_cover_the_true_value() -> None:
    # Noise of 1 um at each point: each alarm is set to 1 %, and more than 6 of 150 come once in 1000 then. Of 95 %
    # intervals 150 cover between 133 and 150 times, but for one case in 1000.
    bars = [fit_bar(bar_points(1e-6, seed), ALONG_Z, noise=1e-6) for seed in range(150)]
    assert sum(bool(bar.left_out) for bar in bars) <= 6
    assert sum(bar.systematic for bar in bars) <= 6
    assert sum(bar.exceeds_noise for bar in bars) <= 6
    assert 133 <= sum(abs(bar.radius - R) < 1.96 * bar.radius_u for bar in bars) <= 150
    across = [bar.centre[1] / np.sqrt(bar.centre_covariance[1, 1]) for bar in bars]
    assert 133 <= np.sum(np.abs(across) < 1.96) <= 150


@pytest.mark.parametrize("size", [130e-6, -130e-6])
def test_wrong_reading_is_found_despite_a_systematic_error(size: float) -> None:
    # Half a dozen times as far off as the wave: whatever the wave's phase, the wrong point is outside of what it makes.
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        wave = 20e-6 * np.sin(rng.uniform(0, 2 * np.pi) + rng.uniform(1, 2) * np.linspace(0, 2 * np.pi, 20))
        wrong = int(rng.integers(2, 18))
        bar = fit_bar(bar_points(1e-6, seed, wave + size * (np.arange(20) == wrong)), ALONG_Z, noise=1e-6)
        found.append(wrong in bar.left_out)
        if bar.left_out == (wrong,):
            assert bar.systematic
    assert sum(found) >= 19


def test_systematic_form_error_is_not_treated_as_outliers() -> None:
    wave = 14e-6 * np.sin(np.linspace(0, 3 * np.pi, 20))
    bar = fit_bar(bar_points(1e-6, 1, wave), ALONG_Z, noise=1e-6)
    assert bar.systematic
    assert bar.left_out == ()


def test_noise_larger_than_stated_is_reported_and_increases_the_uncertainty() -> None:
    stated, true = (fit_bar(bar_points(5e-6, 3), ALONG_Z, noise=noise) for noise in (0.5e-6, 5e-6))
    assert stated.exceeds_noise
    assert not stated.systematic
    assert not true.exceeds_noise
    assert any("exceed the noise" in note for note in stated.notes)
    # Ten times too small a noise, corrected by the residuals of 17 freedoms (17 % of one standard deviation).
    assert stated.radius_u == pytest.approx(true.radius_u, rel=0.5)


def test_without_stated_noise_it_is_estimated_from_the_residuals() -> None:
    bar = fit_bar(bar_points(1e-6, 4), ALONG_Z)
    reported = fit_bar(bar_points(1e-6, 4), ALONG_Z, noise=1e-6)
    assert np.isnan(bar.explained)
    assert not bar.exceeds_noise
    assert bar.radius_u == pytest.approx(reported.radius_u, rel=0.5)


def test_order_of_the_points_does_not_matter_on_a_circle() -> None:
    wave = 14e-6 * np.sin(np.linspace(0, 3 * np.pi, 20))
    scan = bar_points(1e-6, 1, wave)
    mixed = fit_bar(scan[np.random.default_rng(0).permutation(20)], ALONG_Z, noise=1e-6)
    assert mixed.chance == pytest.approx(fit_bar(scan, ALONG_Z, noise=1e-6).chance)


def test_points_without_reading_are_not_counted_as_ignored() -> None:
    scan = bar_points(1e-6, 1)
    scan[4] = np.nan
    bar = fit_bar(scan, ALONG_Z, noise=1e-6)
    assert bar.left_out == ()
    assert np.isnan(bar.residuals[4])
    assert np.isfinite(np.delete(bar.residuals, 4)).all()


def test_fixed_radius_improves_the_centre_and_contributes_its_uncertainty() -> None:
    scan = bar_points(1e-6, 1)
    free = fit_bar(scan, ALONG_Z, radius=R, noise=1e-6)
    held = fit_bar(scan, ALONG_Z, radius=R, hold_radius=True, noise=1e-6)
    sure = np.sqrt(held.centre_covariance[0, 0])
    assert sure < 0.5 * np.sqrt(free.centre_covariance[0, 0])
    assert held.radius == R
    assert held.free_radius == pytest.approx(free.radius, abs=1e-12)
    unsure = fit_bar(scan, ALONG_Z, radius=R, radius_uncertainty=1e-6, hold_radius=True, noise=1e-6)
    # A bar that is 1 um thicker has its axis 1 um / mean cos(angle) farther away: 1 to 1.7 um on this arc.
    assert 1e-6 < np.sqrt(unsure.centre_covariance[0, 0] - sure**2) < 1.7e-6


def test_a_radius_that_contradicts_the_certificate_is_reported() -> None:
    bar = fit_bar(bar_points(0.2e-6, 1), ALONG_Z, radius=R + 20e-6, noise=0.2e-6)
    assert any("um from the calibrated one, 25.0200 mm" in note for note in bar.notes)
    assert fit_bar(bar_points(0.2e-6, 1), ALONG_Z, radius=R, noise=0.2e-6).notes == ()


def test_cylinder_finds_a_tilted_axis() -> None:
    axis = np.array([0.02, -0.01, 1.0]) / np.linalg.norm([0.02, -0.01, 1.0])
    rng = np.random.default_rng(2)
    angle, height = rng.uniform(-1, 1, 80), rng.uniform(0, 50e-3, 80)
    first = np.cross(axis, (0, 1, 0)) / np.linalg.norm(np.cross(axis, (0, 1, 0)))
    second = np.cross(axis, first)
    r = R + 1e-6 * rng.normal(size=80)
    scan = np.outer(r * np.cos(angle), first) + np.outer(r * np.sin(angle), second) + np.outer(height, axis)
    scan[7] -= 200e-6 * first
    bar = fit_bar(scan, ALONG_Z, shape="cylinder", noise=1e-6)
    assert bar.left_out == (7,)
    off = bar.axis - axis
    assert np.linalg.norm(off) < 3 * np.sqrt(np.trace(bar.axis_covariance))
    assert np.linalg.norm(off) < 3e-5  # 1 um over 50 mm, from a few dozen points
    assert abs(bar.radius - R) < 3 * bar.radius_u


def test_errors_of_the_beam_shift_all_points_and_are_in_the_covariance_of_the_bar() -> None:
    stage = np.column_stack([0 * ACROSS, ACROSS, 0 * ACROSS])
    reading = 3e-3 - np.sqrt(R**2 - ACROSS**2)
    covariance = np.zeros((6, 6))
    covariance[0, 0], covariance[4, 4] = (5e-6) ** 2, (1e-3) ** 2
    scan = points(reading, stage, (0, 0, 0), (1, 0, 0), covariance=covariance, noise=0.1e-6)
    bar = fit_bar(scan, ALONG_Z)
    # The origin's 5 um move the centre along x. A turn of 1 mrad moves it across by 1 mrad times its distance.
    u = np.sqrt(np.diag(bar.centre_covariance))
    turned = points(reading, stage, (0, 0, 0), np.array([1, 1e-3, 0]) / np.hypot(1, 1e-3))
    assert u[1] == pytest.approx(abs(fit_bar(turned, ALONG_Z).centre[1] - bar.centre[1]), rel=0.02)
    moved = fit_bar(points(reading, stage, (5e-6, 0, 0), (1, 0, 0)), ALONG_Z)
    assert moved.centre[0] - bar.centre[0] == pytest.approx(5e-6, rel=1e-6)
    assert u[0] > 5e-6
    assert np.trace(bar.common_covariance[:2, :2]) > 0.99 * (u[0] ** 2 + u[1] ** 2)


def test_too_few_points_and_points_that_form_no_bar_are_refused() -> None:
    with raises("shape.points.too_few"):
        fit_bar(bar_points(1e-6)[:4], ALONG_Z)
    line = np.column_stack([np.zeros(20), ACROSS, np.zeros(20)])
    with pytest.raises(FitError):
        fit_bar(line, ALONG_Z)


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"shape": "cone"}, "beam.bar.shape"),
        ({"radius": -1.0}, "beam.bar.radius"),
        ({"hold_radius": True}, "beam.bar.hold_radius"),
        ({"noise": -1.0}, "beam.bar.noise"),
    ],
)
def test_wrong_options_are_reported(options: dict, code: str) -> None:
    with raises(code):
        fit_bar(bar_points(1e-6), ALONG_Z, **options)


def test_dataset_without_bar_is_refused() -> None:
    raw = datasets.load(TABLE_2 / "scheme1.csv").drop_vars(["bar_distance", "bar_axis"])
    with raises("beam.bar.readings_missing"):
        measure_bar(raw, (0, 0, 0), (1, 0, 0))
