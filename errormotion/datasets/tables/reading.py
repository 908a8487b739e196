"""Reading of the table of a file of any kind, which is recognised from its first bytes."""

from __future__ import annotations

from pathlib import Path

from errormotion.datasets.files.reading import read_bytes, require_regular
from errormotion.datasets.tables.binary import binary_table
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.sheets import sheet_table, sheet_tables
from errormotion.datasets.tables.table import Table
from errormotion.datasets.tables.text import MAX_LINE, text_table
from errormotion.errors import DatasetError

MAX_FILE = 1 << 28
"""Largest size of a file, bytes; its cells need more memory."""

_PIECE = 1 << 16
"""Number of bytes that are read at a time: a short file needs little memory."""
_BINARY = (
    (b"TDSm", "tdms"),
    (b"\x89HDF\r\n\x1a\n", "hdf5"),
    (b"MATLAB 5.0", "matlab"),
    (b"CDF\x01", "netcdf3"),
    (b"CDF\x02", "netcdf3"),
)
_SHEETS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1")


def read_tables(path: Path, form: Format) -> list[Table]:
    """Return the tables of a file: of all sheets of a spreadsheet, else the only one; raises like `read_table`."""
    try:
        require_regular(path)
        with path.open("rb") as file:
            start = file.read(16)
        if start.startswith(_SHEETS):
            return sheet_tables(read_bytes(path, MAX_FILE), path, form)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}", code="file.unreadable") from error
    return [read_table(path, form)]


def read_table(path: str | Path, form: Format | None = None) -> Table:
    """Return the table of a file.

    Parameters
    ----------
    path : str or Path
        Text of a logger or a program (.csv, .txt, .lvm, ...), a spreadsheet (.xlsx, .xls, .ods), LabVIEW TDMS,
        MATLAB up to 7.2, HDF5 or NetCDF 3. The first bytes decide, not the name.
    form : Format, optional
        What is known of the format; the rest is recognised.

    Raises
    ------
    DatasetError
        The file cannot be read, is too large, or has no table of numbers.
    """
    path, form = Path(path), form or Format.model_validate({})
    try:
        require_regular(path)
        with path.open("rb") as file:
            start = file.read(16)
        kind = next((kind for mark, kind in _BINARY if start.startswith(mark)), "")
        if kind:
            return binary_table(path, form, kind)
        data = read_bytes(path, MAX_FILE) if start.startswith(_SHEETS) else _text(path)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}", code="file.unreadable") from error
    if start.startswith(_SHEETS):
        return sheet_table(data, path, form)
    if not data.strip():
        raise DatasetError(f"{path}: expected lines of numbers; the file is empty", code="file.no_numbers")
    return text_table(data, path, form)


def _text(path: Path) -> bytes:
    """Return the content of a text; DatasetError if it is too long, or as soon as a line is."""
    parts: list[bytes] = []
    length = since = line = 0
    with path.open("rb") as file:
        while part := file.read(_PIECE):
            length += len(part)
            ends = max(part.rfind(b"\n"), part.rfind(b"\r"))
            since = len(part) - ends if ends >= 0 else since + len(part)
            if since > 4 * MAX_LINE:  # four bytes are a character at most
                raise DatasetError(
                    f"{path}, line {line + 1}: expected at most {MAX_LINE} characters; it is longer",
                    code="file.too_large",
                )
            if length > MAX_FILE:
                raise DatasetError(f"{path}: expected at most {MAX_FILE} bytes; it is longer", code="file.too_large")
            line += part.count(b"\n")
            parts.append(part)
    return b"".join(parts)
