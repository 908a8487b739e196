"""Files of a LinuxCNC machine as text."""

from __future__ import annotations

from pathlib import Path

from errormotion.datasets.files.reading import require_regular
from errormotion.errors import ProgramError

UNITS = {"mm": 1e-3, "inch": 25.4e-3}
"""Lengths of the units of machines and programs, m."""

MAX_FILE = 1 << 20
"""Maximum size of a parameter file or tool table, bytes."""


def text_of(path: Path) -> str:
    """Return the text of a parameter file or tool table; line ends are not changed.

    Raises
    ------
    ProgramError
        The file cannot be read, is too large, or is no text.
    """
    try:
        if require_regular(path).st_size > MAX_FILE:
            raise ProgramError(f"{path}: expected a file of at most {MAX_FILE} bytes", code="program.too_long")
        return path.read_bytes().decode("utf-8")
    except OSError as error:
        raise ProgramError(f"{path} cannot be read: {error.strerror}", code="program.file.unreadable") from None
    except UnicodeDecodeError as error:
        raise ProgramError(
            f"{path}: expected text; found other bytes at {error.start}", code="program.file.no_text"
        ) from None
