"""The audit log: one JSON object per line, each with the hash of all lines before it; lines are only appended."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from errormotion.datasets.files.reading import require_regular
from errormotion.errors import CompensationError

START = "0" * 64
"""Hash before the first line."""

MAX_LINE = 1 << 16
"""Maximum length of a line, bytes."""


class AuditLog:
    """Appends entries to an audit log; a context manager.

    Parameters
    ----------
    path : Path
        Created if it does not exist; an existing audit log is continued.

    Raises
    ------
    CompensationError
        The chain of hashes of the existing file is broken.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._hash = verify(path)[1] if path.exists() else START
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def write(self, entry: Mapping[str, Any], *, sync: bool = False) -> None:
        """Append an entry; ``sync`` waits until it is stored on the disk.

        Raises
        ------
        CompensationError
            The entry cannot be written.
        """
        content = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), **entry}
        text = json.dumps(content, ensure_ascii=False, allow_nan=False)
        self._hash = _next(self._hash, text)
        line = f'{{"hash":"{self._hash}","entry":{text}}}\n'.encode()
        try:
            if os.write(self._file, line) != len(line):
                raise OSError("the line was written incompletely")
            if sync:
                os.fdatasync(self._file)
        except OSError as error:
            raise CompensationError(f"{self.path}: the audit log cannot be written: {error}") from None


class AuditReader:
    """Reads an audit log while it is written, and checks its chain of hashes.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    count : int
        Entries so far.
    hash : str
        Hash of the last entry.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.count, self.hash = path, 0, START
        self._at = 0

    def read(self, most: int) -> list[dict[str, Any]]:
        """Return the next entries, at most ``most``; an incomplete last line is read by a later call.

        Raises
        ------
        CompensationError
            A line was changed, removed or added, or the log cannot be read; every later call raises it as well.
        """
        found: list[dict[str, Any]] = []
        try:
            require_regular(self.path)
            with self.path.open("rb") as file:
                file.seek(self._at)
                while len(found) < most and (line := file.readline(MAX_LINE)):
                    if not line.endswith(b"\n") and len(line) < MAX_LINE:
                        break
                    last, text = _follows(self.path, self.count, self.hash, line)
                    found.append(_entry(text))
                    self.hash, self.count, self._at = last, self.count + 1, self._at + len(line)
        except OSError as error:
            raise CompensationError(f"{self.path}: cannot be read: {error.strerror}") from None
        return found


def verify(path: Path) -> tuple[int, str]:
    """Return the number of entries of an audit log, and its last hash.

    Raises
    ------
    CompensationError
        A line was changed, removed or added; its number is in the message.
    """
    count, last = 0, START
    with path.open("rb") as file:
        while line := file.readline(MAX_LINE):
            last, _ = _follows(path, count, last, line)
            count += 1
    return count, last


def _follows(path: Path, count: int, before: str, line: bytes) -> tuple[str, str]:
    """Return hash and entry of the line after ``count`` others, the last of which has the hash ``before``."""
    text = line.decode("utf-8", "replace")
    head, entry = text[: len('{"hash":"') + 64], text[len('{"hash":"') + 64 + len('","entry":') : -2]
    last = _next(before, entry)
    if text != f'{{"hash":"{last}","entry":{entry}}}\n' or head[-64:] != last:
        raise CompensationError(
            f"{path}: line {count + 1} does not follow from the lines before it: the log was altered, or its "
            "last line was cut off. Keep it, and start a new one."
        )
    return last, entry


def _entry(text: str) -> dict[str, Any]:
    """Return an entry; an empty one if the text is not a JSON object."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _next(before: str, text: str) -> str:
    return hashlib.sha256(f"{before}{text}".encode()).hexdigest()
