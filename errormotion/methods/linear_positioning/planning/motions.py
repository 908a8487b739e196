"""Motions of the axis in a test, as steps and as an NC program (ISO 6983)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from errormotion.methods.linear_positioning import moving
from errormotion.methods.linear_positioning.planning.targets import positions, reach, seconds, sequence
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

MM, MINUTE = 1e3, 60.0
PROGRAM = "positioning.nc"


def stops(settings: LinearPositioningSettings) -> Iterator[tuple[float, float, float]]:
    """Yield every stop of the axis: position, m, feed of the move to it, m/s, and dwell, s.

    Raises
    ------
    MethodError
        The axis would leave its limits.
    """
    if settings.moving is not None:
        yield from moving.stops(settings)
        return
    moving.check_limits(settings, *reach(settings))
    for approach in sequence(settings):
        if approach.before is not None:
            yield approach.before, settings.feed, 0.0
        yield approach.position, settings.feed, settings.dwell


def steps(settings: LinearPositioningSettings) -> list[Step]:
    """Return every step of the machine: a rapid move to the start, then moves at the feed, and dwells."""
    k = "XYZ".index(settings.axis)
    result: list[Step] = []
    last: float | None = None
    for position, feed, dwell in stops(settings):
        x, y, z = (position if i == k else rest for i, rest in enumerate(settings.start))
        if last is None:
            result.append(Step("move", (x, y, z), float("nan"), float("nan")))
        elif position != last:
            result.append(Step("move", (x, y, z), feed, abs(position - last) / feed))
        last = position
        if dwell > 0:
            result.append(Step("rest", None, float("nan"), dwell))
    return result


def programs(settings: LinearPositioningSettings) -> Mapping[str, str]:
    """Return the NC program of the test by file name: one line per move, and a dwell at each target.

    An instrument that records whenever the axis is at rest takes one reading per target, in the order of the program.
    """
    axis = settings.axis
    first, *others = steps(settings)
    if settings.moving is not None:
        P = np.array(moving.ends(settings))
        low, high = moving.ends(settings)
        title = f"{axis} after ISO 230-3, both ends of a moving axis"
        duration = math.fsum(step.seconds for step in others)
    else:
        P, (low, high), duration = positions(settings), reach(settings), seconds(settings)
        title = f"{axis} after ISO 230-2, {P.size} targets, {settings.runs} runs, {settings.cycle} cycles"
    lines = [
        "%",
        f"({PROGRAM}: {title})",
        f"({axis}{low * MM:.3f} to {axis}{high * MM:.3f} mm, about {duration / 60:.1f} min, dwells G4 P in s)",
        "(machine coordinates: work offset all zero, no tool length offset)",
        *(f"(target {i + 1}: {axis}{position * MM:.3f})" for i, position in enumerate(P)),
        "G90 G94 G21",
        "G0 " + " ".join(f"{name}{value * MM:.3f}" for name, value in zip("XYZ", first.place or (), strict=True)),
    ]
    feed = math.nan
    for step in others:
        if step.place is None:
            lines.append(f"G4 P{step.seconds:.3f}")
        else:
            feed_word = "" if step.feed == feed else f" F{step.feed * MM * MINUTE:.10g}"
            lines.append(f"G1 {axis}{step.place['XYZ'.index(axis)] * MM:.3f}{feed_word}")
            feed = step.feed
    return {PROGRAM: "\n".join([*lines, "M30", "%", ""])}
