"""The terminal as rich draws on it, for texts from files and devices."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from errormotion.cli.output import printable


class Terminal(Console):
    """A console on stderr, whose texts contain no control characters but those of rich."""

    def __init__(self) -> None:
        super().__init__(stderr=True, highlight=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of anything that rich draws."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)
