"""Curves in the terminal: a line of block characters for each value that a running measurement reports."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

from rich.text import Text

BLOCKS = "▁▂▃▄▅▆▇█"

MAX_POINTS = 240
"""Largest number of points of a curve; a full curve is halved by averaging neighbours."""

MAX_CURVES = 8

_VALUES = re.compile(r"\b([A-Za-z]\w{0,11}) ([+-]\d+(?:\.\d+)?)(?![\w.])")
_UNIT = re.compile(r"\s*([A-Za-z/]+)?(?:,|$)")


def bars(values: list[float], least: float = 0.0) -> str:
    """Return values as block characters, scaled from the lowest to the highest value, or at least over ``least``.

    Unknown values are blank.
    """
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return ""
    low, span = min(known), max(max(known) - min(known), least) or 1.0
    top = len(BLOCKS) - 1
    return "".join(" " if math.isnan(v) else BLOCKS[round((v - low) / span * top)] for v in values)


class Curves:
    """Curves of the values in notes such as ``EX +1.2 EY -0.3 um, EA +4.0 arcsec``, from the start of a stage.

    Memory and width are bounded: a full curve averages neighbouring points, and then twice as many notes per point.
    """

    def __init__(self) -> None:
        self._curves: dict[str, _Curve] = {}
        self._units: dict[str, str] = {}

    def add(self, note: str) -> None:
        """Add the values of a note: signed numbers, each after its name."""
        waiting = []
        for found in _VALUES.finditer(note):
            name, value = found[1], float(found[2])
            if name not in self._curves and len(self._curves) >= MAX_CURVES:
                continue
            self._curves.setdefault(name, _Curve()).add(value)
            waiting.append(name)
            unit = _UNIT.match(note, found.end())
            if unit is not None:  # one unit for all values since the last
                self._units |= dict.fromkeys(waiting, unit[1] or "")
                waiting = []

    @property
    def shown(self) -> bool:
        """Whether there is at least one curve."""
        return bool(self._curves)

    def lines(self, width: int) -> Iterator[Text]:
        """Yield a line for each curve: name, block characters, last value, and range."""
        for name, curve in self._curves.items():
            shown = curve.points[-MAX_POINTS:]
            room = max(width - len(name) - 44, 10)
            step = -(-len(shown) // room)
            thinned = [sum(part) / len(part) for part in (shown[k : k + step] for k in range(0, len(shown), step))]
            low, high = curve.extremes
            last = f"{curve.last:+.4g} {self._units.get(name, '')}".rstrip()
            yield Text(
                f"  {name}  {bars(thinned)}  {last}  ({low:+.4g} to {high:+.4g})", no_wrap=True, overflow="ellipsis"
            )


class _Curve:
    """One curve; each point is the mean of the same number of notes."""

    def __init__(self) -> None:
        self.points: list[float] = []
        self.extremes = (math.inf, -math.inf)
        self.last = math.nan
        self._joined = 1
        self._sum, self._count = 0.0, 0

    def add(self, value: float) -> None:
        self.last = value
        self.extremes = min(self.extremes[0], value), max(self.extremes[1], value)
        self._sum, self._count = self._sum + value, self._count + 1
        if self._count < self._joined:
            return
        self.points.append(self._sum / self._count)
        self._sum, self._count = 0.0, 0
        if len(self.points) >= MAX_POINTS:
            self.points = [(a + b) / 2 for a, b in zip(self.points[::2], self.points[1::2], strict=True)]
            self._joined *= 2
