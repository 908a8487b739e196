"""Runs of one function over many tasks, in other processes where wanted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any


def mapped(function: Callable[[Any], Any], tasks: Sequence[Any], workers: int) -> list[Any]:
    """Return the results in the order of the tasks."""
    if workers < 2:
        return [function(task) for task in tasks]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(function, tasks, chunksize=4))
