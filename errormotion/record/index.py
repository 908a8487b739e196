"""The index of a folder of runs: what its ``run.json`` files state, kept for the next call.

The index is never the truth. An entry counts only while time of change and size of its ``run.json`` are those that
it was read from; a missing, damaged or unwritable index costs time and nothing else.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from errormotion.record.entry import Entry, from_plain

FILE = ".errormotion-index.json"
SCHEMA = "errormotion.index/1"
LARGEST = 256 << 20
"""Bytes of an index that is read."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stamp:
    """Time of change, ns, and size, bytes, of a ``run.json``."""

    changed: int
    size: int


Kept = dict[str, tuple[Stamp, Entry]]


def load(folder: Path) -> Kept:
    """Return the entries of an index with their stamps, by name of the run folder; empty if it cannot be used."""
    file = folder / FILE
    try:
        if file.stat().st_size > LARGEST:
            return {}
        data = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(data, dict) or data.get("schema") != SCHEMA or not isinstance(data.get("runs"), list):
        return {}
    kept: Kept = {}
    for each in data["runs"]:
        entry = from_plain(each)
        if entry is None or not isinstance(each.get("changed"), int) or not isinstance(each.get("size"), int):
            continue
        kept[entry.folder] = (Stamp(each["changed"], each["size"]), entry)
    return kept


def save(folder: Path, kept: Mapping[str, tuple[Stamp, Entry]]) -> None:
    """Write an index in one step; where the folder cannot be written there is none."""
    runs = [{**entry.plain(), "changed": stamp.changed, "size": stamp.size} for stamp, entry in kept.values()]
    part = folder / f"{FILE}.{os.getpid()}.part"
    try:
        part.write_text(json.dumps({"schema": SCHEMA, "runs": runs}, separators=(",", ":")), encoding="utf-8")
        part.replace(folder / FILE)
    except OSError as error:
        log.info("no index in %s: %s", folder, error.strerror)
        with suppress(OSError):
            part.unlink(missing_ok=True)
