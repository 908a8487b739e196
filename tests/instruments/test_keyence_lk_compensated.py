"""Point sensors with correction of the inclination error: an LK-H and an optoNCDT in front of the same plane."""

import math
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion.datasets.calibrations.inclination import (
    AWAY,
    ROTATION_ZERO,
    InclinationCalibration,
    build,
    half_tilt,
    terms,
)
from errormotion.errors import DatasetError
from errormotion.instruments.point_lds.compensated import CompensatedSensor
from errormotion.instruments.point_lds.keyence_lk import KeyenceLK, LKSettings
from errormotion.instruments.point_lds.optoncdt import OptoNCDT, OptoSettings
from errormotion.instruments.simulators import world
from errormotion.kinematics.beams import inclination_rotation, tilt, tilt_vector
from errormotion.twin import VirtualMachine

STEEP = math.radians(30.0)
FACE = math.radians(20.0)  # of the gauge; the beam leans by as much the other way: 40 deg between them
K_UNCERTAINTY = 1e-4
DEGREE = 4


def calibration() -> InclinationCalibration:
    """The twin's own inclination error as a calibration: a polynomial through its slopes up to 45 deg."""
    alpha, beta = (
        part.ravel() for part in np.meshgrid(np.radians(np.arange(5, 50, 5)), np.radians(np.arange(0, 360, 15)))
    )
    q = np.concatenate([[[0.0, 0.0]], tilt_vector(alpha, beta)])
    slope = VirtualMachine("cframe", seed=3).point_sensor.slope(q)
    scale = math.tan(math.radians(45.0) / 2)
    degrees = np.array([(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)])
    coefficients = np.linalg.lstsq(terms(half_tilt(q) / scale, degrees), slope, rcond=None)[0]
    n = len(q)
    values = {
        "coefficient": coefficients,
        "coefficient_covariance": K_UNCERTAINTY**2 * np.diag(degrees.sum(axis=1) == 0),
        "degree": degrees,
        "tilt_scale": scale,
        "mid_range": 0.0,
        "mid_range_found": math.nan,
        "mid_range_uncertainty": math.nan,
        "reading_low": -10e-3,
        "reading_high": 10e-3,
        "support_gap": 0.4,
        "support_margin": 0.05,
        "inclination": inclination_rotation(q)[0],
        "rotation": inclination_rotation(q)[1],
        "slope": slope,
        "slope_uncertainty": np.full(n, K_UNCERTAINTY),
        "offset": np.zeros(n),
        "slope_predicted": slope,
        "slope_predicted_uncertainty": np.full(n, K_UNCERTAINTY),
        "setting_left_out": np.zeros(n, dtype=np.int8),
        "noise": 0.1e-6,
        "scatter": 1.0,
        "group_setting": np.arange(n),
        "group_depth": np.full(n, 10e-3),
        "group_residual": np.zeros(n),
        "group_left_out": np.zeros(n, dtype=np.int8),
        "remaining_error": K_UNCERTAINTY,
        "remaining_error_interval": [0.0, 2 * K_UNCERTAINTY],
    }
    attributes = {"order": DEGREE, "mirror": 0, ROTATION_ZERO: AWAY, "provenance": "{}", "name": "twin"}
    return InclinationCalibration(build(values, attributes))


@pytest.fixture(scope="module")
def known() -> InclinationCalibration:
    return calibration()


def lk() -> KeyenceLK:
    return KeyenceLK("sim://cframe/lk?seed=3", LKSettings(timeout=10.0))


def opto() -> OptoNCDT:
    settings = OptoSettings(model="ILD2300", range=20e-3, rate=1500.0, timeout=10.0)
    return OptoNCDT("sim://cframe/opto?seed=3&range=20", settings)


def before_a_plane(lift: float) -> tuple[float, float, float]:
    """Move in front of a plane at 40 deg to the beam; return the true depth from mid-range, inclination and
    rotation."""
    here = world("cframe", 3)
    here.set_target("plane", FACE, 0.0)
    here.move_to(here.machine.home() + np.array([0.0, 0.0, lift]))
    point, stage = here.machine.point_sensor, np.array(here.position())
    depth, normals = here.stand.target.meet((point.true_origin + stage)[None], point.true_direction)
    alpha, beta = inclination_rotation(tilt(point.true_direction, point.triangulation_normal, normals[0]))
    return float(depth[0]), float(alpha), float(beta)


@pytest.mark.parametrize("make", [lk, opto])
def test_every_point_sensor_reads_the_depth_from_its_mid_range(make) -> None:
    with make() as sensor:
        low, high = sensor.measuring_range
        assert sensor.mid_range == pytest.approx((low + high) / 2)
        # the gauge's tilt makes up to 1 % of the depth: 5 mm are read to 0.1 mm, and mid-range to a few um
        for lift, allowed in ((-3e-3, 0.1e-3), (0.0, 0.02e-3), (3e-3, 0.1e-3)):
            depth, _, _ = before_a_plane(lift)
            assert sensor.read() - sensor.mid_range == pytest.approx(depth, abs=allowed)


@pytest.mark.parametrize("make", [lk, opto])
@pytest.mark.parametrize("lift", [-3e-3, 3e-3])
def test_the_inclination_error_is_corrected_and_the_raw_reading_unchanged(make, lift: float, known) -> None:
    with make() as sensor:
        compensated = CompensatedSensor(sensor, known, allow_other_sensor=True)
        depth, alpha, beta = before_a_plane(lift)
        block = next(islice(compensated.stream(alpha, beta, block=200), 1))
        one = compensated.read(alpha, beta)
    raw, value = (float(np.mean(part)) - sensor.mid_range for part in (block.raw, block.values))
    # speckle 0.3 um, and what the polynomial leaves of k: 2e-4 of 4 mm
    assert value == pytest.approx(depth, abs=2e-6)
    assert abs(raw - depth) > 5 * abs(value - depth)
    assert abs(raw - depth) > 5e-6
    assert float(one.raw) - sensor.mid_range == pytest.approx(raw, abs=2e-6)
    assert float(one.value) - sensor.mid_range == pytest.approx(value, abs=2e-6)
    assert float(one.uncertainty) == pytest.approx(K_UNCERTAINTY * abs(depth), rel=0.05)


@pytest.mark.parametrize("make", [lk, opto])
def test_a_compensated_block_also_contains_the_raw_one(make, known) -> None:
    with make() as sensor:
        _, alpha, beta = before_a_plane(2e-3)
        blocks = list(
            islice(CompensatedSensor(sensor, known, allow_other_sensor=True).stream(alpha, beta, block=25), 2)
        )
    assert [block.first for block in blocks] == [0, 25]
    for block in blocks:
        assert block.rate == sensor.rate
        assert block.values.shape == block.raw.shape == block.uncertainty.shape == (1, 25)
        assert block.jacobian.shape == (1, 25, known.coefficients.size)
        again = known.compensate(block.raw, tilt_vector(alpha, beta), mid_range=sensor.mid_range)
        np.testing.assert_array_equal(again.value, block.values)


def test_missing_values_are_also_missing_when_compensated_and_are_counted(known) -> None:
    with KeyenceLK("sim://cframe/lk?seed=3&readings=1,nan,12") as sensor:
        block = next(iter(CompensatedSensor(sensor, known).stream(STEEP, 0.0, block=6)))
    assert np.isnan(block.values[0]).tolist() == [False, True, True] * 2
    assert block.invalid == {"no value": 2, "under range": 2}


def test_a_tilt_beyond_the_calibrated_ones_is_refused_unless_permitted(known) -> None:
    with KeyenceLK("sim://cframe/lk?seed=3&readings=5") as sensor:
        with raises("calibration.inclination.outside"):
            CompensatedSensor(sensor, known).read(math.radians(55.0), 0.0)
        beyond = CompensatedSensor(sensor, known, extrapolate=True).read(math.radians(55.0), 0.0)
        assert float(beyond.raw) == pytest.approx(5e-3)
        with raises("sensor.surface.angle"):
            CompensatedSensor(sensor, known).read(math.nan, 0.0)


def test_a_calibration_is_found_by_name_and_by_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "calibrations").mkdir()
    known.save(tmp_path / "calibrations" / "head7.nc")
    with KeyenceLK("sim://cframe/lk?seed=3&readings=5") as sensor:
        values = [
            float(CompensatedSensor(sensor, where).read(STEEP, 0.0).value)
            for where in (known, "head7", tmp_path / "calibrations" / "head7.nc")
        ]
        with pytest.raises(DatasetError, match="calibration 'head8': not found"):
            CompensatedSensor(sensor, "head8")
    assert values[0] == values[1] == values[2] != 5e-3


def test_a_sensor_that_states_no_mid_range_is_refused(known) -> None:
    with raises("sensor.mid_range.missing"):
        CompensatedSensor(object(), known)


def of_sensor(known: InclinationCalibration, serial: str) -> InclinationCalibration:
    return InclinationCalibration(known.dataset.assign_attrs(serial_number=serial))


def numbered(serial: str) -> KeyenceLK:
    return KeyenceLK("sim://cframe/lk?seed=3&readings=5", LKSettings(serial_number=serial))


def test_a_calibration_of_the_same_sensor_is_used_without_a_note(known) -> None:
    with numbered("H17") as sensor:
        assert CompensatedSensor(sensor, of_sensor(known, "H17")).notes == ()


def test_a_calibration_of_another_serial_number_is_refused_unless_allowed(known) -> None:
    other = of_sensor(known, "H16")
    with numbered("H17") as sensor:
        with raises("calibration.sensor.other"):
            CompensatedSensor(sensor, other)
        allowed = CompensatedSensor(sensor, other, allow_other_sensor=True)
        assert "H16" in allowed.notes[0]
        assert float(allowed.read(STEEP, 0.0).value) == float(
            CompensatedSensor(sensor, of_sensor(known, "H17")).read(STEEP, 0.0).value
        )


def test_a_calibration_of_another_mid_range_is_refused(known) -> None:
    serial = "4711"
    with opto() as sensor, raises("calibration.sensor.other"):
        CompensatedSensor(sensor, of_sensor(known, serial), allow_other_sensor=False)


def test_a_serial_number_that_is_missing_is_noted(known) -> None:
    with numbered("H17") as sensor:
        assert "states no serial number" in CompensatedSensor(sensor, known).notes[0]
    with numbered("") as sensor:
        assert "The sensor reports no serial number" in CompensatedSensor(sensor, of_sensor(known, "H17")).notes[0]
