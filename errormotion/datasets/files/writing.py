"""Files that are written whole or not at all: beside their place, brought to the disk, and renamed."""

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
    errno.EACCES: "permission denied; choose a place where you may write, or have the permission given",
    errno.EPERM: "permission denied; choose a place where you may write, or have the permission given",
    errno.EROFS: "the file system is read-only; choose another place",
    errno.ENOSPC: "the disk is full; free some space or choose another disk. Nothing was left behind there",
    errno.EDQUOT: "your disk quota is used up; free some space or choose another disk. Nothing was left behind there",
    errno.EFBIG: "the file would be larger than allowed. Nothing was left behind there",
    errno.ENAMETOOLONG: "the name is too long",
}


def reason(error: Exception, missing: str) -> str:
    """Return why a file cannot be read or written; ``missing`` for a place that is not there."""
    code = getattr(error, "errno", None)
    stated = re.search(r"errno = (\d+)", str(error))
    if stated is not None and code not in _REASONS:
        code = int(stated[1])
    if code == errno.ENOENT:
        return missing
    return _REASONS.get(code or 0, getattr(error, "strerror", None) or str(error))


@contextmanager
def writing(path: Path, part: Path) -> Iterator[None]:
    """Remove what was written beside a file when its place has been taken, or when that has failed.

    Raises
    ------
    DatasetError
        The disk does not take it; the message names the file.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        # HDF5 closes a file on a full disk with a RuntimeError that carries the system's words.
        raise DatasetError(f"{path}: cannot be written: {reason(error, 'there is no such folder')}") from error
    finally:
        remove(part)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield the place where a file is written; then it replaces an older one in one step.

    Raises
    ------
    DatasetError
        As `writing`. An older file is as it was.
    """
    part = path.with_name(f"{path.name}.part")
    with writing(path, part):
        yield part
        sync(part)
        part.replace(path)


def sync(path: Path) -> None:
    """Bring a file or the names in a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Remove a file or a folder, if the disk lets it."""
    with suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
