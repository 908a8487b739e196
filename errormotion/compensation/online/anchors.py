"""What is known of audit logs outside of their files: the key that authenticates them, and how many entries they have.

Both are in the user's state folder, which only the user can read: the key in ``audit.key``, and for each log a file in
``audit``. They show what others did to a log. They prove nothing against a user who can write to this folder.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.files.writing import create_bytes, replace_bytes
from errormotion.errors import CompensationError
from errormotion.state import is_private, open_itself, own_folder, state_folder

KEY, FOLDER = "audit.key", "audit"
KEY_BYTES = 32
MAX_ANCHOR = 1 << 14
"""Largest size of the file of one log, bytes."""
MAX_ANCHORS = 100_000
"""Number of files that are searched for a log that was moved."""


@dataclass(frozen=True)
class Anchor:
    """What is known of a log: its path when it was begun, its identity, and the number of its entries on the disk."""

    path: str
    log: str
    entries: int


def own_key() -> bytes:
    """Return the key of the user; create it if it does not exist.

    Raises
    ------
    CompensationError
        The key cannot be created, or others can read it.
    """
    try:
        path = own_folder() / KEY
        if not os.path.lexists(path):
            with suppress(FileExistsError):  # another process has created it
                create_bytes(path, secrets.token_hex(KEY_BYTES).encode(), mode=0o600)
        return _read_key(path)
    except (OSError, ValueError) as error:
        raise CompensationError(
            f"{state_folder() / KEY}: expected the key of audit logs, a file of this user that no other user can read "
            f"(mode 0600); {error}",
            code="audit.key.form",
        ) from None


def known_key() -> bytes | None:
    """Return the key of the user; None without a valid one."""
    with suppress(OSError, ValueError):
        return _read_key(state_folder() / KEY)
    return None


def name_of(key: bytes) -> str:
    """Return the name by which a log states its key."""
    return hashlib.sha256(b"name of a key" + key).hexdigest()[:16]


def save(anchor: Anchor) -> None:
    """Store what is known of a log. A power failure may undo this, which proves less, and refuses nothing."""
    path = own_folder(FOLDER) / _name(anchor.path)
    replace_bytes(path, json.dumps(asdict(anchor)).encode(), flush=False, mode=0o600)


def of_path(path: Path) -> Anchor | None:
    """Return what is known of the log at a path; None if nothing is."""
    return _read(state_folder() / FOLDER / _name(str(path.resolve())))


def of_log(log: str) -> Anchor | None:
    """Return what is known of a log that was moved; None if nothing is."""
    return next((each for each in _all() if each.log == log), None)


def _all() -> Iterator[Anchor]:
    with suppress(OSError), os.scandir(state_folder() / FOLDER) as found:
        for _, each in zip(range(MAX_ANCHORS), found, strict=False):
            anchor = _read(Path(each.path)) if each.name.endswith(".json") else None
            if anchor is not None:
                yield anchor


def _name(path: str) -> str:
    return f"{hashlib.sha256(path.encode('utf-8', 'surrogatepass')).hexdigest()[:32]}.json"


def _read(path: Path) -> Anchor | None:
    with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
        found = json.loads(read_bytes(path, MAX_ANCHOR))
        anchor = Anchor(str(found["path"]), str(found["log"]), found["entries"])
        return anchor if type(anchor.entries) is int else None
    return None


def _read_key(path: Path) -> bytes:
    handle = open_itself(path, os.O_RDONLY)
    with os.fdopen(handle, "rb") as file:
        found = os.fstat(handle)
        if not is_private(found):
            raise ValueError(f"found mode {stat.S_IMODE(found.st_mode):04o} of user {found.st_uid}")
        key = bytes.fromhex(file.read(4 * KEY_BYTES).decode("ascii"))
    if len(key) != KEY_BYTES:
        raise ValueError(f"found {len(key)} bytes instead of {KEY_BYTES}")
    return key
