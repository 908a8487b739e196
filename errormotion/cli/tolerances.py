"""Decisions on tolerances in the output of commands, and their exit codes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import typer

from errormotion.cli.guard import NONCONFORMING, OK, UNDECIDED
from errormotion.tolerances.conformity import Conformity
from errormotion.tolerances.decision import INSIDE, OUTSIDE


def unused_limits(conformities: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the limits that apply to no test of a campaign."""
    if not conformities:
        return []
    rest = [set(each["unused"]) for each in conformities]
    return [name for name in conformities[0]["unused"] if all(name in names for names in rest)]


def exit_code(conformities: Sequence[Mapping[str, Any]]) -> int:
    """Return NONCONFORMING, UNDECIDED (also for a limit that applies to no test), or OK."""
    decisions = [each["decision"] for each in conformities if each["decision"] is not None]
    if OUTSIDE in decisions:
        return NONCONFORMING
    if any(each != INSIDE for each in decisions) or unused_limits(conformities):
        return UNDECIDED
    return OK


def end_with(conformities: Sequence[Mapping[str, Any]]) -> None:
    """End the command with the exit code of the decisions; return if it is OK."""
    code = exit_code(conformities)
    if code != OK:
        raise typer.Exit(code)


def remarks(conformities: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for each limit that applies to no test."""
    return [
        f"Tolerances: the limit '{name}' applies to no figure and no freedom" for name in unused_limits(conformities)
    ]


def lines_of(found: Conformity) -> list[str]:
    """Return the decision on one dataset, with the limits that do not apply to it."""
    return [*found.lines(), *remarks([found.plain()])]
