"""What the axis does in a test, as steps and as an NC program (ISO 6983)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from errormotion.errors import MethodError
from errormotion.methods.linear_positioning import moving
from errormotion.methods.linear_positioning.planning.targets import positions, reach, seconds, sequence
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings

MM, MINUTE = 1e3, 60.0
PROGRAM = "positioning.nc"
_TOLERANCE = 1e-9


def stops(settings: Settings) -> Iterator[tuple[float, float, float]]:
    """Yield every position at which the axis stops, m, the feed towards it, m/s, and how long it rests there, s.

    Raises
    ------
    MethodError
        The axis would leave its limits.
    """
    if settings.moving is not None:
        yield from moving.stops(settings)
        return
    low, high = reach(settings)
    if settings.limits is not None:
        least, most = settings.limits
        if low < least - _TOLERANCE or high > most + _TOLERANCE:
            raise MethodError(
                f"limits: expected {settings.axis} from {least * MM:.3f} to {most * MM:.3f} mm; with an overrun of "
                f"{settings.overrun * MM:g} mm the test needs {low * MM:.3f} to {high * MM:.3f} mm. Shorten the travel "
                "of the targets."
            )
    for approach in sequence(settings):
        if approach.before is not None:
            yield approach.before, settings.feed, 0.0
        yield approach.place, settings.feed, settings.dwell


def steps(settings: Settings) -> list[Step]:
    """Return every step of the machine: the way to the start in rapid, then moves with the feed, and rests."""
    x, y, z = settings.start
    k = "XYZ".index(settings.axis)
    found: list[Step] = []
    last: float | None = None
    for place, feed, rest in stops(settings):
        where = [x, y, z]
        where[k] = place
        if last is None:
            found.append(Step("move", (where[0], where[1], where[2]), float("nan"), float("nan")))
        elif place != last:
            found.append(Step("move", (where[0], where[1], where[2]), feed, abs(place - last) / feed))
        last = place
        if rest > 0:
            found.append(Step("rest", None, float("nan"), rest))
    return found


def programs(settings: Settings) -> Mapping[str, str]:
    """Return the test as an NC program by file name: one line a move, a rest at each target.

    An instrument that records whenever the axis rests takes one reading a target, in the order of the program.
    """
    axis = settings.axis
    first, *others = steps(settings)
    if settings.moving is not None:
        P = np.array(moving.ends(settings))
        low, high = moving.ends(settings)
        what = f"{axis} after ISO 230-3, both ends of a moving axis"
        duration = math.fsum(step.seconds for step in others)
    else:
        P, (low, high), duration = positions(settings), reach(settings), seconds(settings)
        what = f"{axis} after ISO 230-2, {P.size} targets, {settings.runs} runs, {settings.cycle} cycles"
    lines = [
        "%",
        f"({PROGRAM}: {what})",
        f"({axis}{low * MM:.3f} to {axis}{high * MM:.3f} mm, about {duration / 60:.1f} min, dwells G4 P in s)",
        "(machine coordinates: work offset all zero, no tool length offset)",
        *(f"(target {i + 1}: {axis}{place * MM:.3f})" for i, place in enumerate(P)),
        "G90 G94 G21",
        f"G0 {_words(first)}",
    ]
    feed = math.nan
    for step in others:
        if step.place is None:
            lines.append(f"G4 P{step.seconds:.3f}")
        else:
            word = "" if step.feed == feed else f" F{step.feed * MM * MINUTE:.10g}"
            lines.append(f"G1 {axis}{step.place['XYZ'.index(axis)] * MM:.3f}{word}")
            feed = step.feed
    return {PROGRAM: "\n".join([*lines, "M30", "%", ""])}


def _words(step: Step) -> str:
    place = step.place or (0.0, 0.0, 0.0)
    return " ".join(f"{name}{value * MM:.3f}" for name, value in zip("XYZ", place, strict=True))
