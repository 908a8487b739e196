"""``errormotion calibrate``."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.methods.beam_direction import simulation
from errormotion.twin import VirtualMachine

HEAD = """# schema = errormotion.raw.inclination/1
# sensor = LK-H050
# mid_range = 0 mm
# receiver_rotation = 180 deg
inclination [deg],rotation [deg],reading [mm],reference [mm]
"""


@pytest.fixture(scope="module")
def readings() -> xr.Dataset:
    return simulation.raw_inclination(VirtualMachine("cframe", seed=3), depths=1e-3 * np.arange(-10, 11, 4), seed=1)


@pytest.fixture
def data(readings: xr.Dataset, tmp_path: Path) -> Path:
    return datasets.save(readings, tmp_path / "data.nc")


def test_readings_become_a_calibration_that_is_found_by_its_name(run, data, tmp_path):
    (tmp_path / "calibrations").mkdir()
    shown = run("calibrate", data, "-o", "calibrations/left.nc").stdout
    assert "calibrations/left.nc: calibration from 1482 readings at 247 settings" in shown
    assert "left out: 0 readings, 0 settings" in shown
    assert "note: Holes between the settings" in shown
    known = InclinationCalibration.find("left")
    assert known.supported([0.1, 0.0])
    assert "valid" in run("validate", "calibrations/left.nc").stdout


def test_figures_are_in_the_json_output(answer, data):
    said = answer("calibrate", data, "--out", "left.nc")
    low, high = said["remaining_error_um_interval"]
    # 0.1 um of noise over depths of +-10 mm
    assert 0.02 < low < said["remaining_error_um"] < high < 0.2
    assert said["depth_mm"] == pytest.approx(10, rel=1e-4)  # the reference has noise too
    assert said["noise_um"] == pytest.approx(0.1, rel=0.1)
    assert 50 < said["largest_error_um"] < 90
    assert abs(said["mid_range_found_mm"]) < 5 * said["mid_range_uncertainty_mm"]


def test_a_table_of_text_is_accepted(answer, data, readings, tmp_path):
    columns = (np.degrees(readings.inclination), np.degrees(readings.rotation), 1e3 * readings.reading)
    rows = zip(*columns, 1e3 * readings.reference, strict=True)
    lines = "".join(",".join(f"{float(cell):.6f}" for cell in row) + "\n" for row in rows)
    (tmp_path / "data.csv").write_text(HEAD + lines)
    from_text, said = answer("calibrate", "data.csv", "-o", "a.nc"), answer("calibrate", data, "-o", "b.nc")
    assert from_text["order"] == said["order"]
    # Text of 1 nm: a hundredth of the noise.
    assert from_text["remaining_error_um"] == pytest.approx(said["remaining_error_um"], rel=0.02)
    assert InclinationCalibration.load("a.nc").dataset.attrs["sensor"] == "LK-H050"


def test_settings_are_checked(run, answer, data):
    assert answer("calibrate", data, "-o", "a.nc", "--set", "order=4", "--set", "mirror=false")["order"] == 4
    found = run("calibrate", data, "-o", "b.nc", "--set", "ordre=4", code=1)
    assert "ordre" in found.stderr
    assert "order" in found.stderr


def test_nothing_is_overwritten(run, data, tmp_path):
    (tmp_path / "a.nc").write_text("mine")
    assert "already exists" in run("calibrate", data, "-o", "a.nc", code=1).stderr
    assert (tmp_path / "a.nc").read_text() == "mine"
    assert "expected a name that ends in .nc" in run("calibrate", data, "-o", "a.txt", code=1).stderr


def test_other_data_are_refused(run, record, tmp_path):
    datasets.save(record, tmp_path / "drift.nc")
    found = run("calibrate", "drift.nc", "-o", "a.nc", code=1)
    assert "expected schema errormotion.raw.inclination/1; found errormotion.raw.spindle_drift/1" in found.stderr
    assert not (tmp_path / "a.nc").exists()


def test_implausible_readings_leave_no_file(run, readings, tmp_path):
    datasets.save(readings.assign(reference=-readings["reference"]), tmp_path / "data.nc")
    found = run("calibrate", "data.nc", "-o", "a.nc", code=1)
    assert "Change the sign of the reference" in found.stderr
    assert not (tmp_path / "a.nc").exists()


def test_identify_states_the_command_for_such_readings(run, data):
    found = run("identify", data, "--out", "errors.nc", code=1)
    assert "errormotion calibrate" in found.stderr
    assert "Traceback" not in found.stderr
