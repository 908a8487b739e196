"""The calibration of an inclination error as a dataset: values, refused tilts, and search by name."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from coded import raises
from hypothesis import given
from hypothesis import strategies as st

from errormotion import datasets
from errormotion.datasets.calibrations.inclination import (
    AWAY,
    ROTATION_ZERO,
    SCHEMA,
    InclinationCalibration,
    build,
    hole_texts,
    violations,
)
from errormotion.datasets.calibrations.tilt_support import TiltSupport
from errormotion.errors import DatasetError
from errormotion.kinematics.beams import tilt_vector

INCLINATIONS = np.radians([0, 10, 20, 30, 40])
ROTATIONS = np.radians([0, 30, 60, 90, 120, 150, 180, 210, 240, 270, 300, 330])
DEGREES = np.array([[0, 0], [1, 0], [2, 0], [0, 2]])
COEFFICIENTS = np.array([1e-4, 3e-3, 2e-3, 5e-4])
DEVIATIONS = np.array([1e-6, 2e-6, 2e-6, 3e-6])


def calibration(
    alpha: np.ndarray = INCLINATIONS, beta: np.ndarray = ROTATIONS, gap: float = 0.5, **changes: object
) -> InclinationCalibration:
    """Return a calibration of four terms over a grid of settings."""
    a, b = (part.ravel() for part in np.meshgrid(alpha, beta))
    n = len(a)
    variables = {
        "coefficient": COEFFICIENTS,
        "coefficient_covariance": np.diag(DEVIATIONS**2),
        "degree": DEGREES,
        "tilt_scale": np.tan(np.radians(20)),
        "mid_range": 0.0,
        "mid_range_found": np.nan,
        "mid_range_uncertainty": np.nan,
        "reading_low": -10e-3,
        "reading_high": 10e-3,
        "support_gap": gap,
        "support_margin": 0.04,
        "inclination": a,
        "rotation": b,
        "setting_left_out": np.zeros(n, dtype=np.int8),
        "noise": 1e-7,
        "scatter": 1.0,
        "group_setting": np.arange(n),
        "group_left_out": np.zeros(n, dtype=np.int8),
        "remaining_error": 2e-6,
        "remaining_error_interval": [1e-6, 3e-6],
        **{name: np.zeros(n) for name in ("group_depth", "group_residual", "offset", "slope", "slope_uncertainty")},
        **{name: np.zeros(n) for name in ("slope_predicted", "slope_predicted_uncertainty")},
    }
    attributes = {"order": 2, "mirror": 1, ROTATION_ZERO: AWAY, "provenance": "{}"}
    return InclinationCalibration(build({**variables, **changes}, attributes))


@pytest.fixture(scope="module")
def good() -> InclinationCalibration:
    return calibration()


@pytest.fixture(scope="module")
def holed() -> InclinationCalibration:
    """Settings along 0..10, 90 and 170..180 deg, over inclinations of both signs."""
    return calibration(np.radians(np.arange(-45, 46, 5)), np.radians([0, 5, 10, 90, 170, 175, 180]))


@given(
    depth=st.floats(-9e-3, 9e-3),
    alpha=st.floats(0.0, np.radians(38)),
    beta=st.floats(0.0, 2 * np.pi),
    mid=st.sampled_from([0.0, 1e-3]),
)
def test_compensation_removes_the_error(
    good: InclinationCalibration, depth: float, alpha: float, beta: float, mid: float
) -> None:
    q = tilt_vector(alpha, beta)
    k, _ = good.slope(q)
    found = good.compensate(mid + depth + depth * k, q, mid_range=mid)
    assert found.value == pytest.approx(mid + depth, abs=1e-15)


def test_the_raw_reading_is_stored_with_the_compensated_one(good: InclinationCalibration) -> None:
    reading = np.array([-4e-3, 0.0, 5e-3, np.nan])
    found = good.compensate(reading, tilt_vector(np.radians(20.0), 0.0))
    np.testing.assert_array_equal(found.raw, reading)
    assert found.value[1] == 0.0
    assert abs(found.value[2] - reading[2]) > 1e-6
    assert np.isnan(found.value[3])
    assert np.isnan(found.uncertainty[3])


def test_uncertainty_and_jacobian_are_those_of_the_coefficients(good: InclinationCalibration) -> None:
    q, reading = tilt_vector(np.radians([15.0, 30.0]), np.radians([40.0, 200.0])), np.array([5e-3, -8e-3])
    found = good.compensate(reading, q)
    C = good.coefficient_covariance
    np.testing.assert_allclose(
        found.uncertainty, np.sqrt(np.einsum("ni,ij,nj->n", found.jacobian, C, found.jacobian)), rtol=1e-12
    )
    for k, step in enumerate(1e-7 * np.eye(len(COEFFICIENTS))):
        moved = calibration(coefficient=COEFFICIENTS + step).compensate(reading, q).value
        # second order in a step of 1e-7 relative to 1 + k
        np.testing.assert_allclose((moved - found.value) / 1e-7, found.jacobian[:, k], rtol=1e-5, atol=1e-12)


def test_between_settings_is_supported(good: InclinationCalibration) -> None:
    assert good.supported(
        tilt_vector(np.radians([5.0, 15.0, 35.0, 40.0]), np.radians([15.0, 100.0, 345.0, 45.0]))
    ).all()


def test_a_tilt_beyond_the_steepest_setting_is_refused(good: InclinationCalibration) -> None:
    with raises("calibration.inclination.outside") as reported:
        good.compensate(1e-3, tilt_vector(np.radians(50.0), np.radians(30.0)))
    assert "nearest calibrated: inclination 40.0 deg at rotation 30.0 deg" in str(reported.value)


def test_a_tilt_in_a_hole_is_refused(holed: InclinationCalibration) -> None:
    q = tilt_vector(np.radians([30.0, 30.0]), np.radians([5.0, 45.0]))
    assert holed.supported(q).tolist() == [True, False]
    with raises("calibration.inclination.outside"):
        holed.compensate([1e-3, 1e-3], q)
    assert holed.compensate([1e-3, 1e-3], q, extrapolate=True).uncertainty[1] > 0


def test_along_a_single_row_of_settings_is_supported(holed: InclinationCalibration) -> None:
    alpha = np.radians(np.arange(-44.0, 45.0, 2.0))
    assert holed.supported(tilt_vector(alpha, np.radians(90.0))).all()
    assert holed.supported(tilt_vector(alpha, np.radians(91.5))).all()


def test_near_right_angles_all_rows_are_close_enough(holed: InclinationCalibration) -> None:
    assert holed.supported(tilt_vector(np.radians(12.0), np.radians(np.arange(0.0, 360.0, 5.0)))).all()


def test_holes_are_listed(holed: InclinationCalibration, good: InclinationCalibration) -> None:
    holes = holed.support.holes()
    assert len(holes) == 4  # one in each quarter
    assert not holed.supported(np.array([hole.middle for hole in holes])).any()
    assert hole_texts(holes) == [
        "inclination 15 to 45 deg at rotation 10 to 90, 90 to 170, 190 to 270 and 270 to 350 deg"
    ]
    assert len(good.support.holes()) == 0


def test_omitted_settings_support_no_tilt() -> None:
    a, _ = np.meshgrid(INCLINATIONS, ROTATIONS)
    steep = (np.abs(np.degrees(a.ravel()) - 40) < 1).astype(np.int8)
    assert not calibration(setting_left_out=steep).supported(tilt_vector(np.radians(38.0), 0.0))


@pytest.mark.parametrize("tilts", [[[0.0, 0.0]], [[0.0, 0.0], [0.2, 0.0]], [[0.0, 0.0], [0.2, 0.1], [0.4, 0.2]]])
def test_settings_on_a_line_support_only_this_line(tilts: list[list[float]]) -> None:
    support = TiltSupport(np.array(tilts), gap=0.5, margin=0.02)
    inside = np.mean(tilts, axis=0)
    assert support.holds(inside)
    assert not support.holds(inside + np.array([0.0, 0.1]))
    assert not support.holds([np.nan, 0.0])


def test_a_reading_beyond_the_calibrated_depths_is_refused(good: InclinationCalibration) -> None:
    with raises("calibration.reading.outside"):
        good.compensate([1e-3, 12e-3], tilt_vector(0.1, 0.0))
    assert good.compensate([12e-3], tilt_vector(0.1, 0.0), extrapolate=True).value.shape == (1,)


def test_the_grid_contains_the_surface_and_its_support(good: InclinationCalibration) -> None:
    grid = good.grid(21)
    q = np.array([float(grid.q1[5]), float(grid.q2[8])])
    assert float(grid.slope[5, 8]) == good.slope(q)[0]
    assert bool(grid.supported[10, 10])
    assert not bool(grid.supported[0, 0])


def test_a_calibration_is_unchanged_by_storage(good: InclinationCalibration, tmp_path: Path) -> None:
    again = InclinationCalibration.load(good.save(tmp_path / "lk_h050.nc"))
    q = tilt_vector(np.radians(25.0), 0.3)
    assert again.name == "lk_h050"
    assert again.order == 2
    np.testing.assert_array_equal(again.slope(q), good.slope(q))
    assert datasets.violations(datasets.load(tmp_path / "lk_h050.nc")) == []
    assert [path.name for path in tmp_path.iterdir()] == ["lk_h050.nc"]


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder and the folder of a bench file."""
    for name in ("here", "bench/calibrations", "shared"):
        (tmp_path / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.delenv("ERRORMOTION_CALIBRATIONS", raising=False)
    return tmp_path


def test_a_calibration_is_found_by_name_in_the_folder_of_the_campaign(
    good: InclinationCalibration, folders: Path
) -> None:
    good.save(folders / "bench" / "calibrations" / "left.nc")
    assert InclinationCalibration.find("left", folders / "bench").name == "left"
    assert InclinationCalibration.find("calibrations/left.nc", folders / "bench").name == "left"


def test_a_calibration_is_found_by_name_in_the_working_folder_and_in_the_named_one(
    good: InclinationCalibration, folders: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ERRORMOTION_CALIBRATIONS", str(folders / "shared"))
    good.save(folders / "shared" / "one.nc")
    (folders / "here" / "calibrations").mkdir()
    good.save(folders / "here" / "calibrations" / "two.nc")
    good.save(folders / "here" / "three.nc")
    assert [InclinationCalibration.find(name).name for name in ("one", "two", "three.nc")] == ["one", "two", "three"]


def test_a_missing_calibration_is_reported_with_the_searched_folders(
    good: InclinationCalibration, folders: Path
) -> None:
    good.save(folders / "bench" / "calibrations" / "left.nc")
    with raises("calibration.not_found") as reported:
        InclinationCalibration.find("right", folders / "bench")
    message = str(reported.value)
    assert str(folders / "bench" / "calibrations" / "right.nc") in message
    assert str(folders / "here" / "calibrations" / "right.nc") in message
    assert "Calibrations there: left." in message
    assert "ERRORMOTION_CALIBRATIONS" in message


def test_readings_are_refused_as_a_calibration(tmp_path: Path) -> None:
    datasets.save(xr.Dataset(attrs={"schema": "errormotion.raw.inclination/1"}), tmp_path / "data.nc")
    with pytest.raises(DatasetError, match="make a calibration of them with 'errormotion calibrate"):
        InclinationCalibration.load(tmp_path / "data.nc")


def test_all_violations_of_the_schema_are_reported(good: InclinationCalibration, tmp_path: Path) -> None:
    broken = good.dataset.drop_vars("noise").assign(
        mid_range=5.0, coefficient_covariance=(("term", "term_"), -np.eye(4)), tilt_scale=np.nan
    )
    found = violations(broken)
    assert [line.split(":")[0] for line in found] == ["tilt_scale", "mid_range = 5 m", "noise()"]
    assert "is it in mm?" in found[1]
    found = violations(good.dataset.assign(coefficient_covariance=(("term", "term_"), -np.eye(4))))
    assert found == ["coefficient_covariance: expected a symmetric matrix without negative variances; found another"]
    datasets.save(broken, tmp_path / "broken.nc")
    with pytest.raises(DatasetError, match=rf"breaks its schema \({SCHEMA}\)") as reported:
        InclinationCalibration.load(tmp_path / "broken.nc")
    assert len(reported.value.violations) == 3
