"""Output of commands: text and tables for users, JSON for programs."""

from __future__ import annotations

import json
import math
import re
import shutil
import sys
import textwrap
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from typing import Any

import typer

MIN_WIDTH = 12
"""Smallest width of a column of text, characters."""


NOTICE_DELAY = 1.0
"""Duration after which a line states what the command is doing, s."""


_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Characters that a terminal executes: controls other than tab and line feed, and changes of direction; and bytes of a
file name that are no text, which cannot be printed."""


def printable(text: str) -> str:
    r"""Return a text with its control characters as escapes, such as \x1b.

    Names, messages and notes come from files and devices; as they are, they could retitle the window of the terminal,
    write to its clipboard or hide what was printed.
    """
    return _CONTROL.sub(_escape, text)


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def show(text: str = "", *, err: bool = False) -> None:
    """Print a text; on stderr with ``err``."""
    typer.echo(printable(text), err=err)  # noqa: TID251 - the one place


def show_json(value: Any) -> None:
    """Print one JSON document; NaN and infinite numbers become null."""
    text = json.dumps(_strict(value), indent=2, ensure_ascii=False, default=str)
    sys.stdout.write(_CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text) + "\n")


def failure(message: str, *, code: str, **about: Any) -> dict[str, Any]:
    """Return the member ``error`` of a JSON document, by whose code a program distinguishes failures."""
    return {"error": {"code": code, "message": message, **about}}


@contextmanager
def working(what: str) -> Iterator[None]:
    """Print on a terminal what the command is doing, if the block takes longer than `NOTICE_DELAY`."""
    timer = threading.Timer(NOTICE_DELAY, lambda: show(f"{what} ...", err=True))
    timer.daemon = True
    if sys.stderr.isatty():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table with aligned columns; numbers are aligned to the right.

    On a terminal the widest columns of text are wrapped to fit its width. Where that is not enough, each
    row becomes a block with a line for each column.
    """
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    right = [bool(rows) and all(_numeric(row[k]) for row in rows) for k in range(len(head))]
    if sys.stdout.isatty():
        room = shutil.get_terminal_size().columns
        fitting = _fit(widths, right, room)
        if fitting is None:
            return _blocks(cells, room)
        widths = fitting
    lines = []
    for row in cells:
        columns = [_wrap(cell, width) for cell, width in zip(row, widths, strict=True)]
        for pieces in zip_longest(*columns, fillvalue=""):
            parts = [
                piece.rjust(width) if side else piece.ljust(width)
                for piece, width, side in zip(pieces, widths, right, strict=True)
            ]
            lines.append("  ".join(parts).rstrip())
        if row is cells[0]:
            lines.append("  ".join("-" * width for width in widths))
    return "\n".join(lines)


def _fit(widths: Sequence[int], right: Sequence[bool], room: int) -> list[int] | None:
    """Return column widths that fit into the room, the widest columns of text reduced first; None where none fit."""
    found = list(widths)
    while sum(found) + 2 * (len(found) - 1) > room:
        wide = [k for k, width in enumerate(found) if not right[k] and width > MIN_WIDTH]
        if not wide:
            return None
        found[max(wide, key=lambda k: found[k])] -= 1
    return found


def _blocks(cells: Sequence[Sequence[str]], room: int) -> str:
    """Return each row as a block, with a line for each cell that is not empty."""
    head, *rows = cells
    label = max(map(len, head)) + 2
    blocks = []
    for row in rows:
        lines = []
        for name, cell in zip(head, row, strict=True):
            pieces = _wrap(cell, max(room - label, MIN_WIDTH)) if cell.strip() else []
            lines += [f"{name if n == 0 else '':<{label}}{piece}" for n, piece in enumerate(pieces)]
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


def _wrap(cell: str, width: int) -> list[str]:
    return [cell] if len(cell) <= width else textwrap.wrap(cell, width) or [""]


def _numeric(cell: str) -> bool:
    text = cell.strip().removeprefix("+").removeprefix("-").replace("−", "")
    return text in ("", "nan") or text.replace(".", "", 1).isdigit()


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _strict(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
