"""Readings as CSV: correct files are read in SI, mistakes are reported with line and column."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from errormotion import datasets
from errormotion.datasets.text.readings_csv import read_csv
from errormotion.errors import DatasetError

HEAD = """# schema = errormotion.raw.beam_direction/1
# machine = C-frame 610
# a remark of any kind
# nominal_direction = 0.342 0 0.940
# distance_noise = 0.1 um
"""
TABLE = """plane,reading [mm],x [mm],y [mm],z [mm]
1,-2.004,100.000,50.000,20.000
1,-1.508,101.000,50.000,20.000
2,0.25,101.000,50.000,20.000
2,,101.000,50.000,21.000
2,0.5,101.000,51.000,21.000
"""
INCLINATION = """# schema = errormotion.raw.inclination/1
# reading_noise = 0.1 um
reading [mm],reference [mm],inclination [deg],rotation [deg]
-5.001,-5.000,-30,0
5.002,5.000,30,90
"""


@pytest.fixture
def read(tmp_path: Path):
    def read(text: str | bytes) -> xr.Dataset:
        path = tmp_path / "readings.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_csv(path)

    return read


@pytest.fixture
def complaints(read, tmp_path: Path):
    def complaints(text: str | bytes) -> str:
        with pytest.raises(DatasetError) as caught:
            read(text)
        message = str(caught.value)
        assert str(tmp_path / "readings.csv") in message
        return message

    return complaints


def test_planes_of_a_beam_in_si(read) -> None:
    raw = read(HEAD + TABLE)
    assert raw.attrs["schema"] == "errormotion.raw.beam_direction/1"
    assert raw.attrs["machine"] == "C-frame 610"
    assert raw["distance"].dims == ("plane", "reading")
    assert raw["stage"].dims == ("plane", "reading", "direction")
    np.testing.assert_array_equal(raw["distance"], [[-2.004e-3, -1.508e-3, np.nan], [0.25e-3, np.nan, 0.5e-3]])
    np.testing.assert_allclose(raw["stage"][1, 2], [0.101, 0.051, 0.021])
    assert float(raw["distance_noise"]) == pytest.approx(1e-7)
    assert list(raw["plane"].values) == [1, 2]
    assert datasets.violations(raw) == []


def test_empty_cells_are_counted_except_after_the_end_of_a_short_plane(read) -> None:
    assert json.loads(read(HEAD + TABLE).attrs["missing_values"]) == {"distance": 1}


def test_direction_with_few_digits_is_normalised(read) -> None:
    assert np.linalg.norm(read(HEAD + TABLE)["nominal_direction"]) == pytest.approx(1, abs=1e-12)


def test_second_table_uses_the_names_of_the_first(read) -> None:
    normals = "\nplane,nominal_normal_x [1],nominal_normal_y [1],nominal_normal_z [1]\n2,0,0,1\n1,0,1,0\n"
    np.testing.assert_array_equal(read(HEAD + TABLE + normals)["nominal_normal"], [[0, 1, 0], [0, 0, 1]])


def test_planes_may_have_names_and_their_lines_may_alternate(read) -> None:
    head, *lines = TABLE.splitlines()
    mixed = [lines[2], lines[0], lines[3], lines[1], lines[4]]
    text = "\n".join([head, *mixed]).replace("\n1,", "\nsteep,").replace("\n2,", "\nflat,")
    raw = read(HEAD + text)
    assert list(raw["plane"].values) == ["flat", "steep"]
    np.testing.assert_array_equal(raw["distance"][1], [-2.004e-3, -1.508e-3, np.nan])


def test_check_bar_in_a_separate_table(read) -> None:
    bar = "\nbar_distance [um],bar_stage_x [mm],bar_stage_y [mm],bar_stage_z [mm]\n5,1,2,3\n6,1,2,4\n"
    raw = read(HEAD + "# bar_radius = 25 mm\n# bar_axis = 0 0 1\n" + TABLE + bar)
    np.testing.assert_allclose(raw["bar_distance"], [5e-6, 6e-6])
    assert float(raw["bar_radius"]) == 0.025


def test_inclination_readings(read) -> None:
    raw = read(INCLINATION)
    np.testing.assert_allclose(raw["inclination"], np.radians([-30, 30]))
    assert raw["reading"].dims == ("group",)
    assert float(raw["reading_noise"]) == pytest.approx(1e-7)


@pytest.mark.parametrize("sign", [";", "\t"])
def test_other_separators(read, sign: str) -> None:
    assert read(HEAD + TABLE.replace(",", sign)).equals(read(HEAD + TABLE))


def test_a_file_saved_by_a_spreadsheet_is_read(read) -> None:
    lines = (HEAD + TABLE).splitlines()
    padded = "\r\n".join(line if "," in line else line + ",,,," for line in lines) + "\r\n,,,,\r\n"
    assert read(b"\xef\xbb\xbf" + padded.encode()).equals(read(HEAD + TABLE))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "latin-1"])
def test_other_encodings_and_decimal_commas_are_read(read, tmp_path: Path, encoding: str) -> None:
    """As a German spreadsheet saves a file of this form; the values of the header keep their points."""
    expected = read(HEAD + TABLE)
    path = tmp_path / "german.csv"
    path.write_bytes((HEAD + "# 3 \xb5m\n" + TABLE.replace(",", ";").replace(".", ",")).encode(encoding))
    found = datasets.load(path)
    assert found.equals(expected)


def test_a_comma_of_two_meanings_is_refused(complaints) -> None:
    table = "reading [mm];reference [mm];inclination [deg];rotation [deg]\n1,250;1,250;1;1\n"
    message = complaints(INCLINATION.partition("reading [mm]")[0] + table)
    assert "the comma in '1,250' may be the decimal sign or separate thousands" in message


def test_load_reads_csv_files(tmp_path: Path) -> None:
    path = tmp_path / "A.CSV"
    path.write_text(HEAD + TABLE)
    raw = datasets.load(path)
    assert raw.equals(read_csv(path))
    assert datasets.load(datasets.save(raw, tmp_path / "a.nc")).equals(raw)


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=20))
def test_numbers_are_unchanged_by_storage(tmp_path_factory: pytest.TempPathFactory, values: list[float]) -> None:
    path = tmp_path_factory.mktemp("csv") / "readings.csv"
    lines = [f"1,{value * 1e-3!r},0,0,0" for value in values]
    path.write_text(HEAD + TABLE.splitlines()[0].replace("mm", "m") + "\n" + "\n".join(lines))
    np.testing.assert_array_equal(read_csv(path)["distance"][0], [value * 1e-3 for value in values])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("x [mm]", "q [mm]", "line 6: column 3 'q [mm]': unknown column; "),
        ("x [mm]", "stage_xx [mm]", "did you mean 'stage_x'?"),
        ("x [mm]", "x", "line 6: column 3 'x': expected its unit in brackets, such as 'x [m]'; found none"),
        ("reading [mm]", "reading", "column 2 'reading': expected its unit in brackets"),
        ("x [mm]", "x []", "expected its unit in brackets, such as 'x [m]'; found none"),
        ("x [mm]", "x (mm)", "column 3 'x (mm)': expected a name and its unit in brackets"),
        ("x [mm]", "x [deg]", "column 'x [deg]': expected a unit of the kind of m; found 'deg'"),
        ("x [mm]", "x [parsnip]", "found 'parsnip'"),
        ("x [mm]", "y [mm]", "column 4 'y [mm]': duplicate of column 3 'y [mm]'"),
        ("x [mm]", "stage_z [mm]", "column 5 'z [mm]': duplicate of column 3 'stage_z [mm]'"),
        ("z [mm]", "bar_distance [mm]", "stage: expected all its components; missing stage_z"),
        ("plane,", "group,", "line 6: column 1 'group': unknown column"),
        (
            "x [mm]",
            "x [m]",
            "line 7: column 'x [m]': makes stage = 100 m; expected -20..20 m. Is the unit 'm' right?",
        ),
        ("-1.508", "-1,508", "line 8: expected 5 fields; found 6 (the decimal sign is a point)"),
        ("-1.508", "broken", "line 8: column 'reading [mm]': expected a number; found 'broken'"),
        ("-1.508", "1_000", "expected a number; found '1_000'"),
        ("-1.508", "inf", "expected a number; found 'inf'"),
        ("-1.508", "1e999", "expected a number; found '1e999'"),
        ("-1.508,", "", "line 8: expected 5 fields; found 4"),
        (",101.000,51", ",,51", "line 11: column 'x [mm]': expected a number; found nothing"),
        ("1,-1.508", ",-1.508", "line 8: column 'plane': expected a number or name; found nothing"),
        ("0.1 um", "0.1", "line 5: distance_noise: expected a unit, such as m; found none"),
        (
            "0.1 um",
            "0,1 um",
            "line 5: distance_noise: expected one number and a unit such as m; found '0,1 um' (the dec",
        ),
        ("0.1 um", "0.1 s", "line 5: distance_noise: expected a unit of the kind of m; found 's'"),
        ("0.1 um", "0.1 m", "line 5: distance_noise: makes distance_noise = 0.1 m; expected 0..0.001 m"),
        ("0.1 um", "", "line 5: distance_noise: expected one number"),
        ("0.342 0 0.940", "0.342 0", "line 4: nominal_direction: expected 3 numbers; found '0.342 0'"),
        ("0.342 0 0.940", "0,342 0 0,940", "(the decimal sign is a point; blanks separate numbers)"),
        ("0.342 0 0.940", "0.342 0 0.640", "line 4: nominal_direction: expected a vector of length 1; found 0.7256"),
        ("distance_noise", "distance_noize", "line 5: distance_noize: unknown key; did you mean 'distance_noise'?"),
        ("# distance_noise", "# stage = 1 mm\n# distance_noise", "line 5: stage: expected in a table"),
        ("# distance_noise = 0.1 um\n", "", "distance_noise(): missing; expected in m"),
        (
            "# machine = C-frame 610",
            "# schema = errormotion.raw.inclination/1",
            "line 2: duplicate key 'schema'; first given in line 1",
        ),
        (
            "raw.beam_direction",
            "raw.beam_directoin",
            "line 1: schema 'errormotion.raw.beam_directoin/1' is unknown; did",
        ),
        ("# schema = errormotion.raw.beam_direction/1\n", "", "expected a line '# schema = ...'"),
    ],
)
def test_mistakes_are_reported_with_their_position(complaints, old: str, new: str, message: str) -> None:
    assert message in complaints((HEAD + TABLE).replace(old, new, 1))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            "\nplane,nominal_normal_x [1],nominal_normal_y [1],nominal_normal_z [1]\n1,0,1,0\n7,0,0,1\n",
            "of 1, 2; found '7'",
        ),
        (
            "\nplane,nominal_normal_x [1],nominal_normal_y [1],nominal_normal_z [1]\n1,0,1,0\n1,0,0,1\n",
            "duplicate; first given in line 14",
        ),
        (
            "\nnominal_normal_x [1],nominal_normal_y [1],nominal_normal_z [1]\n1,0,0\n",
            "line 13: expected 2 along plane",
        ),
        ("\nplane,reading [mm]\n1,0.1\n", "column 2 'reading [mm]': distance is already given above"),
        ("\ndistance_noise [um]\n0.1\n", "distance_noise: expected in the header, as '# distance_noise = ...'"),
        ("\nplane,bar_distance [mm]\n1,0.1\n", "column 'plane': no variable of this table has this dimension"),
        ("\nbar_distance [mm]\n", "line 13: expected lines of numbers below the column names; found none"),
        ('\nbar_distance [mm]\n"0.1\n', "line 14: cannot be split into fields"),
    ],
)
def test_mistakes_of_further_tables(complaints, table: str, message: str) -> None:
    assert message in complaints(HEAD + TABLE + table)


def test_variables_of_two_kinds_do_not_share_a_table(complaints) -> None:
    message = complaints(
        INCLINATION.replace("reading [mm],", "reading_noise [um],", 1).replace("# reading_noise = 0.1 um\n", "")
    )
    assert "expected variables of one kind in a table; found reading_noise (one value) and reference (group)" in message


def test_all_mistakes_are_reported_at_once(complaints) -> None:
    message = complaints((HEAD + TABLE).replace("-1.508", "a").replace("0.25", "b").replace("0.1 um", "0.1"))
    assert "3 mistakes" in message
    assert message.index("line 5") < message.index("line 8") < message.index("line 9")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected a line of column names and lines of readings; found none"),
        (HEAD.encode(), "expected a line of column names"),
        (b"\x00\x01\x02\xff" * 9, "contains zero bytes; expected text"),
    ],
)
def test_other_files_are_reported(complaints, data: bytes, message: str) -> None:
    assert message in complaints(data)


def test_no_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"nothing\.csv: cannot be read: No such file"):
        datasets.load(tmp_path / "nothing.csv")
