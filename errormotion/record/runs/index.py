"""The index of a folder of runs: a cache of the entries of its runs.

Each line is a JSON document: the first states the schema, each other one an entry. An entry is valid only while
modification time and size of its ``run.json`` and of its notes are unchanged. A missing, damaged or read-only index
only costs time.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.files.writing import replace_text
from errormotion.record.runs.entry import Entry, from_plain

FILE = ".errormotion-index.json"
SCHEMA = "errormotion.index/3"
MAX_SIZE = 256 << 20
"""Largest size of an index, bytes."""
MAX_LINE = 4 << 20
"""Largest size of an entry, bytes: while one is decoded, other threads of the process wait."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stamp:
    """Modification time, ns, and size, bytes, of a ``run.json`` and of the notes beside it; 0 without notes."""

    changed: int
    size: int
    notes_changed: int = 0
    notes_size: int = 0


STAMP = tuple(field.name for field in fields(Stamp))
Entries = dict[str, tuple[Stamp, Entry]]


def load(folder: Path) -> Entries:
    """Return the entries of an index with their stamps, by name of the run folder; empty if it cannot be used."""
    file = folder / FILE
    try:
        head, *lines = read_bytes(file, MAX_SIZE).split(b"\n")
    except OSError:
        return {}
    data = _document(head)
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        return {}
    kept: Entries = {}
    for line in lines:
        each = _document(line)
        entry = from_plain(each)
        numbers = [each.get(name) for name in STAMP] if entry is not None else []
        if entry is not None and all(isinstance(number, int) for number in numbers):
            kept[entry.folder] = (Stamp(*numbers), entry)
    return kept


def save(folder: Path, kept: Mapping[str, tuple[Stamp, Entry]]) -> None:
    """Write an index by a rename; without write permission nothing is written."""
    documents = [{"schema": SCHEMA}, *({**entry.plain(), **asdict(stamp)} for stamp, entry in kept.values())]
    try:
        lines = (json.dumps(each, separators=(",", ":")) + "\n" for each in documents)
        replace_text(folder / FILE, "".join(lines), flush=False)
    except OSError as error:
        log.info("no index in %s: %s", folder, error.strerror)


def _document(line: bytes) -> Any:
    """Return the content of a line; None if it is damaged or too long."""
    try:
        return json.loads(line) if len(line) <= MAX_LINE else None
    except (ValueError, RecursionError):
        return None
