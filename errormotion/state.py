"""The user's folder for state: keys, logs and claims of this program, for its user only."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
"""Flag by which a link is not opened; systems without it have no links that others can place."""


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


def is_private(found: os.stat_result) -> bool:
    """Return whether a file belongs to this user and no other user has rights to it; true on systems without modes."""
    return not hasattr(os, "geteuid") or (found.st_uid == os.geteuid() and not found.st_mode & 0o077)


def close_to_others(path: Path) -> None:
    """Remove all rights of other users to a file or folder of this user; a link is not followed."""
    with suppress(OSError):
        found = path.lstat()
        if not stat.S_ISLNK(found.st_mode) and not is_private(found) and found.st_uid == os.geteuid():
            path.chmod(stat.S_IMODE(found.st_mode) & ~0o077)
