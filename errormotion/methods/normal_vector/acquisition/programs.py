"""NC programs for machines that only execute programs: G-code out, DPRNT lines in.

``G31`` moves until the probe trips, ``DPRNT`` prints the position of the trip (macro variables #5061 to #5063, mm) and
its time (#3001, ms). Positions are those of the machine's axes in mm, feeds in mm/min. ``G4 P`` is in seconds on some
controls and in milliseconds on others: the settings select it, and the head of each program states it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from errormotion.errors import MethodError
from errormotion.methods.normal_vector.acquisition import cycle, touching
from errormotion.plugins import Step, Touch

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import NormalVectorSettings

MM, MINUTE = 1e3, 60.0
CYCLE, WARM_UP = "cycle.nc", "warm_up.nc"

_SAME_POSITION = 1e-6  # m, resolution of the programs
_PRINT = "DPRNT[N{number}*X#5061[53]*Y#5062[53]*Z#5063[53]*T#3001[80]]"


def programs(settings: NormalVectorSettings) -> Mapping[str, str]:
    """Return one probing cycle, and the whole warm-up with all cycles, as NC programs by file name.

    Raises
    ------
    MethodError
        The settings have no balls.
    """
    return {CYCLE: cycle_program(settings), WARM_UP: warm_up_program(settings)}


def cycle_program(settings: NormalVectorSettings, tip_radius: float | None = None) -> str:
    """Return one probing cycle as a program; ``tip_radius`` (m) is used if the settings have none."""
    part = next(cycle.parts(settings))
    body = [*_to_probe(settings, settings.settle), *_cycle(settings, None, tip_radius)]
    return _text(CYCLE, "one probing cycle", body, settings, _seconds(part))


def warm_up_program(settings: NormalVectorSettings) -> str:
    """Return the cold cycle, the warm-up and all later cycles as a program.

    Each cycle has its number as sequence number, before its warm-up: the program can be restarted there.
    """
    lines: list[str] = []
    seconds = 0.0
    for part in cycle.parts(settings):
        lines.append(f"N{part.number} ({'warm-up and ' if part.number else ''}cycle {part.number})")
        if part.warm_up:
            lines += [_first_up(settings), *settings.to_warm_up, *_warm_up(settings, part.warm_up)]
        lines += [*_to_probe(settings, part.settle), *_cycle(settings, part.here)]
        seconds += _seconds(part)
    return _text(WARM_UP, f"cold cycle, warm-up, {cycle.cycles(settings) - 1} cycles", lines, settings, seconds)


def _seconds(part: cycle.Part) -> float:
    return math.fsum(step.seconds for step in (*part.warm_up, *part.cycle)) + part.settle


def _text(name: str, purpose: str, body: list[str], settings: NormalVectorSettings, seconds: float) -> str:
    head = [
        "%",
        f"({name}: {purpose}, about {seconds / 60:.1f} min)",
        f"(mm, mm/min, dwells G4 {settings.dwell})",
        "(positions of the tip in machine coordinates: work offset all zero, no tool length offset)",
        "G90 G94 G21",
    ]
    return "\n".join([*head, *body, "M30", "%", ""])


def _to_probe(settings: NormalVectorSettings, settle: float) -> list[str]:
    """Return the lines that stop the spindle, insert the probe, and let the machine settle."""
    return ["M5", *settings.to_probe, *([_dwell(settings, settle)] if settle else [])]


def _first_up(settings: NormalVectorSettings, tip_radius: float | None = None) -> str:
    """Return the move to the safe height from any position of the tip."""
    high = cycle.safe_height(_touches(settings, tip_radius), settings.clearance)
    return f"G1 Z{high * MM:.3f} F{_feed(settings.positioning_feed)}"


def _touches(settings: NormalVectorSettings, tip_radius: float | None) -> list[Touch]:
    if not settings.balls:
        raise MethodError(
            "balls: expected the approximate centres of three or more balls; found none.", code="probing.balls.too_few"
        )
    return cycle.cycle_touches(settings, settings.tip_radius or tip_radius or cycle.TIP_RADIUS)[0]


def _cycle(
    settings: NormalVectorSettings, here: cycle.Position | None, tip_radius: float | None = None
) -> Iterator[str]:
    names, feed = touching.names(settings), _feed(settings.positioning_feed)
    number, ball = 0, -1
    yield "POPEN"
    if here is None:
        yield _first_up(settings, tip_radius)
    for item in cycle.itinerary(_touches(settings, tip_radius), settings.clearance, here):
        if isinstance(item, Touch):
            number += 1
            comment = f" ({_plain(names[item.item])})" if item.item != ball else ""
            ball = item.item
            yield f"G31 {_position(item.target)} F{_feed(settings.probing_feed)}{comment}"
            yield _PRINT.format(number=number)
            yield f"G1 {_position(item.start)} F{feed}"
            here = item.start
        elif here is None or math.dist(item, here) > _SAME_POSITION:
            yield f"G1 {_position(item)} F{feed}"
            here = item
    yield "PCLOS"


def _plain(name: str) -> str:
    """Return a name with the characters that are allowed in a comment."""
    return re.sub(r"[^ -~]|[()]", "?", name)


def _warm_up(settings: NormalVectorSettings, steps: list[Step]) -> Iterator[str]:
    speed: float | None = None
    for step in steps:
        if step.spindle_speed != speed:
            speed = step.spindle_speed
            yield f"M3 S{speed:.10g}" if speed else "M5"
        if step.place is not None:
            yield f"G1 {_position(step.place)} F{_feed(step.feed)}"
        else:
            yield _dwell(settings, step.seconds)


def _dwell(settings: NormalVectorSettings, seconds: float) -> str:
    word, unit = settings.dwell.split()
    return f"G4 {word}{seconds:.3f}" if unit == "s" else f"G4 {word}{1e3 * seconds:.0f}"


def _feed(feed: float) -> str:
    return f"{feed * MM * MINUTE:.10g}"


def _position(position: tuple[float, float, float]) -> str:
    return " ".join(f"{axis}{value * MM:.3f}" for axis, value in zip("XYZ", position, strict=True))
