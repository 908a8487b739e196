"""Tables as programs and instruments write them: what is recognised, and what is refused with its line."""

from __future__ import annotations

import io
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from errormotion.datasets.tables.dates import fitting
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.reading import read_table
from errormotion.datasets.tables.table import Table
from errormotion.errors import DatasetError

LVM = """LabVIEW Measurement\t
Writer_Version\t2
Separator\tTab
Date\t2024/05/31
***End_of_Header***\t
\t
Channels\t2\t\t
Samples\t3\t3\t
Date\t2024/05/31\t2024/05/31\t
Delta_X\t0.100000\t0.100000\t
***End_of_Header***\t\t\t
X_Value\tUntitled\tUntitled 1\tComment
0.000000\t1.000000\t2.0000
0.100000\t1.100000\t2.1000
0.200000\t1.200000\t2.2000
"""
GERMAN = """Messprotokoll;Maschine A
Datum;31.05.2024

Zeit [s];Weg X1 [µm];Temp Ständer [°C]
0,0;1,25;20,1
0,5;1,30;---
1,0;1,35;20,2

Mittelwert;1,30;20,15
"""
VALUES = "".join(f"Item {k},{k}\n" for k in range(30))
READ = [
    ("comma", "t,a\n0,1\n1,2\n2,3\n", ["t", "a"], [0, 1, 2], [1, 2, 3]),
    ("tabs", "t\ta\n0\t1\n1\t2\n", ["t", "a"], [0, 1], [1, 2]),
    ("blanks", "   time     x1\n    0.0    1.00\n    1.0   -2.10", ["time", "x1"], [0, 1], [1, -2.1]),
    ("decimal commas", "t;a\n0,5;1,25\n1,0;1,5\n", ["t", "a"], [0.5, 1.0], [1.25, 1.5]),
    ("quoted decimal commas", 't,a\n"0,5","1000,5"\n"1,0","1001,5"\n', ["t", "a"], [0.5, 1.0], [1000.5, 1001.5]),
    ("points between thousands", "t;a\n1;1.234,5\n2;987,5\n", ["t", "a"], [1, 2], [1234.5, 987.5]),
    ("commas between thousands", "t;a\n1;1,234.5\n2;987.5\n", ["t", "a"], [1, 2], [1234.5, 987.5]),
    ("apostrophes", "t;a\n1;1'234.5\n2;987.5\n", ["t", "a"], [1, 2], [1234.5, 987.5]),
    ("separator stated", "sep=;\nt;a\n0;1\n1;2\n", ["t", "a"], [0, 1], [1, 2]),
    ("old Macintosh", "t,a\r0,1\r1,2\r", ["t", "a"], [0, 1], [1, 2]),
    ("names in a comment", "# t a\n0.0 1.0\n1.0 1.5\n", ["t", "a"], [0, 1], [1, 1.5]),
    ("no names", "0.0 1.0\n1.0 1.5\n", ["1", "2"], [0, 1], [1, 1.5]),
    ("text above", "My program 2.0\nStart, 10:00\n\nt,a\n0,1\n1,2\n", ["t", "a"], [0, 1], [1, 2]),
    ("many values above", VALUES + "t,a,b\n0,1,5\n1,2,5\n", ["t", "a", "b"], [0, 1], [1, 2]),
    ("header again after a restart", "t,a\n0,1\n1,2\nt,a\n2,3\n", ["t", "a"], [0, 1, 2], [1, 2, 3]),
    ("delimiter at the end", "t;a\n0;1;\n1;2;\n", ["t", "a", ""], [0, 1], [1, 2]),
    ("numbers as names", "Target;1\n0;0,1\n100;1,5\n", ["Target", "1"], [0, 100], [0.1, 1.5]),
    ("no value", "t,a\n0,1\n1,OL\n2,9.9E+37\n3,---.--\n4,\n", ["t", "a"], range(5), [1] + 4 * [np.nan]),
    ("LabVIEW", LVM, ["X_Value", "Untitled", "Untitled 1", "Comment"], [0, 0.1, 0.2], [1, 1.1, 1.2]),
    ("German", GERMAN, ["Zeit [s]", "Weg X1 [µm]", "Temp Ständer [°C]"], [0, 0.5, 1], [1.25, 1.3, 1.35]),
]  # fmt: skip


@pytest.fixture
def read(tmp_path: Path):
    def read(text: str | bytes, encoding: str = "utf-8", **form: object) -> Table:
        path = tmp_path / "table.txt"
        path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
        return read_table(path, Format.model_validate(form))

    return read


def numbers(table: Table, *columns: int) -> list[np.ndarray]:
    mistakes = Mistakes(table.path)
    table.report(mistakes)
    found = table.numbers({k: table.titles[k] for k in columns}, mistakes)
    mistakes.raise_any()
    return [found[k] for k in columns]


@pytest.mark.parametrize(("text", "titles", "first", "second"), [case[1:] for case in READ], ids=[c[0] for c in READ])
@pytest.mark.parametrize("many", [False, True], ids=["few rows", "many rows"])
def test_a_table_is_read_without_a_word_about_its_form(read, monkeypatch, text, titles, first, second, many) -> None:
    """Both ways of reading give the same: row by row, and by pandas where there are many rows."""
    monkeypatch.setattr("errormotion.datasets.tables.text._MANY", 1 if many else 10**9)
    table = read(text)
    assert table.titles == titles
    t, a = numbers(table, 0, 1)
    np.testing.assert_array_equal(t, first)
    np.testing.assert_array_equal(a, second)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (GERMAN, "utf-8-sig"),
        (GERMAN, "cp1252"),
        (GERMAN, "cp850"),
        (GERMAN, "mac_roman"),
        (GERMAN, "utf-16"),
        (GERMAN, "utf-16-le"),
        (GERMAN, "utf-16-be"),
        (GERMAN, "utf-32"),
        ("时间,位移 [um],温度\n0,1.5,20.1\n1,1.6,20.1\n", "gb18030"),
        ("時間,変位 [um],温度の測定値\n0,1.5,20.1\n1,1.6,20.1\n", "shift_jis"),
        ("Время,Перемещение [um],Температура\n0,1.5,20.1\n1,1.6,20.1\n", "cp1251"),
    ],
)
def test_the_encoding_is_recognised(read, text: str, encoding: str) -> None:
    table = read(text, encoding)
    names = [
        title for title in text.replace("\n", ";").replace(",", ";").split(";") if "um]" in title or "µm]" in title
    ]
    assert table.titles[1] == names[0]


def test_units_are_those_of_the_line_below_the_names_or_of_the_names(read) -> None:
    assert read("t, a, T\n(s), (um), (C)\n\n0, 1000, 20.5\n1, 1001, 20.5\n").units == ["s", "um", "C"]
    assert read("t,a,T\ns,mm,°C\n0,1,20\n1,1,20\n").units == ["s", "mm", "°C"]
    assert read("t [s],a (\u03bcm),T / °C\n0,1,20\n1,1,20\n").units == ["s", "\u00b5m", "°C"]


def test_names_that_look_equal_are_equal(read) -> None:
    table = read("t,a\u00a01,b (\u03bcm),Weg [mm]\n0,1,2,3\n1,1,2,3\n")
    mistakes = Mistakes(table.path)
    assert [table.place(name, "key", mistakes) for name in ("a 1", "b (\u00b5m)", "Weg")] == [1, 2, 3]
    assert not mistakes.count


def test_text_below_a_table_is_noted(read) -> None:
    assert read(GERMAN).notes == ["1 line below the table not read, from line 9 on: 'Mittelwert;1,30;20,15'"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,a\n0,1\n1,2x\n2,3\n3,4\n", "line 3: a: expected a number; found '2x'"),
        ("t,a\n0,1\n1,2\n2,3\n3,abc\n", "line 5: a: expected a number; found 'abc'"),
        ("t,a\n0,abc\n1,2\n2,3\n3,4\n", "line 2: a: expected a number; found 'abc'"),
        ("t,a,b\n0,1,2\n1,2,3\n2,3\n3,4,5\n", "line 4: expected 3 fields; found 2"),
        ("t,a,b\n0,1,2\n1,2,3\n2,3,4\n3,4\n", "line 5: expected 3 fields; found 2"),
        ("s,a,b\nS1,1,2\nS1,2,3\nS2,3,4\nS2,4\n", "line 5: expected 3 fields; found 2"),
        ("t;a\n0;1,5\n1;1.5\n2;1,5\n", "some numbers have a comma and others a point"),
        ("t;a\n0;1,250\n1;2,500\n2;3,750\n", "the comma in '1,250' may be the decimal sign or separate thousands"),
        ("t,a\n0,20.50\n1,20.51\n2,20.52\n3,20.5", "fewer decimals than all numbers"),
        ("t,a\nx,y\n", "expected lines of numbers; found none"),
        (LVM + LVM.partition("***\t\n")[2], "has 2 segments"),
        (b"\x00\x01\x02\x03" * 100, "contains zero bytes"),
    ],
)
def test_what_cannot_be_read_is_named(read, text, message: str) -> None:
    def every_number() -> None:
        table = read(text)
        numbers(table, *(k for k, title in enumerate(table.titles) if title != "s"))

    with pytest.raises(DatasetError) as caught:
        every_number()
    assert message in str(caught.value)


def test_a_stated_form_wins(read) -> None:
    (a,) = numbers(read("t;a\n0;1,250\n1;2,500\n", thousands=","), 1)
    assert a.tolist() == [1250, 2500]
    (a,) = numbers(read("t;a\n0;1,250\n1;2,500\n", decimal=","), 1)
    assert a.tolist() == [1.25, 2.5]
    (a,) = numbers(read("t,a\n0,-9999.0\n1,2\n", missing=["-9999"]), 1)
    assert np.isnan(a[0])
    assert a[1] == 2


@pytest.mark.parametrize(
    ("texts", "unit", "seconds"),
    [
        (["2024-05-31T14:05:09.5", "2024-05-31T14:05:10.5"], "iso8601", [0, 1]),
        (["01/26/2009 08:07:12:237", "01/26/2009 08:07:13:237"], "mm/dd/yyyy", [0, 1]),
        (["31-May-2024 14:05:09", "31-May-2024 14:05:10"], "dd-mmm-yyyy", [0, 1]),
        (["31.05.2024_14:05:09", "31.05.2024_14:05:10"], "dd.mm.yyyy", [0, 1]),
        (["31.05.2024-14:05:09", "31.05.2024-14:05:10"], "dd.mm.yyyy", [0, 1]),
        (["30.05.2024 23:59:59", "30.05.2024 24:00:00"], "dd.mm.yyyy", [0, 1]),
        (["5/31/2024 11:59:59 AM", "5/31/2024 12:00:00 PM"], "mm/dd/yyyy", [0, 1]),
        (["00:00:00", "25:00:01.5"], "hh:mm:ss", [0, 90001.5]),
        (["23:59:59", "00:00:01"], "hh:mm:ss", [86399, 86401]),
        (["45443.586909722", "45443.586921296"], "excel", [0, 1]),
        (["1717164309000", "1717164309500"], "unix ms", [0, 0.5]),
        (["1717164309", "1717164310"], "unix", [0, 1]),
    ],
)
def test_times_of_loggers(read, texts: list[str], unit: str, seconds: list[float]) -> None:
    table = read("t;a\n" + "".join(f"{text};1\n" for text in texts))
    mistakes = Mistakes(table.path)
    values, clock = table.seconds([0], unit, "t", mistakes, repeats=False)
    mistakes.raise_any()
    np.testing.assert_allclose(values, seconds, atol=2e-4 if unit == "excel" else 1e-9)
    assert unit in ("excel", "unix", "unix ms") or fitting(texts)[0] == unit
    if unit == "unix ms":
        assert clock.start is not None
        assert clock.start.isoformat() == "2024-05-31T14:05:09+00:00"


def test_an_order_of_day_and_month_that_the_dates_do_not_show_is_left_open() -> None:
    assert fitting(["03/04/2026 10:00:00", "03/04/2026 10:00:01"]) == ["mm/dd/yyyy", "dd/mm/yyyy"]
    assert fitting(["03/14/2026 10:00:00"]) == ["mm/dd/yyyy"]
    assert fitting(["09.03.2026 10:00:00"]) == ["dd.mm.yyyy"]


@pytest.mark.parametrize("unit", ["iso8601", "dd.mm.yyyy"])
@pytest.mark.parametrize("zone", ["", "Europe/Berlin"])
def test_many_dates_at_once_are_those_one_by_one(read, unit: str, zone: str) -> None:
    rng = np.random.default_rng(1)
    instants = np.datetime64("2024-05-31T14:05:09", "ms") + np.cumsum(rng.integers(1, 10**6, 3000)).astype(
        "timedelta64[ms]"
    )
    pattern = "%Y-%m-%d %H:%M:%S.%f" if unit == "iso8601" else "%d.%m.%Y %H:%M:%S.%f"
    texts = [each.astype(datetime).strftime(pattern) for each in instants]
    results = []
    for rows in (texts, [*texts, ""]):  # an empty cell is read one by one
        table = read("t;a\n" + "".join(f"{text};1\n" for text in rows), zone=zone)
        values, clock = table.seconds([0], unit, "t", Mistakes(table.path), repeats=True)
        results.append((values[:3000], clock.start))
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-6)
    assert results[0][1] == results[1][1]


def workbook(*sheets: tuple[str, list[list[object]]]) -> bytes:
    from openpyxl import Workbook

    book = Workbook()
    book.remove(book.active)
    for name, rows in sheets:
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    data = io.BytesIO()
    book.save(data)
    return data.getvalue()


def test_a_spreadsheet_is_read_with_its_numbers_and_dates(read) -> None:
    day = datetime(2024, 5, 31)
    rows: list[list[object]] = [["Machine", "A"], [], ["Date", "Time", "Weg [um]", "T"]]
    rows += [[day, day.replace(hour=14, second=k).time(), 0.1 * k, None if k == 1 else 20] for k in range(3)]
    rows.append(["Mean", None, 0.1, 20])
    table = read(workbook(("Notes", [["only text"]]), ("Data", rows)))
    assert table.titles == ["Date", "Time", "Weg [um]", "T"]
    assert table.units[2] == "um"
    assert table.form.sheet == "Data"
    way, temperature = numbers(table, 2, 3)
    np.testing.assert_array_equal(way, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(temperature, [20, np.nan, 20])
    values, _ = table.seconds([0, 1], "dd.mm.yyyy", "t", Mistakes(table.path), repeats=False)
    assert values.tolist() == [0, 1, 2]
    assert "below the table" in table.notes[0]
    assert table.lines.tolist() == [4, 5, 6]


def test_of_several_sheets_with_tables_one_is_stated(read) -> None:
    data = workbook(("A", [["t", "a"], [0, 1], [1, 2]]), ("B", [["t", "a"], [0, 3], [1, 4]]))
    with pytest.raises(DatasetError, match=r"expected one sheet with a table; found 'A', 'B'"):
        read(data)
    assert numbers(read(data, sheet="B"), 1)[0].tolist() == [3, 4]
    with pytest.raises(DatasetError, match=r"no sheet 'C'"):
        read(data, sheet="C")


def test_a_damaged_spreadsheet_is_refused(read) -> None:
    with pytest.raises(DatasetError, match="cannot be read as a spreadsheet"):
        read(workbook(("A", [["t", "a"], [0, 1]]))[:200])


def test_binary_tables(tmp_path: Path) -> None:
    import h5py
    from nptdms import ChannelObject, TdmsWriter
    from scipy.io import netcdf_file, savemat

    t, a = np.arange(5.0), np.linspace(1, 2, 5)
    with TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(
            [
                ChannelObject("group", "a", a, {"unit_string": "um", "wf_increment": 1.0, "wf_start_offset": 0.0}),
                ChannelObject("group", "b", 2 * a, {"unit_string": "um", "wf_increment": 1.0, "wf_start_offset": 0.0}),
            ]
        )
    savemat(tmp_path / "a.mat", {"time": t, "a": a, "scalar": 1.0})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["log/time"] = t
        file["log/a"] = a
        file["log/a"].attrs["units"] = "um"
    with netcdf_file(tmp_path / "a.nc", "w") as file:
        file.createDimension("n", 5)
        file.createVariable("time", "f8", ("n",))[:] = t
        file.createVariable("a", "f8", ("n",))[:] = a
    for name, where, titles in (
        ("a.tdms", 1, ["time", "a", "b"]),
        ("a.mat", 1, ["time", "a"]),
        ("a.h5", 0, ["log/a", "log/time"]),
        ("a.nc", 1, ["time", "a"]),
    ):
        table = read_table(tmp_path / name)
        assert table.titles == titles, name
        np.testing.assert_array_equal(numbers(table, where)[0], a, name)


@pytest.mark.parametrize("name", ["a.tdms", "a.mat", "a.h5", "a.nc"])
def test_damaged_binary_tables_are_refused(tmp_path: Path, name: str) -> None:
    starts = {"a.tdms": b"TDSm", "a.mat": b"MATLAB 5.0", "a.h5": b"\x89HDF\r\n\x1a\n", "a.nc": b"CDF\x01"}
    path = tmp_path / name
    path.write_bytes(starts[name] + b"\xff\x07" * 60)
    with pytest.raises(DatasetError):
        read_table(path)
