"""One run in the record: the content of its ``run.json``, with printable texts of limited length."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Any

from errormotion.datasets.files import events
from errormotion.datasets.files.events import Event
from errormotion.datasets.files.reading import require_regular
from errormotion.errors import RunError
from errormotion.plugins import FigureOfMerit

SCHEMA = "errormotion.run/1"
MAX_READ = 2 << 20
"""Bytes of a ``run.json`` that are read; the usual size is 20 kB. What stands after them is not shown."""
MAX_TEXT = 200
"""Longest text, characters."""
MAX_FIGURES = 200
"""Largest number of figures of merit of a run."""
MAX_FILES = 50
"""Largest number of files of an imported run."""
_SPACES = re.compile(r"[ \t\r\n]*")


@dataclass(frozen=True)
class Entry:
    """Entry of one run.

    Attributes
    ----------
    folder : str
        Name of the run folder.
    created : str
        ISO 8601; empty if unknown. For an imported run the start of the measurement, if it is known.
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
    partial : str
        A sentence on what was not read because ``run.json`` is too large; empty if it was read completely.
    imported : tuple of str
        SHA-256 of each file of an imported run; empty for a measured one.
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
    partial: str = ""
    imported: tuple[str, ...] = ()

    @property
    def state(self) -> str:
        """Status with the mark of an imported run."""
        return f"{self.status}, imported" if self.imported else self.status

    @property
    def time(self) -> datetime | None:
        """Creation of the run, of an imported one the start of the measurement; None if unknown."""
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
        ``run.json`` is missing, damaged, or has another schema.
    """
    file = folder / "run.json"
    try:
        size = require_regular(file).st_size
        with file.open("rb") as stream:
            raw = stream.read(MAX_READ)
    except OSError as error:
        raise RunError(f"{file}: cannot be read: {error.strerror}", code="run.file.unreadable") from error
    partial = ""
    try:
        if size > MAX_READ:
            data: Any = first_keys(raw.decode(errors="ignore"))
            last = next(reversed(data), "")
            partial = (
                f"{file}: has {size} bytes, of which the first {MAX_READ} are read: "
                f"what stands after the key '{_text(last)}' is not shown"
            )
        else:
            data = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise RunError(f"{file}: is not valid JSON ({error})", code="run.file.no_json") from error
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        schema = data.get("schema") if isinstance(data, dict) else type(data).__name__
        raise RunError(f"{file}: expected schema '{SCHEMA}'; found {str(schema)[:MAX_TEXT]!r}", code="run.file.schema")
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
        partial=partial,
        imported=_hashes(data.get("imported")),
    )


def first_keys(text: str) -> dict[str, Any]:
    """Return the complete keys and values at the start of a JSON object that may be cut.

    Of a list that is cut, the complete elements are returned, `MAX_FIGURES` at most.

    Raises
    ------
    ValueError
        The text does not start like a JSON object.
    """
    decode, values = json.JSONDecoder().raw_decode, dict[str, Any]()
    at = _after(text, 0, "{")
    while True:
        try:
            name, at = decode(text, _after(text, at))
            start = at = _after(text, _after(text, at, ":"))
        except ValueError:
            if not values:
                raise
            return values
        if not isinstance(name, str):
            raise ValueError(f"expected a key at character {at}")
        try:
            values[name], at = decode(text, at)
            at = _after(text, at, ",")
        except ValueError:  # the end of the object, or where it is cut
            if text[start : start + 1] == "[" and name not in values:
                values[name] = _first_elements(text, start, decode)
            return values


def _first_elements(text: str, at: int, decode: Callable[[str, int], tuple[Any, int]]) -> list[Any]:
    elements: list[Any] = []
    try:
        at = _after(text, at, "[")
        while len(elements) < MAX_FIGURES:
            element, end = decode(text, _after(text, at))
            at = _after(text, end, ",")
            elements.append(element)
    except ValueError:
        pass
    return elements


def _after(text: str, at: int, sign: str = "") -> int:
    """Return the place after spaces, and after a sign if it is expected."""
    found = _SPACES.match(text, at)
    at = found.end() if found else at
    if not text.startswith(sign, at):
        raise ValueError(f"expected {sign!r} at character {at}")
    return at + len(sign)


def from_plain(data: Any) -> Entry | None:
    """Return the entry of a JSON file; None if it is damaged."""
    names = ("folder", "created", "machine", "test", "method", "campaign", "status", "errors", "verdict", "partial")
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
    hashes = data.get("imported")
    if not isinstance(hashes, list) or not all(isinstance(each, str) for each in hashes):
        return None
    texts = {name: data[name] for name in names}
    figures = figures_from(data.get("figures"))
    return Entry(**texts, figures=figures, notes=known, damaged_notes=tuple(damaged), imported=tuple(hashes))


def figures_from(data: Any) -> tuple[FigureOfMerit, ...] | None:
    """Return the figures of a JSON file; None if they are missing or damaged."""
    if not isinstance(data, list):
        return None
    figures = []
    for entry in data[:MAX_FIGURES]:
        if not isinstance(entry, dict):
            return None
        limit = _number(entry.get("limit"))
        figures.append(
            FigureOfMerit(
                _text(entry.get("name")),
                _number(entry.get("value")),
                _number(entry.get("expanded_uncertainty")),
                _text(entry.get("unit")),
                limit if math.isfinite(limit) else None,
            )
        )
    return tuple(figures)


def _hashes(data: Any) -> tuple[str, ...]:
    """Return the SHA-256 of each file of an imported run; empty for a measured one."""
    files = data.get("files") if isinstance(data, Mapping) else None
    found = (
        [_text(each, "sha256") for each in files[:MAX_FILES] if isinstance(each, Mapping)]
        if isinstance(files, list)
        else []
    )
    return tuple(each for each in found if each)


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
