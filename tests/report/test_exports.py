"""A report in other forms: every table as CSV and XLSX with numbers as numbers, and the page as PDF."""

import csv
import json
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree
from zipfile import ZipFile

import pytest
from coded import raises
from command_line import CliRunner

from errormotion.cli.app import app
from errormotion.datasets import save
from errormotion.errors import RunError
from errormotion.report import Form, write_report
from errormotion.report.document import Cell, Table
from errormotion.report.exports import pdf, tables, xlsx

TABLE = Table(
    "Errors.",
    ["name", "a / µm", "what"],
    [["=1+1", Cell("−1.50", "0.25"), "text"], ["group"], ["b", Cell("—", reason="not seen"), "12\u202f000"]],
    [("", 1), ("error", 2)],
    notes=["a note"],
)
MAIN = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"


def read_csv(path, delimiter=","):
    with path.open(encoding="utf-8-sig", newline="") as file:
        return list(csv.reader(file, delimiter=delimiter))


def read_xlsx(path):
    """Sheets by name as rows of cells by letter: numbers as floats."""
    with ZipFile(path) as archive:
        assert archive.testzip() is None
        book = ElementTree.fromstring(archive.read("xl/workbook.xml"))
        found = {}
        for k, sheet in enumerate(book.iter(f"{MAIN}sheet"), 1):
            root = ElementTree.fromstring(archive.read(f"xl/worksheets/sheet{k}.xml"))
            found[sheet.get("name")] = [
                {
                    c.get("r").rstrip("0123456789"): "".join(c.itertext())
                    if c.get("t") == "inlineStr"
                    else float(c.findtext(f"{MAIN}v"))
                    for c in row
                }
                for row in root.iter(f"{MAIN}row")
            ]
    return found


def test_a_sheet_has_a_column_for_each_uncertainty_and_reasons_for_what_is_missing():
    found = tables.sheet(TABLE, 3, "Section")
    assert found.head == ["name", "error: a / µm", "U of error: a / µm", "error: what"]
    assert found.rows == [["=1+1", -1.5, 0.25, "text"], ["group"], ["b", None, None, 12000.0]]
    assert found.decimals[0] == [None, 2, 2, None]
    assert found.notes == ["a note", "b, error: a / µm: not seen"]


@pytest.mark.parametrize("comma", [False, True])
def test_csv_keeps_the_decimals_and_disarms_formulas(tmp_path, comma):
    folder = tables.write_csv([tables.sheet(TABLE, 3, "A/B ../ c")], tmp_path / "t", comma=comma)
    (file,) = folder.iterdir()
    assert file.name == "03-a-b-c.csv"
    rows = read_csv(file, ";" if comma else ",")
    assert rows[1] == ["'=1+1", "-1,50" if comma else "-1.50", "0,25" if comma else "0.25", "text"]
    assert rows[3] == ["b", "", "", "12000"]
    assert [row[0] for row in rows[4:]] == ["# Errors.", "# a note", "# b, error: a / µm: not seen"]


def test_a_workbook_has_a_sheet_for_each_table_with_numbers(tmp_path):
    hostile = Table("<c>&\x00", ["<script>", "b"], [["=HYPERLINK(1)", "1.250"]])
    sheets = [tables.sheet(TABLE, 1, "A: [b]/c" * 9), tables.sheet(hostile, 2, "A")]
    found = read_xlsx(xlsx.write(sheets, tmp_path / "t.xlsx"))
    assert [len(name) <= 31 for name in found] == [True, True]
    first, second = found.values()
    assert first[2] == {"A": "=1+1", "B": -1.5, "C": 0.25, "D": "text"}
    assert second[0] == {"A": "<c>&"}
    assert second[2] == {"A": "=HYPERLINK(1)", "B": 1.25}


@pytest.mark.usefixtures("undrawn")
def test_every_table_of_a_report_is_exported(drift, tmp_path):
    page = write_report(drift, tmp_path / "r.html", form=Form(also=("csv", "xlsx")))
    count = page.read_text(encoding="utf-8").count("<table")
    assert len(list((tmp_path / "r-tables").iterdir())) == count
    assert len(read_xlsx(tmp_path / "r.xlsx")) == count
    rows = read_csv(next((tmp_path / "r-tables").glob("01-*.csv")))
    assert rows[1][0] == "d(X1)"
    assert float(rows[1][3]) == pytest.approx(0.40)


@pytest.mark.usefixtures("undrawn")
def test_without_a_printing_program_the_message_names_packages(beams, tmp_path, monkeypatch):
    monkeypatch.setattr(pdf, "browser", lambda: "")
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with pytest.raises(RunError, match=r"apt install chromium.*errormotion\[pdf\]"):
        write_report(beams, tmp_path / "r.html", form=Form(also=("pdf",)))
    assert [path.name for path in tmp_path.iterdir()] == ["r.html"]


@pytest.mark.skipif(not pdf.browser(), reason="no browser is installed")
def test_the_command_prints_with_the_stated_paper(beams, tmp_path: Path) -> None:
    save(beams, tmp_path / "errors.nc")
    done = CliRunner().invoke(app, ["report", str(tmp_path / "errors.nc"), "--pdf", "--paper", "Letter", "--json"])
    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout)
    assert answer["files"] == [str(tmp_path / "errors.pdf")]
    assert (tmp_path / "errors.pdf").read_bytes().startswith(b"%PDF-")
    assert "size: letter;" in (tmp_path / "errors.html").read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["errors.html", "errors.nc", "errors.pdf"]


@pytest.mark.skipif(not pdf.browser(), reason="no browser is installed")
@pytest.mark.usefixtures("undrawn")
def test_a_browser_that_fails_is_named(beams, tmp_path, monkeypatch):
    monkeypatch.setattr(pdf, "browser", lambda: shutil.which("false"))
    with raises("pdf.failed"):
        write_report(beams, tmp_path / "r.html", form=Form(also=("pdf",)))
