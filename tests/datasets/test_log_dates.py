"""Dates and times in logs: orders of day and month, two columns, local zones, gaps, thousands, equal mistakes."""

import json
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets.importing import import_log
from errormotion.datasets.tables.dates import Clock, is_date
from errormotion.errors import DatasetError

MAP = """schema = "errormotion.raw.monitor/1"
values.gap = {value = [[0], [0], [0], [0], [0], [0]], unit = "1"}
[columns]
time = {column = ["Datum", "Zeit"], unit = "dd.mm.yyyy"}
temperature.frame = {column = "T", unit = "degC"}
[format]
decimal = ","
"""
LOG = "Datum;Zeit;T\n" + "".join(f"31.05.2024;14:0{k}:00;20,{k}\n" for k in range(6))
SPINDLE = """schema = "errormotion.map/1"
bar_radius = "5 mm"
distance_noise = "0.3 um"
levels = ["10 mm", "50 mm"]
time = {column = [1, 2], unit = "dd.mm.yyyy"}
format = {header = false, delimiter = ";", zone = "Europe/Berlin"}
""" + "".join(
    f'channels.{name} = {{column = 3, unit = "um", origin = ["0 mm", "0 mm", "0 mm"], direction = [1, 0, 0]}}\n'
    for name in ("X1", "X2", "Y1", "Y2", "Z")
)
# The clocks were set back from 03:00 to 02:00 on 27 October 2024, and forward from 02:00 to 03:00 on 31 March.
BERLIN = ZoneInfo("Europe/Berlin")


@pytest.fixture
def run(tmp_path: Path):
    def run(log: str, mapping: str) -> xr.Dataset:
        (tmp_path / "log.csv").write_text(log, encoding="utf-8")
        (tmp_path / "map.toml").write_text(mapping, encoding="utf-8")
        return import_log(tmp_path / "log.csv", tmp_path / "map.toml", tmp_path / "raw.nc")

    return run


@pytest.fixture
def mistakes(run):
    def mistakes(log: str, mapping: str) -> list[str]:
        with pytest.raises(DatasetError) as caught:
            run(log, mapping)
        return caught.value.violations or [str(caught.value)]

    return mistakes


def notes(raw: xr.Dataset) -> list[str]:
    return json.loads(raw.attrs.get("import_notes", "[]"))


def test_date_and_time_of_day_in_two_columns(run) -> None:
    raw = run(LOG, MAP)
    np.testing.assert_array_equal(raw["time"], 60 * np.arange(6))
    assert raw.attrs["start"] == "2024-05-31T14:00:00"
    assert notes(raw) == []


def test_two_columns_and_the_zone_are_read_for_a_drift(run) -> None:
    raw = run("".join(f"27.10.2024;{time};1\n" for time in ("01:30", "02:30", "02:30", "03:30")), SPINDLE)
    np.testing.assert_array_equal(raw["time"], [0, 3600, 7200, 10800])
    assert raw.attrs["start"] == "2024-10-27T01:30:00+02:00"
    assert notes(raw)[0] == "2 times of the hour that occurs twice in Europe/Berlin were resolved by their order"


def test_two_columns_without_a_date_are_refused(mistakes) -> None:
    (found,) = mistakes(LOG, MAP.replace('unit = "dd.mm.yyyy"', 'unit = "s"'))
    assert "two columns are date and time of day; expected the unit 'iso8601' or 'dd.mm.yyyy'" in found


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("dd.mm.yyyy", "31.05.2024 14:05:09.25"),
        ("dd.mm.yyyy", "31.5.2024 14:05:09,25"),
        ("DD.MM.YYYY", "31.05.2024, 14:05:09.25"),
        ("dd.mm.yy", "31.05.24 14:05:09.25"),
        ("mm/dd/yyyy", "05/31/2024 02:05:09.25 PM"),
        ("yyyy-mm-dd", "2024-05-31T14:05:09.250"),
        ("iso8601", "2024-05-31 14:05:09.25"),
    ],
)
def test_orders_of_a_date(unit: str, text: str) -> None:
    assert is_date(unit)
    clock = Clock(unit)
    assert clock.seconds(text) == 0
    assert clock.start.isoformat() == "2024-05-31T14:05:09.250000"


@pytest.mark.parametrize("unit", ["s", "dd.mm", "dd.mm/yyyy", "dd.dd.yyyy", "", "dd.mm.yyyy hh"])
def test_units_that_are_not_dates_are_refused(unit: str) -> None:
    assert not is_date(unit)


@pytest.mark.parametrize(
    "text", ["05/31/2024 14:05", "32.05.2024", "31.05.2024 25:00", "31.05.2024 14:05 PM", "", "٣١.05.2024", "1" * 9999]
)
def test_other_dates_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected a date and time such as 31\.05\.2024 14:05:09; found '"):
        Clock("dd.mm.yyyy").seconds(text)


def test_the_hour_that_occurs_twice_is_resolved_by_the_order_of_the_lines() -> None:
    clock = Clock(zone=BERLIN)
    texts = ("01:50", "02:10", "02:50", "02:10", "02:50", "03:10")
    assert [clock.seconds(f"2024-10-27 {text}") / 60 for text in texts] == [0, 20, 60, 80, 120, 140]
    assert clock.resolved == 4


def test_lines_of_one_time_stay_together_in_the_hour_that_occurs_twice() -> None:
    clock = Clock(zone=BERLIN, repeats=True)
    texts = ("01:50", "02:10", "02:10", "02:50", "02:10", "02:10")
    assert [clock.seconds(f"2024-10-27 {text}") / 60 for text in texts] == [0, 20, 20, 60, 80, 80]


def test_a_log_that_starts_in_the_hour_that_occurs_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="'2024-10-27 02:10' occurs twice in Europe/Berlin"):
        Clock(zone=BERLIN).seconds("2024-10-27 02:10")


def test_a_local_time_that_does_not_exist_is_refused() -> None:
    clock = Clock(zone=BERLIN)
    assert clock.seconds("2024-03-31 01:50") == 0
    with pytest.raises(ValueError, match="'2024-03-31 02:10' does not exist in Europe/Berlin"):
        clock.seconds("2024-03-31 02:10")
    assert clock.seconds("2024-03-31 03:10") == 1200


def test_dates_with_their_own_offset_need_no_order() -> None:
    clock = Clock(zone=BERLIN)
    assert [clock.seconds(f"2024-10-27T02:30:00{offset}") for offset in ("+02:00", "+01:00")] == [0, 3600]


def test_an_unknown_zone_is_a_mistake_of_the_map(mistakes) -> None:
    for zone in ("Europe/Berlim", "+99:00", "../x", "\\u0000"):
        (found,) = mistakes(LOG, MAP + f'zone = "{zone}"\n')
        assert "format.zone: expected a time zone such as 'Europe/Berlin', 'UTC' or '+01:00'" in found


def test_a_gap_in_the_rows_is_noted(run) -> None:
    raw = run(LOG.replace("14:04", "14:14").replace("14:05", "14:15"), MAP)
    assert notes(raw) == ["1 hole in the rows, where the usual interval is 60 s; the longest, of 660 s, ends in line 6"]


def test_rows_at_irregular_times_have_no_gaps(run) -> None:
    log = LOG
    for k, minute in enumerate((0, 1, 5, 11, 12, 30)):
        log = log.replace(f"14:0{k}:00;20", f"14:{minute:02}:30;20")
    assert notes(run(log, MAP)) == []


def test_labels_without_a_row_are_noted(run) -> None:
    mapping = """schema = "errormotion.raw.multilateration/1"
labels = {station = "S", target = "P"}
values = {displacement_noise = "1 um", target_nominal = {value = [[0, 0, 0], [1, 0, 0]], unit = "m"}}
columns.displacement = {column = "L", unit = "m"}
"""
    raw = run("S,P,L\n1,1,0.5\n1,2,0.6\n2,1,0.7\n", mapping)
    assert np.isnan(raw["displacement"].sel(station=2, target=2))
    assert notes(raw) == [
        "no row for 1 combination of the labels, whose values are NaN; the first is station '2', target '2'"
    ]


def test_an_ambiguous_point_is_refused_until_the_format_is_stated(run, mistakes) -> None:
    log = LOG.replace("20,", "15.000,")
    (found,) = mistakes(log, MAP)
    assert found.startswith("lines 2, 3, 4, 5, 6 and 1 more: column 'T': the point in '15.000,0' may be a decimal sign")
    assert "set format.thousands = '.' in the map, or ''" in found
    wide = MAP.replace('"degC"', '"degC", scale = 1e-3') + "thousands = '.'\n"
    np.testing.assert_allclose(run(log, wide)["temperature"][:, 0], 15 + 1e-4 * np.arange(6))


def test_a_point_is_a_decimal_sign_if_the_map_states_it(run) -> None:
    raw = run(LOG.replace("20,", "20.00"), MAP + "thousands = ''\n")
    np.testing.assert_allclose(raw["temperature"][:, 0], 20 + 1e-3 * np.arange(6))


@pytest.mark.parametrize(
    ("sign", "text"),
    [("'", "15'000,5"), ("'", "15\u2019000,5"), (" ", "15 000,5"), (" ", "15\u202f000,5"), (".", "15.000,5")],
)
def test_signs_between_thousands(run, sign: str, text: str) -> None:
    mapping = MAP.replace('"degC"', '"degC", scale = 1e-3') + f'thousands = "{sign}"\n'
    raw = run(LOG.replace("20,0", text), mapping)
    assert raw["temperature"][0, 0] == pytest.approx(15.0005)


@pytest.mark.parametrize("text", ["1.50,0", "15.00.000", "1,5.000", "15.000.00"])
def test_signs_that_are_not_between_thousands_are_refused(mistakes, text: str) -> None:
    (found,) = mistakes(LOG.replace("20,0", text), MAP + "thousands = '.'\n")
    assert found == f"line 2: column 'T': expected a number with '.' between groups of three digits; found '{text}'"


def test_the_same_sign_twice_in_a_format_is_refused(mistakes) -> None:
    (found,) = mistakes(LOG, MAP + "thousands = ','\n")
    assert "thousands: ',' is the decimal sign or the delimiter" in found


def test_a_hundred_equal_mistakes_are_one_message(mistakes) -> None:
    log = "Datum;Zeit;T\n" + "".join(f"31.05.2024;14:00:00;{k}a\n" for k in range(100))
    found = mistakes(log, MAP)
    assert found == [
        "lines 2, 3, 4, 5, 6 and 95 more: column 'T': expected a number; found '0a' in line 2",
    ]
    log = "Datum;Zeit;T\n" + "".join(f"05/31/2024;14:{k % 60:02}:00;20\n" for k in range(100))
    (found,) = mistakes(log, MAP)
    assert found.startswith(
        "lines 2, 3, 4, 5, 6 and 95 more: column 'Datum': expected a date and time such as 31.05.2024"
    )
