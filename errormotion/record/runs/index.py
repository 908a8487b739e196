"""The index of a folder of runs: a cache of the entries of its runs.

An entry is valid only while modification time and size of its ``run.json`` and of its notes are unchanged. A missing,
damaged or read-only index only costs time.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.files.writing import replace_text
from errormotion.record.runs.entry import Entry, from_plain

FILE = ".errormotion-index.json"
SCHEMA = "errormotion.index/1"
MAX_SIZE = 256 << 20
"""Largest size of an index, bytes."""

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
        data = json.loads(read_bytes(file, MAX_SIZE))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(data, dict) or data.get("schema") != SCHEMA or not isinstance(data.get("runs"), list):
        return {}
    kept: Entries = {}
    for each in data["runs"]:
        entry = from_plain(each)
        numbers = [each.get(name) for name in STAMP] if entry is not None else []
        if entry is not None and all(isinstance(number, int) for number in numbers):
            kept[entry.folder] = (Stamp(*numbers), entry)
    return kept


def save(folder: Path, kept: Mapping[str, tuple[Stamp, Entry]]) -> None:
    """Write an index by a rename; without write permission nothing is written."""
    runs = [{**entry.plain(), **asdict(stamp)} for stamp, entry in kept.values()]
    try:
        replace_text(folder / FILE, json.dumps({"schema": SCHEMA, "runs": runs}, separators=(",", ":")), flush=False)
    except OSError as error:
        log.info("no index in %s: %s", folder, error.strerror)
