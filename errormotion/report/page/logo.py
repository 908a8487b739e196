"""The logo of a laboratory: a picture of limited size, copied into a run folder and embedded into the report."""

from __future__ import annotations

import base64
import re
from pathlib import Path

from errormotion.datasets.files.reading import leaves, read_bytes
from errormotion.datasets.files.writing import replace_bytes

LARGEST = 512 << 10
"""Bytes."""
NAME = "logo"
"""Name of the copy in a run folder, without its suffix."""
PICTURES = {
    ".png": (b"\x89PNG\r\n", "image/png"),
    ".jpg": (b"\xff\xd8\xff", "image/jpeg"),
    ".svg": (b"", "image/svg+xml"),
}
"""First bytes of a file by suffix, and its media type."""
_SVG = re.compile(
    rb"(\xef\xbb\xbf)?(?>\s+|<\?xml\s(?>[^>]*\?>)|<!--(?>.*?-->)|<!DOCTYPE[^>\[]*>)*+<(\w+:)?svg[\s/>]", re.DOTALL
)
"""Begin of a picture of SVG: its first element, behind a declaration and comments; no entities, no style sheets.
Nothing is tried twice, so that the time is proportional to the length."""


def mistake(path: Path) -> str:
    """Return why a file cannot be used as a logo; empty if it can."""
    known = PICTURES.get(path.suffix.lower())
    if known is None:
        return f"expected a picture ({', '.join(PICTURES)}); found '{path.name}'"
    try:
        data = read_bytes(path, LARGEST)
    except OSError as error:
        return f"{path} cannot be read: {error.strerror}"
    fits = data.startswith(known[0]) if known[0] else _SVG.match(data)
    return "" if fits else f"{path} is not of type {known[1]}"


def copy(path: Path, folder: Path) -> None:
    """Copy a logo into a run folder, if it can still be used."""
    if not mistake(path):
        replace_bytes(folder / f"{NAME}{path.suffix.lower()}", read_bytes(path, LARGEST))


def of_folder(folder: Path) -> str:
    """Return the logo of a run folder as a data URI; empty without one."""
    for suffix, (_, kind) in PICTURES.items():
        path = folder / f"{NAME}{suffix}"
        if path.is_file() and not leaves(folder, path) and not mistake(path):
            return f"data:{kind};base64,{base64.b64encode(read_bytes(path, LARGEST)).decode()}"
    return ""
