"""Tables as one workbook (Office Open XML, ECMA-376): a sheet for each, numbers as numbers with their decimals."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr
from zipfile import ZIP_DEFLATED, ZipFile

from errormotion.datasets.files.writing import whole
from errormotion.report.exports.tables import Entry, Sheet

_MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
_TYPE = "application/vnd.openxmlformats-officedocument.spreadsheetml"
_HEAD = '<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n'
_ILLEGAL = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_MAX_DECIMALS = 9
_BOLD = _MAX_DECIMALS + 2
_LONGEST = 32_000
"""Characters of a text in a cell."""


def write(sheets: Sequence[Sheet], out: Path) -> Path:
    """Write a workbook; an older file is replaced in one step."""
    names = _names(sheets)
    with whole(out) as beside, ZipFile(beside, "w", ZIP_DEFLATED) as archive:
        for name, text in {
            "[Content_Types].xml": _types(len(sheets)),
            "_rels/.rels": _relations([(f"{_OFFICE}/officeDocument", "xl/workbook.xml")]),
            "xl/workbook.xml": _workbook(names),
            "xl/_rels/workbook.xml.rels": _relations(
                [(f"{_OFFICE}/worksheet", f"worksheets/sheet{k}.xml") for k in range(1, len(sheets) + 1)]
                + [(f"{_OFFICE}/styles", "styles.xml")]
            ),
            "xl/styles.xml": _styles(),
            **{f"xl/worksheets/sheet{k}.xml": _sheet(each) for k, each in enumerate(sheets, 1)},
        }.items():
            archive.writestr(name, _HEAD + text)
    return out


def _names(sheets: Sequence[Sheet]) -> list[str]:
    """Return a different name of at most 31 allowed characters for each sheet."""
    clean = (re.sub(r"[\[\]:*?/\\']", " ", _ILLEGAL.sub("", each.section)).strip() for each in sheets)
    return [f"{each.number} {name}"[:31].strip() for each, name in zip(sheets, clean, strict=True)]


def _types(count: int) -> str:
    parts = [("/xl/workbook.xml", "sheet.main"), ("/xl/styles.xml", "styles")]
    parts += [(f"/xl/worksheets/sheet{k}.xml", "worksheet") for k in range(1, count + 1)]
    return (
        f'<Types xmlns="{_PACKAGE}/content-types">'
        f'<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Default Extension="xml" ContentType="application/xml"/>'
        + "".join(f'<Override PartName="{name}" ContentType="{_TYPE}.{kind}+xml"/>' for name, kind in parts)
        + "</Types>"
    )


def _relations(targets: Sequence[tuple[str, str]]) -> str:
    found = (f'<Relationship Id="r{k}" Type="{kind}" Target="{at}"/>' for k, (kind, at) in enumerate(targets, 1))
    return f'<Relationships xmlns="{_PACKAGE}/relationships">{"".join(found)}</Relationships>'


def _workbook(names: Sequence[str]) -> str:
    found = (f'<sheet name={quoteattr(name)} sheetId="{k}" r:id="r{k}"/>' for k, name in enumerate(names, 1))
    return f'<workbook xmlns="{_MAIN}" xmlns:r="{_OFFICE}"><sheets>{"".join(found)}</sheets></workbook>'


def _styles() -> str:
    """Return the formats: 0 general, k + 1 for k decimals, the last one bold."""
    formats = "".join(
        f'<numFmt numFmtId="{164 + k}" formatCode="0{"." if k else ""}{"0" * k}"/>' for k in range(_MAX_DECIMALS + 1)
    )
    cells = "".join(
        f'<xf numFmtId="{164 + k}" fontId="0" fillId="0" borderId="0" xfId="0" applyNumberFormat="1"/>'
        for k in range(_MAX_DECIMALS + 1)
    )
    font = '<font>{}<sz val="10"/><name val="Arial"/></font>'
    return (
        f'<styleSheet xmlns="{_MAIN}"><numFmts count="{_MAX_DECIMALS + 1}">{formats}</numFmts>'
        f'<fonts count="2">{font.format("")}{font.format("<b/>")}</fonts>'
        '<fills count="2"><fill><patternFill patternType="none"/></fill><fill><patternFill patternType="gray125"/>'
        '</fill></fills><borders count="1"><border><left/><right/><top/><bottom/><diagonal/></border></borders>'
        '<cellStyleXfs count="1"><xf numFmtId="0" fontId="0" fillId="0" borderId="0"/></cellStyleXfs>'
        f'<cellXfs count="{_MAX_DECIMALS + 3}"><xf numFmtId="0" fontId="0" fillId="0" borderId="0" xfId="0"/>{cells}'
        '<xf numFmtId="0" fontId="1" fillId="0" borderId="0" xfId="0" applyFont="1"/></cellXfs>'
        '<cellStyles count="1"><cellStyle name="Normal" xfId="0" builtinId="0"/></cellStyles></styleSheet>'
    )


def _sheet(each: Sheet) -> str:
    rows: list[str] = []

    def add(entries: Sequence[Entry], decimals: Sequence[int | None] = (), style: int = 0) -> None:
        places = [*decimals, *[None] * (len(entries) - len(decimals))]
        at = f"{len(rows) + 1}"
        cells = [
            _cell(f"{_letters(j)}{at}", entry, place, style)
            for j, (entry, place) in enumerate(zip(entries, places, strict=True))
            if entry is not None
        ]
        rows.append(f'<row r="{at}">{"".join(cells)}</row>')

    add([each.caption])
    add(list(each.head), style=_BOLD)
    for row, decimals in zip(each.rows, each.decimals, strict=True):
        add(row, decimals)
    for note in each.notes:
        add([note])
    columns = ""
    for j, name in enumerate(each.head, 1):
        longest = max([len(str(name)), *(len(str(row[j - 1])) for row in each.rows if j <= len(row))])
        columns += f'<col min="{j}" max="{j}" width="{min(max(longest + 2, 8), 60)}" customWidth="1"/>'
    return f'<worksheet xmlns="{_MAIN}"><cols>{columns}</cols><sheetData>{"".join(rows)}</sheetData></worksheet>'


def _cell(at: str, entry: Entry, decimals: int | None, style: int) -> str:
    if isinstance(entry, float):
        chosen = min(decimals, _MAX_DECIMALS) + 1 if decimals is not None else style
        return f'<c r="{at}" s="{chosen}"><v>{entry!r}</v></c>'
    text = escape(_ILLEGAL.sub("", str(entry))[:_LONGEST])
    return f'<c r="{at}" s="{style}" t="inlineStr"><is><t xml:space="preserve">{text}</t></is></c>'


def _letters(index: int) -> str:
    more, last = divmod(index, 26)
    return (_letters(more - 1) if more else "") + "ABCDEFGHIJKLMNOPQRSTUVWXYZ"[last]
