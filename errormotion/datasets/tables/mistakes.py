"""Mistakes in a file, reported in one error and grouped by kind."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from errormotion.errors import DatasetError

_MAX_REPORTED = 20
"""Largest number of kinds of mistakes that are reported with their text."""
_MAX_KINDS = 1000
"""Largest number of kinds of mistakes that are distinguished."""
_MAX_LINES = 5
"""Largest number of lines that are named for one kind of mistake."""
_MAX_SINGLE = 3
"""Largest number of mistakes of one kind, with different texts, that are reported one by one."""


@dataclass
class _Kind:
    """Mistakes of one kind: line and text of the first ones, and their number."""

    first: list[tuple[int, str]]
    count: int = 1
    alike: bool = True

    def shown(self) -> list[str]:
        if self.count <= _MAX_SINGLE and not self.alike:
            return [f"line {line}: {text}" if line else text for line, text in self.first]
        lines = [str(line) for line, _ in self.first if line]
        text = self.first[0][1]
        if not lines:
            return [text]
        rest = self.count - len(self.first)
        others = f" and {rest} more" if rest else f" and {lines.pop()}" if self.count > 1 else ""
        where = f"line{'s' if self.count > 1 else ''} {', '.join(lines)}{others}"
        return [f"{where}: {text}" + ("" if self.alike else f" in line {lines[0]}")]


@dataclass
class Mistakes:
    """Mistakes in a file, grouped by kind: the first kinds with their text, the others counted."""

    path: Path
    count: int = 0
    _kinds: dict[str, _Kind] = field(default_factory=dict, repr=False)

    def add(self, line: int, text: str, kind: str = "") -> None:
        """Add one mistake; ``line`` 0 is the file as a whole.

        Mistakes of one ``kind`` are reported together with the text of the first one. The default kind is the text up
        to the found value.
        """
        self.count += 1
        key = kind or text.partition("; found")[0]
        known = self._kinds.get(key)
        if known is not None:
            known.count += 1
            known.alike &= text == known.first[0][1]
            if len(known.first) < _MAX_LINES:
                known.first.append((line, text))
        elif len(self._kinds) < _MAX_KINDS:
            self._kinds[key] = _Kind([(line, text)])

    @property
    def first(self) -> str:
        """Text of the first mistake; empty if there is none."""
        return next((kind.first[0][1] for kind in self._kinds.values()), "")

    def raise_any(self) -> None:
        """Raise DatasetError if there are any."""
        if self.count:
            kinds = sorted(list(self._kinds.values())[:_MAX_REPORTED], key=lambda kind: kind.first[0][0])
            rest = self.count - sum(kind.count for kind in kinds)
            number = "1 mistake" if self.count == 1 else f"{self.count} mistakes"
            shown = [text for kind in kinds for text in kind.shown()]
            raise DatasetError(
                f"{self.path}: {number}; nothing was imported",
                [*shown, *([f"and {rest} more"] if rest else [])],
                code="import.mistakes",
            )
