"""The reference page of the schemas agrees with the validator."""

import math
import re
from pathlib import Path

import pytest

from errormotion.compare.result import REPEATS, TABLE
from errormotion.datasets.calibrations import inclination as calibration
from errormotion.datasets.certificates import ITEMS
from errormotion.datasets.maps.form import MapColumn, MapFile
from errormotion.datasets.schemas import ERROR_ATTRIBUTES, ERROR_ROWS, RawSchema, Row, raw_schemas
from errormotion.datasets.text.log_map import MappedLabels, MappedValue
from errormotion.methods.spindle_drift.log_import.import_map import (
    Channel,
    Format,
    ImportMap,
    SpeedColumn,
    TimeColumn,
)

RAW_SCHEMAS = raw_schemas()
DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "reference" / "schemas.md").read_text()


def line(row: Row) -> str:
    dims = ", ".join(row.dims).replace("|", " or ")
    limits = "" if math.isinf(row.low) else f"{row.low:.6g} to {row.high:.6g}"
    return f"| `{row.name}` | {dims} | {row.unit} | {'yes' if row.required else 'no'} | {limits} | {row.meaning} |"


def rows_of(text: str) -> list[str]:
    return [found for found in text.splitlines() if found.startswith("| `") and found.count("|") == 7]


def test_the_table_of_errors_is_the_schema() -> None:
    section = PAGE.partition("\n## Error dataset")[2].partition("\n## Raw datasets")[0]
    assert rows_of(section) == [line(row) for row in ERROR_ROWS]


@pytest.mark.parametrize("raw", RAW_SCHEMAS, ids=lambda raw: raw.title)
def test_the_table_of_each_raw_dataset_is_the_schema(raw: RawSchema) -> None:
    sections = PAGE.partition("\n## Raw datasets")[2].partition("\n## Files")[0].split("\n### ")[1:]
    assert len(sections) == len(RAW_SCHEMAS)
    of_schema = [section for section in sections if f"`{raw.id}`" in section]
    assert [line(row) for row in raw.rows] in [rows_of(section) for section in of_schema]


def test_the_table_of_comparisons_is_the_schema() -> None:
    section = PAGE.partition("\n## Comparison")[2].partition("\n## ")[0]
    rows = [row for row in section.splitlines() if row.startswith("| `")]
    assert rows == [f"| `{name}` | {', '.join(dims)} | {meaning} |" for name, (dims, meaning) in TABLE.items()]


def test_the_table_of_repeats_is_the_schema() -> None:
    section = PAGE.partition("\n## Repeats in a comparison")[2].partition("\n## ")[0]
    rows = [row for row in section.splitlines() if row.startswith("| `")]
    assert rows == [f"| `{name}` | {', '.join(dims)} | {meaning} |" for name, (dims, meaning) in REPEATS.items()]


def test_the_table_of_calibrations_is_the_schema() -> None:
    section = PAGE.partition("\n## Inclination calibration")[2].partition("\n## ")[0]
    assert rows_of(section) == [line(row) for row in calibration.ROWS]
    for name, meaning in calibration.ATTRIBUTES.items():
        assert f"| `{name}` | {meaning} |" in section


def test_the_reference_names_every_key_of_a_map() -> None:
    page = (DOCS / "reference" / "import-maps.md").read_text()
    reported = set(re.findall(r"[`.]([a-z_]+)`", page))
    for table in (MapFile, MapColumn, MappedLabels, MappedValue, ImportMap, Format, TimeColumn, Channel, SpeedColumn):
        keys = {field.alias or name for name, field in table.model_fields.items()}
        assert (
            keys - {"format", "time", "channels", "temperatures", "spindle_speed", "columns", "units", "values"}
            <= reported
        )


def test_the_table_of_attributes_is_the_schema() -> None:
    for name, meaning in ERROR_ATTRIBUTES.items():
        assert f"| `{name}` | {meaning} |" in PAGE


def test_the_table_of_certificates_is_the_list_of_items() -> None:
    section = (DOCS / "reference" / "files.md").read_text().partition("### Certificates")[2].partition("\n### ")[0]
    named = [
        item
        for row in section.splitlines()
        if row.startswith("| `")
        for item in re.findall(r"`(\w+)`", row[: row.index("|", 2)])
    ]
    assert sorted(named) == sorted(ITEMS)
