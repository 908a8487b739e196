"""``errormotion identify`` reads text, and selects the method by the schema."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets

Run = Callable[..., Any]


def drift_as_text(record: xr.Dataset) -> str:
    """Write a record of the five-sensor frame in customary units, one line per time."""
    head = [
        "# schema = errormotion.raw.spindle_drift/1",
        f"# bar_radius = {1e3 * float(record['bar_radius'])!r} mm",
        f"# distance_noise = {1e6 * float(record['distance_noise'])!r} um",
        f"# level = {' '.join(repr(1e3 * float(z)) for z in record['level'])} mm",
    ]
    columns = [*(f"beam_origin_{axis} [m]" for axis in "xyz"), *(f"beam_direction_{axis} [1]" for axis in "xyz")]
    beams = [f"channel,{','.join(columns)}"]
    for channel in record["channel"].values:
        one = record.sel(channel=channel)
        beams.append(f"{channel}," + ",".join(repr(float(x)) for x in (*one["beam_origin"], *one["beam_direction"])))
    lines = ["time [s]," + ",".join(f"distance_{channel} [um]" for channel in record["channel"].values)]
    for t, distances in zip(record["time"].values, record["distance"].transpose("time", "channel").values, strict=True):
        lines.append(",".join(repr(float(number)) for number in (t, *(1e6 * distances))))
    return "\n".join([*head, *lines, "", *beams]) + "\n"


def test_text_and_netcdf_with_equal_numbers_have_equal_errors(run: Run, record: xr.Dataset, tmp_path: Path) -> None:
    names = ["distance", "beam_origin", "beam_direction", "bar_radius", "distance_noise", "level"]
    same = record[names].drop_vars(["spindle_speed", "temperature", "sensor"], errors="ignore")
    datasets.save(same, tmp_path / "drift.nc")
    (tmp_path / "drift.csv").write_text(drift_as_text(record))
    run("validate", "drift.csv")
    run("identify", "drift.nc", "--method", "spindle_drift", "--out", "a.nc", "--set", "average=2 s")
    run("identify", "drift.csv", "--out", "b.nc", "--set", "average=2 s")
    a, b = (datasets.load(tmp_path / name) for name in ("a.nc", "b.nc"))
    # Written in um to the last digit: differences are rounding, 1e-16 of places of some 10 mm.
    np.testing.assert_allclose(b["EY"], a["EY"], rtol=0, atol=1e-13)
    assert b.attrs["method"] == "spindle_drift"


def test_an_error_in_the_text_is_reported_with_its_position(run: Run, tmp_path: Path) -> None:
    text = "# schema = errormotion.raw.inclination/1\nreading [mm],reference [mm],inclination,rotation [deg]\n1,1,0,0\n"
    (tmp_path / "readings.csv").write_text(text)
    reported = run("identify", "readings.csv", "--method", "spindle_drift", "--out", "errors.nc", code=1).stderr
    assert "line 2: column 3 'inclination': expected its unit in brackets, such as 'inclination [rad]'" in reported
    assert not (tmp_path / "errors.nc").exists()


def test_errors_do_not_state_a_method_for_identification(run: Run, raw: Path) -> None:
    run("identify", raw, "--method", "spindle_drift", "--out", "errors.nc")
    reported = run("identify", "errors.nc", "--out", "again.nc", code=1).stderr
    assert "expected a raw dataset of a method; found schema errormotion.errors/1" in reported


def test_method_of_a_folder_of_runs_has_to_be_named(run: Run, tmp_path: Path) -> None:
    (tmp_path / "runs" / "one").mkdir(parents=True)
    (tmp_path / "runs" / "one" / "run.json").write_text("{}")
    reported = run("identify", "runs", "--out", "errors", code=1).stderr
    assert "is a folder of runs; name the method with --method" in reported


@pytest.mark.parametrize(
    ("name", "radius", "left_out"),
    [("scheme1", 25.0009, 0), ("scheme2_0deg_compensated", 24.9608, 1), ("scheme3", 25.0018, 0)],
)
def test_a_check_bar_alone_is_fitted_without_beams(run: Run, name: str, radius: float, left_out: int) -> None:
    published = Path(__file__).parents[2] / "examples" / "check_bar" / f"{name}.csv"
    run("validate", published)
    reported = run("identify", published, "--out", "errors.nc").stdout
    line = next(line for line in reported.splitlines() if line.startswith("radius of the check bar"))
    value, unit = line.split()[-3], line.split()[-1]
    digits = len(value.partition(".")[2])
    assert (float(value), unit) == (pytest.approx(radius, abs=0.51 * 10 ** -min(digits, 4)), "mm")
    assert "the stated beam is used, without uncertainty; its errors are unknown" in reported
    errors = datasets.load("errors.nc")
    assert datasets.violations(errors) == []
    assert np.isnan(errors.em.twist()).all()
    assert int(errors["bar_left_out"].sum()) == left_out
    assert "valid" in run("validate", "errors.nc").stdout
    assert "Check bar" in Path(run("report", "errors.nc").stdout.strip()).read_text()
