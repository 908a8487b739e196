"""Output of commands: text in columns for a person, JSON for a program."""

from __future__ import annotations

import json
import math
import shutil
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

import typer

LEAST_WIDTH = 20
"""Characters; a narrower last column is not wrapped."""


def show(text: str = "") -> None:
    """Print for a person."""
    typer.echo(text)


def show_json(value: Any) -> None:
    """Print one JSON document; NaN and infinite numbers become null."""
    sys.stdout.write(json.dumps(_strict(value), indent=2, ensure_ascii=False, default=str) + "\n")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return rows in columns under a head, numbers to the right; on a terminal the last column is wrapped."""
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    right = [bool(rows) and all(_numeric(row[k]) for row in rows) for k in range(len(head))]
    room = shutil.get_terminal_size().columns - sum(widths[:-1]) - 2 * len(widths[:-1]) if sys.stdout.isatty() else 0
    if room >= LEAST_WIDTH:
        widths[-1] = min(widths[-1], room)
    lines = []
    for row in cells:
        last = (textwrap.wrap(row[-1], widths[-1]) if room >= LEAST_WIDTH else [row[-1]]) or [""]
        for number, piece in enumerate(last):
            shown = [*(row[:-1] if number == 0 else [""] * (len(row) - 1)), piece]
            parts = [
                cell.rjust(width) if side else cell.ljust(width)
                for cell, width, side in zip(shown, widths, right, strict=True)
            ]
            lines.append("  ".join(parts).rstrip())
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def _numeric(cell: str) -> bool:
    text = cell.strip().removeprefix("+").removeprefix("-").replace("−", "")
    return text in ("", "nan") or text.replace(".", "", 1).isdigit()


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _strict(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
