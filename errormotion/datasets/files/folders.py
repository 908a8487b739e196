"""Folders in which files are searched that settings name: first the folder of the file with the settings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_beside: ContextVar[tuple[Path, ...]] = ContextVar("beside", default=())


@contextmanager
def looking_beside(folder: Path) -> Iterator[None]:
    """Let names in settings be looked for in a folder too, such as that of a campaign file, while this lasts."""
    token = _beside.set((folder, *_beside.get()))
    try:
        yield
    finally:
        _beside.reset(token)


def folders_beside() -> tuple[Path, ...]:
    """Return the folders to look into, the innermost first."""
    return _beside.get()
