"""The map of added files: stated, of earlier files of the same kind, or proposed with the answers of a person."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from errormotion import plugins
from errormotion.datasets.files.reading import leaves
from errormotion.datasets.files.tomlfile import read_toml
from errormotion.datasets.files.tomltext import value_of
from errormotion.datasets.files.writing import replace_bytes
from errormotion.datasets.maps.known import known_map
from errormotion.datasets.maps.proposal import Choice, Proposal, Question, propose
from errormotion.datasets.maps.writing import write_map
from errormotion.datasets.schemas import RawSchema
from errormotion.errors import DatasetError
from errormotion.record.adding.machines import FILE, load_machines
from errormotion.record.adding.originals import MAP
from errormotion.record.adding.own_maps import own_map, questions_of, write_own_map
from errormotion.record.adding.questions import Ask
from errormotion.record.adding.reading import is_raw
from errormotion.record.adding.request import Request
from errormotion.record.runs.listing import Listing

MAX_MAPS = 200
"""Largest number of maps of earlier runs that are tried."""
MAX_CHOICES = 20
"""Largest number of machines that are offered."""
_FIRST = ("format.decimal", "raw", "machine")
"""Keys of the questions on whose answers others depend."""


@dataclass
class MapOfFiles:
    """How files are read.

    Attributes
    ----------
    file : Path or None
        The map in the run folder; None for files that need none.
    answers : dict of str to str
        What was answered otherwise than proposed.
    given : dict of str to str
        All answers, also the proposed ones.
    notes : tuple of str
    """

    file: Path | None = None
    answers: dict[str, str] = field(default_factory=dict)
    given: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def map_of_files(request: Request, copies: Sequence[Path], folder: Path, ask: Ask) -> MapOfFiles:
    """Write the map of files into a run folder. One that a failed run has kept is used again.

    Raises
    ------
    DatasetError
        The files have no table that fits a raw schema, or an answer is missing or wrong, or would have no effect.
    """
    map_file = folder / MAP
    if request.answers and (request.map is not None or all(is_raw(copy) for copy in copies)):
        keys = ", ".join(f"--set {key}" for key in request.answers)
        reason = "a map states all of this" if request.map is not None else "a file with a schema states all of this"
        raise DatasetError(f"{keys}: {reason}; omit the option, or correct the file", code="add.answers.unused")
    if request.map is not None:
        replace_bytes(map_file, request.map.read_bytes())
        return MapOfFiles(map_file)
    if all(is_raw(copy) for copy in copies):
        return MapOfFiles()
    if map_file.is_file() and not leaves(folder, map_file) and not request.answers and not request.shown:
        return MapOfFiles(map_file)
    stated = {"machine": request.machine, "attributes.axis": request.axis}
    known = {key: text for key, text in stated.items() if text} | dict(request.answers)
    if (model := own_map(copies)) is not None:
        while questions := questions_of(model, known):
            known |= ask(questions)
        write_own_map(model, known, map_file)
        return MapOfFiles(map_file, given=known)
    schemas: Sequence[RawSchema] = plugins.get("methods", request.method).raw_schemas if request.method else ()
    if schemas and not any("axis" in each.attributes for each in schemas):
        known.pop("attributes.axis", None)  # an attribute without a meaning for the method
    found = propose(copies, tuple(schemas), answers=known)
    if not found.questions and not found.schema:
        raise DatasetError(f"{found.notes[0]}; describe them by a map: --map FILE", code="add.file.unknown")
    proposed = bool(request.answers) or request.shown
    if not proposed and (earlier := known_map(copies, _maps(request.record))) is not None:
        contradiction = _contradiction(read_toml(earlier), found, known, request.record.machines, ask)
        if not contradiction:
            replace_bytes(map_file, earlier.read_bytes())
            return MapOfFiles(map_file, notes=(f"read by the map of {earlier.parent.name}",))
        found = found.answered(contradiction)
    if request.answers:
        found = found.answered(request.answers)  # refuses those to questions that there are not
    given, answered, notes, found = _asked(found, request, ask)
    write_map(found, map_file, overwrite=True)
    stated = dict(request.answers)
    return MapOfFiles(map_file, answered | stated, known | given | stated, notes)


def of_machine(question: Question, machines: Sequence[str]) -> Question:
    """Return the question for the machine, with those of the record as choices."""
    names = dict.fromkeys(filter(None, (question.proposed, question.earlier, *machines)))
    choices = tuple(Choice(name, name) for name in list(names)[:MAX_CHOICES])
    proposed = question.proposed or (choices[0].value if len(choices) == 1 else "")
    return Question("machine", "On which machine was this measured?", choices, proposed, True, question.earlier)


def _asked(
    found: Proposal, request: Request, ask: Ask
) -> tuple[dict[str, str], dict[str, str], tuple[str, ...], Proposal]:
    """Return all answers, those of people, notes and the proposal without questions.

    What is known of the machine is not asked.
    """
    given: dict[str, str] = {}
    answered: dict[str, str] = {}
    before, mistake = set[str](), ""
    while found.questions:
        questions = {each.key: each for each in found.questions}
        stored: dict[str, str] = {}
        if "machine" not in questions:
            known = load_machines(request.runs).answers(str(found.map.get("machine", "")), found.schema)
            stored = {key: known[key] for key in questions if key in known}
        before |= set(stored)
        names = request.record.machines
        asked = [of_machine(each, names) if key == "machine" else each for key, each in questions.items()]
        new = stored or dict(ask(sorted(asked, key=lambda each: each.key not in _FIRST), mistake))
        try:
            found, mistake = found.answered(new), ""
        except DatasetError as error:
            if error.code != "map.answer":
                raise
            if stored:
                raise DatasetError(f"{request.runs / FILE}: {error}", code="map.answer") from error
            mistake = str(error)
            continue
        given |= new
        answered |= {key: text for key, text in new.items() if key in questions and text != questions[key].proposed}
    return given, answered, (*found.notes, *(f"as before on this machine: {key}" for key in sorted(before))), found


def _contradiction(
    content: Mapping[str, Any], found: Proposal, known: Mapping[str, str], machines: Sequence[str], ask: Ask
) -> dict[str, str]:
    """Return what holds for the files otherwise than in an earlier map; empty if the map can be used for them.

    The machine, to which values such as a set-up belong, and attributes, such as the axis, may differ between files of
    one kind: they are asked if the files do not state them, the machine only if the record has several.
    """
    questions = {each.key: each for each in found.questions}
    machine = str(content.get("machine", ""))
    before = {"machine": machine} if machine else {}
    for group in ("attributes", "values"):
        before |= {f"{group}.{name}": text for name, text in content.get(group, {}).items()}
    for key, text in before.items():
        question = questions.get(key)
        now = known.get(key) or (question.proposed if question is not None else "")
        if not now and question is not None and not key.startswith("values."):
            asked = replace(question, earlier=str(text))
            asked = of_machine(asked, machines) if key == "machine" else asked
            now = str(text) if len(asked.choices) == 1 else dict(ask([asked]))[key]
        if now and text not in (now, value_of(now)):
            return {key: now}
    return {}


def _maps(record: Listing) -> Iterator[Path]:
    """Return the maps of imported runs, newest first."""
    folders = (path for path, entry in record.runs if entry.imported)
    return islice((path / MAP for path in folders if (path / MAP).is_file()), MAX_MAPS)
