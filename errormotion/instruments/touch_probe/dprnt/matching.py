"""Which touch a printed position belongs to, and what it states of it."""

from __future__ import annotations

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.touch_probe.dprnt.codec import Line
from errormotion.instruments.touch_probe.touching import NO_TRIP, NOWHERE, TRIPPED
from errormotion.plugins import Contact, Touch

REPEATED = -1
"""Instead of a touch: the line was printed twice."""


def place_of(line: Line, touches: list[Touch], due: int, last: Line | None, first: int, margin: float) -> int:
    """Return the number of the touch (from 0) that a line belongs to, or `REPEATED`.

    A printed number decides, and goes on counting or starts again from cycle to cycle. Without one it is the next touch
    whose way the position lies on; a number before the one that is due then belongs to the next cycle.

    Raises
    ------
    InstrumentError
        The position lies on the way of no touch, or not on that of its number.
    """
    if line.number is not None:
        if last is not None and last.number == line.number and last.position == line.position:
            return REPEATED
        place: int = (line.number - first) % len(touches)
        if not lies_on(line, touches[place], margin):
            raise InstrumentError(
                f"touch {line.number} was printed at {_told(line)}, which is not on the way of touch {place + 1}; are "
                "program and touches the same, and the lengths in the right unit?"
            )
        return place
    candidates = [*range(due, len(touches)), *range(due)]
    found: list[int] = [place for place in candidates if lies_on(line, touches[place], margin)]
    repeated = last is not None and last.position == line.position
    if repeated and (not found or found[0] != due):
        return REPEATED
    if not found:
        raise InstrumentError(
            f"a contact was printed at {_told(line)}, which is on the way of no touch; are program and touches the "
            "same, and the lengths in the right unit?"
        )
    return found[0]


def lies_on(line: Line, touch: Touch, margin: float) -> bool:
    """Whether a position lies on the way of a touch, to a margin (m)."""
    start, way = np.array(touch.start), np.subtract(touch.target, touch.start)
    offset = np.array(line.position) - start
    along = np.clip(offset @ way / (way @ way), 0.0, 1.0)
    return bool(np.linalg.norm(offset - along * way) <= margin)


def contact_of(line: Line, touch: Touch, free: float, at_target: float) -> Contact:
    """Return what a printed position states of its touch: a skip move that nothing stopped ends at its target."""
    way = np.subtract(touch.target, touch.start)
    length = float(np.linalg.norm(way))
    along = float(np.subtract(line.position, touch.start) @ way) / length
    if along >= length - at_target:
        return Contact(NOWHERE, line.time, NO_TRIP)
    if along < free:
        return Contact(NOWHERE, line.time, TRIPPED)
    return Contact(line.position, line.time)


def _told(line: Line) -> str:
    x, y, z = (1e3 * value for value in line.position)
    return f"X {x:.3f} Y {y:.3f} Z {z:.3f} mm"
