"""NC programs for machines that run programs only: G-code out, DPRNT lines in.

``G31`` moves until the probe trips, ``DPRNT`` prints where that was (macro variables #5061 to #5063, mm) and when
(#3001, ms). Places are those of the machine's axes in mm, feeds in mm/min, dwells in s: ``G4 P`` counts milliseconds on
some controls, which the head of each program says.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from errormotion.errors import MethodError
from errormotion.methods.normal_vector import cycle, touching
from errormotion.plugins import Touch

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import Settings

MM, MINUTE = 1e3, 60.0
CYCLE, WARM_UP = "cycle.nc", "warm_up.nc"

_PRINT = "DPRNT[N{number}*X#5061[53]*Y#5062[53]*Z#5063[53]*T#3001[80]]"


def programs(settings: Settings) -> Mapping[str, str]:
    """Return one probing cycle, and the whole warm-up with all its cycles, as NC programs by the name of their files.

    Raises
    ------
    MethodError
        The settings name no balls.
    """
    return {CYCLE: cycle_program(settings), WARM_UP: warm_up_program(settings)}


def cycle_program(settings: Settings) -> str:
    """Return one probing cycle as a program."""
    return _text(CYCLE, "one probing cycle", _cycle(settings), _seconds(settings))


def warm_up_program(settings: Settings, first: int = 0) -> str:
    """Return the warm-up from a cycle on, which is 0 for the cold one, as a program."""
    length = _seconds(settings)
    lines: list[str] = []
    for number in range(first, cycle.cycles(settings)):
        if number:
            begin = (number - 1) * settings.interval
            lines += [
                f"(warm-up before cycle {number})",
                *_warm_up(settings, begin, begin + settings.interval - length),
            ]
        lines += [f"(cycle {number})", *_cycle(settings)]
    seconds = (cycle.cycles(settings) - 1 - first) * settings.interval + length
    return _text(WARM_UP, f"warm-up from cycle {first} on", lines, seconds)


def _seconds(settings: Settings) -> float:
    return math.fsum(step.seconds for step in cycle.cycle_steps(settings))


def _text(name: str, purpose: str, body: list[str], seconds: float) -> str:
    head = ["%", f"({name}: {purpose}, about {seconds / 60:.1f} min)", "(mm, mm/min, dwells G4 P in s)", "G90 G94 G21"]
    return "\n".join([*head, *body, "M30", "%", ""])


def _cycle(settings: Settings) -> list[str]:
    if not settings.balls:
        raise MethodError("balls: expected the rough places of three balls or more; found none.")
    touches, _ = cycle.cycle_touches(settings, settings.tip_radius or cycle.TIP_RADIUS)
    names, feed = touching.names(settings), _feed(settings.positioning_feed)
    lines, number, ball = ["M5", "POPEN"], 0, -1
    if settings.settle:
        lines.insert(1, _dwell(settings.settle))
    here: tuple[float, float, float] | None = None
    high = max(touch.start[2] for touch in touches) + settings.clearance
    lines.append(f"G1 Z{high * MM:.3f} F{feed}")  # wherever the tip is: first up, then across
    for item in cycle.itinerary(touches, settings.clearance):
        if isinstance(item, Touch):
            number += 1
            if item.item != ball:
                ball = item.item
                lines.append(f"(ball {names[ball]})")
            lines.append(f"G31 {_place(item.target)} F{_feed(settings.probing_feed)}")
            lines.append(_PRINT.format(number=number))
            lines.append(f"G1 {_place(item.start)} F{feed}")
            here = item.start
        elif here is None or math.dist(item, here) > 1e-6:
            lines.append(f"G1 {_place(item)} F{feed}")
            here = item
    return [*lines, "PCLOS"]


def _warm_up(settings: Settings, begin: float, end: float) -> Iterator[str]:
    speed: float | None = None
    for step in cycle.warm_up_steps(settings, begin, end):
        if step.spindle_speed != speed:
            speed = step.spindle_speed
            yield f"M3 S{speed:.0f}" if speed else "M5"
        if step.place is not None:
            yield f"G1 {_place(step.place)} F{_feed(step.feed)}"
        elif step.seconds > 0:
            yield _dwell(step.seconds)


def _dwell(seconds: float) -> str:
    return f"G4 P{seconds:.1f}"


def _feed(feed: float) -> str:
    return f"{feed * MM * MINUTE:.10g}"


def _place(place: tuple[float, float, float]) -> str:
    return " ".join(f"{axis}{value * MM:.3f}" for axis, value in zip("XYZ", place, strict=True))
