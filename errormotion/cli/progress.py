"""Progress bars with the remaining time on a terminal; no output elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self

from rich.console import RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from errormotion.campaign.planning.release import WORD, refuse, require_word
from errormotion.cli.curves import Curves
from errormotion.cli.terminal import Terminal


def on_terminal() -> bool:
    """Return whether a person can be asked: input and messages are on a terminal."""
    return sys.stdin.isatty() and sys.stderr.isatty()


class _Display(Progress):
    """Bars, and curves below them."""

    def __init__(
        self, curves: Callable[[], Curves], *columns: ProgressColumn, console: Terminal, disable: bool
    ) -> None:
        self._curves, self._own = curves, console
        super().__init__(*columns, console=console, disable=disable)

    def get_renderables(self) -> Iterator[RenderableType]:
        yield from super().get_renderables()
        yield from self._curves().lines(self._own.width)


class Bars:
    """Progress of a campaign as bars on stderr; where stderr is no terminal, only announcements of motions are printed.

    Parameters
    ----------
    quiet : bool
        Show no bars.
    announcing : bool
        Print the motions of each test before it starts, also without bars.
    """

    def __init__(self, quiet: bool = False, *, announcing: bool = False) -> None:
        self._announcing = announcing
        self._console = Terminal()
        self._shown = not quiet and sys.stderr.isatty()
        self._curves = Curves()
        self._progress = _Display(
            lambda: self._curves,
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=self._console,
            disable=not self._shown,
        )
        self._task: TaskID | None = None
        self._name = ""

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._finish(error is None)
        self._progress.stop()

    def announce(self, text: str) -> None:
        """Print on one line how a test will move the machine."""
        if self._announcing:
            self._console.print(text, markup=False, soft_wrap=True)

    def test(self, name: str, folder: Path, number: int, total: int) -> None:
        """Start a test."""
        self._finish()
        self._name = f"{number + 1}/{total} {name}: "
        if self._shown:
            self._progress.console.print(f"test {number + 1} of {total}, {name}: {folder}")

    def stage(self, name: str, total: float | None = None) -> None:
        """Start a stage of a test."""
        self._finish()
        self._curves = Curves()
        self._task = self._progress.add_task(self._name + name, total=total, note="")

    def advance(self, done: float) -> None:
        """Show the completed part of the stage."""
        if self._task is not None:
            self._progress.update(self._task, completed=done)

    @property
    def shown(self) -> bool:
        """Whether the bars are shown on a terminal."""
        return self._shown

    def note(self, text: str) -> None:
        """Show an intermediate result beside the bar, and its values as curves below."""
        self._curves.add(text)
        if self._task is not None:
            self._progress.update(self._task, note=text)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Hide the bars, so that a person can read and type."""
        self._progress.stop()
        try:
            yield
        finally:
            self._progress.start()

    def ask(self, message: str) -> None:
        """Show a request to the operator and wait for Enter."""
        with self.paused():
            self._console.answer(f"\n{message}\nPress Enter when it is done, Ctrl-C to stop: ")

    def release(self, motions: Sequence[str]) -> None:
        """Show the motions of the tests, and wait for the word that releases them.

        Raises
        ------
        RunError
            Another text was typed, or the input is not a terminal. Nothing has moved.
        """
        if not on_terminal():
            refuse(motions)
        self._progress.stop()
        try:
            if not self._announcing:
                for line in motions:
                    self._console.print(line, markup=False, soft_wrap=True)
            question = "The machine is not simulated. Type '{}' to release these motions, anything else to end: "
            require_word(self._console.answer("\n" + question.format(WORD)))
        finally:
            self._progress.start()

    def _finish(self, well: bool = True) -> None:
        if self._task is None:
            return
        if well:
            task = self._progress.tasks[self._progress.task_ids.index(self._task)]
            self._progress.update(self._task, total=task.completed or 1, completed=task.completed or 1)
        self._progress.stop_task(self._task)
        self._task = None
