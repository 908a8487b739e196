"""The index of a folder of runs: what its ``run.json`` files state, kept for the next call.

The index is never the truth. An entry counts only while time of change and size of its ``run.json`` and of its notes
are those that it was read from; a missing, damaged or unwritable index costs time and nothing else.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from errormotion.datasets.files.reading import read_bytes
from errormotion.record.runs.entry import Entry, from_plain

FILE = ".errormotion-index.json"
SCHEMA = "errormotion.index/1"
LARGEST = 256 << 20
"""Bytes of an index that is read."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stamp:
    """Time of change, ns, and size, bytes, of a ``run.json`` and of the notes beside it; 0 where there are none."""

    changed: int
    size: int
    notes_changed: int = 0
    notes_size: int = 0


STAMP = tuple(field.name for field in fields(Stamp))
Kept = dict[str, tuple[Stamp, Entry]]


def load(folder: Path) -> Kept:
    """Return the entries of an index with their stamps, by name of the run folder; empty if it cannot be used."""
    file = folder / FILE
    try:
        data = json.loads(read_bytes(file, LARGEST))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(data, dict) or data.get("schema") != SCHEMA or not isinstance(data.get("runs"), list):
        return {}
    kept: Kept = {}
    for each in data["runs"]:
        entry = from_plain(each)
        numbers = [each.get(name) for name in STAMP] if entry is not None else []
        if entry is not None and all(isinstance(number, int) for number in numbers):
            kept[entry.folder] = (Stamp(*numbers), entry)
    return kept


def save(folder: Path, kept: Mapping[str, tuple[Stamp, Entry]]) -> None:
    """Write an index in one step; where the folder cannot be written there is none."""
    runs = [{**entry.plain(), **asdict(stamp)} for stamp, entry in kept.values()]
    part = folder / f"{FILE}.{os.getpid()}.part"
    try:
        part.write_text(json.dumps({"schema": SCHEMA, "runs": runs}, separators=(",", ":")), encoding="utf-8")
        part.replace(folder / FILE)
    except OSError as error:
        log.info("no index in %s: %s", folder, error.strerror)
        with suppress(OSError):
            part.unlink(missing_ok=True)
