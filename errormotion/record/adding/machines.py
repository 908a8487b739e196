"""What was answered about a machine, in a file beside its runs, so that it is not asked again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from errormotion.datasets.files import tomlfile, tomltext
from errormotion.datasets.files.writing import replace_text, writing
from errormotion.record.adding.exclusive import exclusive

FILE = "machines.toml"
SCHEMA = "errormotion.machines/1"
_HEAD = f"""schema = "{SCHEMA}"
# Answers to the questions of 'errormotion add', by machine and raw schema. They are used without a question; correct
# or delete them here.
"""
_KEPT = ("values.",)
"""Start of the keys whose answers belong to the machine and its set-up, not to one file."""

Answers = dict[str, str]


class Machines(BaseModel):
    """The file: answers by machine and raw schema."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: Literal["errormotion.machines/1"] = Field(alias="schema", description=f"'{SCHEMA}'")
    machines: dict[str, dict[str, Answers]] = Field(
        default_factory=dict, description="a table for each machine, in it one for each raw schema, in it the answers"
    )

    def answers(self, machine: str, schema: str) -> Answers:
        """Return what is known of a machine for a raw schema."""
        return self.machines.get(machine, {}).get(schema, {})


def load_machines(runs: Path) -> Machines:
    """Return the answers in a folder of runs.

    Raises
    ------
    DatasetError
        The file cannot be read, or contains mistakes.
    """
    path = runs / FILE
    return tomlfile.load_model(path, Machines) if path.exists() else Machines.model_validate({"schema": SCHEMA})


def remember(runs: Path, machine: str, schema: str, answers: Mapping[str, str]) -> None:
    """Keep the answers that belong to the machine; comments and other answers in the file are kept.

    Raises
    ------
    DatasetError
        The file is too large to be changed, or cannot be written.
    """
    new = {key: text for key, text in answers.items() if key.startswith(_KEPT) and text}
    if not new:
        return
    path = runs / FILE
    with exclusive(runs):
        known = load_machines(runs).answers(machine, schema)
        if all(known.get(key) == text for key, text in new.items()):
            return
        text = path.read_text(encoding="utf-8-sig") if path.exists() else _HEAD
        for key, answer in new.items():
            text = tomltext.with_value(text, ("machines", machine, schema, key), answer)
        with writing(path):
            replace_text(path, text)
