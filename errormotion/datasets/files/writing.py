"""Atomic writing of files: to a temporary file in the same folder, which is flushed to the disk and renamed."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from errormotion.errors import DatasetError

_REASONS = {
    errno.ENOENT: "there is no such folder",
    errno.EACCES: "permission denied; choose another folder, or change its permissions",
    errno.EPERM: "permission denied; choose another folder, or change its permissions",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.ENOSPC: "the disk is full; free some space or choose another disk. Nothing was written",
    errno.EDQUOT: "your disk quota is used up; free some space or choose another disk. Nothing was written",
    errno.EFBIG: "the file would be larger than allowed. Nothing was written",
    errno.ENAMETOOLONG: "the name is too long",
}


def reason(error: Exception, missing: str) -> str:
    """Return the reason why a file cannot be read or written; ``missing`` if a file or folder does not exist."""
    code = getattr(error, "errno", None)
    stated = re.search(r"errno = (\d+)", str(error))
    if stated is not None and code not in _REASONS:
        code = int(stated[1])
    if code == errno.ENOENT:
        return missing
    return _REASONS.get(code or 0, getattr(error, "strerror", None) or str(error))


@contextmanager
def writing(path: Path, part: Path) -> Iterator[None]:
    """Remove a temporary file after its context, and report errors of the disk.

    Raises
    ------
    DatasetError
        The file cannot be written; the message names it.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        # On a full disk HDF5 raises a RuntimeError with the message of the system.
        raise DatasetError(f"{path}: cannot be written: {reason(error, 'there is no such folder')}") from error
    finally:
        remove(part)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file, which then replaces the file in one step.

    Raises
    ------
    DatasetError
        As `writing`. An existing file is not changed.
    """
    part = path.with_name(f"{path.name}.part")
    with writing(path, part):
        yield part
        sync(part)
        part.replace(path)


def sync(path: Path) -> None:
    """Flush a file or the names in a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Remove a file or a folder, if possible."""
    with suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
