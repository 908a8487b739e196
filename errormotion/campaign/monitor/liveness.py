"""Whether a sensor still measures: values that stop changing, and two sensors with the same changes.

A gateway can repeat a value from its cache for ever, with a new time each. The value alone does not show it: a sensor
with a resolution of 0.1 K in a stable room repeats its value for hours as well. The noise of a sensor, as seen in its
own values, decides how often it can repeat a value.

**Unchanging values.** Readings are compared in blocks of ten. The score of a block is the number of different values
in it if these are at least three and go up and down, else 1: trends, and a coarse value that flickers between two
neighbours, prove no noise. For a standard deviation ``s`` of the noise, in units of the resolution, and values at a
place ``f`` between two steps, the expected score is

    E = sum_j [1 - (1 - p_j)^10] - sum_(i<j) [(p_i + p_j)^10 - p_i^10 - p_j^10],   p_j = P(value j)

and its maximum over ``f`` increases with ``s``. The mean score of the last blocks, less two standard deviations, is
thus a lower bound of ``s``. A value is then repeated with a probability of at most ``p = erf(1 / (2 sqrt(2) s))``,
wherever it lies between two steps, and N times in a row with p^N. A sensor does not change if this is below
`FALSE_ALARM`. With p above `LARGEST_REPETITION` the noise is hidden by the resolution, and nothing is decided.

**Equal changes.** Two sensors with independent noise, both of which change by steps, disagree sooner or later: of two
changes to and fro, both are simultaneous and equal with a probability of at most 1/9 (maximum over the probability p
of the more frequent value, of (1-p)/(1+p) p/(2-p)). After `COMMON_CHANGES` of them without one disagreement, fewer than
one in 10^9 by chance, both sensors are one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations

import numpy as np

from errormotion.arrays import Array

BLOCK = 10
"""Readings of a block."""
BLOCKS = 30
"""Last blocks that are evaluated."""
FEWEST_BLOCKS = 3
"""Blocks without which nothing is decided."""
FEWEST_VALUES, FEWEST_REVERSALS = 3, 3
"""Different values, and changes of direction, that prove noise."""
FALSE_ALARM = 1e-9
"""Probability that a measuring sensor repeats its value so often, for each change of the value."""
SHORTEST = 60
"""Fewest repetitions that are reported: a gateway may bridge a short failure."""
LARGEST_REPETITION = 0.95
"""Probability of a repetition above which the noise is hidden by the resolution."""
COMMON_CHANGES = 20
RUNS = 20
"""Last sequences of equal values, the shortest of which is the interval of the sensor, in readings."""


@dataclass
class _Sensor:
    """Values of one sensor."""

    last: float = math.nan
    repeats: int = 0
    changed: bool = False
    runs: deque[int] = field(default_factory=lambda: deque(maxlen=RUNS))
    block: list[float] = field(default_factory=list)
    scores: deque[int] = field(default_factory=lambda: deque(maxlen=BLOCKS))
    skipped: int = 0

    def put(self, value: float) -> None:
        self.changed = value != self.last
        if self.changed:
            if not math.isnan(self.last):
                self.runs.append(self.repeats + 1)
            self.last, self.repeats = value, 0
        else:
            self.repeats += 1
        self.skipped += 1
        if (
            self.skipped < self.interval or self.repeats >= BLOCK * self.interval
        ):  # a block of repetitions proves nothing
            return
        self.skipped = 0
        self.block.append(value)
        if len(self.block) == BLOCK:
            self.scores.append(_score(self.block))
            self.block.clear()

    @property
    def interval(self) -> int:
        """Readings from one value of the device to its next one."""
        return min(self.runs, default=1)

    @property
    def most(self) -> float:
        """Most repetitions that its noise allows; infinite if unknown."""
        if len(self.scores) < FEWEST_BLOCKS:
            return math.inf
        scores = np.array(self.scores, dtype=float)
        bound = scores.mean() - 2 * max(float(scores.std()), 0.5) / math.sqrt(len(scores))
        repetition = largest_repetition(float(bound))
        if repetition > LARGEST_REPETITION:
            return math.inf
        return self.interval * max(SHORTEST, math.ceil(math.log(FALSE_ALARM) / math.log(repetition)))


class Liveness:
    """Finds sensors that no longer measure, from the readings of a monitor."""

    def __init__(self) -> None:
        self._sensors: dict[str, _Sensor] = {}
        self._common: dict[tuple[str, str], int] = {}

    def put(self, values: Mapping[str, float]) -> None:
        """Take the readings of one time, degC; NaN and absent: unknown. A value that was not read again is absent."""
        known = {name: float(value) for name, value in values.items() if math.isfinite(value)}
        for name, value in known.items():
            self._sensors.setdefault(name, _Sensor()).put(value)
        for pair in [pair for pair in self._common if any(name in known for name in pair)]:
            first, second = (known.get(name, math.nan) for name in pair)
            if first != second:
                del self._common[pair]
        changed: dict[float, list[str]] = {}
        for name, value in known.items():
            if self._sensors[name].changed:
                changed.setdefault(value, []).append(name)
        for names in changed.values():
            for pair in combinations(sorted(names), 2):
                self._common[pair] = self._common.get(pair, 0) + 1

    def found(self) -> dict[str, str]:
        """Return the sensors that no longer measure, and why: the end of a sentence that begins with the name."""
        wrong = dict(self._unchanging())
        for (first, second), count in self._common.items():
            if count >= COMMON_CHANGES:
                for name, other in ((first, second), (second, first)):
                    wrong.setdefault(name, f"has the same changes as {other}")
        return wrong

    def _unchanging(self) -> Iterator[tuple[str, str]]:
        for name, sensor in self._sensors.items():
            if sensor.repeats >= SHORTEST and sensor.repeats >= sensor.most:
                yield name, "repeats one value, in spite of its noise"


def _score(block: list[float]) -> int:
    """Return the number of different values if they prove noise, else 1."""
    count = len(set(block))
    steps = np.sign(np.diff(block))
    steps = steps[steps != 0]
    reversals = int(np.count_nonzero(steps[1:] != steps[:-1]))
    return count if count >= FEWEST_VALUES and reversals >= FEWEST_REVERSALS else 1


def largest_repetition(score: float) -> float:
    """Return the largest probability that a value is repeated, for a lower bound of the mean score; 1 without noise."""
    noise, expected = _scores()
    s = float(np.interp(score, expected, noise))
    return math.erf(0.5 / (math.sqrt(2.0) * s))


@cache
def _scores() -> tuple[Array, Array]:
    """Return standard deviations of the noise, in units of the resolution, and the largest expected score of each."""
    noise = np.geomspace(0.1, 8.0, 60)
    return noise, np.maximum.accumulate([max(_expected(float(s), f) for f in np.linspace(0.0, 0.5, 11)) for s in noise])


def _expected(s: float, f: float) -> float:
    half = math.ceil(5 * s) + 1
    edges = np.arange(-half, half + 2) - 0.5 - f
    p = np.diff([0.5 * (1 + math.erf(float(x) / (math.sqrt(2.0) * s))) for x in edges])
    i, j = np.triu_indices(p.size, 1)
    two = (p[i] + p[j]) ** BLOCK - p[i] ** BLOCK - p[j] ** BLOCK
    return float(np.sum(1 - (1 - p) ** BLOCK) - np.sum(two))
