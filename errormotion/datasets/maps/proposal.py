"""A proposed map of files: the tables as they were recognised, their columns as variables, and what has to be asked."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from errormotion import plugins
from errormotion.datasets.files.tomlfile import check, nearest
from errormotion.datasets.maps.columns import Content, contents
from errormotion.datasets.maps.content import format_of, map_of
from errormotion.datasets.maps.fit import Fit, approached, fit, further
from errormotion.datasets.maps.questions import APPROACH, Choice, Question, is_column, place_of, questions_of
from errormotion.datasets.maps.reading import kind_of
from errormotion.datasets.schemas import RawSchema, raw_schemas
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.reading import read_tables
from errormotion.datasets.tables.table import Table
from errormotion.errors import DatasetError
from errormotion.kinematics.iso import DOF

__all__ = ["Choice", "Preview", "Proposal", "Question", "propose"]

MAX_COLUMNS = 1000
"""Largest number of columns of which a map is proposed."""
_ROWS = 8
"""Number of rows of a preview."""
_NONE: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Preview:
    """A table as it was recognised.

    Attributes
    ----------
    path : Path
    sheet : str
        Sheet of a spreadsheet; empty for other files.
    titles, units, meanings : tuple of str
        Of each column; empty for no unit in the file, and for a column that is not used.
    keys : tuple of str
        Of each column, the key of the answer that states another column instead; empty where none can be stated.
    rows : tuple of tuple of str
        The first rows.
    count : int
        Number of rows.
    format : mapping of str to str
        What was recognised: encoding, delimiter, decimal sign.
    notes : tuple of str
    """

    path: Path
    sheet: str
    titles: tuple[str, ...]
    units: tuple[str, ...]
    meanings: tuple[str, ...]
    keys: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    count: int
    format: Mapping[str, str]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Proposal:
    """A proposed map.

    Attributes
    ----------
    paths : tuple of Path
    schema, variant : str
        Raw schema of the dataset; empty if none fits.
    candidates : tuple of Choice
        Schemas that fit, the best first.
    tables : tuple of Preview
    map : mapping
        ``errormotion.map/2`` as data, with all proposals and answers.
    questions : tuple of Question
        Those without an answer, in the order in which to ask them.
    notes : tuple of str
        What was left out, and why.
    """

    paths: tuple[Path, ...]
    schema: str
    variant: str
    candidates: tuple[Choice, ...]
    tables: tuple[Preview, ...]
    map: Mapping[str, Any]
    questions: tuple[Question, ...]
    notes: tuple[str, ...]
    _state: _State = field(repr=False)

    @property
    def open(self) -> tuple[Question, ...]:
        """The questions without whose answers nothing can be imported, and for which nothing can be proposed."""
        return tuple(each for each in self.questions if each.needed and not each.proposed)

    @property
    def raw(self) -> RawSchema | None:
        """The raw schema."""
        return self._state.chosen

    def answered(self, answers: Mapping[str, str]) -> Proposal:
        """Return the proposal with further answers, by the keys of the questions.

        Raises
        ------
        DatasetError
            An answer is none of the choices, or no value of its kind; there is no such key.
        """
        return _proposal(replace(self._state, answers={**self._state.answers, **answers}), set(answers))


@dataclass(frozen=True)
class _State:
    paths: tuple[Path, ...]
    schemas: tuple[RawSchema, ...]
    answers: Mapping[str, str]
    columns: tuple[tuple[Content, ...], ...] = ()
    counts: tuple[int, ...] = ()
    form: Mapping[str, str] = field(default_factory=dict)
    chosen: RawSchema | None = None
    checked: str = ""
    fits: tuple[tuple[Fit, int], ...] | None = None


def propose(
    paths: Sequence[Path], schemas: Sequence[RawSchema] = (), *, answers: Mapping[str, str] = _NONE
) -> Proposal:
    """Return a proposed map of files.

    Parameters
    ----------
    paths : sequence of Path
        The files of one dataset.
    schemas : sequence of RawSchema, optional
        Schemas that the dataset may have; default: those of all plugins.
    answers : mapping of str to str, optional
        Answers that are known, by the keys of questions, such as ``values.bar_radius``. Those that only other schemas
        have are ignored.

    Raises
    ------
    DatasetError
        A file cannot be read, or has no table of numbers; an answer is wrong, or has no schema.
    """
    if not paths:
        raise DatasetError("expected files; found none", code="map.files")
    state = _State(tuple(map(Path, paths)), tuple(schemas) or raw_schemas(), dict(answers))
    return _proposal(state, {key for key in answers if not any(_has(raw, key) for raw in state.schemas)})


def _proposal(state: _State, new: set[str]) -> Proposal:
    """Return the proposal with all answers; those in ``new`` are checked, and all when the schema is known."""
    form = {key.partition(".")[2]: text for key, text in state.answers.items() if key.startswith("format.") and text}
    if not state.columns or form != state.form:
        try:
            tables = [table for path in state.paths for table in _tables(path, form)]
        except DatasetError as error:
            if error.code != "file.numbers.ambiguous" or "decimal" in form:
                raise
            return _unreadable(state, error)
        count = sum(len(table.titles) for table in tables)
        if count > MAX_COLUMNS:
            raise DatasetError(
                f"{state.paths[0]}: expected at most {MAX_COLUMNS} columns for a proposed map; found {count}; describe "
                "those with readings in a map",
                code="file.too_large",
            )
        read = tuple(tuple(contents(table)) for table in tables)
        counts = tuple(len(table.lines) for table in tables)
        state = replace(state, columns=read, counts=counts, form=form, fits=None)
    if state.fits is None:
        state = replace(state, fits=tuple(_fits(state)))
    fits = [(each.copy(), k) for each, k in state.fits or ()]  # answers change a copy
    candidates = tuple(Choice(each.raw.title, _described(each.raw)) for each, _ in fits)
    wanted = state.answers.get("raw", "")
    if wanted and wanted not in {each.value for each in candidates}:
        known = {each.value for each in candidates}
        raise DatasetError(f"raw: expected a schema that fits the file; {nearest(wanted, known)}", code="map.answer")
    previews = [_preview(*each, []) for each in zip(state.columns, state.counts, strict=True)]
    if not fits:
        note = (
            "the columns fit no raw schema: "
            + "; ".join(", ".join(repr(title) for title in each.titles) for each in previews)[:300]
        )
        return Proposal(state.paths, "", "", (), tuple(previews), {}, (), (note,), state)
    chosen, main = next(((each, k) for each, k in fits if each.raw.title == wanted), fits[0])
    if (wanted or len(fits) == 1) and chosen.raw.title != state.checked:  # for this schema nothing was checked so far
        new = new | {key for key in state.answers if _has(chosen.raw, key)}
        state = replace(state, checked=chosen.raw.title)
    state = replace(state, chosen=chosen.raw)
    parts = _parts(state, chosen, main)
    questions = questions_of(parts, state.answers, new, _above(state))
    _refuse_unused(new, questions, parts, state.answers)
    questions = [each for each in questions if each.key not in state.answers]
    if len(fits) > 1 and not wanted:
        clear = fits[0][0].score - fits[1][0].score >= _MARGIN
        proposed = candidates[0].value if clear else ""
        questions = [Question("raw", "Which kind of measurement is this?", candidates, proposed, True), *questions]
    tables = [parts[0].columns[0].column.table, *(each.columns[0].column.table for each in parts[1:])]
    kind = "" if chosen.ways else kind_of(tables)  # a direction that the file does not state is asked for each one
    content = map_of(parts, state.answers, questions, kind, form)
    by_table = {id(each.columns[0].column.table): each for each in parts}
    previews = []
    notes = []
    for columns, count in zip(state.columns, state.counts, strict=True):
        part = by_table.get(id(columns[0].table))
        width = len(columns[0].table.titles)
        keys = parts[0].keys(width) if part is parts[0] else []  # answers are for the table of the readings
        previews.append(_preview(columns, count, part.meanings(width) if part else [], keys))
        if part is None:
            table = columns[0].table
            where = f"sheet '{table.form.sheet}' of " if table.form.sheet else ""
            notes.append(f"{where}{table.path.name} is not used: its columns fit no variable that is missing")
    for each in previews:
        unused = [title for title, meaning in zip(each.titles, each.meanings, strict=True) if not meaning and title]
        if unused and any(each.meanings):
            notes.append(f"columns that are not used: {', '.join(unused)}")
    variant = chosen.raw.variant
    return Proposal(
        state.paths, chosen.raw.id, variant, candidates, tuple(previews), content, tuple(questions), tuple(notes), state
    )


_FAR = 4.0
"""Difference of the scores from which a schema is not offered."""
_MARGIN = 0.5
"""Smallest difference of the scores with which the better one of two schemas is proposed."""


def _described(raw: RawSchema) -> str:
    """Return what a schema is for: the summary of its plugin, and the variant."""
    owner = plugins.owner_of_schema(raw.id)
    summary = owner.info.summary if owner is not None else raw.id
    return f"{summary}: {raw.variant}" if raw.variant else summary


def _tables(path: Path, form: Mapping[str, str]) -> list[Table]:
    known, mistakes = check(format_of(form), Format, prefix=("format",), edge=False)
    if known is None:
        raise DatasetError("; ".join(mistakes), code="map.answer")
    return read_tables(path, known)


def _unreadable(state: _State, error: DatasetError) -> Proposal:
    """Return the proposal that only asks for the decimal sign."""
    choices = (Choice(",", "comma: 1,250 is 1.25"), Choice(".", "point: 1,250 is 1250"))
    text = f"The decimal sign cannot be seen in the numbers ({str(error).partition(': ')[2].partition(';')[0]})."
    question = Question("format.decimal", text, choices, "", True)
    return Proposal(state.paths, "", "", (), (), {}, (question,), (), state)


def _fits(state: _State) -> list[tuple[Fit, int]]:
    """Return the schemas that fit one of the tables, and its number, the best first."""
    found = []
    for raw in state.schemas:
        own = [(each, k) for k, columns in enumerate(state.columns) if (each := fit(raw, columns)) is not None]
        if own:
            found.append(max(own, key=lambda each: each[0].score))
    found = sorted(found, key=lambda each: -each[0].score)
    return [each for each in found if each[0].score > found[0][0].score - _FAR]


def _parts(state: _State, chosen: Fit, main: int) -> list[Fit]:
    """Return the columns of all tables: of the readings, and of those with variables that they lack."""
    parts = [_corrected(chosen, state.columns[main], state.answers)]
    if (way := state.answers.get(APPROACH, "")) in chosen.ways:
        approached(chosen, way)
    there = {each.name for each in chosen.columns} - {"time"}
    for k, columns in enumerate(state.columns):
        if k == main:
            continue
        wanted = [row.name for row in chosen.raw.rows if row.name not in there and row.name != "time"]
        more = further(chosen.raw, columns, wanted)
        if more is not None:
            parts.append(more)
            there |= {each.name for each in more.columns} - {"time"}
            chosen.lacking = [row for row in chosen.lacking if row.name not in there]
    return parts


def _corrected(found: Fit, columns: Sequence[Content], answers: Mapping[str, str]) -> Fit:
    """Return a fit with the answers to which column has which variable."""
    for key, text in answers.items():
        where = key.removeprefix("columns.")
        own = next((each for each in found.columns if each.key == where), None)
        if not key.startswith("columns.") or own is None:
            continue
        column = next((each for each in columns if is_column(text, each)), None)
        if column is None:
            titles = {place_of(each) for each in columns}
            raise DatasetError(f"{key}: expected a column of the file; {nearest(text, titles)}", code="map.answer")
        other = next((each for each in found.columns if each.column.index == column.index), None)
        if other is not None:
            other.column = own.column
        own.column, own.sure = column, True
    return found


def _above(state: _State) -> list[str]:
    """Return the lines above the tables, and the names of the files without their endings."""
    lines = [line for columns in state.columns for line in columns[0].table.above]
    return [*lines, *(re.sub(r"[_\W]+", " ", path.stem) for path in state.paths)]


def _has(raw: RawSchema, key: str) -> bool:
    """Return whether a schema can have a question with this key."""
    head, _, name = key.partition(".")
    if head in ("columns", "units", "values"):
        return name.partition(".")[0] in {row.name for row in (*raw.rows, *raw.stated)}
    if head == "attributes":
        return name in raw.attributes
    return key in ("raw", "machine") or (head == "format" and bool(name))


def _refuse_unused(
    new: Iterable[str], questions: Sequence[Question], parts: Sequence[Fit], answers: Mapping[str, str]
) -> None:
    """Raise DatasetError for an answer that has no effect: to no question, or to what the file itself states."""
    raw = parts[0].raw
    keys = [each.key for each in questions]
    for key in new:
        head, _, name = key.partition(".")
        reason = ""
        if not (_has(raw, key) or key in keys or (key == APPROACH and parts[0].ways)):
            known = [*keys, *(f"values.{row.name}" for row in (*raw.rows, *raw.stated))]
            reason = f"no such question; {nearest(key, known)}"
        elif head == "columns" and (key not in keys or f"{name}.?" in {each.key for each in parts[0].columns}):
            reason = _of_columns(name, answers[key], parts)
        elif head == "units" and answers[key] and key not in keys and not _is_difference(name, parts):
            reason = "has no effect, since the file states the unit, or has no such column"
        if reason:
            raise DatasetError(f"{key}: {reason}", code="map.answer")


def _of_columns(name: str, text: str, parts: Sequence[Fit]) -> str:
    """Return why an answer to which column has a variable, or which error is in it, has no effect; empty if it has."""
    if any(each.key == name for each in parts[0].columns):
        return ""  # a column, see _corrected
    if not any(each.key == f"{name}.?" for part in parts for each in part.columns):
        recognised = [each.key.removesuffix(".?") for each in parts[0].columns if not each.labels]
        return f"expected one of the columns {', '.join(dict.fromkeys(recognised))}; describe others in a map"
    if text and text[:2] not in DOF:
        return f"expected an error, such as EXX; found '{text}'"
    return ""


def _is_difference(name: str, parts: Sequence[Fit]) -> bool:
    """Return whether a variable is the difference of two columns, of which none states a unit."""
    own = [each for part in parts for each in part.columns if each.name == name]
    rows = {row.name: row for row in parts[0].raw.rows}
    return any(each.minus is not None and not each.column.unit_for(rows[name]) for each in own)


def _preview(columns: Sequence[Content], count: int, meanings: Sequence[str], keys: Sequence[str] = ()) -> Preview:
    table = columns[0].table
    width = len(table.titles)
    cells = [list(table.cells.texts(k)[:_ROWS]) for k in range(width)]
    rows = tuple(tuple(column[k] for column in cells) for k in range(min(_ROWS, len(table.lines))))
    form = {
        name: value
        for name in ("encoding", "delimiter", "decimal", "thousands")
        if (value := getattr(table.form, name)) and value != "auto"
    }
    units = tuple([*table.units, *[""] * width][:width])
    return Preview(
        table.path,
        table.form.sheet,
        tuple(table.titles),
        units,
        tuple(meanings) or ("",) * width,
        tuple(keys) or ("",) * width,
        rows,
        count,
        form,
        tuple(table.notes),
    )
