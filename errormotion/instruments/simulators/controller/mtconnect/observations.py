"""The buffer of an agent: observations with sequence numbers, and the state at each of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field

from errormotion.instruments.simulators.controller.mtconnect.machine import UNAVAILABLE, Condition, Value


@dataclass(frozen=True)
class Observation:
    """One observation of a data item.

    Attributes
    ----------
    sequence : int
    item : str
        Identifier of the data item.
    time : str
        ISO 8601, UTC.
    value : str, Condition, Series, or mapping
    """

    sequence: int
    item: str
    time: str
    value: Value


@dataclass
class State:
    """The latest observation of every data item; for a condition, one for each active native code."""

    latest: dict[str, dict[str, Observation]] = field(default_factory=dict)

    def apply(self, seen: Observation) -> None:
        """Add one observation: a normal condition without code ends all others of its data item."""
        if isinstance(seen.value, Condition) and seen.value.code:
            others = self.latest.setdefault(seen.item, {})
            others.pop("", None)
            others.pop(seen.value.code, None)
            if seen.value.level != "Normal":
                others[seen.value.code] = seen
            elif not others:
                others[""] = seen
        else:
            self.latest[seen.item] = {"": seen}

    def copy(self) -> State:
        """Return an independent copy."""
        return State({item: dict(active) for item, active in self.latest.items()})

    def observations(self, items: Container[str]) -> list[Observation]:
        """Return the latest observations of some data items, by sequence number."""
        found = [seen for item, active in self.latest.items() if item in items for seen in active.values()]
        return sorted(found, key=lambda seen: seen.sequence)


class Buffer:
    """The ring buffer of an agent.

    Parameters
    ----------
    size : int
        Number of stored observations.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.next = 1
        self.latest = State()
        self._stored: deque[Observation] = deque()
        self._before = State()  # at the sequence number before the first stored one

    @property
    def first(self) -> int:
        """Lowest stored sequence number."""
        return self._stored[0].sequence if self._stored else self.next

    def add(self, item: str, time: str, value: Value) -> None:
        """Add one observation; the oldest one is lost if the buffer is full."""
        seen = Observation(self.next, item, time, value)
        self.next += 1
        self._stored.append(seen)
        self.latest.apply(seen)
        if len(self._stored) > self.size:
            self._before.apply(self._stored.popleft())

    def values(self) -> Mapping[str, Value]:
        """Return the latest value of every data item."""
        return {
            item: max(active.values(), key=lambda seen: seen.sequence).value
            for item, active in self.latest.latest.items()
        }

    def at(self, sequence: int) -> State:
        """Return the state at a stored sequence number."""
        state = self._before.copy()
        for seen in self._stored:
            if seen.sequence > sequence:
                break
            state.apply(seen)
        return state

    def select(
        self, begin: int, count: int, items: Container[str], end: int | None = None
    ) -> tuple[list[Observation], int]:
        """Return at most ``count`` observations of some data items from ``begin`` on, and the next sequence number.

        A negative ``count`` goes backwards from ``begin``.
        """
        chosen: list[Observation] = []
        following = begin
        for seen in self._walk(begin, forwards=count > 0):
            if len(chosen) == abs(count) or (end is not None and seen.sequence >= end):
                break
            following = seen.sequence + (1 if count > 0 else -1)
            if seen.item in items:
                chosen.append(seen)
        return sorted(chosen, key=lambda seen: seen.sequence), max(following, 1)

    def _walk(self, begin: int, *, forwards: bool) -> Iterator[Observation]:
        if forwards:
            return (seen for seen in self._stored if seen.sequence >= begin)
        return (seen for seen in reversed(self._stored) if seen.sequence <= begin)


def empty_value(category: str) -> Value:
    """Return the value that an agent reports for a data item before its first value."""
    return Condition("Unavailable") if category == "CONDITION" else UNAVAILABLE
