"""How well the columns of a table fit a raw schema, and which column has which variable."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from errormotion.datasets.maps.columns import DATES, EMPTY, NUMBERS, TEXTS, Content
from errormotion.datasets.maps.form import SEQUENCE
from errormotion.datasets.maps.words import is_clear_way, likeness, tokens, way_of
from errormotion.datasets.schemas import RawSchema, Row
from errormotion.datasets.tables.table import name_of
from errormotion.datasets.text.layout import BACKWARD, FORWARD, targets
from errormotion.datasets.text.table_reader import FREEDOM, Names
from errormotion.datasets.units import convert

_DEVICES = ("sensor", FREEDOM)
"""Dimensions without stated labels that have a column for each label."""
_FREEDOM = re.compile(r"(?<![A-Za-z0-9])E[XYZABC][XYZABCUVW](?![A-Za-z0-9])", re.IGNORECASE)
_NUMBERING = frozenset("nr no number nummer index lfd sweep sample scan zeile row line # id count".split())  # noqa: SIM905
_QUANTITIES = ("temperature", "speed", "pressure", "humidity", "time", "load", "feed")
"""Quantities that a title states on its own."""
ALTERNATING = "alternating"
"""Answer for columns of passes in turn, the first one forward."""
_FEW = 50
"""Number of readings from which their interval is known."""
_CLEAR = 2.0
"""Likeness from which a title states a variable or dimension."""


@dataclass
class Assigned:
    """A column with a variable.

    Attributes
    ----------
    column : Content
    key : str
        Variable, or variable and component: ``distance.X1``.
    labels : dict of str to str or int
        Labels of this one of several columns of the variable.
    minus : Content, optional
        Column that is subtracted.
    sure : bool
        Whether the title states it; else a person is asked.
    """

    column: Content
    key: str
    labels: dict[str, str | int] = field(default_factory=dict)
    minus: Content | None = None
    sure: bool = True

    @property
    def name(self) -> str:
        """The variable."""
        return self.key.partition(".")[0]


@dataclass
class Fit:
    """Columns of one table that have variables of a schema.

    Attributes
    ----------
    raw : RawSchema
    columns : list of Assigned
    labels : dict of str to (Content, dict)
        Column with the labels of a dimension, and names in the dataset by those in the file.
    sequence : Content, optional
        Positions in the order of measurement.
    lacking : list of Row
        Required variables without a column.
    score : float
        The larger the better.
    ways : tuple of str
        Directions of approach of the columns side by side, of which neither titles nor positions state one; empty if
        they are known.
    """

    raw: RawSchema
    columns: list[Assigned] = field(default_factory=list)
    labels: dict[str, tuple[Content, dict[str, str]]] = field(default_factory=dict)
    sequence: Content | None = None
    lacking: list[Row] = field(default_factory=list)
    score: float = 0.0
    ways: tuple[str, ...] = ()

    def copy(self) -> Fit:
        """Return a fit with columns of its own."""
        columns = [replace(each, labels=dict(each.labels)) for each in self.columns]
        return replace(self, columns=columns, labels=dict(self.labels), lacking=list(self.lacking))

    @property
    def used(self) -> set[int]:
        """Indices of the columns with a meaning."""
        found = {place for each in self.columns for place in each.column.places}
        found |= {each.minus.index for each in self.columns if each.minus is not None}
        found |= {column.index for column, _ in self.labels.values()}
        return found | ({self.sequence.index} if self.sequence is not None else set())

    def meanings(self, count: int) -> list[str]:
        """Return what each column of the table is, for people; empty for one that is not used."""
        found = [""] * count
        for dim, (column, _) in self.labels.items():
            found[column.index] = f"labels.{dim}"
        for each in self.columns:
            labels = ", ".join(f"{dim} {label}" for dim, label in each.labels.items())
            for place in each.column.places:
                found[place] = f"{each.key}, {labels}" if labels else each.key
            if each.minus is not None and not found[each.minus.index]:
                found[each.minus.index] = f"subtracted from {each.key}"
        return found

    def keys(self, count: int) -> list[str]:
        """Return the key of each column of the table for which another one can be stated; empty for the others."""
        found = [""] * count
        keys = [each.key for each in self.columns]
        for each in self.columns:
            if keys.count(each.key) == 1 and not each.labels and not each.key.endswith("?"):
                found[each.column.index] = f"columns.{each.key}"
        return found


@dataclass(frozen=True)
class _Schema:
    """A raw schema, seen as columns."""

    raw: RawSchema
    names: Names
    record: tuple[str, ...]
    mains: tuple[Row, ...]

    @classmethod
    def of(cls, raw: RawSchema) -> _Schema | None:
        """Return the schema with the dimensions of its readings; None if it has none that a table could have."""
        free = {row.dims[-1]: () for row in raw.rows if row.dims and row.dims[-1] in _DEVICES}
        names = Names.of([raw], free)
        required = [row for row in raw.rows if row.required and row.name not in raw.derived]
        rows = [row for row in required if names.record_dims(row) and row.name not in row.dims]
        if not rows or all(names.record_dims(row) == ("time",) and row.name == "time" for row in rows):
            rows = [row for row in raw.rows if "time" in row.dims and row.name != "time" and not row.required]
        if raw.marker not in raw.derived:
            rows = [row for row in rows if raw.marker in (row.name, *row.dims)] or rows
        if not rows:
            return None
        record = max((names.record_dims(row) for row in rows), key=len)
        return cls(raw, names, record, tuple(row for row in rows if names.record_dims(row) == record))

    def words(self, name: str) -> tuple[str, ...]:
        short = tuple(alias for alias, full in self.raw.aliases.items() if full == name)
        return (*self.raw.words.get(name, ()), *short)

    def candidates(self) -> list[Row]:
        """Return the variables that a column may have."""
        return [
            row
            for row in self.raw.rows
            if row.name not in (*self.raw.derived, "time")
            and row.dims
            and set(self.names.record_dims(row)) <= set(self.record)
            and self.names.record_dims(row)
        ]


def fit(raw: RawSchema, columns: Sequence[Content]) -> Fit | None:
    """Return the columns of a table as variables of a schema; None if its readings are not among them."""
    schema = _Schema.of(raw)
    if schema is None:
        return None
    found = Fit(raw)
    rest = [column for column in columns if column.kind != EMPTY]
    if not _time(schema, found, rest):
        return None
    _labels(schema, found, rest)
    _titled(schema, found, rest)
    _by_order(schema, found, rest)
    _difference(schema, found, rest)
    if not _layout(schema, found, rest):
        return None
    assigned = {each.name for each in found.columns}
    if raw.derived and not assigned - {"time"}:
        return None
    if not raw.derived and any(row.name not in assigned for row in schema.mains):
        return None
    if not _complete(schema, found):
        return None
    found.lacking = [
        row for row in raw.rows if row.required and row.name not in assigned and row.name not in raw.derived
    ]
    fixed = {*raw.labels, *raw.sizes}
    if any(len(set(row.dims) - fixed) > 1 for row in found.lacking):  # no value that a person could state
        return None
    found.score = _score(schema, found, rest)
    return found


def further(raw: RawSchema, columns: Sequence[Content], wanted: Iterable[str]) -> Fit | None:
    """Return the columns of a second table that have variables which the first table lacks; None if there are none."""
    schema = _Schema.of(raw)
    if schema is None:
        return None
    found, names = Fit(raw), set(wanted)
    rest = [column for column in columns if column.kind != EMPTY]
    if any(row.name == "time" for row in raw.rows):
        _time(schema, found, rest)
    _labels(schema, found, rest)
    _titled(schema, found, list(rest), names)
    return found if {each.name for each in found.columns} - {"time"} else None


def _time(schema: _Schema, found: Fit, rest: list[Content]) -> bool:
    """Assign the column of times; return whether there is one if the schema needs it."""
    rows = [row for row in schema.raw.rows if row.unit == "s" and row.dims and set(row.dims) <= set(schema.record)]
    row = next((row for row in rows if row.name == "time"), None) or next(iter(rows), None)
    if row is None:
        return True
    best = max(rest, key=lambda column: _is_time(column, row), default=None)
    if best is None or _is_time(best, row) <= 0:
        return not (row.required and row.name == "time")
    if row.name != "time" and not row.required and best.kind != DATES and likeness(best.title, row.name) < _CLEAR:
        return True
    rest.remove(best)
    found.columns.append(Assigned(best, row.name))
    if row.name == "time" and len(schema.record) > 1:
        found.labels["time"] = (best, {})
    return True


def _is_time(column: Content, row: Row) -> float:
    if column.kind == DATES:
        return 4.0
    if column.kind != NUMBERS:
        return 0.0
    known = column.values[~np.isnan(column.values)]
    if known.size < 2 or (np.diff(known) < 0).any() or known[0] == known[-1]:
        return 0.0
    unit = 1.0 if column.unit_for(row) else 0.0 if not column.unit else -9.0
    like = max(likeness(column.title, row.name), likeness(column.title, "time"))
    return unit + like if unit > 0 or like >= _CLEAR else 0.0


def _labels(schema: _Schema, found: Fit, rest: list[Content]) -> None:
    """Assign columns with the labels of dimensions."""
    for dim in schema.record:
        if dim in found.labels or dim == "time" or any(row.name == dim for row in schema.raw.rows):
            continue
        able = [
            column
            for column in rest
            if column.kind == TEXTS
            or (
                (column.kind == NUMBERS and column.whole and not column.unit)
                and not (_is_number(column) and dim != schema.record[-1])
            )
        ]
        if dim == "approach":
            ways = next((each for each in map(_ways, rest) if each is not None), None)
            if ways is not None:
                found.labels[dim] = ways
                rest.remove(ways[0])
            continue
        best = max(able, key=lambda column: likeness(column.title, dim, schema.words(dim)), default=None)
        if best is not None and likeness(best.title, dim, schema.words(dim)) >= _CLEAR:
            found.labels[dim] = (best, {})
            rest.remove(best)


def _ways(column: Content) -> tuple[Content, dict[str, str]] | None:
    """Return a column with directions of approach, and their names in the dataset; None for another column."""
    texts = _distinct(column)
    if column.kind == TEXTS:
        names = {text: way_of(text) for text in texts}
    elif column.kind == NUMBERS and not column.unit and likeness(column.title, "approach") >= _CLEAR:
        names = {text: {"1": "forward", "+1": "forward", "-1": "backward"}.get(text, "") for text in texts}
    else:
        return None
    if not names or not all(names.values()):
        return None
    letters = any(text.strip().isalpha() and len(text.strip()) == 1 for text in names)
    stated = likeness(column.title, "approach") >= _CLEAR and not letters
    if len(set(names.values())) < 2 and not stated:  # a Z in all rows may be an axis
        return None
    return column, {text: way for text, way in names.items() if text != way}


def _distinct(column: Content) -> list[str]:
    return list(dict.fromkeys(column.texts))[:1000]


def _titled(schema: _Schema, found: Fit, rest: list[Content], names: set[str] | None = None) -> None:
    """Assign the columns whose titles state a variable, the clearest first."""
    choices: list[tuple[float, int, str, Content]] = []
    for column in rest:
        if column.kind != NUMBERS:
            continue
        for row in schema.candidates():
            if (names is not None and row.name not in names) or not column.may_be(row):
                continue
            for key, score in _keys(schema, row, column):
                choices.append((score, -column.index, key, column))
    for _, _, key, column in sorted(choices, key=lambda each: each[:3], reverse=True):
        if column in rest and all(each.key != key for each in found.columns):
            rest.remove(column)
            found.columns.append(Assigned(column, key, sure=not key.endswith(".?")))


def _keys(schema: _Schema, row: Row, column: Content) -> Iterable[tuple[str, float]]:
    """Yield the keys that a column may have for a variable, with their scores."""
    like = likeness(column.title, row.name, schema.words(row.name))
    unit = 1.0 if column.unit_for(row) else 0.0
    dim = schema.names.component_dim(row)
    if dim is None:
        if like >= _CLEAR or (like > 0 and unit):
            yield row.name, like + unit
        return
    if dim == FREEDOM:
        if match := _FREEDOM.search(column.title):
            yield f"{row.name}.{match[0].upper()}", 3.0 + unit + like
        elif like >= _CLEAR or (like > 0 and unit):
            yield f"{row.name}.?", like + unit
        return
    if dim in _DEVICES:
        # a device of its own for each column: its unit or its name states what it measures
        if (unit and not _is_flag(row)) or like >= _CLEAR:
            yield f"{row.name}.{label_of(column)}", like + 1.2 * unit + (0.5 if row in schema.mains else 0.0)
        return
    own = tokens(column.title)
    for label in schema.names.labels[dim]:
        parts = tokens(label)
        if any(own[k : k + len(parts)] == parts for k in range(len(own))):
            vector = dim == "direction"
            # a lonely X is a coordinate; of several vectors the title names one
            base = 1.0 if vector and len(own) == len(parts) else 2.0 if like > 0 or not vector else 0.0
            if base and (unit or not column.unit):
                yield f"{row.name}.{label}", base + like + unit + (0.5 if row.required else 0.0)


def _is_flag(row: Row) -> bool:
    """Return whether a variable is a pure number, which every column without a unit could be."""
    return row.unit in ("", "1") and not row.units


def _states_another(column: Content, row: Row) -> bool:
    """Return whether the title of a column states a quantity of another kind, where its unit is not known."""
    if column.unit_for(row) or likeness(column.title, row.name) >= _CLEAR:
        return False
    return any(likeness(column.title, name) >= _CLEAR for name in _QUANTITIES)


def label_of(column: Content) -> str:
    """Return the label of a device that has a column of its own: the title without its unit."""
    return re.sub(r"[.\[\]]", " ", name_of(column.title)).strip() or str(column.index + 1)


def _by_order(schema: _Schema, found: Fit, rest: list[Content]) -> None:
    """Assign columns without a clear title to readings of which there are as many as columns."""
    for row in schema.mains:
        if schema.raw.derived or _is_flag(row):
            continue
        dim = schema.names.component_dim(row)
        free = [
            column
            for column in rest
            if column.kind == NUMBERS
            and column.may_be(row)
            and not _is_number(column)
            and not _states_another(column, row)
        ]
        if dim is None or dim in _DEVICES:
            if dim is None and not any(each.name == row.name for each in found.columns) and len(free) == 1:
                if not free[0].unit_for(row):
                    continue
                rest.remove(free[0])
                found.columns.append(Assigned(free[0], row.name))
            elif dim in _DEVICES and dim != FREEDOM and not any(each.name == row.name for each in found.columns):
                for column in free:
                    rest.remove(column)
                    sure = bool(column.unit_for(row))
                    found.columns.append(Assigned(column, f"{row.name}.{label_of(column)}", sure=sure))
            continue
        there = {each.key for each in found.columns if each.name == row.name}
        lacking = [f"{row.name}.{label}" for label in schema.names.labels[dim] if f"{row.name}.{label}" not in there]
        if len(free) > len(lacking):  # those whose titles say more
            free = [column for column in free if likeness(column.title, row.name, schema.words(row.name)) > 0]
        units = {column.unit for column in free} | {each.column.unit for each in found.columns if each.name == row.name}
        if lacking and len(free) == len(lacking) and len(units) == 1:
            for key, column in zip(lacking, free, strict=True):
                rest.remove(column)
                found.columns.append(Assigned(column, key, sure=False))


def _is_number(column: Content) -> bool:
    """Return whether a column numbers the rows."""
    own = tokens(column.title)
    named = any(token in _NUMBERING for token in own) or not own
    values = column.values
    counts = column.whole and values.size > 2 and bool((np.diff(values) == 1).all()) and not column.unit
    return counts and (named or column.index == 0)


def _difference(schema: _Schema, found: Fit, rest: list[Content]) -> None:
    """Assign a deviation as the difference of the actual and the target positions."""
    for row in schema.mains:
        if any(each.name == row.name for each in found.columns) or "deviation" not in row.name.split("_"):
            continue
        numbers = [column for column in rest if column.kind == NUMBERS and column.may_be(row)]
        actual = [column for column in numbers if likeness(column.title, "actual") >= _CLEAR]
        target = next((each.column for each in found.columns if each.name.startswith("target")), None)
        if len(actual) == 1 and target is not None and target.unit == actual[0].unit:
            rest.remove(actual[0])
            key = f"{row.name}.?" if schema.names.component_dim(row) == FREEDOM else row.name
            found.columns.append(Assigned(actual[0], key, minus=target, sure=False))


def _layout(schema: _Schema, found: Fit, rest: list[Content]) -> bool:
    """Assign what states the dimensions of the readings; return whether all of them are known."""
    lacking = [dim for dim in schema.record if dim not in found.labels and dim != "time"]
    if not lacking:
        return True
    for dim in lacking:  # a coordinate of its own, such as an angle, labels its dimension
        own = next((each for each in found.columns if each.key == dim), None)
        if own is not None and len(schema.record) > 1:
            found.labels[dim] = (own.column, {})
    lacking = [dim for dim in lacking if dim not in found.labels]
    if set(SEQUENCE) & set(lacking) and set(SEQUENCE) <= set(schema.record):
        return _runs(schema, found, rest, lacking)
    if len(lacking) > 0 and _wide(schema, found, rest, lacking):
        return True
    return set(lacking) <= {schema.record[-1]}


def _runs(schema: _Schema, found: Fit, rest: list[Content], lacking: Sequence[str]) -> bool:
    """Find run, approach and target of readings from their positions, or from the titles of a matrix."""
    place = next((each for each in found.columns if each.name.startswith("target")), None)
    if place is None:
        return False
    values = place.column.values
    if np.isnan(values).any() or values.size == 0:
        return False
    number = targets(values)
    if len(set(number.tolist())) == values.size:  # a row for each target: columns are runs
        return _matrix(schema, found, rest, place, lacking)
    if set(lacking) == set(SEQUENCE):
        found.sequence = place.column
        return True
    if set(lacking) == {"approach", "target"} and _is_pass_each(found.labels["run"][0].texts, number.tolist()):
        del found.labels["run"]
        found.sequence = place.column
        return True
    if "target" in lacking:  # run and direction have columns of their own
        found.labels["target"] = (place.column, {})
        lacking = [dim for dim in lacking if dim != "target"]
    return not lacking


def _is_pass_each(runs: Sequence[str], number: Sequence[int]) -> bool:
    """Return whether the rows of each run follow one another, and visit at least two targets in one direction."""
    starts = [0, *(k for k in range(1, len(runs)) if runs[k] != runs[k - 1]), len(runs)]
    passes = [number[first:last] for first, last in pairwise(starts)]
    ordered = all(each in (sorted(set(each)), sorted(set(each), reverse=True)) and len(each) > 1 for each in passes)
    return ordered and len(passes) == len(set(runs))


def _matrix(schema: _Schema, found: Fit, rest: list[Content], place: Assigned, lacking: Sequence[str]) -> bool:
    """Assign columns with the readings of one run and direction each, whose titles state both."""
    row = schema.mains[0]
    single = [each for each in found.columns if each.name == row.name]
    able = [each.column for each in single] + [
        column for column in rest if column.kind == NUMBERS and column.may_be(row) and _run_of(column.title)
    ]
    runs = [_run_of(column.title) or {} for column in able]
    if len(able) > 1 and all(runs) and len({tuple(each.items()) for each in runs}) == len(able):
        if not _certain(able, runs):
            if len({each["run"] for each in runs}) < len(able):
                return False
            numbered = sorted(int(each["run"]) for each in runs) == list(range(1, len(runs) + 1))
            found.ways = (FORWARD, BACKWARD, *((ALTERNATING,) if numbered and len(runs) % 2 == 0 else ()))
            runs = [{"run": each["run"], "approach": "?"} for each in runs]
        found.labels["target"] = (place.column, {})
        key = single[0].key if single and single[0].sure else f"{row.name}.?"
        found.columns = [each for each in found.columns if each.name != row.name]
        for column, labels in sorted(zip(able, runs, strict=True), key=lambda each: each[0].index):
            if column in rest:
                rest.remove(column)
            found.columns.append(Assigned(column, key, dict(labels), sure=not key.endswith("?")))
        return True
    if len(single) != 1:
        return False
    steps = np.diff(place.column.values)
    if set(lacking) == set(SEQUENCE) and steps.size and ((steps > 0).all() or (steps < 0).all()):
        found.sequence = place.column  # one run in one direction, which each file of this kind states by itself
        return True
    found.labels["target"] = (place.column, {})
    stated: dict[str, str | int] = {"run": 1, "approach": "?"}
    single[0].labels = {dim: label for dim, label in stated.items() if dim in lacking}
    if "approach" in lacking:
        found.ways = (FORWARD, BACKWARD)
    return True


def _certain(columns: Sequence[Content], runs: Sequence[Mapping[str, str | int]]) -> bool:
    """Return whether the titles of columns state their directions: a run in both, or a word of no other meaning.

    A letter or a sign alone may mean something else: R1 is a first run, and a hyphen separates words.
    """
    if not all("approach" in each for each in runs):
        return False
    pair = len({each["run"] for each in runs}) < len(runs)
    return pair or all(any(map(is_clear_way, tokens(column.title))) for column in columns)


def _run_of(title: str) -> dict[str, str | int] | None:
    """Return run and, if there is one, the approach that a title such as ``Run 2 -`` or ``1 vor`` states."""
    own = tokens(title)
    numbers = [int(token) for token in own if token.isdigit()]
    words = [token for token in own if not token.isdigit()]
    ways = {way for token in words if is_clear_way(token) and (way := way_of(token))}
    ways = ways or {way for token in words if (way := way_of(token))}
    if len(numbers) != 1 or len(ways) > 1:
        return None
    return {"run": numbers[0]} | ({"approach": ways.pop()} if ways else {})


def approached(found: Fit, answer: str) -> None:
    """Set the directions of approach of columns by an answer: one of ``found.ways``."""
    for each in found.columns:
        if each.labels.get("approach") != "?":
            continue
        each.labels["approach"] = answer
        if answer == ALTERNATING:
            number = int(each.labels["run"])
            each.labels |= {"run": (number + 1) // 2, "approach": FORWARD if number % 2 else BACKWARD}


def _wide(schema: _Schema, found: Fit, rest: list[Content], lacking: Sequence[str]) -> bool:
    """Assign a column for each label of one dimension of readings, such as a station."""
    row = schema.mains[0]
    if len(schema.mains) > 1 or schema.names.component_dim(row) is not None or len(schema.record) != 2:
        return False
    other = [dim for dim in schema.record if dim in found.labels]
    dim = next((each for each in lacking if each not in other), "")
    able = [each.column for each in found.columns if each.name == row.name]
    able += [column for column in rest if column.kind == NUMBERS and column.may_be(row) and not _is_number(column)]
    if not dim or len(able) < 2 or len(lacking) > 1:
        return False
    found.columns = [each for each in found.columns if each.name != row.name]
    for column in sorted(able, key=lambda each: each.index):
        if column in rest:
            rest.remove(column)
        found.columns.append(Assigned(column, row.name, {dim: label_of(column)}, sure=bool(column.unit_for(row))))
    return True


def _complete(schema: _Schema, found: Fit) -> bool:
    """Return whether vectors have all their components; those of optional variables that have not are left out."""
    for row in schema.candidates():
        dim = schema.names.component_dim(row)
        if dim is None or dim in _DEVICES:
            continue
        there = {each.key for each in found.columns if each.name == row.name}
        if there and len(there) < len(schema.names.labels[dim]):
            if row in schema.mains:
                return False
            found.columns = [each for each in found.columns if each.name != row.name]
    return True


def _interval(schema: _Schema, found: Fit) -> float:
    """Return the usual interval between two readings, s; 0 if it is not known."""
    time = next((each.column for each in found.columns if each.key == "time"), None)
    row = next((row for row in schema.raw.rows if row.name == "time"), None)
    if time is None or row is None:
        return 0.0
    if time.kind == DATES:
        values = time.seconds(time.dates[0], _FEW)
    else:
        unit = time.unit_for(row)
        values = np.asarray(convert(time.values[:_FEW], unit or "s", "s"))
    steps = np.diff(values)
    return float(np.median(steps)) if steps.size and (time.kind == DATES or time.unit) else 0.0


def _score(schema: _Schema, found: Fit, rest: Sequence[Content]) -> float:
    score = 0.0 if schema.raw.derived else 2.0 * len(schema.mains)  # a log may be of anything
    # as many columns as the schema has channels are no accident
    score += sum(2.0 for row in schema.mains if schema.names.component_dim(row) not in (None, "direction", *_DEVICES))
    for each in found.columns:
        row: Any = next(row for row in schema.raw.rows if row.name == each.name)
        like = likeness(each.column.title, each.name, schema.words(each.name))
        score += (1.0 if each.sure else 0.5) + like / 3
        score += 0.5 if each.column.kind == DATES or each.column.unit_for(row) else 0.0
    score += len(found.labels)
    score -= 1.0 * sum(column.kind == NUMBERS and not _is_number(column) for column in rest)
    if _interval(schema, found) > schema.raw.longest_interval:
        score -= 2.0
    score -= 0.5 * sum(column.kind == TEXTS for column in rest)
    table = sum(bool(set(schema.names.record_dims(row)) & set(schema.record)) for row in found.lacking)
    return score - 2.0 * table - 0.1 * len(found.lacking)
