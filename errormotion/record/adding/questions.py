"""Questions on a file, and their answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from errormotion.errors import DatasetError


@dataclass(frozen=True)
class Choice:
    """A possible answer, and what it means."""

    value: str
    text: str


@dataclass(frozen=True)
class Question:
    """A question; without choices the answer is a text. ``proposed`` is the answer of a script, empty for none."""

    key: str
    text: str
    choices: tuple[Choice, ...] = ()
    proposed: str = ""
    needed: bool = True


Ask = Callable[[Sequence[Question]], Mapping[str, str]]
"""Returns an answer to each question by its key; an empty text leaves a question that is not needed unanswered."""


def take_proposals(questions: Sequence[Question]) -> dict[str, str]:
    """Return the proposed answers.

    Raises
    ------
    DatasetError
        Nothing is proposed for a question that must be answered.
    """
    refuse([each for each in questions if each.needed and not each.proposed])
    return {each.key: each.proposed for each in questions}


def refuse(questions: Sequence[Question]) -> None:
    """Raise DatasetError if there is a question, and state how to answer each."""
    if questions:
        lines = [f"{option(each)}: {each.text}{_known(each)}" for each in questions]
        what = "An answer is" if len(lines) == 1 else f"{len(lines)} answers are"
        raise DatasetError(
            "\n  - ".join([f"{what} missing; nothing was added. State with:", *lines]), code="add.answers.missing"
        )


def option(question: Question) -> str:
    """Return the option of ``errormotion add`` that answers a question."""
    known = {"machine": "--machine NAME", "attributes.axis": "--axis AXIS"}
    return known.get(question.key, f"--set {question.key}=VALUE")


def _known(question: Question) -> str:
    choices = ", ".join(each.value for each in question.choices)
    proposed = f" Proposed: {question.proposed}." if question.proposed else ""
    return (f" One of {choices}." if choices else "") + proposed
