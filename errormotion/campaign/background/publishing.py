"""Campaigns in separate processes, on the side of the process: publish the progress, wait for answers to requests.

All files are in one folder that only its user can access (mode 0700). ``status.json`` states the progress and the
open request; it is replaced by a rename. The file ``answer`` contains the number of the request that is done.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from errormotion.datasets.files.reading import parse_json, read_bytes
from errormotion.datasets.files.writing import replace_text
from errormotion.errors import RunError

STATUS, ANSWER, RELEASED = "status.json", "answer", "released.json"
INTERVAL = 0.5
"""Shortest interval between two updates of the progress, s."""
POLL_INTERVAL = 0.2
"""Interval between checks for an answer, s."""
MAX_TEXT = 2000
"""Longest text in the state, characters."""
MAX_TESTS = 1000
"""Number of tests that are listed in the state."""
MAX_ANSWER = 100
"""Largest size of an answer, bytes."""
MAX_RELEASED = 1 << 22
"""Largest size of the released motions, bytes."""


def store_released(folder: Path, motions: Sequence[str], sha256: str) -> None:
    """State the motions that a person has released, and the hash of the files from which they follow."""
    replace_text(folder / RELEASED, json.dumps({"motions": list(motions), "sha256": sha256}))


def released_in(folder: Path, sha256: str) -> Callable[[Sequence[str]], None]:
    """Return the release of a process: of the motions that a person was shown and has released, and of no others.

    The process reads the campaign again when it begins; a file may have changed since.
    """

    def release(motions: Sequence[str]) -> None:
        try:
            stated = parse_json(read_bytes(folder / RELEASED, MAX_RELEASED))
        except (OSError, ValueError):
            stated = None
        if stated != {"motions": list(motions), "sha256": sha256}:
            raise RunError(
                "Nothing has moved, and nothing was created: the motions are not those that were released, since the "
                "campaign or its bench file has changed meanwhile. Check the motions, and start it again.",
                code="motions.changed",
            )

    return release


class Published:
    """Progress of a campaign in a folder, a `Progress` of the runner; a context manager.

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

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        stopped = isinstance(error, KeyboardInterrupt)
        self._set(
            ended="finished" if error is None else "interrupted" if stopped else "failed",
            message="" if error is None else str(error)[:MAX_TEXT],
        )

    def announce(self, text: str) -> None:
        """State what motions and spindle speeds a test will command."""
        self._set(announcements=[*self._state["announcements"], text[:MAX_TEXT]][:MAX_TESTS])

    def test(self, name: str, folder: Path, number: int, total: int) -> None:
        """State the present test and its run folder."""
        tests = {**self._state["tests"], name: folder.name} if number < MAX_TESTS else self._state["tests"]
        self._set(test=name, number=number, total=total, tests=tests)

    def stage(self, name: str, total: float | None = None) -> None:
        """State the present stage."""
        self._set(stage=name, expected=total, done=0.0, note="")

    def advance(self, done: float) -> None:
        """State the completed amount of the stage; at most twice a second."""
        self._state["done"] = done
        self._write_if_due()

    @property
    def shown(self) -> bool:
        """Return True: notes are published."""
        return True

    def note(self, text: str) -> None:
        """State an intermediate result."""
        self._state["note"] = text[:MAX_TEXT]
        self._write_if_due()

    def ask(self, message: str) -> None:
        """Publish a request to the operator and wait until it is answered."""
        number = self._state["requests"] + 1
        self._set(requests=number, request={"number": number, "text": message[:MAX_TEXT]})
        try:
            while self._answered() != number:
                time.sleep(POLL_INTERVAL)
        finally:
            self._set(request=None)

    def _answered(self) -> int:
        """Return the number of the last answered request, or 0."""
        with suppress(OSError, ValueError):
            return int(read_bytes(self._folder / ANSWER, MAX_ANSWER))
        return 0

    def _set(self, **changes: Any) -> None:
        self._state |= changes
        self._write()

    def _write_if_due(self) -> None:
        if time.monotonic() - self._written >= INTERVAL:
            self._write()

    def _write(self) -> None:
        """Replace the state; a write error, such as a full disk, does not end the measurement."""
        self._written = time.monotonic()
        with suppress(OSError):
            replace_text(self._folder / STATUS, json.dumps(self._state), flush=False)
