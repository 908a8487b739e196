"""Last data of an adapter: values by key, conditions by key and code, and the times of its clock."""

from __future__ import annotations

import math
from collections.abc import Mapping

from errormotion.errors import ProtocolError
from errormotion.instruments.controller.shdr.codec import UNAVAILABLE, Observed, parse_numbers

MAX_KEYS = 10_000
MAX_CONDITIONS = 1000


class Memory:
    """Last values of one device of an adapter.

    Attributes
    ----------
    values : dict of str to Observed
        Last values by key.
    conditions : dict of (str, str) to Observed
        Active warnings and faults, by key and code.
    doubtful : dict of str to str
        Why the last value of a key could not be told from its line.
    started, newest : float
        Times of the first and of the newest line, s since 1970; NaN if no line had a time.
    """

    def __init__(self) -> None:
        self.values: dict[str, Observed] = {}
        self.conditions: dict[tuple[str, str], Observed] = {}
        self.doubtful: dict[str, str] = {}
        self.started = self.newest = math.nan

    def clear(self) -> None:
        """Discard values and conditions; the clock continues."""
        self.values.clear()
        self.conditions.clear()
        self.doubtful.clear()

    def store(self, observed: Observed) -> None:
        """Store a value or condition.

        Raises
        ------
        ProtocolError
            There are more than `MAX_KEYS` values or `MAX_CONDITIONS` conditions.
        """
        if not math.isnan(observed.time):
            self.started = observed.time if math.isnan(self.started) else self.started
            self.newest = observed.time if math.isnan(self.newest) else max(self.newest, observed.time)
        if observed.level:
            self._condition(observed)
        elif observed.key in self.values or len(self.values) < MAX_KEYS:
            self.values[observed.key] = observed
            self.doubtful.pop(observed.key, None)
            if observed.doubt:
                self.doubtful[observed.key] = observed.doubt
        else:
            raise ProtocolError(
                f"Expected at most {MAX_KEYS} keys; found '{observed.key[:40]}' in addition",
                code="protocol.shdr.too_many",
            )

    def text(self, key: str) -> str:
        """Return a value; empty if it is unknown."""
        observed = self.values.get(key)
        return "" if observed is None or observed.value.upper() == UNAVAILABLE else observed.value

    def numbers(self, key: str, reasons: dict[str, str]) -> list[float]:
        """Return the numbers of a value, each NaN where it is unknown, at least one; why is added to ``reasons``."""
        observed = self.values.get(key)
        if observed is None:
            return [math.nan]
        numbers = []
        for word in observed.value.partition(":")[0].split() or [UNAVAILABLE]:
            try:
                numbers += parse_numbers(word)
            except ProtocolError as error:
                reasons[key] = str(error)
                numbers.append(math.nan)
        return numbers

    def reported(self, level: str) -> list[str]:
        """Return the texts of the conditions of a level, such as ``system 1104: overtravel``."""
        return [
            f"{' '.join(filter(None, (each.key, each.code)))}: {each.value}".rstrip(": ")
            for each in self.conditions.values()
            if each.level == level
        ]

    def changed(self, keys: Mapping[str, str] | list[str]) -> float:
        """Return the time of the newest of these keys, s since 1970; NaN if none has a time."""
        times = [self.values[key].time for key in keys if key in self.values]
        return max((time for time in times if not math.isnan(time)), default=math.nan)

    def _condition(self, observed: Observed) -> None:
        """Store or end a condition: a key may have several by code; NORMAL without a code ends all of them."""
        if observed.level in ("NORMAL", UNAVAILABLE):
            ended = [each for each in self.conditions if each[0] == observed.key and observed.code in ("", each[1])]
            for each in ended:
                del self.conditions[each]
        elif len(self.conditions) < MAX_CONDITIONS or (observed.key, observed.code) in self.conditions:
            self.conditions[observed.key, observed.code] = observed
        else:
            raise ProtocolError(f"Expected at most {MAX_CONDITIONS} conditions at once", code="protocol.shdr.too_many")
