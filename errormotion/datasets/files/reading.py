"""Reading of files of unknown origin with limits: regular files in their folder only, and JSON of limited depth."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any

DEEPEST = 64
"""Largest number of levels of objects and lists in JSON."""


def require_regular(path: str | Path) -> os.stat_result:
    """Return the state of a regular file; refuse a pipe, a device or a folder.

    Raises
    ------
    OSError
        The file does not exist, or is not a regular one, which reading may never end.
    """
    state = os.stat(path)
    if stat.S_ISDIR(state.st_mode):
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    return state


def leaves(folder: Path, path: Path) -> bool:
    """Return whether a path in a folder leads out of it through a link; also if it cannot be followed."""
    try:
        return not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a link to itself, or a name that is too long
        return True


def visible(folder: Path, pattern: str) -> list[Path]:
    """Return the files and folders of a pattern, sorted, without those in or behind a hidden name.

    Temporary files and folders are hidden, and a power cut may leave them incomplete.
    """
    return sorted(
        path
        for path in folder.glob(pattern)
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def read_bytes(path: str | Path, longest: int) -> bytes:
    """Return the content of a regular file.

    Raises
    ------
    OSError
        It cannot be read, is not a regular file, or has more than ``longest`` bytes.
    """
    size = require_regular(path).st_size
    if size > longest:
        raise OSError(errno.EFBIG, f"expected at most {longest} bytes; it is larger", str(path))
    with open(path, "rb") as file:
        return file.read(size + 1)[:size]  # a large limit would be allocated; data appended meanwhile are not read


def parse_json(text: str | bytes) -> Any:
    """Return the content of JSON.

    Raises
    ------
    ValueError
        It is not JSON in UTF-8, or has more than DEEPEST levels.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    level = [value]
    for _ in range(DEEPEST):
        level = [each for outer in level for each in _inside(outer) if isinstance(each, dict | list)]
        if not level:
            return value
    raise ValueError(f"nested too deeply; expected at most {DEEPEST} levels")


def _inside(value: Any) -> Iterable[Any]:
    return value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
