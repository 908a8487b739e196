"""Motions of the machine along the diagonals: stops, steps, and the NC program."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.linear_positioning.diagonals.lines import Line, distances, lines
from errormotion.methods.linear_positioning.planning.targets import sequence
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.kinematics.description import MachineDescription
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

MM, MINUTE = 1e3, 60.0
PROGRAM = "diagonals.nc"


def stops(settings: LinearPositioningSettings) -> Iterator[tuple[Line, Array, float]]:
    """Yield every stop of the axes: its diagonal, position (3,), m, and dwell, s."""
    for line, distances_of_line in zip(lines(settings), distances(settings), strict=True):
        for approach in sequence(settings, distances_of_line):
            if approach.before is not None:
                yield line, line.point(approach.before), 0.0
            yield line, line.point(approach.position), settings.dwell


def steps(settings: LinearPositioningSettings) -> list[Step]:
    """Return every step: a rapid move to the start of each diagonal, moves at the feed, and dwells."""
    result: list[Step] = []
    last: tuple[str, Array] | None = None
    for line, position, dwell in stops(settings):
        x, y, z = (float(value) for value in position)
        if last is None or last[0] != line.name:
            result.append(Step("move", (x, y, z), float("nan"), float("nan")))
        elif (length := float(np.linalg.norm(position - last[1]))) > 0.0:
            result.append(Step("move", (x, y, z), settings.feed, length / settings.feed))
        last = (line.name, position)
        if dwell > 0:
            result.append(Step("rest", None, float("nan"), dwell))
    return result


def seconds(settings: LinearPositioningSettings) -> float:
    """Return the duration of the test at its feed, dwells included, s; accelerations and rapid moves are neglected."""
    return float(np.nansum([step.seconds for step in steps(settings)]))


def programs(settings: LinearPositioningSettings) -> Mapping[str, str]:
    """Return the NC program by file name; it stops (M0) before each diagonal, for the alignment of the instrument."""
    remaining = iter(lines(settings))
    text = [
        "%",
        f"({PROGRAM}: diagonals after ISO 230-6, {settings.runs} runs, {settings.cycle} cycles)",
        f"(about {seconds(settings) / MINUTE:.1f} min, dwells G4 P in s)",
        "(machine coordinates: work offset all zero, no tool length offset)",
        "G90 G94 G21",
    ]
    for step in steps(settings):
        if step.place is None:
            text.append(f"G4 P{step.seconds:.3f}")
            continue
        words = " ".join(f"{name}{value * MM:.3f}" for name, value in zip("XYZ", step.place, strict=True))
        if np.isnan(step.feed):
            text += [f"(diagonal {next(remaining).name}: align the instrument)", f"G0 {words}", "M0"]
        else:
            text.append(f"G1 {words} F{step.feed * MM * MINUTE:.10g}")
    return {PROGRAM: "\n".join([*text, "M30", "%", ""])}


def outside(settings: LinearPositioningSettings, machine: MachineDescription) -> dict[str, str]:
    """Return by setting what the machine cannot do: axes that it does not have, stops outside its travel."""
    positions = np.array([position for _, position, _ in stops(settings)])
    for k, axis in enumerate("XYZ"):
        first, last = float(positions[:, k].min()), float(positions[:, k].max())
        if axis not in machine.travel:
            return {"diagonals": f"expected a machine with the axes X, Y and Z; it has {', '.join(machine.travel)}"}
        low, high = machine.travel[axis]
        if first < low - 1e-9 or last > high + 1e-9:
            return {
                "diagonals.volume": f"expected stops and overrun within {axis} {low * MM:g} mm to {high * MM:g} mm; "
                f"found {first * MM:.3f} mm to {last * MM:.3f} mm"
            }
    return {}
