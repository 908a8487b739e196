"""The user's folder for state: keys, logs and claims of this program, for its user only."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path


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


def close_to_others(path: Path) -> None:
    """Remove all rights of other users to a file or folder of this user; a link is not followed."""
    with suppress(OSError):
        found = path.lstat()
        if not stat.S_ISLNK(found.st_mode) and found.st_uid == os.geteuid() and found.st_mode & 0o077:
            path.chmod(stat.S_IMODE(found.st_mode) & ~0o077)
