"""Number of cells of a spreadsheet, counted in a process of its own with bounded memory and time.

The library allocates all cells between the first and the last one of a sheet, whatever is in them, and ends the
process if there is no memory for them: two cells in opposite corners of a sheet need half a terabyte.

Run as a script, this file reads the name of a sheet (JSON, one line; empty for all sheets) and the content of a
spreadsheet from its input, and prints the number of cells, or the reason for which they cannot be read.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys

MAX_CELLS = 20_000_000
"""Largest number of cells of a spreadsheet, empty ones between others included."""
MAX_MEMORY = 4 << 30
"""Address space of the process, bytes, where the system can limit it."""
MAX_TIME = 120.0
"""Time for it, s."""


def count_cells(data: bytes, sheet: str) -> int | str | None:
    """Return the number of cells of a sheet of a spreadsheet, or of all sheets.

    Parameters
    ----------
    data : bytes
    sheet : str
        Empty for all sheets.

    Returns
    -------
    int, str or None
        The number; a text for the reason for which they cannot be read; None if they need more memory or time than
        the process has.
    """
    command = [sys.executable, "-P", __file__]
    given = json.dumps(sheet).encode() + b"\n" + data
    try:
        ended = subprocess.run(command, input=given, capture_output=True, timeout=MAX_TIME, check=False)
        found = json.loads(ended.stdout) if ended.returncode == 0 else None
    except (subprocess.TimeoutExpired, ValueError):
        return None
    return found if isinstance(found, int | str) else None


def _main() -> None:
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    except (ImportError, OSError, ValueError):  # Windows; a lower limit
        pass
    sheet = json.loads(sys.stdin.buffer.readline())
    print(json.dumps(_counted(sys.stdin.buffer.read(), sheet)))


def _counted(data: bytes, sheet: str) -> int | str:
    from python_calamine import CalamineWorkbook

    try:
        book = CalamineWorkbook.from_filelike(io.BytesIO(data))
        names = [name for name in book.sheet_names if sheet in ("", name)]
        sheets = [book.get_sheet_by_name(name) for name in names]
        count = sum((each.end[0] + 1) * (each.end[1] + 1) for each in sheets if each.end is not None)
        if count <= MAX_CELLS:
            grids = [each.to_python(skip_empty_area=False) for each in sheets]  # the texts need memory as well
            del grids
    except BaseException as error:
        if isinstance(error, MemoryError):
            raise
        return str(error) or type(error).__name__
    return count


if __name__ == "__main__":
    _main()
