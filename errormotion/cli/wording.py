"""What all commands share: ``-o`` for ``--out``, and placeholders for the values of options."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand
from typer.models import ArgumentInfo, OptionInfo

_PLACEHOLDERS = {
    "axis": "AXIS",
    "chain": "CHAIN",
    "component": "AXIS",
    "controller": "NAME",
    "duration": "TIME",
    "fault": "NAME",
    "figure": "NAME",
    "freedoms": "NAMES",
    "host": "ADDRESS",
    "address": "ADDRESS",
    "interval": "TIME",
    "machine": "NAME",
    "method": "ID",
    "origin": "NAME=X,Y,Z",
    "change": "NAME=AFTER,BEFORE",
    "sampling": "LENGTH",
    "scheduler": "NAME",
    "select": "DIM=NUMBER",
    "since": "DATE",
    "step": "LENGTH",
    "test": "NAME",
    "time": "TIME",
    "tolerance": "LENGTH",
    "unit": "UNIT",
    "machine_unit": "UNIT",
}
"""Placeholder of an option, by its name."""

_FOLDER = re.compile(r"(With --dry-run: )?((a|the|run) )?folder", re.IGNORECASE)
_ARGUMENTS = {"folders": "FOLDER", "results": "RESULT", "plugin": "ID"}

_POINTS = ("at", "functional_point", "gauge_point", "point", "gauge", "start")
"""Options whose value is three coordinates, mm."""


def share(*apps: typer.Typer) -> None:
    """Add ``-o`` beside ``--out``, and placeholders, to all commands of these applications."""
    for app in apps:
        for command in app.registered_commands:
            command.cls = _Command
            if command.callback is not None:
                _adapt(command.callback)


class _Command(TyperCommand):
    """A command whose help shows only the placeholders of arguments, not their Python types."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        for parameter in self.params:
            if getattr(parameter, "param_type_name", "") == "argument":
                vars(parameter)["display_type_rich"] = _nothing


def _nothing(**_: Any) -> str:
    return ""


def _adapt(callback: Any) -> None:
    hints = get_type_hints(callback, include_extras=True)
    for name, hint in hints.items():
        if get_origin(hint) is not Annotated:
            continue
        kind, *notes = get_args(hint)
        for note in notes:
            if isinstance(note, OptionInfo):
                if name == "out" and "-o" not in (note.param_decls or ()):
                    note.param_decls = ("--out", "-o")
                kinds = {kind, *get_args(kind)}
                kinds |= {each for outer in kinds for each in get_args(outer)}
                if note.metavar is None and bool not in kinds:
                    note.metavar = _placeholder(name.rstrip("_"), kinds, note.help or "")
            elif isinstance(note, ArgumentInfo) and note.metavar is None and get_origin(kind) is not Literal:
                note.metavar = _ARGUMENTS.get(name.rstrip("_"), name.rstrip("_").upper())
    # Evaluated, so that the placeholders are kept; the signature is that of the function inside its decorators.
    callback.__annotations__ = inspect.unwrap(callback).__annotations__ = hints


def _placeholder(name: str, kinds: set[Any], meaning: str) -> str | None:
    if any(get_origin(kind) is Literal for kind in kinds):
        return None  # the choices themselves
    if Path in kinds:
        return "FOLDER" if _FOLDER.match(meaning) else "FILE"
    if name in _POINTS and str in kinds:
        return "X,Y,Z"
    if str not in kinds:
        return "N" if int in kinds else "NUMBER"
    return _PLACEHOLDERS.get(name, "TEXT")
