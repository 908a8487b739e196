"""Files that strangers may have made, read with a bound: regular files only, and JSON of bounded depth."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any

DEEPEST = 64
"""Levels of objects and lists in JSON."""


def require_regular(path: str | Path) -> os.stat_result:
    """Refuse a pipe, a device, a folder; return the state of a regular file.

    Raises
    ------
    OSError
        There is no such file, or it is not a regular one: reading it could last for ever.
    """
    state = os.stat(path)
    if stat.S_ISDIR(state.st_mode):
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    return state


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
        return file.read(size + 1)[:size]  # what is appended meanwhile is not read; a large bound would be allocated


def parse_json(text: str | bytes) -> Any:
    """Return what JSON states.

    Raises
    ------
    ValueError
        It is not JSON in UTF-8, or has more than DEEPEST levels.
    """
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    level = [found]
    for _ in range(DEEPEST):
        level = [each for outer in level for each in _inside(outer) if isinstance(each, dict | list)]
        if not level:
            return found
    raise ValueError(f"nested too deeply; expected at most {DEEPEST} levels")


def _inside(value: Any) -> Iterable[Any]:
    return value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
