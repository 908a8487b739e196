"""Runs of one function over many tasks, optionally in other processes, and stored in a folder."""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Pool:
    """Processes, and a folder of results of earlier runs.

    Results are stored by function and task, not by version: a folder is for one state of the code.
    """

    workers: int = 1
    folder: Path | None = None

    def mapped(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> list[Any]:
        """Return the results in the order of the tasks."""
        kept = _Kept(function, self.folder)
        if self.workers < 2:
            return [kept(task) for task in tasks]
        with ProcessPoolExecutor(self.workers) as pool:
            return list(pool.map(kept, tasks, chunksize=4))


@dataclass(frozen=True)
class _Kept:
    function: Callable[[Any], Any]
    folder: Path | None

    def __call__(self, task: Any) -> Any:
        if self.folder is None:
            return self.function(task)
        name = f"{self.function.__module__}.{self.function.__qualname__} {task!r}"
        path = self.folder / f"{hashlib.sha256(name.encode()).hexdigest()[:24]}.pickle"
        if path.exists():
            return pickle.loads(path.read_bytes())
        found = self.function(task)
        self.folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        part.write_bytes(pickle.dumps(found))
        part.replace(path)
        return found
