"""Assignment of printed positions to touches."""

from __future__ import annotations

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.touch_probe.dprnt.codec import Line
from errormotion.instruments.touch_probe.touching import NO_TRIP, NOWHERE, TRIPPED
from errormotion.plugins import Contact, Touch

REPEATED = -1
"""Result for a line that was printed twice."""


def touch_of(line: Line, touches: list[Touch], due: int, last: Line | None, first: int, margin: float) -> int:
    """Return the number of the touch (from 0) that a line belongs to, or `REPEATED`.

    A printed number determines the touch; numbers continue or restart from cycle to cycle. Without a number, the line
    belongs to the next touch whose path has this position. A touch before ``due`` belongs to the next cycle.

    Raises
    ------
    InstrumentError
        The position is on the path of no touch, or not on that of its number.
    """
    if line.number is not None:
        if last is not None and last.number == line.number and last.position == line.position:
            return REPEATED
        index: int = (line.number - first) % len(touches)
        if not is_on_path(line, touches[index], margin):
            raise InstrumentError(
                f"touch {line.number} was printed at {_text(line)}, which is not on the path of touch {index + 1}; "
                "check that program and touches agree, and the unit",
                code="touch.path.other",
            )
        return index
    candidates = [*range(due, len(touches)), *range(due)]
    numbers: list[int] = [index for index in candidates if is_on_path(line, touches[index], margin)]
    repeated = last is not None and last.position == line.position
    if repeated and (not numbers or numbers[0] != due):
        return REPEATED
    if not numbers:
        raise InstrumentError(
            f"a contact was printed at {_text(line)}, which is on the path of no touch; check that program and "
            "touches agree, and the unit of lengths",
            code="touch.path.none",
        )
    return numbers[0]


def is_on_path(line: Line, touch: Touch, margin: float) -> bool:
    """Whether a position is on the path of a touch, to a margin (m)."""
    start, path = np.array(touch.start), np.subtract(touch.target, touch.start)
    offset = np.array(line.position) - start
    along = np.clip(offset @ path / (path @ path), 0.0, 1.0)
    return bool(np.linalg.norm(offset - along * path) <= margin)


def contact_of(line: Line, touch: Touch, free: float, at_target: float) -> Contact:
    """Return the contact of a printed position; a skip move without a contact ends at its target."""
    path = np.subtract(touch.target, touch.start)
    length = float(np.linalg.norm(path))
    along = float(np.subtract(line.position, touch.start) @ path) / length
    if along >= length - at_target:
        return Contact(NOWHERE, line.time, NO_TRIP)
    if along < free:
        return Contact(NOWHERE, line.time, TRIPPED)
    return Contact(line.position, line.time)


def _text(line: Line) -> str:
    x, y, z = (1e3 * value for value in line.position)
    return f"X {x:.3f} Y {y:.3f} Z {z:.3f} mm"
