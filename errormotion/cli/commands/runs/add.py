"""``errormotion add``: files of other software become runs of the record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import typer

from errormotion.cli.commands.campaigns.run import describe, report_of_run, result_lines
from errormotion.cli.options import read_settings
from errormotion.cli.output import show, show_json
from errormotion.cli.progress import Bars, on_terminal
from errormotion.cli.tolerances import end_with, remarks
from errormotion.datasets.maps.questions import Question
from errormotion.record.adding.add import Added
from errormotion.record.adding.add import add as add_files
from errormotion.record.adding.questions import Ask, refuse, take_proposals
from errormotion.record.adding.request import Request

_OF_MAP = ("columns.", "units.", "values.", "attributes.", "format.", "labels.", "map.", "raw=")
"""Start of the assignments that answer questions on the files; others are settings of the method."""


def add(request: Request, assignments: Sequence[str], yes: bool, as_json: bool) -> None:
    """Add the files of a request to the record, and print the results."""
    answers = [each for each in assignments if each.startswith(_OF_MAP)]
    settings = [each for each in assignments if each not in answers]
    request = replace(
        request,
        settings=lambda model: read_settings(model, None, settings),
        answers={key.strip(): text.strip() for key, _, text in (each.partition("=") for each in answers)},
    )
    with Bars(as_json) as bars:

        def asked(questions: Sequence[Question], mistake: str = "") -> Mapping[str, str]:
            with bars.paused():
                return _asked(questions, mistake)

        taken: dict[str, str] = {}

        def proposed(questions: Sequence[Question], mistake: str = "") -> Mapping[str, str]:
            answers = take_proposals(questions, mistake)
            taken.update(answers)
            return answers

        ask: Ask = proposed if yes else asked if on_terminal() and not as_json else refuse
        added = add_files(request, ask, report=report_of_run, stage=bars.stage)
    if any(taken.values()):
        stated = ", ".join(f"{key} = {text}" for key, text in taken.items() if text)
        added = replace(added, notes=(*added.notes, f"proposed, and not stated by the file: {stated}"))
    conformity = added.folder.data.get("conformity")
    if as_json:
        described = describe(added.folder)
        show_json({"ok": True, "known": added.known, **described, "notes": [*added.notes, *described["notes"]]})
    else:
        for line in _lines(added, request.files):
            show(line)
    end_with([conformity] if conformity else [])


def _lines(added: Added, files: Sequence[Path]) -> list[str]:
    names, folder = ", ".join(path.name for path in files), added.folder
    if added.known:
        return [f"{names}: in the record already, {folder.path}; --again adds it once more"]
    machine, test = folder.data["bench"]["machine"], folder.data["test"]
    lines = [*(f"note: {note}" for note in added.notes), *result_lines(folder)]
    decided = [folder.data["conformity"]] if folder.data.get("conformity") else []
    return [f"{names}: {test} of {machine}, in {folder.path}", *(f"  {line}" for line in lines), *remarks(decided)]


def _asked(questions: Sequence[Question], mistake: str = "") -> Mapping[str, str]:
    """Return the answer of a person to the first question; choices are numbered."""
    question = questions[0]
    if mistake:
        show(mistake, err=True)
    values = [choice.value for choice in question.choices]
    show(f"\n{question.text}", err=True)
    for number, choice in enumerate(question.choices, 1):
        text = choice.text if choice.text.startswith(choice.value) else f"{choice.value}: {choice.text}"
        show(f"  {number}  {text}", err=True)
    default = question.proposed or question.earlier
    default = str(values.index(default) + 1) if default in values else default
    prompt = "Number" if values else "Answer"
    prompt += "" if question.needed else " (may be left empty)"
    answer = ""
    while not answer:
        answer = str(typer.prompt(prompt, default=default, show_default=bool(default), err=True)).strip()
        if not question.needed:
            break
    return {question.key: values[int(answer) - 1] if _is_number(answer, len(values)) else answer}


def _is_number(answer: str, count: int) -> bool:
    return answer.isascii() and answer.isdigit() and 1 <= int(answer) <= count
