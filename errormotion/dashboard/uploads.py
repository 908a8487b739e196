"""Files that a browser sends, in hidden folders beside the runs until they are added: few, small, for a short time."""

from __future__ import annotations

import os
import re
import secrets
import stat
import threading
import time
import unicodedata
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from errormotion.datasets.files.reading import leaves
from errormotion.datasets.files.writing import make_folder, remove, replace_bytes, writing
from errormotion.errors import DatasetError
from errormotion.record.adding.originals import MAX_FILES

MAX_UPLOAD = 16 << 20
"""Largest size of a file, bytes."""
MAX_TOTAL = 64 << 20
"""Largest size of the files of an upload, bytes."""
MAX_FOLDERS = 8
"""Number of uploads that are kept; a further one is refused, since a person may be at work on each."""
MAX_AGE = 2 * 3600.0
"""Time for which an upload is kept after its last use, s."""
MAX_NAME = 120
"""Longest name of a file, characters."""
_PREFIX = ".upload-"
_KEY = re.compile(r"[0-9a-f]{16}")
_LOCK = threading.Lock()


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
            The name is not that of a file, or there already; there are too many or too large files, or too many
            uploads; the upload is gone.
        """
        if not content:
            raise DatasetError(f"{name[:MAX_NAME]}: is empty", code="upload.empty")
        if not _is_name(name):
            raise DatasetError(
                f"expected the name of a file, of at most {MAX_NAME} printable characters; found {name[:MAX_NAME]!a}",
                code="upload.name",
            )
        with _LOCK:
            folder = self.folder(key) if key else self._new()
            there = list(folder.iterdir())
            if len(there) >= MAX_FILES:
                raise DatasetError(f"expected at most {MAX_FILES} files of one measurement", code="upload.too_many")
            if _plain(name) in {_plain(each.name) for each in there}:
                raise DatasetError(
                    f"{name}: two files have this name; rename one of them. (Names that differ only in upper and lower "
                    "case are one name on some disks.)",
                    code="upload.twice",
                )
            if sum(each.stat().st_size for each in there) + len(content) > MAX_TOTAL:
                raise DatasetError(
                    f"expected files of at most {MAX_TOTAL >> 20} MiB in one measurement; use 'errormotion add'",
                    code="upload.too_large",
                )
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
        with suppress(FileNotFoundError):  # removed meanwhile
            os.utime(folder)  # the time of the last use
        return folder

    def forget(self, key: str) -> None:
        """Remove an upload, if it is there."""
        with suppress(DatasetError):
            remove(self.folder(key))

    def clean(self) -> list[Path]:
        """Remove the uploads that nobody has used for `MAX_AGE`, and return the folders of the others."""
        kept = []
        for path in self.runs.glob(f"{_PREFIX}*") if self.runs.is_dir() else ():
            try:
                found = path.lstat()
            except FileNotFoundError:  # removed meanwhile
                continue
            if not stat.S_ISDIR(found.st_mode):  # a link is not followed
                continue
            if time.time() - found.st_mtime > MAX_AGE:
                remove(path)
            else:
                kept.append(path)
        return kept

    def _new(self) -> Path:
        if len(self.clean()) >= MAX_FOLDERS:
            raise DatasetError(
                f"expected at most {MAX_FOLDERS} measurements that are being added at once; save or cancel one of "
                f"them. One that nobody works on is removed after {MAX_AGE / 3600:.0f} hours",
                code="upload.full",
            )
        folder = self.runs / f"{_PREFIX}{secrets.token_hex(8)}"
        with writing(folder):
            make_folder(folder)
        return folder


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _is_name(name: str) -> bool:
    whole = 0 < len(name) <= MAX_NAME and name.isprintable() and name == name.strip()
    return whole and not name.startswith(".") and not set(name) & set('/\\:*?"<>|')
