"""The memory of an LJ-X8000A: single profiles, or batches."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

MAX_PROFILES = 2048
"""Profiles kept; the oldest ones are dropped. Fewer than in the device, so that a simulator takes at most 25 MB."""


@dataclass
class Batch:
    """Successive profiles, numbered from 0.

    Attributes
    ----------
    number : int
        Of the batch.
    count : int
        Profiles measured.
    oldest : int
        Number of the oldest profile kept.
    committed : bool
        Whether the batch has ended.
    """

    number: int
    count: int = 0
    oldest: int = 0
    committed: bool = False
    _blocks: deque[Array] = field(default_factory=deque)

    def add(self, rows: Array) -> None:
        """Add profiles, (n, words)."""
        self._blocks.append(rows)
        self.count += len(rows)

    def rows(self, first: int, count: int) -> Array:
        """Return profiles that are kept, (count, words)."""
        parts, number = [], self.oldest
        for block in self._blocks:
            low, high = max(0, first - number), min(len(block), first + count - number)
            if low < high:
                parts.append(block[low:high])
            number += len(block)
        return np.concatenate(parts)

    def drop_before(self, number: int) -> None:
        """Drop the profiles before one."""
        while self._blocks and self.oldest < number:
            block = self._blocks.popleft()
            here = min(len(block), number - self.oldest)
            if here < len(block):
                self._blocks.appendleft(block[here:])
            self.oldest += here

    @property
    def kept(self) -> int:
        """Number of profiles kept."""
        return self.count - self.oldest


class Memory:
    """The last profiles."""

    def __init__(self) -> None:
        self.batches: deque[Batch] = deque()
        self._next = 0

    def clear(self) -> None:
        """Drop everything."""
        self.batches.clear()
        self._next = 0

    def open_batch(self) -> Batch:
        """Start and return a new batch."""
        batch = Batch(self._next)
        self._next += 1
        self.batches.append(batch)
        return batch

    @property
    def newest(self) -> Batch | None:
        """The batch that was opened last."""
        return self.batches[-1] if self.batches else None

    def batch(self, number: int) -> Batch | None:
        """Return a batch by its number; None if it is not kept."""
        return next((batch for batch in self.batches if batch.number == number), None)

    def add(self, rows: Array) -> None:
        """Add profiles to the newest batch; drop the oldest ones beyond the limit."""
        (self.newest or self.open_batch()).add(rows)
        excess = sum(batch.kept for batch in self.batches) - MAX_PROFILES
        while excess > 0:
            oldest = self.batches[0]
            dropped = min(excess, oldest.kept)
            oldest.drop_before(oldest.oldest + dropped)
            excess -= dropped
            if not oldest.kept and len(self.batches) > 1:
                self.batches.popleft()
