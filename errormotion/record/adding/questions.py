"""Questions on files, and who answers them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from errormotion.datasets.maps.questions import Question
from errormotion.errors import DatasetError


class Ask(Protocol):
    """Answers questions."""

    def __call__(self, questions: Sequence[Question], mistake: str = "") -> Mapping[str, str]:
        """Return answers to one or several of the questions, by their keys; those that remain are asked again.

        An empty text leaves a question unanswered that is not needed. ``mistake`` states what was wrong with the answer
        before.
        """


OPTIONS = {"machine": "--machine NAME", "attributes.axis": "--axis AXIS"}
"""Options of ``errormotion add`` for answers; all others are stated by ``--set``."""


def take_proposals(questions: Sequence[Question], mistake: str = "") -> dict[str, str]:
    """Return the proposed answer to the first question.

    Raises
    ------
    DatasetError
        Nothing is proposed for questions that must be answered; all are listed.
    """
    refuse([each for each in questions if each.needed and not each.proposed], mistake)
    return {questions[0].key: questions[0].proposed}


def refuse(questions: Sequence[Question], mistake: str = "") -> dict[str, str]:
    """Raise an error that states how to answer each of the questions by an option; no answers without questions.

    Raises
    ------
    DatasetError
        There is a question, or a proposed answer was wrong.
    """
    if mistake:
        raise DatasetError(mistake, code="map.answer")
    if not questions:
        return {}
    lines = [f"{OPTIONS.get(each.key, f'--set {each.key}=VALUE')}: {_described(each)}" for each in questions]
    what = "1 answer is missing" if len(lines) == 1 else f"{len(lines)} answers are missing"
    takes = " --yes takes what is proposed." if any(each.proposed for each in questions) else ""
    raise DatasetError("\n  - ".join([f"{what}; nothing was added.{takes}", *lines]), code="add.answers.missing")


def _described(question: Question) -> str:
    parts = [question.text]
    if question.choices:
        parts.append("one of " + ", ".join(each.value for each in question.choices))
    if question.proposed:
        parts.append(f"proposed: {question.proposed}")
    elif question.earlier:
        parts.append(f"{question.earlier} in an earlier file of this kind")
    elif not question.needed:
        parts.append("may be omitted")
    return "; ".join(parts)
