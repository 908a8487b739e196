"""Files that a browser sends, in hidden folders beside the runs until they are added: few, small, for a short time."""

from __future__ import annotations

import os
import re
import secrets
import time
from dataclasses import dataclass
from pathlib import Path

from errormotion.datasets.files.reading import leaves
from errormotion.datasets.files.writing import make_folder, remove, replace_bytes, writing
from errormotion.errors import DatasetError
from errormotion.record.adding.originals import MAX_FILES

MAX_UPLOAD = 16 << 20
"""Largest size of a file, bytes."""
MAX_FOLDERS = 8
"""Number of uploads that are kept; for a further one the oldest is removed."""
MAX_AGE = 24 * 3600.0
"""Time for which an upload is kept, s."""
MAX_NAME = 120
"""Longest name of a file, characters."""
_PREFIX = ".upload-"
_KEY = re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True)
class Uploads:
    """The uploads of one folder of runs."""

    runs: Path

    def store(self, key: str, name: str, content: bytes, changed: float | None = None) -> str:
        """Store a file of an upload, and return its key; an empty key begins an upload.

        ``changed`` is the time of the last change of the file, s since 1970.

        Raises
        ------
        DatasetError
            The name is not that of a file, there are too many files, or the upload is gone.
        """
        if not content:
            raise DatasetError(f"{name[:MAX_NAME]}: is empty", code="upload.empty")
        if not _is_name(name):
            raise DatasetError(
                f"expected the name of a file, of at most {MAX_NAME} printable characters; found {name[:MAX_NAME]!a}",
                code="upload.name",
            )
        folder = self.folder(key) if key else self._new()
        if len(list(folder.iterdir())) >= MAX_FILES:
            raise DatasetError(f"expected at most {MAX_FILES} files of one measurement", code="upload.too_many")
        with writing(folder / name):
            replace_bytes(folder / name, content)
            if changed is not None:
                os.utime(folder / name, (changed, changed))
        return folder.name.removeprefix(_PREFIX)

    def files(self, key: str) -> tuple[Path, ...]:
        """Return the files of an upload.

        Raises
        ------
        DatasetError
            The upload is gone.
        """
        return tuple(sorted(path for path in self.folder(key).iterdir() if not path.name.startswith(".")))

    def folder(self, key: str) -> Path:
        """Return the folder of an upload.

        Raises
        ------
        DatasetError
            There is none of this key.
        """
        folder = self.runs / f"{_PREFIX}{key}"
        if not _KEY.fullmatch(key) or not folder.is_dir() or leaves(self.runs, folder):
            raise DatasetError("The files are not there any more; choose them again.", code="upload.gone")
        return folder

    def forget(self, key: str) -> None:
        """Remove an upload."""
        remove(self.folder(key))

    def _new(self) -> Path:
        known = (
            sorted(self.runs.glob(f"{_PREFIX}*"), key=lambda path: path.stat().st_mtime) if self.runs.exists() else []
        )
        old = [path for path in known if time.time() - path.stat().st_mtime > MAX_AGE]
        for path in {*old, *known[: max(0, len(known) - MAX_FOLDERS + 1)]}:
            remove(path)
        folder = self.runs / f"{_PREFIX}{secrets.token_hex(8)}"
        with writing(folder):
            make_folder(folder)
        return folder


def _is_name(name: str) -> bool:
    whole = 0 < len(name) <= MAX_NAME and name.isprintable() and name == name.strip()
    return whole and not name.startswith(".") and not set(name) & set('/\\:*?"<>|')
