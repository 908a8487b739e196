import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.datasets.importing import import_log
from errormotion.errors import DatasetError

PLACES = {
    "X1": ("6 mm", "0 mm", "10 mm", [-1, 0, 0]),
    "X2": ("6 mm", "0 mm", "50 mm", [-1, 0, 0]),
    "Y1": ("0 mm", "6 mm", "10 mm", [0, -1, 0]),
    "Y2": ("0 mm", "6 mm", "50 mm", [0, -1, 0]),
    "Z": ("0 mm", "0 mm", "-1 mm", [0, 0, 1]),
}
HEAD = """schema = "errormotion.map/1"
machine = "C-frame"
bar_radius = "5 mm"
distance_noise = "0.3 um"
levels = ["10 mm", "50 mm"]
time = {column = "t", unit = "min"}
temperatures.frame = {column = "T", unit = "degC"}
"""
GOOD = "t,X1,X2,Y1,Y2,Z,T\n0,1.1,1.2,1.3,1.4,1.5,20.5\n0.5,1.1,1.2,1.3,1.4,1.6,20.5\n"


def map_text(head: str = HEAD, channel: str = "", **columns: object) -> str:
    text = head
    for name, (x, y, z, direction) in PLACES.items():
        column = json.dumps(columns.get(name, name))
        text += f'[channels.{name}]\ncolumn = {column}\nunit = "mm"\norigin = ["{x}", "{y}", "{z}"]\n'
        text += f"direction = {direction}\n{channel}\n"
    return text


@pytest.fixture
def run(tmp_path: Path):
    def run(log: str | bytes, mapping: str = "", name: str = "log.csv", out: str = "raw.nc") -> xr.Dataset:
        (tmp_path / name).write_bytes(log if isinstance(log, bytes) else log.encode())
        (tmp_path / "map.toml").write_text(mapping or map_text())
        return import_log(tmp_path / name, tmp_path / "map.toml", tmp_path / out)

    return run


@pytest.fixture
def complaints(run, tmp_path: Path):
    def complaints(*arguments: str | bytes) -> list[str]:
        with pytest.raises(DatasetError) as caught:
            run(*arguments)
        assert not (tmp_path / "raw.nc").exists()
        return caught.value.violations or [str(caught.value).removeprefix(f"{tmp_path}/")]

    return complaints


def test_beams_without_stated_uncertainty_are_those_of_a_frame_not_calibrated(run) -> None:
    raw = run(GOOD, map_text())
    variance = np.diagonal(raw["beam_covariance"], axis1=1, axis2=2)
    np.testing.assert_allclose(variance[:, :3], 1e-4**2)
    np.testing.assert_allclose(np.sort(variance[:, 3:], axis=1)[:, 1:], 5e-3**2, rtol=0.05)
    assert "The map states no uncertainty of the beams: 0.1 mm and 5 mrad are assumed" in raw.attrs["import_notes"]


@pytest.mark.parametrize("out", ["raw.nc", "raw.zarr"])
def test_columns_become_a_raw_dataset_in_si(run, tmp_path, out) -> None:
    raw = run(GOOD, out=out)
    assert datasets.violations(raw) == []
    np.testing.assert_array_equal(raw["time"], [0, 30])
    np.testing.assert_allclose(raw["distance"].sel(channel="Z"), [1.5e-3, 1.6e-3], rtol=1e-15)
    np.testing.assert_array_equal(raw["temperature"].sel(sensor="frame"), [20.5, 20.5])
    np.testing.assert_array_equal(raw["beam_origin"].sel(channel="X2"), [0.006, 0, 0.05])
    assert raw.attrs["machine"] == "C-frame"
    assert json.loads(raw.attrs["missing_values"]) == {}
    with datasets.load(tmp_path / out) as stored:
        xr.testing.assert_identical(stored, raw)


def test_scale_and_offset_turn_a_reading_into_a_distance(run) -> None:
    raw = run(GOOD, map_text(channel='scale = -1\noffset = "2 mm"'))
    np.testing.assert_allclose(raw["distance"].isel(time=0), np.array([0.9, 0.8, 0.7, 0.6, 0.5]) * 1e-3, rtol=1e-12)


def test_speed_dates_and_stated_beam_uncertainty_are_imported(run) -> None:
    head = HEAD.replace('{column = "t", unit = "min"}', '{column = "t", unit = "iso8601"}')
    mapping = map_text(head, 'origin_uncertainty = "10 um"\ndirection_uncertainty = "1 mrad"')
    mapping += '[spindle_speed]\ncolumn = "S"\nunit = "rpm"\n'
    log = "t,X1,X2,Y1,Y2,Z,T,S\n2024-05-31T14:05:09.5,1,1,1,1,1,20,15000\n2024-05-31T14:05:10.25,1,1,1,1,1,20,15000\n"
    raw = run(log, mapping)
    np.testing.assert_allclose(raw["time"], [0, 0.75], rtol=1e-15)
    assert raw.attrs["start"] == "2024-05-31T14:05:09.500000"
    np.testing.assert_array_equal(raw["spindle_speed"], 15000)
    # in the direction only across the beam: along it nothing turns
    np.testing.assert_allclose(np.diag(raw["beam_covariance"][0]), [1e-10] * 3 + [0, 1e-6, 1e-6], rtol=1e-12)


@pytest.mark.parametrize(
    ("log", "form"),
    [
        (GOOD.replace(",", "\t"), ""),
        (GOOD.replace(",", ";"), ""),
        (GOOD.replace(",", ";").replace(".", ","), 'decimal = ","'),
        (GOOD.replace(",", "\t").replace(".", ","), 'decimal = ","'),
        (GOOD.replace(",", "   "), 'delimiter = " "'),
        (GOOD.replace("\n", "\r\n"), ""),
        ("\ufeff" + GOOD, ""),
        (GOOD.encode("utf-16"), 'encoding = "utf-16"'),
        (GOOD.replace("T\n", "T,°\n").replace("20.5\n", "20.5,µ\n").encode("cp1252"), 'encoding = "cp1252"'),
        ("# by hand\n\n" + GOOD.replace("0.5,", "# a pause\n0.5,"), ""),
        ("Software 3.1\nNo 7\n" + GOOD, "skip = 2"),
        (GOOD.replace("T\n", "T,note\n").replace("20.5\n", '20.5,"a, b"\n'), ""),
        (GOOD.replace("t,X1", '"t",  X1'), ""),
    ],
)
def test_the_ways_to_write_a_table_give_the_same_numbers(run, log, form) -> None:
    head = HEAD + f"[format]\n{form}\n"
    raw = run(log, map_text(head))
    np.testing.assert_allclose(raw["distance"].isel(time=1), np.array([1.1, 1.2, 1.3, 1.4, 1.6]) * 1e-3, rtol=1e-15)
    np.testing.assert_array_equal(raw["temperature"], [[20.5], [20.5]])


def test_a_log_without_header_is_mapped_by_number(run) -> None:
    head = HEAD.replace('"t"', "1").replace('"T"', "7") + "[format]\nheader = false\n"
    raw = run(GOOD.partition("\n")[2], map_text(head, X1=2, X2=3, Y1=4, Y2=5, Z=6))
    np.testing.assert_allclose(raw["distance"].sel(channel="Z"), [1.5e-3, 1.6e-3], rtol=1e-15)


def test_empty_cells_are_nan_and_counted(run) -> None:
    raw = run(GOOD + "1,,1.2,1.3,,1.5,NaN\n1.5,1.1,1.2, ,1.4,1.5,20\n")
    assert json.loads(raw.attrs["missing_values"]) == {
        "channels.X1": 1,
        "channels.Y1": 1,
        "channels.Y2": 1,
        "temperatures.frame": 1,
    }
    assert int(np.isnan(raw["distance"]).sum()) == 3


def test_every_mistake_is_reported_with_its_line(complaints) -> None:
    log = (
        GOOD
        + "0.5,1,1,1,1,1,20\n# a comment\n\n1,1,1,1,one,1,20\n"
        + "2,1,1,1,1,1\n,1,1,1,1,1,20\n3,1,1x,1,1,1,293\n4,1,1,1,1,1e3,20\n"
    )
    assert complaints(log) == [
        "line 4: time: expected more than 0.5 of line 3; found 0.5",
        "line 7: channels.Y2, field 5: expected a number; found 'one'",
        "line 8: expected 7 fields; found 6",
        "line 9: time, field 1: expected a number; found an empty cell",
        "line 10: channels.X2, field 3: expected a number; found '1x'",
        "line 10: temperatures.frame: 293 is a temperature of 293 degC; expected -60..200 degC. "
        "Is the unit 'degC' right? (1 such values)",
        "line 11: channels.Z: 1000 is a distance of 1 m; expected -0.1..0.1 m. Is the unit 'mm' right? (1 such values)",
    ]


def test_missing_and_doubled_columns_are_reported_with_the_nearest(complaints) -> None:
    assert complaints("# c\nt,X1,X2,Y1,Y-2,Z,Z\n0,1,1,1,1,1,1\n") == [
        "line 2: channels.Y2: no column 'Y2'; did you mean 'Y-2'? Known here: X1, X2, Y-2, Y1, Z, t",
        "line 2: channels.Z: column 'Z' occurs 2 times; give its number instead",
        "line 2: temperatures.frame: no column 'T'; did you mean 't'? Known here: X1, X2, Y-2, Y1, Z, t",
    ]


def test_a_decimal_comma_is_recognised(run) -> None:
    raw = run("t;X1;X2;Y1;Y2;Z;T\n0;1,5;1;1;1;1;20\n1;1,5;1;1;1;1;20\n")
    np.testing.assert_allclose(raw["distance"].sel(channel="X1"), 1.5e-3, rtol=1e-15)


@pytest.mark.parametrize(
    ("log", "message"),
    [
        (
            b"t,X1,X2,Y1,Y2,Z,T\n0,1,1,1,1,1,20\n1,1,1,1,1,1,20 \xb0C\n",
            "line 3: temperatures.frame, field 7: expected a number; found '20 \u00b0C'",
        ),
        ('t,X1,X2,Y1,Y2,Z,T\n0,"1,1,1,1,1,20\n', "log.csv, line 2: cannot be split into fields"),
        ("", "log.csv: expected lines of numbers; the file is empty"),
        ("# only a comment\n", "log.csv: expected lines of numbers; found none"),
        ("t,X1,X2,Y1,Y2,Z,T\n", "line 1: t,X1,X2,Y1,Y2,Z,T"),
    ],
)
def test_a_text_that_is_no_table_is_reported(complaints, log, message) -> None:
    assert complaints(log)[0].startswith(message)


def test_many_mistakes_are_counted_and_the_first_are_reported(complaints) -> None:
    (found,) = complaints(GOOD + "".join(f"{k},a,1,1,1,1,20\n" for k in range(1, 101)))
    assert found == "lines 4, 5, 6, 7, 8 and 95 more: channels.X1, field 2: expected a number; found 'a'"
    found = complaints(GOOD + "".join(f"{k},1,1,1,1,1,20{',1' * k}\n" for k in range(1, 101)), map_text(HEAD))
    assert found == ["lines 4, 5, 6, 7, 8 and 95 more: expected 7 fields; found 8 in line 4"]


def test_invalid_dates_are_reported(complaints) -> None:
    head = HEAD.replace('unit = "min"', 'unit = "iso8601"')
    (found,) = complaints("t,X1,X2,Y1,Y2,Z,T\n14:05,1,1,1,1,1,20\n", map_text(head))
    assert found.startswith(
        "line 2: time, field 1: expected a date and time such as 2024-05-31T14:05:09.5; found '14:05'"
    )


def test_mistakes_of_the_map_are_reported_by_key(complaints) -> None:
    mapping = map_text(HEAD.replace('"5 mm"', "5").replace('"min"', '"mm"')).replace("[channels.Y2]", "[channels.y2]")
    mapping = mapping.replace("[0, 0, 1]", "[0, 0, 2]")
    (found,) = complaints(GOOD, mapping)
    for part in (
        "map.toml: 5 mistakes",
        "bar_radius: expected a length with its unit, such as '5 mm'; found 5",
        "time.unit: expected a unit of time, or 'iso8601' for dates: 'mm' is not convertible to 's'",
        "channels.Y2: missing; expected a table",
        "channels.y2: unknown key; did you mean 'Y2'?",
        "channels.Z: direction: expected a vector of length 1; found (0.0, 0.0, 2.0) of length 2",
    ):
        assert part in found


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ('[format]\nthousands = ","\ndecimal = ","\n', "thousands: ',' is the decimal sign or the delimiter"),
        ('[format]\nencoding = "utf8-ish"\n', "format.encoding: expected an encoding such as 'utf-8'"),
    ],
)
def test_invalid_format_is_reported(complaints, extra, message) -> None:
    assert message in complaints(GOOD, map_text(HEAD + extra))[0]


def test_beam_uncertainties_are_given_for_all_or_none(complaints) -> None:
    mapping = map_text() + 'origin_uncertainty = "10 um"\ndirection_uncertainty = "1 mrad"\n'
    assert "missing for X1 X2 Y1 Y2" in complaints(GOOD, mapping)[0]
    assert "together, or neither" in complaints(GOOD, map_text() + 'origin_uncertainty = "10 um"\n')[0]


def test_a_missing_log_is_reported(tmp_path) -> None:
    (tmp_path / "map.toml").write_text(map_text())
    with pytest.raises(DatasetError, match=r"none\.csv: cannot be read: No such file"):
        import_log(tmp_path / "none.csv", tmp_path / "map.toml", tmp_path / "raw.nc")


def test_a_hole_in_the_rows_is_noted_in_seconds(run) -> None:
    log = GOOD[: GOOD.index("\n") + 1] + "".join(f"{t},1.1,1.2,1.3,1.4,1.5,20.5\n" for t in (0, 0.5, 1, 1.5, 2, 4.5))
    note, _beams = json.loads(run(log).attrs["import_notes"])
    assert note == "1 hole in the rows, where the usual interval is 30 s; the longest, of 150 s, ends in line 7"
