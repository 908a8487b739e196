"""The side of the process that measures: it publishes its progress, and waits for answers to its requests.

Everything is in one folder that only its user may enter (mode 0700). ``status.json`` states the progress and the
request that waits; it is replaced by a rename. The file ``answer`` holds the number of the request that is done.
"""

from __future__ import annotations

import json
import os
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from errormotion.datasets.files.reading import read_bytes

STATUS, ANSWER = "status.json", "answer"
INTERVAL = 0.5
"""Shortest time between two states of the progress, s."""
POLL_INTERVAL = 0.2
"""Of the look for an answer, s."""
LONGEST_TEXT = 2000
"""Characters of a text in the state."""
MOST_TESTS = 1000
LONGEST_ANSWER = 100
"""Bytes of an answer."""


class Published:
    """Progress of a campaign in a folder, as `Progress` of the runner; usable as a context.

    Parameters
    ----------
    folder : Path
        An existing folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._written = 0.0
        self._state: dict[str, Any] = {"pid": os.getpid(), "announcements": [], "tests": {}, "requests": 0}

    def __enter__(self) -> Self:
        self._write()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        stopped = isinstance(error, KeyboardInterrupt)
        self._set(
            ended="finished" if error is None else "interrupted" if stopped else "failed",
            message="" if error is None else str(error)[:LONGEST_TEXT],
        )

    def announce(self, text: str) -> None:
        """State what a test will do with the machine."""
        self._set(announcements=[*self._state["announcements"], text[:LONGEST_TEXT]][:MOST_TESTS])

    def test(self, name: str, folder: Path, number: int, total: int) -> None:
        """State which test is measured, and where."""
        tests = {**self._state["tests"], name: folder.name} if number < MOST_TESTS else self._state["tests"]
        self._set(test=name, number=number, total=total, tests=tests)

    def stage(self, name: str, total: float | None = None) -> None:
        """State the stage."""
        self._set(stage=name, expected=total, done=0.0, note="")

    def advance(self, done: float) -> None:
        """State how much of the stage is done; not more often than twice a second."""
        self._state["done"] = done
        self._sometimes()

    @property
    def shown(self) -> bool:
        """Return True: notes are shown."""
        return True

    def note(self, text: str) -> None:
        """State an intermediate result."""
        self._state["note"] = text[:LONGEST_TEXT]
        self._sometimes()

    def ask(self, message: str) -> None:
        """Publish a request to the operator and wait until it is answered."""
        number = self._state["requests"] + 1
        self._set(requests=number, request={"number": number, "text": message[:LONGEST_TEXT]})
        try:
            while self._answered() != number:
                time.sleep(POLL_INTERVAL)
        finally:
            self._set(request=None)

    def _answered(self) -> int:
        """Return the number of the last request that was answered; 0 for none."""
        with suppress(OSError, ValueError):
            return int(read_bytes(self._folder / ANSWER, LONGEST_ANSWER))
        return 0

    def _set(self, **changes: Any) -> None:
        self._state |= changes
        self._write()

    def _sometimes(self) -> None:
        if time.monotonic() - self._written >= INTERVAL:
            self._write()

    def _write(self) -> None:
        """Replace the state; a full disk does not end a measurement because of it."""
        self._written = time.monotonic()
        part = self._folder / f"{STATUS}.part"
        with suppress(OSError):
            part.write_text(json.dumps(self._state), encoding="utf-8")
            part.replace(self._folder / STATUS)
