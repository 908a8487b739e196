"""What the axis does in a test, as steps and as an NC program (ISO 6983)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.planning.targets import positions, reach, seconds, sequence
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings

MM, MINUTE = 1e3, 60.0
PROGRAM = "positioning.nc"
_TOLERANCE = 1e-9


def stops(settings: Settings) -> Iterator[tuple[float, float]]:
    """Yield every position at which the axis stops, m, and how long it rests there, s.

    Raises
    ------
    MethodError
        The axis would leave its limits.
    """
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
            yield approach.before, 0.0
        yield approach.place, settings.dwell


def steps(settings: Settings) -> list[Step]:
    """Return every step of the machine: the way to the start in rapid, then moves with the feed, and rests."""
    x, y, z = settings.start
    k = "XYZ".index(settings.axis)
    found: list[Step] = []
    last: float | None = None
    for place, rest in stops(settings):
        where = [x, y, z]
        where[k] = place
        if last is None:
            found.append(Step("move", (where[0], where[1], where[2]), float("nan"), float("nan")))
        else:
            found.append(Step("move", (where[0], where[1], where[2]), settings.feed, abs(place - last) / settings.feed))
        last = place
        if rest > 0:
            found.append(Step("rest", None, float("nan"), rest))
    return found


def programs(settings: Settings) -> Mapping[str, str]:
    """Return the test as an NC program by file name: one line a move, a rest at each target.

    An instrument that records whenever the axis rests takes one reading a target, in the order of the program.
    """
    P, axis = positions(settings), settings.axis
    low, high = reach(settings)
    first, *others = steps(settings)
    lines = [
        "%",
        f"({PROGRAM}: {axis} after ISO 230-2, {P.size} targets, {settings.runs} runs, {settings.cycle} cycles)",
        f"({axis}{low * MM:.3f} to {axis}{high * MM:.3f} mm, about {seconds(settings) / 60:.1f} min, dwells G4 P in s)",
        "(machine coordinates: work offset all zero, no tool length offset)",
        *(f"(target {i + 1}: {axis}{place * MM:.3f})" for i, place in enumerate(P)),
        "G90 G94 G21",
        f"G0 {_words(first)}",
    ]
    feed = f" F{settings.feed * MM * MINUTE:.10g}"
    for step in others:
        if step.place is None:
            lines.append(f"G4 P{step.seconds:.3f}")
        else:
            lines.append(f"G1 {axis}{step.place['XYZ'.index(axis)] * MM:.3f}{feed}")
            feed = ""
    return {PROGRAM: "\n".join([*lines, "M30", "%", ""])}


def _words(step: Step) -> str:
    place = step.place or (0.0, 0.0, 0.0)
    return " ".join(f"{name}{value * MM:.3f}" for name, value in zip("XYZ", place, strict=True))
