"""Atomic writing of files and folders; every file that replaces another one is written by this module.

The content goes to a temporary file in the same folder, which is flushed to the disk and renamed; then the folder is
flushed. When a function of this module returns, the file therefore survives a power cut. A temporary file has a random
name and is created by this process: neither a link nor an existing file is opened for writing. Its name begins with a
point and ends with ``.part``; after a power cut it may remain, and is ignored by all readers.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from errormotion.errors import DatasetError
from errormotion.state import open_itself

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

_PART = re.compile(r"\..+\.[0-9a-f]{16}\.part", re.DOTALL)
_LONGEST = 60
"""Number of characters of a name that are kept in the temporary name, since a file system limits the length."""


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
def writing(path: Path) -> Iterator[None]:
    """Report errors of the disk.

    Raises
    ------
    DatasetError
        The file cannot be written; the message names it.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        # On a full disk HDF5 raises a RuntimeError with the message of the system.
        raise DatasetError(
            f"{path}: cannot be written: {reason(error, 'there is no such folder')}", code="file.unwritable"
        ) from error


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield the path of an empty temporary file, which then replaces the file in one step.

    Raises
    ------
    DatasetError
        As `writing`. An existing file is not changed.
    """
    with writing(path), replacing(path) as part:
        yield part


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the path of an empty temporary file, as `whole`; errors are not converted.

    Raises
    ------
    OSError
        The file cannot be written. An existing file is not changed.
    """
    with _part(path) as part:
        yield part
        sync(part)
        part.replace(path)
        sync(path.parent)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield the path of an empty temporary folder, which then gets its name; with its content it is on the disk.

    Raises
    ------
    OSError
        The folder cannot be written. An existing folder or file is not changed.
    """
    part = _part_name(path)
    try:
        part.mkdir()
        yield part
        sync_all(part)
        _replace(part, path)
        sync(path.parent)
    finally:
        remove(part)


def replace_all(contents: Mapping[Path, bytes | memoryview], *, flush: bool = True, mode: int = 0o666) -> None:
    """Write or replace files; each changes in one step, and on return all are on the disk.

    The files are flushed before the first of them gets its name. Without ``flush`` they may be empty or old after a
    power cut: for what is flushed later by `sync`, and for states that are meaningless after a power cut and written
    by threads that must not wait for the disk.

    Raises
    ------
    OSError
        A file cannot be written; the error names it. An existing file is not changed, or completely.
    """
    with ExitStack() as stack:
        parts = {}
        for path, content in contents.items():
            with _named(path):
                part = parts[path] = stack.enter_context(_part(path, mode))
                with part.open("r+b") as file:
                    file.write(content)
                    if flush:
                        file.flush()
                        os.fsync(file.fileno())
        for path, part in parts.items():
            with _named(path):
                part.replace(path)
    if flush:
        for folder in dict.fromkeys(path.parent for path in parts):
            with _named(folder):
                sync(folder)


def replace_bytes(path: Path, content: bytes | memoryview, *, flush: bool = True, mode: int = 0o666) -> None:
    """Write or replace a file, as `replace_all`."""
    replace_all({path: content}, flush=flush, mode=mode)


def create_bytes(path: Path, content: bytes, *, mode: int = 0o666) -> None:
    """Write a file that does not exist yet, in one step; on return it is on the disk.

    Raises
    ------
    FileExistsError
        There is a file of this name, of another process for example; it is not changed.
    OSError
        The file cannot be written.
    """
    with _part(path, mode) as part:
        with part.open("r+b") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.link(part, path)
        sync(path.parent)


def replace_text(path: Path, text: str, *, flush: bool = True) -> None:
    """Write or replace a text file (UTF-8), as `replace_all`."""
    replace_bytes(path, text.encode("utf-8"), flush=flush)


def open_to_append(path: Path, mode: int = 0o666) -> int:
    """Open a file to append to it, create it if it is missing, and return its descriptor.

    Raises
    ------
    OSError
        The file cannot be written, or is a link, a pipe or a device: a folder of unknown origin may contain such under
        the name of a log.
    """
    return open_itself(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, mode)


def make_folder(path: Path) -> None:
    """Create a folder and the missing ones above it; on return they are on the disk. An existing folder is kept."""
    missing = [each for each in (path, *path.parents) if not each.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for each in missing:
        sync(each.parent)


def sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    if os.name == "nt" and path.is_dir():  # Windows opens no folders
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if not (error.errno in (errno.EINVAL, errno.ENOTSUP) and path.is_dir()):  # a file system without this call
            raise
    finally:
        os.close(descriptor)


def sync_all(path: Path) -> None:
    """Flush a folder with its content to the disk."""
    for folder, _, names in os.walk(path):
        for name in names:
            sync(Path(folder) / name)
        sync(Path(folder))


def is_part(name: str) -> bool:
    """Return whether a file or folder of this name is a temporary one."""
    return _PART.fullmatch(name) is not None


@contextmanager
def _part(path: Path, mode: int = 0o666) -> Iterator[Path]:
    """Create an empty temporary file; remove it after the context unless it was renamed."""
    part = _part_name(path)
    os.close(open_itself(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))
    try:
        yield part
    finally:
        remove(part)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Name a file in the errors of the system, instead of the temporary one."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _part_name(path: Path) -> Path:
    return path.with_name(f".{path.name[:_LONGEST]}.{secrets.token_hex(8)}.part")


def _replace(part: Path, path: Path) -> None:
    """Rename a finished folder; an existing folder, which cannot be replaced in one step, is renamed first."""
    if not path.is_dir():
        part.rename(path)
        return
    old = _part_name(path).with_suffix(".old")
    path.rename(old)
    try:
        part.rename(path)
    except OSError:
        old.rename(path)
        raise
    remove(old)


def remove(path: Path) -> None:
    """Remove a file or a folder, if possible."""
    with suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
