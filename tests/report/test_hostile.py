"""Texts and pictures from strangers in reports and their exports: no formula, no script, no long reading."""

import csv
import time
import zipfile
from pathlib import Path

import pytest

from errormotion.report.exports import xlsx
from errormotion.report.exports.tables import Sheet, plain_text, write_csv
from errormotion.report.page import logo

SECONDS = 5.0
"""Time for the largest logo on a computer with other work, s; 50 comments alone took days."""
SIGNS = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")
FORMULAS = [
    f"{before}{sign}HYPERLINK(1)"
    for sign in SIGNS
    for before in ("", "\t", "\r", "\n", " ", " \t", "a;", "a\t", "a\r\n", "a\n", "a,", "a;;", "\t;")
]


@pytest.mark.parametrize("comma", [False, True])
def test_no_text_becomes_a_formula_in_any_spreadsheet(tmp_path: Path, comma: bool) -> None:
    rows = [[text, text] for text in FORMULAS]
    table = Sheet(1, "=1+1", "=caption", FORMULAS[:2], rows, [[None, None]] * len(rows), ["@note", "a;=b"])
    (file,) = write_csv([table], tmp_path / "csv", comma=comma).iterdir()
    text = file.read_text("utf-8-sig")
    for separator in (",", ";", "\t"):  # as programs in other languages, or set otherwise, read it
        for row in csv.reader(text.splitlines(keepends=True), delimiter=separator):
            for cell in row:
                for line in cell.splitlines():
                    assert not line.lstrip("\t\r\n ").startswith(SIGNS), (separator, cell)


def test_usual_texts_are_unchanged() -> None:
    for text in (
        "EX at 20 °C",
        "a, -5 um; b",
        "machine (table-side)",
        "5 +/- 1",
        "x = 3",
        "a@b.example",
        "",
        "2026-03-31",
    ):
        assert plain_text(text) == text


def test_a_workbook_has_no_formula(tmp_path: Path) -> None:
    texts = [*FORMULAS, "\x00\x1b[31m\ud800</t></is><f>1</f>", "]]>&<"]
    xlsx.write([Sheet(1, "=1", "=2", texts, [texts], [[None] * len(texts)], texts)], tmp_path / "x.xlsx")
    with zipfile.ZipFile(tmp_path / "x.xlsx") as file:
        text = file.read("xl/worksheets/sheet1.xml").decode()
    assert "<f>" not in text
    assert text.count('t="inlineStr"') == 1 + 3 * len(texts)


@pytest.mark.parametrize(
    "start",
    [
        b"<!---->",
        b"<!-- --",
        b"<!--",
        b" \n",
        b"<?xml ",
        b"<?xml ?>",
        b"<!DOCTYPE",
        b"<!DOCTYPE a>",
        b"<?xml ?><!---->",
        b"<",
    ],
)
def test_no_logo_takes_long_to_refuse(tmp_path: Path, start: bytes) -> None:
    path = tmp_path / "logo.svg"
    for content in (start * 50, start * (logo.LARGEST // len(start) - 1)):
        path.write_bytes(content + b"x")
        begin = time.monotonic()
        assert "is not of type image/svg+xml" in logo.mistake(path)
        assert time.monotonic() - begin < SECONDS


@pytest.mark.parametrize(
    "head",
    [
        b'<!DOCTYPE svg [<!ENTITY a "b"><!ENTITY c "&a;&a;">]>',
        b'<!DOCTYPE svg SYSTEM "a" [<!ENTITY % a SYSTEM "file:///etc/passwd">%a;]>',
        b'<?xml-stylesheet href="http://evil.example/a.xsl"?>',
        "<?xml version='1.0' encoding='utf-16'?>".encode("utf-16"),
        b"<html><body>",
        b"<!-- a --> b -->",
    ],
)
def test_a_logo_with_entities_or_style_sheets_is_refused(tmp_path: Path, head: bytes) -> None:
    (tmp_path / "logo.svg").write_bytes(head + b"<svg xmlns='http://www.w3.org/2000/svg'/>")
    assert logo.of_folder(tmp_path) == ""


@pytest.mark.parametrize(
    "head",
    [b"", b"\xef\xbb\xbf", b"<?xml version='1.0'?>\n<!-- a --><!-- b -->", b"<!DOCTYPE svg PUBLIC 'a' 'http://b'>\r\n"],
)
def test_usual_logos_are_accepted(tmp_path: Path, head: bytes) -> None:
    (tmp_path / "logo.svg").write_bytes(head + b"<svg xmlns='http://www.w3.org/2000/svg'/>")
    assert logo.of_folder(tmp_path).startswith("data:image/svg+xml;base64,")
