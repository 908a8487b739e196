"""Files that a person is about to add: their tables, the proposed meaning of the columns, and the questions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from errormotion import plugins
from errormotion.datasets.maps.proposal import Preview, Question, propose
from errormotion.errors import DatasetError
from errormotion.record.adding.machines import load_machines
from errormotion.record.adding.mapping import of_machine
from errormotion.record.adding.originals import originals_of, run_of
from errormotion.record.adding.own_maps import own_map, questions_of
from errormotion.record.adding.reading import is_raw, owner_of, read_raw
from errormotion.record.adding.request import Request


@dataclass(frozen=True)
class Draft:
    """What is known of files before they are added.

    Attributes
    ----------
    kind : str
        What the data are for.
    tables : tuple of Preview
        Empty for files that need no map.
    questions : tuple of Question
        All that the files leave open; ``proposed`` is the answer, if there is one, or what is known of the machine.
    notes : tuple of str
    known : str
        Key of the finished run of these files in the record; empty if there is none.
    """

    kind: str
    tables: tuple[Preview, ...]
    questions: tuple[Question, ...]
    notes: tuple[str, ...]
    known: str = ""

    def plain(self) -> dict[str, Any]:
        """Return the draft for a JSON document."""
        tables = [{**asdict(each), "path": each.path.name, "format": dict(each.format)} for each in self.tables]
        return {
            "kind": self.kind,
            "tables": tables,
            "questions": [asdict(each) for each in self.questions],
            "notes": list(self.notes),
            "known": self.known,
        }


def draft_of(paths: Sequence[Path], runs: Path, answers: Mapping[str, str]) -> Draft:
    """Return the draft of files with the answers so far.

    Raises
    ------
    DatasetError
        A file cannot be read, or an answer is wrong (``map.answer``).
    """
    record = Request(tuple(paths), runs).record
    before = run_of(originals_of(paths).values(), record)
    known = before.path.name if before is not None and before.finished else ""
    return replace(_draft(paths, runs, record.machines, answers), known=known)


def _draft(paths: Sequence[Path], runs: Path, machines: Sequence[str], answers: Mapping[str, str]) -> Draft:
    if all(is_raw(path) for path in paths):
        with read_raw(paths, None) as raw:
            owner, machine = owner_of(raw), str(raw.attrs.get("machine", "")).replace("unknown", "")
        asked = [] if machine or "machine" in answers else [of_machine(Question("machine", "", (), "", True), machines)]
        return Draft(owner.info.summary, (), tuple(asked), ())
    if (model := own_map(paths)) is not None:
        asked = questions_of(model, answers)
        asked += [] if "machine" in answers else [of_machine(Question("machine", "", (), "", needed=True), machines)]
        return Draft(f"a file {paths[0].suffix.lower()}", (), tuple(asked), ())
    found = propose(paths)
    if not found.questions and not found.schema:
        raise DatasetError(found.notes[0], code="add.file.unknown")
    answered: dict[str, Question] = {}
    first = {key: text for key, text in answers.items() if key == "raw" or key.startswith("format.")}
    for new in (first, {key: text for key, text in answers.items() if key not in first}):
        if new:  # an answer can be changed
            answered |= {each.key: replace(each, proposed=new[each.key]) for each in found.questions if each.key in new}
            found = found.answered(new)
    machine = str(found.map.get("machine", ""))
    known = load_machines(runs).answers(machine, found.schema)
    questions = tuple(
        of_machine(each, machines)
        if each.key == "machine"
        else replace(each, proposed=answers.get(each.key) or known.get(each.key, each.proposed))
        for each in (*answered.values(), *found.questions)
    )
    owner = plugins.owner_of_schema(found.schema) if found.schema else None
    return Draft(owner.info.summary if owner is not None else "", found.tables, questions, found.notes)
