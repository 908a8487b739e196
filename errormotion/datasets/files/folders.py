"""Search folders for files that settings name: the folder of the file with the settings is the first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_beside: ContextVar[tuple[Path, ...]] = ContextVar("beside", default=())


@contextmanager
def looking_beside(folder: Path) -> Iterator[None]:
    """Within this context, also search files that settings name in a folder, such as that of a campaign file."""
    token = _beside.set((folder, *_beside.get()))
    try:
        yield
    finally:
        _beside.reset(token)


def folders_beside() -> tuple[Path, ...]:
    """Return the search folders, the innermost context first."""
    return _beside.get()
