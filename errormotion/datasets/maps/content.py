"""The map of recognised columns as data, in its short form."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from errormotion.datasets.files.tomltext import value_of
from errormotion.datasets.maps.columns import Content
from errormotion.datasets.maps.fit import Assigned, Fit
from errormotion.datasets.maps.form import MAP_SCHEMA
from errormotion.datasets.maps.questions import Question, place_of
from errormotion.datasets.schemas import variants
from errormotion.datasets.tables.table import same
from errormotion.datasets.text.table_reader import FREEDOM

_NO_TEXTS = ("header", "skip", "missing")


def map_of(
    parts: Sequence[Fit],
    answers: Mapping[str, str],
    questions: Sequence[Question],
    kind: str,
    form: Mapping[str, str],
) -> dict[str, Any]:
    """Return ``errormotion.map/2`` of recognised columns, with the answers, and the proposals for open questions.

    Parameters
    ----------
    parts : sequence of Fit
        The readings first.
    answers : mapping of str to str
        By the keys of questions.
    questions : sequence of Question
        Those without an answer.
    kind : str
        Identity of the columns of the files.
    form : mapping of str to str
        Answers about the format.
    """
    given = {each.key: each.proposed for each in questions if each.proposed} | {k: v for k, v in answers.items() if v}
    raw = parts[0].raw
    found: dict[str, Any] = {"schema": MAP_SCHEMA, "raw": raw.id}
    if len(variants(raw.id)) > 1:
        found["variant"] = raw.variant
    if given.get("machine"):
        found["machine"] = given["machine"]
    rows = {row.name for row in (*raw.rows, *raw.stated)}
    attributes = {key.partition(".")[2]: text for key, text in given.items() if key.startswith("attributes.")}
    if attributes := {name: text for name, text in attributes.items() if name in raw.attributes}:
        found["attributes"] = attributes
    tables = [part.columns[0].column.table for part in parts]
    paths = list(dict.fromkeys(table.path for table in tables))
    shared = [table.path for table in tables]
    described = []
    for part, table in zip(parts, tables, strict=True):
        own: dict[str, Any] = {}
        if len(paths) > 1 and (pattern := _pattern(table.path.name, [path.name for path in paths])):
            own["file"] = pattern
        stated = format_of(form)
        if table.form.sheet and (shared.count(table.path) > 1 or len(parts) > 1):
            stated["sheet"] = table.form.sheet
        if stated:
            own["format"] = stated
        described.append(own | _part(part, given))
    found |= described[0]
    values = {
        name: value_of(text)
        for key, text in given.items()
        if key.startswith("values.") and (name := key.partition(".")[2]) in rows
    }
    if values:
        found["values"] = values
    if len(described) > 1:
        found["tables"] = described[1:]
    if kind:
        found["kind"] = kind
    return found


def format_of(form: Mapping[str, str]) -> dict[str, Any]:
    """Return answers about the format as data: those that are no texts are values in TOML."""
    return {key: value_of(text) if key in _NO_TEXTS else text for key, text in form.items()}


def _part(part: Fit, given: Mapping[str, str]) -> dict[str, Any]:
    """Return what a map states of one table."""
    own: dict[str, Any] = {}
    if part.sequence is not None:
        own["sequence"] = _place(part.sequence)
    if part.labels:
        own["labels"] = {
            dim: {"column": _place(column), "names": names} if names else _place(column)
            for dim, (column, names) in part.labels.items()
        }
    groups: dict[str, list[Assigned]] = {}
    for each in part.columns:
        groups.setdefault(each.name, []).append(each)
    own["columns"] = {name: _entry(name, group, part, given) for name, group in groups.items()}
    rows = {row.name: row for row in part.raw.rows}
    units = {}
    for name, group in groups.items():
        stated = given.get(f"units.{name}", "")
        if group[0].minus is not None and not stated:  # the unit of the column that is subtracted
            other = next((each.name for each in part.columns if each.column.index == group[0].minus.index), "")
            stated = given.get(f"units.{other}", "")
        open_ = any(len(each.column.dates) > 1 or not each.column.unit_for(rows[name]) for each in group)
        if stated and open_:  # of the columns without a unit of their own
            units[name] = stated
    if units:
        own["units"] = units
    return own


def _entry(name: str, group: Sequence[Assigned], part: Fit, given: Mapping[str, str]) -> Any:
    """Return the columns of a variable in their shortest form."""
    label = group[0].key.partition(".")[2]
    if label == "?":
        label = given.get(f"columns.{name}", "?")
    if group[0].labels:
        dims = list(group[0].labels)
        row = next(row for row in part.raw.rows if row.name == name)
        if not label and len(dims) == 1 and len({each.labels[dims[0]] for each in group}) == len(group):
            return {dims[0]: {str(each.labels[dims[0]]): _place(each.column) for each in group}}
        matrix = {
            "columns": [_place(each.column) for each in group],
            "labels": {dim: [each.labels[dim] for each in group] for dim in dims},
        }
        return {label: matrix} if label and FREEDOM in row.dims else matrix
    if not label:
        return _single(group[0])
    components = {label if each.key.endswith("?") else each.key.partition(".")[2]: _single(each) for each in group}
    # A list has the order of the labels that the schema states, or its names are the labels.
    row = next(row for row in part.raw.rows if row.name == name)
    fixed = next((part.raw.labels[dim] for dim in reversed(row.dims) if dim in part.raw.labels), None)
    if fixed is None and components == {key: key for key in components}:
        return list(components)
    if fixed == ("x", "y", "z") and set(components) == set(fixed):
        return [components[label] for label in fixed]
    return components


def _single(each: Assigned) -> Any:
    place: Any = [_place_of(each.column, k) for k in each.column.places]
    place = place[0] if len(place) == 1 else place
    return {"column": place, "minus": _place(each.minus)} if each.minus is not None else place


def _place(column: Content) -> str | int:
    return _place_of(column, column.index)


def _place_of(column: Content, index: int) -> str | int:
    own = Content(column.table, (index,), column.kind)
    text = place_of(own)
    return text if text == same(own.title) and column.table.form.header is not False else int(text)


def _pattern(name: str, others: Sequence[str]) -> str:
    """Return a pattern for the name of a file: what is before its digits; empty if it fits other files as well."""
    head = re.split(r"[0-9]", name.partition(".")[0])[0].rstrip("_- ")
    fitting = [other for other in others if other.lower().startswith(head.lower())]
    return f"{head}*" if head and len(fitting) == 1 else name if others.count(name) == 1 else ""
