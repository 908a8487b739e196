"""What a file does not say, as questions with choices and proposals."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from errormotion.datasets.files.tomlfile import check
from errormotion.datasets.files.tomltext import value_of
from errormotion.datasets.maps.columns import DATES, Content
from errormotion.datasets.maps.fit import ALTERNATING, Assigned, Fit, label_of
from errormotion.datasets.maps.units import fitting_unit
from errormotion.datasets.maps.words import is_positioning, likeness, states_other_errors, tokens
from errormotion.datasets.schemas import POSITION, RawSchema, Row
from errormotion.datasets.tables.dates import COUNTED, EXCEL, UNIX, UNIX_MS, Clock
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.table import name_of, same
from errormotion.datasets.text.log_import import read_value
from errormotion.datasets.text.log_map import MappedValue
from errormotion.datasets.text.table_reader import Found, Names
from errormotion.errors import DatasetError
from errormotion.kinematics.iso import DOF

APPROACH = "labels.approach"
"""Key of the question for the direction of approach."""
UNITS = {
    "m": ("mm", "um", "nm", "m", "inch"),
    "rad": ("arcsec", "deg", "um/m", "mrad", "urad", "rad"),
    "s": ("s", "min", "h", "ms", UNIX, UNIX_MS, EXCEL),
    "1/min": ("/min", "/s"),
    "degC": ("degC", "degF", "K"),
    "Pa": ("hPa", "Pa", "kPa"),
    "m/s": ("mm/min", "m/min", "mm/s", "m/s"),
    "K": ("K",),
}
"""Choices of units, by the unit of the schema."""
_STATED = re.compile(r"\W*([^:=;\t]{1,40}?)\s*[:=;\t]\s*([+-]?[0-9][0-9.,eE+-]*\s*[^\s;,]{0,8})")


@dataclass(frozen=True)
class Choice:
    """An answer: ``value`` as it stands in the map, and ``text`` for people."""

    value: str
    text: str


@dataclass(frozen=True)
class Question:
    """What a file does not say.

    Attributes
    ----------
    key : str
        Key of the map that the answer sets, such as ``units.distance``.
    text : str
        One sentence.
    choices : tuple of Choice
        None: a free text, such as ``5 mm``.
    proposed : str
        What is taken without a person; empty if nothing can be proposed.
    needed : bool
        Whether there is no dataset without an answer.
    earlier : str
        What holds for an earlier file: a default for people, who know whether it holds again. It is never taken without
        a person.
    """

    key: str
    text: str
    choices: tuple[Choice, ...]
    proposed: str
    needed: bool
    earlier: str = ""


def questions_of(
    parts: Sequence[Fit], answers: Mapping[str, str], new: set[str], above: Sequence[str]
) -> list[Question]:
    """Return the questions that the columns of all parts leave open, with those that are answered.

    Parameters
    ----------
    parts : sequence of Fit
        The readings first.
    answers : mapping of str to str
        By key.
    new : set of str
        Keys of the answers that are to be checked.
    above : sequence of str
        Lines above the tables, and names of files, in which values may stand.

    Raises
    ------
    DatasetError
        An answer is wrong.
    """
    main = parts[0]
    found = [*_columns(main), *_approach(main), *_attributes(main, above, answers)]
    axis = answers.get("attributes.axis") or next((q.proposed for q in found if q.key == "attributes.axis"), "")
    if axis or "axis" not in main.raw.attributes:  # else asked when the axis is known
        found += _freedoms(parts, axis, above)
    for part in parts:
        found += [question for question in _units(part, answers) if question.key not in {each.key for each in found}]
    found += _values(main, above)
    found.append(Question("machine", "Name of the machine", (), _machine(above), False))
    for question in found:
        if question.key in new:
            _check(question, answers[question.key], main)
    rows = {row.name for row in (*main.raw.rows, *main.raw.stated)}
    for key in new - {each.key for each in found}:
        if key.startswith("values.") and key.partition(".")[2] in rows:
            _check(Question(key, "", (), "", False), answers[key], main)
    return found


def _columns(main: Fit) -> list[Question]:
    """Return the questions for the columns that were assigned by their order."""
    found = []
    able = [each.column for each in main.columns if each.column.kind != DATES]
    choices = tuple(Choice(place_of(column), _shown(column)) for column in able)
    for each in main.columns:
        free = each.key.endswith(f".{label_of(each.column)}")
        if each.sure or each.key.endswith(".?") or each.labels or free:
            continue
        text = f"Which column is {each.key.replace('.', ' ')}?"
        found.append(Question(f"columns.{each.key}", text, choices, place_of(each.column), True))
    return found


def _approach(main: Fit) -> list[Question]:
    """Return the question in which direction the targets were approached, if neither titles nor positions state it."""
    if not main.ways:
        return []
    titles = [each.column.title for each in main.columns if "approach" in each.labels]
    texts = {ALTERNATING: "in turn: 1 forward, 2 backward, 3 forward, and so on"}
    choices = tuple(Choice(way, texts.get(way, f"{way} in all of them")) for way in main.ways)
    listed = ", ".join(f"'{title}'" for title in titles)
    return [Question(APPROACH, f"In which direction were the targets approached in {listed}?", choices, "", True)]


def place_of(column: Content) -> str:
    """Return the name of a column, or its number where that is not unique."""
    titles = [same(title) for title in column.table.titles]
    title = same(column.title)
    return (
        str(column.index + 1) if column.table.form.header is False or titles.count(title) != 1 or not title else title
    )


def is_column(answer: str, column: Content) -> bool:
    """Return whether an answer is the name of a column, with or without its unit, or its number."""
    title = same(column.title)
    return same(answer) in (title, name_of(title), str(column.index + 1))


def _shown(column: Content) -> str:
    first = next((text for text in column.texts if text), "")
    return f"{column.title} ({first}, ...)"


def _attributes(main: Fit, above: Sequence[str], answers: Mapping[str, str]) -> list[Question]:
    found = []
    for name, allowed in main.raw.attributes.items():
        proposed = _attribute(name, allowed, main, above) if not answers.get(f"attributes.{name}") else ""
        choices = tuple(Choice(each, each) for each in allowed)
        found.append(Question(f"attributes.{name}", f"Which {name} was measured?", choices, proposed, True))
    return found


def _attribute(name: str, allowed: Sequence[str], main: Fit, above: Sequence[str]) -> str:
    """Return the value of an attribute that a freedom, a title or a line of the file states; empty if none does.

    A line with another letter of these leaves it open: a second axis may be the measured one.
    """
    words = {name.lower(), *(("achse", "axis") if name == "axis" else ())}
    found = [each.key[-1] for each in main.columns if re.search(r"\.E[XYZABC][XYZABC]$", each.key)]
    scalars = [each for each in main.columns if each.name.startswith("target") and "." not in each.key]
    for each in scalars:  # the position of an axis names it: Pos. X
        found += [value for value in allowed if value.lower() in tokens(each.column.title)]
    lines_of_no_value = [line for line in above if not _STATED.match(line)]  # Y-Achse: 200 mm is a place
    for text in (*lines_of_no_value, *(each.column.title for each in main.columns)):
        own = tokens(text)
        for value in allowed:
            sign = value.lower()
            forms = [form for word in words for form in ((word, sign), (sign, word), (sign, "-", word))]
            beside = any(own[k : k + len(form)] == form for k in range(len(own)) for form in forms)
            joined = any(token in (sign + word, word + sign) for token in own for word in words)
            if beside or joined:
                found.append(value)
    letters = {value.lower(): value for value in allowed if len(value) == 1}
    lines = [re.sub(r"°\s*[CF]\b", "", line) for line in above]
    found += [letters[token] for line in lines for token in tokens(line) if found and token in letters]
    known = [value for value in dict.fromkeys(found) if value in allowed]
    return known[0] if len(known) == 1 else ""


def _freedoms(parts: Sequence[Fit], axis: str, above: Sequence[str]) -> list[Question]:
    """Return the question which error a deviation is, where its title does not state it.

    That along the axis itself is proposed only if no title or line above states another axis or quantity.
    """
    for part in parts:
        each = next((each for each in part.columns if each.key.endswith(".?")), None)
        if each is None:
            continue
        row = next(row for row in part.raw.rows if row.name == each.name)
        lengths, angles = (bool(fitting_unit(each.column.unit, row, kind)) for kind in ("EX", "EA"))
        letter = axis or "X"
        dofs = [dof for dof in DOF if not each.column.unit or (lengths if dof[1] in "XYZ" else angles)]
        own = f"E{letter}{letter}"
        titles = [one.column.title for one in part.columns if one.key.endswith(".?")]
        plain = all(is_positioning(title, axis) for title in titles) and not any(map(states_other_errors, above))
        proposed = own if axis in tuple("XYZ") and own[:2] in dofs and plain else ""
        text = {"EX": "displacement along X", "EY": "displacement along Y", "EZ": "displacement along Z"}
        text |= {"EA": "rotation about X", "EB": "rotation about Y", "EC": "rotation about Z"}
        choices = tuple(Choice(dof + letter, f"{dof}{letter}: {text[dof]}") for dof in dofs)
        ask = f"Which error is in column '{each.column.title}'?"
        return [Question(f"columns.{each.name}", ask, choices, proposed, True)]
    return []


def _units(part: Fit, answers: Mapping[str, str]) -> list[Question]:
    found: dict[str, Question] = {}
    for each in part.columns:
        row = next(row for row in part.raw.rows if row.name == each.name)
        key = f"units.{each.name}"
        if key in found or each.minus is not None:  # a difference has the unit of both columns
            continue
        title = f"column '{each.column.title}'"
        if each.column.kind == DATES:
            if len(each.column.dates) > 1:
                first = next(text for text in each.column.texts if text)
                choices = tuple(Choice(unit, f"{unit}: {_read(first, unit)}") for unit in each.column.dates)
                text = f"What is the order of day and month in {title}, such as {first}?"
                found[key] = Question(key, text, choices, _order(each.column), True)
            continue
        if row.unit in ("", "1") and not row.units:
            continue
        freedom = _freedom(each, answers)
        if each.column.unit_for(row, freedom):
            continue
        kinds = row.units or (row.unit,)
        if freedom[:2] in DOF:
            kinds = ("m",) if freedom[1] in "XYZ" else ("rad",)
        units = [unit for kind in kinds for unit in UNITS.get(kind, (kind,))]
        choices = tuple(Choice(unit, _in(each.column, unit)) for unit in units)
        columns = [one.column for one in part.columns if one.name == each.name and one.minus is None]
        open_ = [column for column in columns if not column.unit_for(row)]
        if len(open_) > 1:
            title = "each of the columns " + ", ".join(f"'{column.title}'" for column in open_)
        same_units = len(open_) == len(columns)  # else the unit beside it may be meant, or not
        proposed = _unit(each.column, row) if same_units else ""
        found[key] = Question(key, f"Which unit has {title}?", choices, proposed, True)
    return list(found.values())


def _freedom(each: Assigned, answers: Mapping[str, str]) -> str:
    _, _, label = each.key.partition(".")
    return answers.get(f"columns.{each.name}", "") if label == "?" else label


def _read(text: str, unit: str) -> str:
    clock = Clock(unit)
    with suppress(ValueError):
        clock.seconds(text)
    return clock.start.strftime("%d %B %Y") if clock.start else text


def _order(column: Content) -> str:
    """Return the order of day and month with which the times of a column increase in short steps; empty for both."""
    if all("." in unit for unit in column.dates):
        return column.dates[0]
    able = []
    for unit in column.dates:
        steps = np.diff(column.seconds(unit, 2000))
        if (steps >= 0).all() and (not steps.size or steps.max() < 20 * 86400):
            able.append(unit)
    return able[0] if len(able) == 1 else ""


def _in(column: Content, unit: str) -> str:
    if unit in COUNTED:
        return unit
    known = column.values[~np.isnan(column.values)]
    return f"{unit}: up to {np.abs(known).max():.6g} {unit}" if known.size else unit


def _unit(column: Content, row: Row) -> str:
    """Return the only plausible unit of numbers; empty if there are several."""
    known = column.values[~np.isnan(column.values)]
    if not known.size:
        return ""
    low, high = float(known.min()), float(known.max())
    if row.unit == "degC":
        return "degC" if low > -60 and high < 50 else ""  # above, a room in degF reads alike
    if row.unit == "m" and (row.low, row.high) == POSITION:
        return "mm" if 10 <= max(-low, high) <= 20000 else ""
    if row.unit == "s":
        year = {EXCEL: (36526, 73050), UNIX: (9.4e8, 4.2e9), UNIX_MS: (9.4e11, 4.2e12)}
        return next((unit for unit, (first, last) in year.items() if first < low and high < last), "")
    if row.unit == "1/min":
        return "/min"
    return ""


def _values(main: Fit, above: Sequence[str]) -> list[Question]:
    found = []
    rows = [*main.lacking, *(row for row in main.raw.rows if row.name in main.raw.asked)]
    assigned = {each.name for each in main.columns}
    decimal = main.columns[0].column.table.form.decimal
    for row in rows:
        if row.name in assigned:
            continue
        unit = f", with its unit, such as {_example(row, main.raw)}" if row.unit not in ("", "1") else ""
        dims = f" ({', '.join(row.dims)})" if row.dims else ""
        text = f"{row.name}{dims}: {row.meaning}{unit}"
        found.append(Question(f"values.{row.name}", text, (), _stated(row, above, decimal), row.required))
    return found


def _example(row: Row, raw: RawSchema) -> str:
    unit = UNITS.get(row.unit, (row.unit,))[0]
    if not row.dims:
        return f"'{0.3 if row.high <= 1e-3 else 5} {'um' if unit == 'mm' and row.high <= 1e-3 else unit}'"
    counts = [len(raw.labels.get(dim, ())) or raw.sizes.get(dim, 2) for dim in row.dims]
    each = " ".join("0" for _ in range(counts[-1])) + f" {unit}"
    return f"'{each}'" if len(counts) == 1 else "[" + ", ".join([f"'{each}'"] * min(counts[0], 5)) + "]"


def _stated(row: Row, above: Sequence[str], decimal: str) -> str:
    """Return the value of a variable with its unit in the lines above the table; empty if there is none."""
    if row.dims or row.unit in ("", "1"):
        return ""
    for line in above:
        match = _STATED.match(line)
        if match and likeness(match[1], row.name) >= 2.0:
            found = re.match(r"[+-]?[0-9.,eE+-]*[0-9.]", match[2])
            number = _plain(found[0], decimal) if found else ""
            unit = fitting_unit(match[2][found.end() :].strip(), row) if found else ""
            if number and unit:
                return f"{number} {unit}"
    return ""


def _plain(text: str, decimal: str) -> str:
    """Return a number with a point as decimal sign; empty if its sign may separate thousands.

    The decimal sign of the table is that of the lines above it; another one is none if three digits follow it.
    """
    signs = re.findall("[.,]", text)
    if len(signs) > 1:
        return ""
    if signs and signs[0] != decimal and re.fullmatch(r"[+-]?[1-9][0-9]{0,2}[.,][0-9]{3}", text):
        return ""
    return text.replace(",", ".")


def _machine(above: Sequence[str]) -> str:
    for line in above:
        match = re.match(r"\W*(?:machine|maschine)(?:\s*name)?\s*[:=;\t]\s*([^;\t\"]{1,60})", line, re.IGNORECASE)
        if match:
            return match[1].strip()
    return ""


def _check(question: Question, answer: str, main: Fit) -> None:
    """Raise DatasetError if an answer is none of the choices, or no value of its kind."""
    if not answer and not question.needed:
        return
    raw = main.raw
    if question.key.startswith("values."):
        name = question.key.partition(".")[2]
        table = main.columns[0].column.table
        mistakes = Mistakes(table.path)
        names = Names.of([raw])
        rows = {**{row.name: row for row in raw.stated}, **names.rows}
        value = value_of(answer)
        content = value if isinstance(value, dict) else {"value": value}
        entry, wrong = check(content, MappedValue, prefix=("values", name), edge=False)
        if entry is None:
            raise DatasetError("; ".join(wrong), code="map.answer")
        read_value(name, entry, table, replace(names, rows=rows), Found(), mistakes)
        if mistakes.count:
            raise DatasetError(f"{question.key}: {mistakes.first.removeprefix(f'values.{name}: ')}", code="map.answer")
        return
    values = [choice.value for choice in question.choices]
    known = not values or answer in values
    if question.key.startswith("units."):
        row = next(row for row in raw.rows if row.name == question.key.partition(".")[2].partition(".")[0])
        known |= bool(fitting_unit(answer, row))
    elif question.key.startswith("columns."):
        known |= any(is_column(answer, each.column) for each in main.columns)
    if known:
        return
    raise DatasetError(
        f"{question.key}: expected {'one of ' + ', '.join(values) if values else 'an answer'}; found '{answer}'",
        code="map.answer",
    )
