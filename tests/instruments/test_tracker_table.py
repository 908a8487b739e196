"""Exported tables of trackers."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion.errors import InstrumentError, ReplayError
from errormotion.instruments.laser_tracker.table_conformance import length_table
from errormotion.instruments.laser_tracker.table_reader import MAX_LINES
from errormotion.instruments.laser_tracker.tracker_table import TrackerTable, TrackerTableSettings
from errormotion.testing import InstrumentConformance, InstrumentSubject

HEAD = "station,target,length [mm],temperature [degC],pressure [hPa],humidity [%]"
LINES = ("S1,1,1500.5,20.1,1013,40", "S1,2,1501.25,20.2,1013,40", "S2,1,900,20.3,1012,41", "S2,2,901,20.4,1012,41")


def write(folder: Path, *lines: str, head: str = HEAD) -> str:
    path = folder / "lengths.csv"
    path.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
    return str(path)


def refusal(address: str, **settings: object) -> str:
    with pytest.raises(InstrumentError) as caught:
        TrackerTable(address, TrackerTableSettings(**settings)).open()
    return str(caught.value)


class TestKit(InstrumentConformance):
    subject = InstrumentSubject(TrackerTable, str(length_table()), settings={"stations": ("S2", "S1", "S0")})


@pytest.mark.parametrize("end", ["\n", "\r\n", "\x0b", "\u2028"])
def test_a_table_of_too_many_lines_is_refused_before_it_is_parsed(tmp_path: Path, end: str) -> None:
    path = tmp_path / "lines.csv"
    path.write_bytes((HEAD + end + (MAX_LINES + 1) * f"]{end}").encode())
    tracemalloc.start()
    try:
        message = refusal(str(path))
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()
    assert f"at most {MAX_LINES} lines; found {MAX_LINES + 2}" in message


def test_lengths_are_by_station_and_target_in_si(tmp_path: Path) -> None:
    with TrackerTable(write(tmp_path, *LINES)) as table:
        found, air = table.table(), table.environment()
        np.testing.assert_array_equal(table.read(), found["displacement"].values)
    np.testing.assert_array_equal(found["displacement"], [[1.5005, 1.50125], [0.9, 0.901]])
    assert found["displacement"].attrs["units"] == "m"
    np.testing.assert_allclose(found["pressure"], [[101_300, 101_300], [101_200, 101_200]])
    assert (found["station"].values.tolist(), found["target"].values.tolist()) == (["S1", "S2"], ["1", "2"])
    assert (air.temperature, air.pressure, air.humidity) == pytest.approx((20.25, 101_250.0, 40.5))


def test_the_order_of_lines_does_not_matter(tmp_path: Path) -> None:
    lines = [f"S{k},{i},{1000 + 100 * k + i},20,1000,50" for k in (1, 2) for i in range(1, 13)]
    shuffled = [lines[k] for k in np.random.default_rng(3).permutation(len(lines))]
    with TrackerTable(write(tmp_path, *shuffled), TrackerTableSettings(stations=("S1", "S2"))) as table:
        assert table.readings.targets == tuple(map(str, range(1, 13)))  # by number, not alphabetically
        expected = 1e-3 * (1000 + 100 * np.array([[1], [2]]) + np.arange(1, 13))
        np.testing.assert_allclose(table.read(), expected, rtol=1e-15)


def test_missing_cells_and_lines_are_nan_and_counted(tmp_path: Path) -> None:
    with TrackerTable(write(tmp_path, "S1,1,1500,20,1013,", "S1,2,,20,1013,40", "S2,1,900,,,")) as table:
        np.testing.assert_array_equal(np.isnan(table.read()), [[False, True], [False, True]])
        assert table.readings.missing == {"empty": 1, "no line": 1}
        assert np.isnan(table.readings.temperature[1, 0])
        assert table.identify().details["missing"] == {"empty": 1, "no line": 1}


def test_a_table_may_contain_no_air_values(tmp_path: Path) -> None:
    with TrackerTable(write(tmp_path, "A;1;1.5", "A;2;1.6", head="tracker;point;displacement (m)")) as table:
        assert set(table.table()) == {"displacement"}
        assert np.isnan(table.environment().temperature)


@pytest.mark.parametrize(
    ("title", "value", "metres"),
    [("length [m]", "1.5", 1.5), ("Length / um", "1500000", 1.5), ("length [inch]", "100", 2.54)],
)
def test_units_are_those_of_the_title(tmp_path: Path, title: str, value: str, metres: float) -> None:
    with TrackerTable(write(tmp_path, f"S1\t1\t{value}", head=f"station\ttarget\t{title}")) as table:
        assert table.read()[0, 0] == pytest.approx(metres, rel=1e-15)


def test_a_repeated_line_is_refused_unless_settings_choose_one(tmp_path: Path) -> None:
    address = write(tmp_path, "S1,1,1500,20,1013,40", "S1,2,1510,20,1013,40", "S1,1,1502,22,1013,40")
    assert "line 4: station 'S1', target '1': expected one line; line 2 is another" in refusal(address)
    for repeats, expected in (("last", 1.502), ("mean", 1.501)):
        with TrackerTable(address, TrackerTableSettings(repeats=repeats)) as table:
            assert table.read()[0, 0] == pytest.approx(expected, rel=1e-15)
            assert table.readings.repeated == 1


def test_an_unnamed_station_is_refused(tmp_path: Path) -> None:
    message = refusal(write(tmp_path, *LINES, "S3,1,1500,20,1013,40"), stations=("S1", "S2"))
    assert "line 6: column 'station': expected one of S1, S2; found 'S3'" in message


def test_a_station_without_lines_is_nan(tmp_path: Path) -> None:
    with TrackerTable(write(tmp_path, *LINES), TrackerTableSettings(stations=("S1", "S2", "S3"))) as table:
        assert np.isnan(table.read()[2]).all()
        assert table.readings.missing == {"no line": 2}


def test_millimetres_declared_as_metres_are_detected(tmp_path: Path) -> None:
    message = refusal(write(tmp_path, "S1,1,1500.5", head="station,target,length [m]"))
    assert "expected -160 to 160; found 1500.5. Check its unit, m" in message


def test_metres_declared_as_millimetres_are_detected(tmp_path: Path) -> None:
    address = write(tmp_path, "S1,1,1.5005", "S1,2,2.1", head="station,target,length [mm]")
    assert "the longest length is 0.0021 m; check its unit" in refusal(address)
    with TrackerTable(address, TrackerTableSettings(least_length=0.0)) as table:
        assert table.read()[0, 0] == pytest.approx(0.0015005, rel=1e-15)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("S1,1,1500,293.1,1013,40", "column 'temperature [degC]': expected -20 to 60; found 293.1"),
        ("S1,1,1500,20,101300,40", "column 'pressure [hPa]': expected 500 to 1200; found 101300"),
        ("S1,1,1500,20,1013,140", "column 'humidity [%]': expected 0 to 100; found 140"),
        ("S1,1,15O0,20,1013,40", "column 'length [mm]': expected a number; found '15O0'"),
        ("S1,,1500,20,1013,40", "column 'target': expected a number or name; found nothing"),
        ("S1,1,1500,5,20,1013,40", "expected 6 fields; found 7"),
    ],
)
def test_wrong_cells_are_named_with_line_and_column(tmp_path: Path, line: str, words: str) -> None:
    message = refusal(write(tmp_path, LINES[1], line))
    assert f"line 3: {words}" in message


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("station,target,length", "column 'length': expected its unit, such as 'length [mm]'"),
        ("station,target,length [kg]", "column 'length [kg]': expected a unit such as mm"),
        ("station,target,lenght [mm]", "did you mean 'length'?"),
        ("station,length [mm],pressure [hPa]", "expected a column 'target'"),
        ("station,distance [mm],length [mm]", "expected one column for the length; found a second one"),
    ],
)
def test_wrong_titles_are_named(tmp_path: Path, head: str, words: str) -> None:
    assert words in refusal(write(tmp_path, "S1,1,1500", head=head))


def test_all_mistakes_are_reported_at_once(tmp_path: Path) -> None:
    message = refusal(write(tmp_path, "S1,1,x,20,1013,40", "S1,2,1500,200,1013,40", "S1,2,1500,20,1013"))
    assert "3 mistakes" in message
    assert all(f"line {number}:" in message for number in (2, 3, 4))


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((), "expected lines of numbers; found none"),
        (("S1,1,,20,1013,40",), "expected lengths; found none"),
        ((*LINES, "", HEAD.replace("humidity [%]", "wind [m/s]"), "S1,3,1500,20,1013,40"), "line 7: column"),
        ((*LINES, "", "exported by program 3"), "1 line below the table not read, from line 7 on"),
    ],
)
def test_tables_without_lengths_or_in_two_parts_are_refused(tmp_path: Path, lines: tuple[str, ...], words: str) -> None:
    assert words in refusal(write(tmp_path, *lines))


def test_a_german_table_is_read(tmp_path: Path) -> None:
    path = tmp_path / "tabelle.csv"
    lines = [
        "Messung vom 4.5.2026",
        "",
        "Standort;Punkt;Länge [mm];Temperatur [°C]",
        "S1;P1;1.500,5;20,1",
        "S1;P2;1.501,25;20,2",
    ]
    path.write_bytes("\r\n".join(lines).encode("cp1252") + b"\r\n")
    with TrackerTable(str(path)) as table:
        np.testing.assert_allclose(table.read(), [[1.5005, 1.50125]], rtol=1e-15)
        assert table.environment().temperature == pytest.approx(20.15)


def test_files_that_are_not_there_are_refused(tmp_path: Path) -> None:
    assert "cannot be read: No such file" in refusal(str(tmp_path / "none.csv"))
    assert "Expected the path of a table" in refusal("tcp://127.0.0.1:700")


def test_a_recording_is_a_copy_and_refused_if_not_a_table(tmp_path: Path) -> None:
    address, copy = write(tmp_path, *LINES), tmp_path / "copy.rec"
    with TrackerTable(address, record=copy) as table:
        original, lengths = table.identify(), table.read()
    with TrackerTable(f"replay://{copy}") as table:
        assert table.identify().serial_number == original.serial_number
        np.testing.assert_array_equal(table.read(), lengths)
    with raises("recording.not_created"):
        TrackerTable(address, record=copy).open()
    copy.write_text("nothing", encoding="utf-8")
    with pytest.raises(ReplayError):
        TrackerTable(f"replay://{copy}").open()
