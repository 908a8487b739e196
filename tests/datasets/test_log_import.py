"""Import of logs with a map for any raw schema."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.datasets.importing import import_log
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.reading import read_table
from errormotion.errors import DatasetError
from errormotion.methods.beam_direction import BeamDirection, simulation
from errormotion.twin import VirtualMachine

TRACKER = """schema = "errormotion.raw.multilateration/1"
machine = "C-frame 610"
labels = {station = "Setup", target = "Point"}
values.displacement_noise = {key = "Length noise", unit = "um"}
values.vacuum_wavelength = "633 nm"
[format]
decimal = ","
skip = 2
[columns]
displacement = {column = "Length", unit = "mm"}
air_temperature = {column = "T", unit = "degC"}
target_nominal.x = {column = "X", unit = "mm"}
target_nominal.y = {column = "Y", unit = "mm"}
target_nominal.z = {column = "Z", unit = "mm"}
station_nominal = {x = {column = "SX", unit = "m"}, y = {column = "SY", unit = "m"}, z = {column = "SZ", unit = "m"}}
"""
TRACKER_LOG = """Tracker software 3.1
Length noise: 0,5
Setup;Point;X;Y;Z;Length;T;SX;SY;SZ
S1;P1;0;0;0;1000,5;20,1;1;0;0,5
S1;P2;100;0;50;;20,1;1;0;0,5
S2;P1;0;0;0;900,25;20,2;0;1;0,5
S2;P2;100;0;50;880;20,2;0;1;0,5
"""
TOUCHES = """schema = "errormotion.raw.normal_vector/1"
variant = "touches"
labels = {time = "cycle", ball = "ball"}
values = {tip_radius = "3 mm", ball_radius = ["10 mm", "10 mm"]}
[columns]
time = {column = "t", unit = "min"}
touch = {x = {column = "X", unit = "mm"}, y = {column = "Y", unit = "mm"}, z = {column = "Z", unit = "mm"}}
"""
TOUCH_LOG = """cycle,t,ball,X,Y,Z
1,0,A,1,2,3
1,0,A,4,5,6
1,0,B,7,8,9
1,0,B,,,
2,10,A,1,2,3
2,10,A,4,5,6
2,10,B,7,8,9
2,10,B,10,11,12
"""


@pytest.fixture
def run(tmp_path: Path):
    def run(log: str, mapping: str) -> xr.Dataset:
        (tmp_path / "log.csv").write_text(log)
        (tmp_path / "map.toml").write_text(mapping)
        return import_log(tmp_path / "log.csv", tmp_path / "map.toml", tmp_path / "raw.nc")

    return run


@pytest.fixture
def mistakes(run, tmp_path: Path):
    def mistakes(log: str, mapping: str) -> str:
        with pytest.raises(DatasetError) as caught:
            run(log, mapping)
        assert not (tmp_path / "raw.nc").exists()
        return str(caught.value)

    return mistakes


def test_lengths_of_a_tracker_in_si(run) -> None:
    raw = run(TRACKER_LOG, TRACKER)
    assert datasets.violations(raw) == []
    np.testing.assert_array_equal(raw["displacement"], [[1.0005, np.nan], [0.90025, 0.88]])
    np.testing.assert_array_equal(raw["target_nominal"], [[0, 0, 0], [0.1, 0, 0.05]])
    np.testing.assert_array_equal(raw["station_nominal"].sel(station="S2"), [0, 1, 0.5])
    np.testing.assert_array_equal(raw["air_temperature"].sel(station="S1"), [20.1, 20.1])
    assert list(raw["target"].values) == ["P1", "P2"]
    assert float(raw["displacement_noise"]) == pytest.approx(0.5e-6, rel=1e-15)
    assert float(raw["vacuum_wavelength"]) == pytest.approx(633e-9, rel=1e-15)
    assert raw.attrs["machine"] == "C-frame 610"
    assert raw.attrs["log"] == "log.csv"
    assert json.loads(raw.attrs["missing_values"]) == {"displacement": 1}


def test_touches_of_balls_are_numbered_within_a_cycle(run) -> None:
    raw = run(TOUCH_LOG, TOUCHES)
    assert datasets.violations(raw) == []
    assert raw["touch"].dims == ("time", "ball", "touch", "direction")
    np.testing.assert_array_equal(raw["time"], [0, 600])
    np.testing.assert_allclose(raw["touch"][0, 1], [[7e-3, 8e-3, 9e-3], [np.nan] * 3], rtol=1e-15)
    np.testing.assert_allclose(raw["touch"][1, 1, 1], [10e-3, 11e-3, 12e-3], rtol=1e-15)
    np.testing.assert_array_equal(raw["ball_radius"], [0.01, 0.01])


def test_an_imported_log_has_the_errors_of_the_raw_dataset(run) -> None:
    raw = simulation.raw(VirtualMachine("cframe", seed=3), seed=1, inclination_error=False)
    lines = ["face,d,x,y,z"]
    for i, plane in enumerate(raw["stage"].values):
        for at, d in zip(plane.tolist(), raw["distance"].values[i].tolist(), strict=True):
            lines.append(",".join([str(i), repr(1.0 - d), *map(repr, at)]))
    mapping = f"""schema = "errormotion.raw.beam_direction/1"
labels.plane = "face"
attributes = {{frame = "machine"}}
[columns]
distance = {{column = "d", unit = "m", scale = -1, offset = "1000 mm"}}
stage = {{x = {{column = "x", unit = "m"}}, y = {{column = "y", unit = "m"}}, z = {{column = 5, unit = "m"}}}}
[values]
nominal_direction = {raw["nominal_direction"].values.tolist()}
nominal_origin = {{value = {raw["nominal_origin"].values.tolist()}, unit = "m"}}
distance_noise = "0.1 um"
plane_point = {{value = {raw["plane_point"].values.tolist()}, unit = "m"}}
plane_point_uncertainty = "2 um"
"""
    found, expected = (BeamDirection().identify(each) for each in (run("\n".join(lines) + "\n", mapping), raw))
    # 1 - (1 - d) keeps 1e-16 m of the reading: 1e-15 rad over 20 mm and more
    np.testing.assert_allclose(found.em.twist(), expected.em.twist(), atol=1e-12)


def test_dates_and_free_labels(run) -> None:
    mapping = """schema = "errormotion.raw.normal_vector/1"
labels = {time = "t", ball = "ball"}
[columns]
time = {column = "t", unit = "iso8601"}
centre = {x = {column = "X", unit = "m"}, y = {column = "Y", unit = "m"}, z = {column = "Z", unit = "m"}}
temperature.spindle = {column = "T1", unit = "degC"}
temperature.ambient = {column = "T2", unit = "degC"}
"""
    log = "t,ball,X,Y,Z,T1,T2\n"
    log += "".join(
        f"2024-05-31T14:{minute:02}:00,{ball},0.1,0.2,{0.3 + ball},{20 + minute},19\n"
        for minute in (0, 10)
        for ball in (0, 1, 2)
    )
    raw = run(log, mapping)
    assert raw.attrs["start"] == "2024-05-31T14:00:00"
    np.testing.assert_array_equal(raw["time"], [0, 600])
    np.testing.assert_array_equal(raw["temperature"].sel(sensor="spindle"), [20, 30])
    assert raw["centre"].shape == (2, 3, 3)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("displacement =", "displacment =", "columns.displacment: unknown variable; did you mean 'displacement'?"),
        ("target_nominal.x", "target_nominal.u", "columns.target_nominal.u: expected columns.target_nominal.x"),
        ('"Length", unit = "mm"', '"Length", unit = "deg"', "columns.displacement.unit: expected a unit of the kind"),
        ('"Length", unit = "mm"', '"Length"', "columns.displacement.unit: expected a unit, such as m; found none"),
        ('"Length", unit = "mm"', '"Length", unit = "mm", offset = "3"', "columns.displacement.offset: expected a num"),
        ('target = "Point"', 'targets = "Point"', "labels.targets: unknown dimension; did you mean 'target'?"),
        ('key = "Length noise"', 'key = "Noise"', "values.displacement_noise: no line with 'Noise'"),
        ('"633 nm"', "633", "values.vacuum_wavelength: expected a unit, such as m; found none"),
        ('"633 nm"', '["633 nm", "5 nm"]', "values.vacuum_wavelength: expected one number; found"),
        (
            '"633 nm"',
            '"633 mm"',
            "values.vacuum_wavelength: makes vacuum_wavelength = 0.633 m; expected 3e-07..1.7e-06",
        ),
        ("values.vacuum_wavelength", "values.wavelength", "values.wavelength: unknown variable"),
        ('"633 nm"', '{unit = "nm"}', "values.vacuum_wavelength: expected either a value, or the key"),
        ('"Length", unit', '"Lenght", unit', "no column 'Lenght'; did you mean 'Length'?"),
        ('unit = "mm"}', 'units = "mm"}', "columns.displacement.units: unknown key; did you mean 'unit'?"),
    ],
)
def test_mistakes_of_a_map_name_their_key(mistakes, old: str, new: str, expected: str) -> None:
    assert old in TRACKER
    assert expected in mistakes(TRACKER_LOG, TRACKER.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "S2;P2;100;",
            "S2;P2;101;",
            "line 7: column 'X': expected 100 as in line 5, which has the same labels; found 101",
        ),
        ("1000,5", "one", "line 4: column 'Length': expected a number; found 'one'"),
        ("S2;P2;", "S2;P1;", "duplicate; first given in line 6"),
        ("900,25", "900000,25", "line 6: column 'Length': makes displacement = 900 m"),
        ("S2;P2;100;0;50;880", "S2;P2;100;0", "line 7: expected 10 fields; found 8"),
        ("noise: 0,5", "noise: 0,-inf", "values.displacement_noise, 'Length noise' in log.csv: expected one number"),
    ],
)
def test_mistakes_of_a_log_name_their_line(mistakes, old: str, new: str, expected: str) -> None:
    assert old in TRACKER_LOG
    assert expected in mistakes(TRACKER_LOG.replace(old, new, 1), TRACKER)


@pytest.mark.parametrize("schema", ["", 'schema = "errormotion.raw.unknown/1"'])
def test_a_map_without_a_known_schema_is_refused(mistakes, schema: str) -> None:
    found = mistakes(TRACKER_LOG, schema)
    assert "map.toml: schema: expected a raw schema or the schema of a map; found" in found
    assert "errormotion.map/1" in found


def test_a_plugin_reads_its_own_maps(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = run(TOUCH_LOG, TOUCHES)
    readers = {"lab.map/1": lambda log, mapping: raw.assign_attrs(machine=f"{log.name} {mapping.name}")}
    monkeypatch.setattr(BeamDirection, "log_readers", readers, raising=False)
    (tmp_path / "own.toml").write_text('schema = "lab.map/1"')
    found = import_log(tmp_path / "log.csv", tmp_path / "own.toml", tmp_path / "own.nc")
    assert found.attrs["machine"] == "log.csv own.toml"
    assert (tmp_path / "own.nc").exists()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_line_without_end_is_refused_before_it_is_in_memory(tmp_path: Path, encoding: str) -> None:
    log = tmp_path / "log.csv"
    with log.open("wb") as file:
        file.write("a,b\n1,2\n".encode(encoding))
        file.truncate(1 << 40)  # a sparse file, which fits into no memory
    with pytest.raises(DatasetError, match=r"log\.csv, line 3: expected at most \d+ characters"):
        read_table(log, Format(encoding=encoding, skip=3))


@pytest.mark.parametrize(
    ("name", "times", "start", "missing"),
    [
        ("dat00001", [0, 1], "2009-01-26T08:07:12.237000", 0),  # milliseconds after a colon
        ("datestr", [0, 1], "2024-05-31T14:05:09", 0),  # a month with its name
        ("hms", [0, 1], "", 0),  # hh:mm:ss where the map states seconds
        ("m9999b", [0, 1], "", 1),  # -9999 stated, -9999.0 in the log
        ("mu1", [0, 60], "", 0),  # two micro signs
        ("nbsp", [0, 60], "", 0),  # no-break space in names
        ("pico", [0, 1], "", 0),  # units below the names
        ("same1s", [0, 0.5], "2018-04-22T17:20:59", 0),  # several rows in a second
        ("serial", [0, 1], "2024-05-31T14:05:09", 0),  # days of a spreadsheet
        ("u16nobom", [0, 1], "", 0),  # UTF-16 without a mark
    ],
)
def test_logs_of_real_devices(tmp_path: Path, name: str, times: list[float], start: str, missing: int) -> None:
    folder = Path(__file__).parents[1] / "data" / "tables"
    raw = import_log(folder / f"{name}.csv", folder / f"{name}.toml", tmp_path / "raw.nc")
    np.testing.assert_allclose(raw["time"][:2], times, atol=1e-4)
    assert raw.attrs.get("start", "") == start
    assert sum(json.loads(raw.attrs["missing_values"]).values()) == missing
    assert float(raw["distance"].sel(channel="X1")[0]) == pytest.approx(1e-3, rel=1e-12)
