"""A proposed map as a file with comments, for a person to correct."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from errormotion.datasets.files import tomltext
from errormotion.datasets.files.writing import create_bytes, replace_text, writing
from errormotion.datasets.maps.proposal import Proposal
from errormotion.datasets.schemas import RawSchema, Row
from errormotion.errors import DatasetError

_WIDTH = 110
"""Number of characters from which a table has a line for each key."""


def write_map(proposal: Proposal, path: Path, *, overwrite: bool = False) -> None:
    """Write a proposed map with comments: what was recognised, what is open, and what may be added.

    Raises
    ------
    DatasetError
        The file exists, or cannot be written.
    """
    if not proposal.schema:
        reason = "; ".join([*proposal.notes, *(question.text for question in proposal.questions)])
        raise DatasetError(f"{', '.join(map(str, proposal.paths))}: no map can be proposed: {reason}", code="map.none")
    text = text_of(proposal)
    if overwrite:
        replace_text(path, text)
    else:
        if path.exists():
            raise DatasetError(f"{path}: exists; state another file for the map", code="map.exists")
        with writing(path):
            create_bytes(path, text.encode())


def text_of(proposal: Proposal) -> str:
    """Return a proposed map as TOML with comments."""
    content = proposal.map
    files = ", ".join(path.name for path in proposal.paths)
    lines = [f"# Map of {files}: correct what is wrong. What is not stated here is read from the file."]
    for question in proposal.open:
        choices = ", ".join(choice.value for choice in question.choices[:8])
        lines.append(f"# TO STATE {question.key}: {question.text}" + (f" One of {choices}" if choices else ""))
    lines += _lines({key: value for key, value in content.items() if not isinstance(value, (dict, list))})
    for name in ("attributes", "labels", "format", "units"):
        if content.get(name):
            lines += _lines({name: content[name]})
    lines += _columns(content.get("columns", {}))
    lines += _values(proposal)
    for each in content.get("tables", []):
        lines += ["", "[[tables]]", *_lines({k: v for k, v in each.items() if k != "columns"})]
        lines += _columns(each["columns"], "tables.")
    return "\n".join(lines) + "\n"


def _lines(content: Mapping[str, Any]) -> list[str]:
    return [f"{tomltext.key(name)} = {tomltext.value(value)}" for name, value in content.items()]


def _columns(columns: Mapping[str, Any], prefix: str = "") -> list[str]:
    lines = ["", f"[{prefix}columns]"]
    for name, entry in columns.items():
        text = f"{tomltext.key(name)} = {tomltext.value(entry)}"
        if len(text) <= _WIDTH or not isinstance(entry, dict):
            lines.append(text)
        else:
            lines += [f"{tomltext.key(name)}.{tomltext.key(k)} = {tomltext.value(v)}" for k, v in entry.items()]
    return lines


def _values(proposal: Proposal) -> list[str]:
    """Return the values of a map, and as comments those that are open or may be added."""
    raw, stated = proposal.raw, proposal.map.get("values", {})
    if raw is None:
        return []
    columns = {name for part in (proposal.map, *proposal.map.get("tables", [])) for name in part.get("columns", {})}
    needed = {question.key.partition(".")[2] for question in proposal.questions if question.needed}
    lines = []
    for row in (*raw.rows, *raw.stated):
        unit = f", {row.unit}" if row.unit not in ("", "1") else ""
        meaning = f"{row.meaning}{unit}"
        if row.name in stated:
            lines.append(f"{row.name} = {tomltext.value(stated[row.name])}  # {meaning}")
        elif row.name in needed or (row.name not in {*columns, *raw.derived} and _may_be_stated(row, raw)):
            lines.append(f"# {row.name} =   # {'needed: ' if row.name in needed else ''}{meaning}")
    return ["", "[values]", *lines] if lines else []


def _may_be_stated(row: Row, raw: RawSchema) -> bool:
    """Return whether a variable is small enough to be stated in a map: along one dimension of unknown size at most."""
    fixed = {*raw.labels, *raw.sizes}
    return "time" not in row.dims and len(set(row.dims) - fixed) <= 1 and len(row.dims) <= 2
