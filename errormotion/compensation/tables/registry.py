"""Formats of tables, found through the entry points of all distributions, including the built-in ones."""

from __future__ import annotations

from collections import Counter
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING

from errormotion.errors import PluginError

if TYPE_CHECKING:
    from errormotion.compensation.tables.contract import TableFormat

GROUP = "errormotion.table_formats"
"""Group of the entry points."""

_REQUIRED = ("id", "title", "source", "Settings", "write")


@cache
def _points() -> tuple[EntryPoint, ...]:
    return tuple(sorted(entry_points(group=GROUP), key=lambda point: point.name))


def available() -> tuple[str, ...]:
    """Return the ids of all formats."""
    return tuple(dict.fromkeys(point.name for point in _points()))


def get(name: str) -> TableFormat:
    """Return a format.

    Raises
    ------
    PluginError
        Unknown, provided by several distributions, or cannot be loaded.
    """
    points = [point for point in _points() if point.name == name]
    if not points:
        near = get_close_matches(name, available(), n=1)
        hint = f" Did you mean '{near[0]}'?" if near else ""
        raise PluginError(
            f"Unknown table format '{name}'; available: {', '.join(available()) or 'none'}.{hint}",
            code="table.format.unknown",
        )
    if Counter(point.name for point in _points())[name] > 1:
        sources = ", ".join(point.dist.name if point.dist else "unknown" for point in points)
        raise PluginError(
            f"Several distributions provide the format '{name}': {sources}. Remove all but one.",
            code="table.format.ambiguous",
        )
    try:
        cls = points[0].load()
        if missing := [each for each in _REQUIRED if not hasattr(cls, each)]:
            raise PluginError(f"the class lacks {', '.join(missing)}", code="table.format.members")
        found: TableFormat = cls()
    except (Exception, SystemExit) as error:
        raise PluginError(
            f"The format '{name}' cannot be loaded: {type(error).__name__}: {error}", code="table.format.not_loaded"
        ) from error
    if found.id != name:
        raise PluginError(
            f"The entry point is named '{name}', but its format has the id '{found.id}'", code="table.format.id"
        )
    return found
