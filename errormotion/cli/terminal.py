"""The terminal as rich draws on it, for texts from files and devices, and the answers of the person at it."""

from __future__ import annotations

import select  # noqa: TID251 - of the terminal
import sys
import time
from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from errormotion.cli.output import printable

QUIET = 0.2
"""Time without input before a question is shown, s: what was typed or pasted before it has then arrived."""
QUIET_TIMEOUT = 5.0
"""Longest time for which input before a question is discarded, s."""


class Terminal(Console):
    """A console on stderr, whose texts contain no control characters but those of rich."""

    def __init__(self) -> None:
        super().__init__(stderr=True, highlight=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of anything that rich draws."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)

    def answer(self, question: str) -> str:
        """Show a question, and return the line that is typed after it; empty at the end of the input.

        What was typed or pasted before the question appeared is discarded: nobody has answered a question before it
        was asked.
        """
        of_person = sys.stdin.isatty()
        quiet = not of_person or _discard_typed()
        self.print(question, markup=False, soft_wrap=True, end="")
        if not of_person:
            return sys.stdin.readline()
        if not quiet:
            self.print("\nThe input did not pause before the question.")
            return ""
        with open(sys.stdin.fileno(), encoding=sys.stdin.encoding, errors="replace", closefd=False) as typed:
            return typed.readline()  # sys.stdin may contain lines of an earlier input


def _discard_typed() -> bool:
    """Discard the input of the terminal until it pauses; return whether it has done so."""
    end = time.monotonic() + QUIET_TIMEOUT
    while time.monotonic() < end:
        _flush()
        if not _has_input(QUIET):
            _flush()  # the start of a line, which does not count as input yet
            return True
    return False


if sys.platform == "win32":
    import msvcrt

    def _flush() -> None:
        while msvcrt.kbhit():
            msvcrt.getwch()

    def _has_input(timeout: float) -> bool:
        time.sleep(timeout)
        return msvcrt.kbhit()

else:
    import termios  # noqa: TID251 - of the user

    def _flush() -> None:
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)

    def _has_input(timeout: float) -> bool:
        return bool(select.select([sys.stdin.fileno()], [], [], timeout)[0])
