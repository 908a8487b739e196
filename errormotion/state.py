"""The user's folder for state: keys, logs and claims of this program, for its user only."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from pathlib import Path

_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
"""Flag by which a link is not opened; 0 on systems without it."""
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)
"""Flag by which opening a pipe does not wait for its other end."""


def state_folder() -> Path:
    """Return ``errormotion`` in the user's state folder (``XDG_STATE_HOME``, else ``~/.local/state``)."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "errormotion"


def own_folder(*names: str) -> Path:
    """Create the state folder, or one within it, with mode 0700, and return it.

    A folder of an earlier version, which other users could read, is closed to them.

    Raises
    ------
    OSError
        The folder cannot be created.
    """
    folder = state_folder()
    folder.parent.mkdir(parents=True, exist_ok=True)
    for each in (folder, *(folder.joinpath(*names[: k + 1]) for k in range(len(names)))):
        each.mkdir(mode=0o700, exist_ok=True)
        close_to_others(each)
    return folder.joinpath(*names)


def is_private(status: os.stat_result) -> bool:
    """Return whether a file belongs to this user and no other user has rights to it; true on systems without modes."""
    return not hasattr(os, "geteuid") or (status.st_uid == os.geteuid() and not status.st_mode & 0o077)


def close_to_others(path: Path) -> None:
    """Remove all rights of other users to a file or folder of this user; a link is not followed."""
    with suppress(OSError):
        status = path.lstat()
        if not stat.S_ISLNK(status.st_mode) and not is_private(status) and status.st_uid == os.geteuid():
            path.chmod(stat.S_IMODE(status.st_mode) & ~0o077)


def open_itself(path: str | os.PathLike[str], flags: int, mode: int = 0o600) -> int:
    """Open a file that is no link, pipe or device, and return its descriptor, which child processes do not inherit.

    Systems without a flag that refuses links are asked what the path is before and after it was opened; a new file is
    created there by a call that follows no link.

    Raises
    ------
    OSError
        The file cannot be opened, or is not a regular file.
    """
    if _NO_FOLLOW:
        try:
            descriptor = os.open(path, flags | _NO_FOLLOW | _NO_WAIT, mode)
        except OSError as error:
            raise _link(path) if error.errno == errno.ELOOP else error from None
    else:
        descriptor = _open_checked(path, flags | _NO_WAIT, mode)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "is not a regular file", os.fspath(path))
    return descriptor


def _open_checked(path: str | os.PathLike[str], flags: int, mode: int) -> int:
    if flags & os.O_CREAT and not flags & os.O_EXCL:
        try:
            return os.open(path, flags | os.O_EXCL, mode)
        except FileExistsError:
            flags &= ~os.O_CREAT
    if not flags & os.O_CREAT and stat.S_ISLNK(os.lstat(path).st_mode):
        raise _link(path)
    descriptor = os.open(path, flags, mode)
    try:
        if os.path.samestat(os.lstat(path), os.fstat(descriptor)):
            return descriptor
    except OSError:
        os.close(descriptor)
        raise
    os.close(descriptor)
    raise _link(path)


def _link(path: str | os.PathLike[str]) -> OSError:
    return OSError(errno.ELOOP, "is a link, and links are not followed", os.fspath(path))
