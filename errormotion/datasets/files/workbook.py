"""Tables as a workbook: XLSX after ECMA-376 (Office Open XML), written without another package."""

from __future__ import annotations

import io
import math
import re
import zipfile
from collections.abc import Sequence
from typing import NamedTuple
from xml.sax.saxutils import escape, quoteattr

from errormotion.errors import DatasetError

Cell = str | float | int | bool | None

MOST_ROWS = 2**20
"""Rows of a sheet, by the format."""

_LONGEST_TEXT = 32767
_WHEN = (1980, 1, 1, 0, 0, 0)
_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
_TYPE = "application/vnd.openxmlformats-officedocument.spreadsheetml"
_HEAD = '<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n'
_STYLES = (
    f'<styleSheet xmlns="{_MAIN}"><fonts count="2"><font><sz val="11"/><name val="Calibri"/></font>'
    '<font><b/><sz val="11"/><name val="Calibri"/></font></fonts>'
    '<fills count="2"><fill><patternFill patternType="none"/></fill><fill><patternFill patternType="gray125"/></fill>'
    '</fills><borders count="1"><border><left/><right/><top/><bottom/><diagonal/></border></borders>'
    '<cellStyleXfs count="1"><xf numFmtId="0" fontId="0" fillId="0" borderId="0"/></cellStyleXfs>'
    '<cellXfs count="2"><xf numFmtId="0" fontId="0" fillId="0" borderId="0" xfId="0"/>'
    '<xf numFmtId="0" fontId="1" fillId="0" borderId="0" xfId="0" applyFont="1"/></cellXfs></styleSheet>'
)


class Sheet(NamedTuple):
    """One table: its name, its head and its rows; NaN and None are empty cells."""

    name: str
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]


def workbook(sheets: Sequence[Sheet]) -> bytes:
    """Return an XLSX file; texts are texts, never formulas.

    Raises
    ------
    DatasetError
        More rows than a sheet may have.
    """
    for sheet in sheets:
        if len(sheet.rows) >= MOST_ROWS:
            raise DatasetError(
                f"A sheet of XLSX holds {MOST_ROWS - 1} rows; found {len(sheet.rows)}. Write .csv or .nc"
            )
    numbers = range(1, len(sheets) + 1)
    listed = "".join(
        f'<sheet name={quoteattr(_plain(sheet.name)[:31])} sheetId="{n}" r:id="rId{n}"/>'
        for n, sheet in zip(numbers, sheets, strict=True)
    )
    links = "".join(
        f'<Relationship Id="rId{n}" Type="{_OFFICE}/worksheet" Target="worksheets/sheet{n}.xml"/>' for n in numbers
    )
    style = len(sheets) + 1
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{_PACKAGE}/content-types">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="xml" ContentType="application/xml"/>'
        f'<Override PartName="/xl/workbook.xml" ContentType="{_TYPE}.sheet.main+xml"/>'
        f'<Override PartName="/xl/styles.xml" ContentType="{_TYPE}.styles+xml"/>'
        + "".join(
            f'<Override PartName="/xl/worksheets/sheet{n}.xml" ContentType="{_TYPE}.worksheet+xml"/>' for n in numbers
        )
        + "</Types>",
        "_rels/.rels": f'<Relationships xmlns="{_PACKAGE}/relationships">'
        f'<Relationship Id="rId1" Type="{_OFFICE}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook xmlns="{_MAIN}" xmlns:r="{_OFFICE}"><sheets>{listed}</sheets></workbook>',
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{_PACKAGE}/relationships">{links}'
        f'<Relationship Id="rId{style}" Type="{_OFFICE}/styles" Target="styles.xml"/></Relationships>',
        "xl/styles.xml": _STYLES,
        **{f"xl/worksheets/sheet{n}.xml": _sheet(sheet) for n, sheet in zip(numbers, sheets, strict=True)},
    }
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in parts.items():  # one time for all: the same tables are the same file
            archive.writestr(zipfile.ZipInfo(name, _WHEN), (_HEAD + text).encode(), zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def _sheet(sheet: Sheet) -> str:
    widths = "".join(
        f'<col min="{k}" max="{k}" width="{min(max(len(name) + 2, 10), 60)}" customWidth="1"/>'
        for k, name in enumerate(sheet.head, 1)
    )
    view = '<sheetViews><sheetView workbookViewId="0"><pane ySplit="1" topLeftCell="A2" state="frozen"/>'
    head = f"<row>{''.join(_cell(name, 1) for name in sheet.head)}</row>"
    rows = "".join(f"<row>{''.join(_cell(value, 0) for value in row)}</row>" for row in sheet.rows)
    return (
        f'<worksheet xmlns="{_MAIN}">{view}</sheetView></sheetViews><cols>{widths}</cols>'
        f"<sheetData>{head}{rows}</sheetData></worksheet>"
    )


def _cell(value: Cell, style: int) -> str:
    if value is None or (not isinstance(value, str) and not math.isfinite(value)):
        return "<c/>"
    if isinstance(value, str):
        return f'<c t="inlineStr" s="{style}"><is><t xml:space="preserve">{escape(_plain(value))}</t></is></c>'
    return f"<c><v>{value:.15g}</v></c>"


def _plain(text: str) -> str:
    return _NOT_XML.sub("?", text)[:_LONGEST_TEXT]
