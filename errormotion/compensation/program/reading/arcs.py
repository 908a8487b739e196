"""Centre and angle of an arc from its words, as LinuxCNC reads them."""

from __future__ import annotations

import math

from errormotion.compensation.program.reading.frames import Triple
from errormotion.instruments.nc_words import Block, refusal

SPIRAL = 1e-3
"""Largest relative difference of the radii at start and end; LinuxCNC rejects larger ones too."""

SMALL = 1e-6
"""Angle below which start and end are the same point, so that the arc is a full circle, rad."""

MAX_TURNS = 1000


def arc(
    block: Block,
    values: dict[str, str],
    start: Triple,
    end: Triple,
    axes: tuple[int, int, int],
    motion: int,
    absolute: bool,
) -> tuple[tuple[float, float], float]:
    """Return the centre of an arc in its plane, and its angle with its sign, rad.

    Raises
    ------
    ProgramError
        The words do not determine an arc.
    """
    a, b, _ = axes
    s, e = (start[a], start[b]), (end[a], end[b])
    sense = 1.0 if motion == 3 else -1.0
    if values.keys() & {"IJK"[axes[2]]}:
        raise refusal(block.line, block.text, "expected the centre of an arc in its plane", code="program.arc.centre")
    offsets = "IJK"[a], "IJK"[b]
    if "R" in values:
        if values.keys() & set(offsets):
            raise refusal(
                block.line, block.text, "an arc with a radius and a centre", code="program.arc.radius_and_centre"
            )
        centre = _from_radius(block, s, e, float(values["R"]), sense)
    else:
        if not values.keys() & set(offsets):
            raise refusal(
                block.line, block.text, "an arc without a centre (I, J, K) or radius (R)", code="program.arc.no_centre"
            )
        if absolute:
            if not set(offsets) <= values.keys():
                raise refusal(
                    block.line,
                    block.text,
                    f"G90.1: expected both {offsets[0]} and {offsets[1]}",
                    code="program.arc.centre",
                )
            centre = float(values[offsets[0]]), float(values[offsets[1]])
        else:
            centre = s[0] + float(values.get(offsets[0], 0.0)), s[1] + float(values.get(offsets[1], 0.0))
    r0, r1 = math.dist(s, centre), math.dist(e, centre)
    if not r0 or not r1 or abs(r1 - r0) > max(SPIRAL * r0, 1e-3):
        raise refusal(
            block.line,
            block.text,
            f"the radii at start and end differ: {r0:.4f} and {r1:.4f}",
            code="program.arc.radii_differ",
        )
    angle = math.atan2(e[1] - centre[1], e[0] - centre[0]) - math.atan2(s[1] - centre[1], s[0] - centre[0])
    angle *= sense
    while angle < SMALL:
        angle += 2 * math.pi
    if angle > 2 * math.pi + SMALL:
        angle -= 2 * math.pi
    turns = float(values.get("P", 1.0))
    if turns != int(turns) or not 1 <= turns <= MAX_TURNS:
        raise refusal(block.line, block.text, f"expected turns P from 1 to {MAX_TURNS}", code="program.arc.turns")
    return centre, sense * (angle + 2 * math.pi * (turns - 1))


def _from_radius(
    block: Block, s: tuple[float, float], e: tuple[float, float], radius: float, sense: float
) -> tuple[float, float]:
    half = math.dist(s, e) / 2
    if not half:
        raise refusal(
            block.line,
            block.text,
            "an arc with a radius that ends where it starts",
            code="program.arc.closed_by_radius",
        )
    if not radius or half > abs(radius) * (1 + SPIRAL):
        raise refusal(
            block.line,
            block.text,
            f"the radius {radius:g} is too small for a chord of {2 * half:.4f}",
            code="program.arc.radius_too_small",
        )
    height = math.sqrt(max(radius * radius - half * half, 0.0)) * (sense if radius > 0 else -sense)
    x, y = (s[0] + e[0]) / 2, (s[1] + e[1]) / 2
    dx, dy = (e[0] - s[0]) / (2 * half), (e[1] - s[1]) / (2 * half)
    return x - height * dy, y + height * dx
