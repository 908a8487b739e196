"""One run in the record: the content of its ``run.json``, with printable texts of limited length."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Any

from errormotion.datasets.files import events
from errormotion.datasets.files.events import Event
from errormotion.datasets.files.reading import read_bytes
from errormotion.errors import RunError
from errormotion.plugins import FigureOfMerit

SCHEMA = "errormotion.run/1"
MAX_FILE = 16 << 20
"""Largest size of a ``run.json``, bytes."""
MAX_TEXT = 200
"""Longest text, characters."""
MAX_FIGURES = 200
"""Largest number of figures of merit of a run."""


@dataclass(frozen=True)
class Entry:
    """Entry of one run.

    Attributes
    ----------
    folder : str
        Name of the run folder.
    created : str
        ISO 8601; empty if unknown.
    machine, test, method, campaign, status : str
        Empty if unknown.
    errors : str
        Path of the error dataset in the folder; empty without errors.
    figures : tuple of FigureOfMerit or None
        Figures of merit, SI; None if they are in the error dataset only and were not read yet.
    verdict : str
        Decision on the tolerances; empty without tolerances.
    notes : tuple of Event
        Notes on the run.
    damaged_notes : tuple of str
        A sentence for each note that cannot be read.
    """

    folder: str
    created: str
    machine: str
    test: str
    method: str
    campaign: str
    status: str
    errors: str
    figures: tuple[FigureOfMerit, ...] | None
    verdict: str = ""
    notes: tuple[Event, ...] = ()
    damaged_notes: tuple[str, ...] = ()

    @property
    def time(self) -> datetime | None:
        """Creation of the run; None if unknown."""
        return events.instant(self.created)

    @property
    def lacks_figures(self) -> bool:
        """Return whether the figures are in the error dataset only."""
        return self.figures is None and bool(self.errors)

    def with_figures(self, figures: list[FigureOfMerit]) -> Entry:
        """Return the entry with figures from its error dataset."""
        return replace(self, figures=tuple(figures[:MAX_FIGURES]))

    def plain(self) -> dict[str, Any]:
        """Return the entry for a JSON file."""
        figures = None if self.figures is None else [asdict(figure) for figure in self.figures]
        notes = [asdict(note) for note in self.notes]
        return {**self.__dict__, "figures": _without_nan(figures), "notes": notes}


def read_entry(folder: Path) -> Entry:
    """Read the entry of a run folder.

    Raises
    ------
    RunError
        ``run.json`` is missing, too large, damaged, or has another schema.
    """
    file = folder / "run.json"
    try:
        raw = read_bytes(file, MAX_FILE)
    except OSError as error:
        raise RunError(f"{file}: cannot be read: {error.strerror}") from error
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise RunError(f"{file}: is not valid JSON ({error})") from error
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        found = data.get("schema") if isinstance(data, dict) else type(data).__name__
        raise RunError(f"{file}: expected schema '{SCHEMA}'; found {str(found)[:MAX_TEXT]!r}")
    return Entry(
        folder.name,
        _text(data.get("created")),
        _text(data.get("bench"), "machine"),
        _text(data.get("test")),
        _text(data.get("method"), "id"),
        _text(data.get("campaign"), "name"),
        _text(data.get("status")),
        _inside(data.get("errors")),
        figures_from(data.get("results")),
        _text(data.get("conformity"), "verdict"),
        *events.read(folder),
    )


def from_plain(data: Any) -> Entry | None:
    """Return the entry of a JSON file; None if it is damaged."""
    names = ("folder", "created", "machine", "test", "method", "campaign", "status", "errors", "verdict")
    if not isinstance(data, dict) or not all(isinstance(data.get(name), str) for name in names):
        return None
    notes, damaged = data.get("notes"), data.get("damaged_notes")
    if (
        not isinstance(notes, list)
        or not isinstance(damaged, list)
        or not all(isinstance(each, str) for each in damaged)
    ):
        return None
    read = [events.from_plain(each) for each in notes]
    known = tuple(each for each in read if isinstance(each, Event))
    if len(known) < len(read):
        return None
    texts = {name: data[name] for name in names}
    return Entry(**texts, figures=figures_from(data.get("figures")), notes=known, damaged_notes=tuple(damaged))


def figures_from(data: Any) -> tuple[FigureOfMerit, ...] | None:
    """Return the figures of a JSON file; None if they are missing or damaged."""
    if not isinstance(data, list):
        return None
    found = []
    for entry in data[:MAX_FIGURES]:
        if not isinstance(entry, dict):
            return None
        limit = _number(entry.get("limit"))
        found.append(
            FigureOfMerit(
                _text(entry.get("name")),
                _number(entry.get("value")),
                _number(entry.get("expanded_uncertainty")),
                _text(entry.get("unit")),
                limit if math.isfinite(limit) else None,
            )
        )
    return tuple(found)


def _number(value: Any) -> float:
    """Return a number; NaN for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def _text(value: Any, key: str = "") -> str:
    """Return a printable text of a JSON value, or of its key; empty for anything else."""
    if key:
        value = value.get(key) if isinstance(value, Mapping) else None
    if not isinstance(value, str):
        return ""
    text = value[:MAX_TEXT]
    return text if text.isprintable() else "".join(each if each.isprintable() else "?" for each in text)


def _inside(value: Any) -> str:
    """Return a path inside the run folder; empty for any other path."""
    if not isinstance(value, str) or not value or "\0" in value or len(value) > MAX_TEXT:
        return ""
    path = PurePosixPath(value.replace("\\", "/"))
    return "" if path.is_absolute() or ".." in path.parts or ":" in path.parts[0] else str(path)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
