"""NC programs of a campaign (ISO 6983), with purpose and duration.

Positions are absolute and in mm, feeds in mm/min, dwells in s. The duration is computed with constant feed; a real
machine takes slightly longer because of its acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from errormotion.errors import MethodError

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

DWELL = 2.0
"""Dwell before the measuring move, s: the axis comes to rest and the profiler becomes ready."""
MM, MINUTE = 1000.0, 60.0
_SHORTEST = 1e-3
"""Shortest move that is written, m."""

PASS = "pass.nc"


@dataclass(frozen=True)
class Move:
    """A move of one axis to a position, m, with a feed, m/s."""

    position: float
    feed: float
    axis: str = "Y"


@dataclass(frozen=True)
class Dwell:
    """A dwell, s."""

    seconds: float


@dataclass(frozen=True)
class Program:
    """One NC program.

    Attributes
    ----------
    name : str
        File name.
    purpose : str
        A short description.
    steps : tuple of Move or Dwell
    """

    name: str
    purpose: str
    steps: tuple[Move | Dwell, ...]

    def seconds(self, start: float | None = None) -> float:
        """Return the duration from a start position of Y, m; by default the end of the program, as in a repetition.

        Moves of other axes than Y are neglected.
        """
        position = self.end if start is None else start
        total = 0.0
        for step in self.steps:
            if isinstance(step, Dwell):
                total += step.seconds
            elif step.axis == "Y":
                total += abs(step.position - position) / step.feed
                position = step.position
        return total

    @property
    def end(self) -> float:
        """Position of Y after the last move, m."""
        return self._positions()[-1]

    def text(self) -> str:
        """Return the program text."""
        low, high = self.reach()
        lines = [
            "%",
            f"({self.name}: {self.purpose})",
            f"(Y{_mm(low)} to Y{_mm(high)}, about {self.seconds():.0f} s)",
            "G90 G94 G21",
        ]
        for step in self.steps:
            if isinstance(step, Dwell):
                lines.append(f"G4 P{step.seconds:.1f}")
            else:
                lines.append(f"G1 {step.axis}{_mm(step.position)} F{step.feed * MM * MINUTE:.10g}")
        return "\n".join([*lines, "M30", "%", ""])

    def reach(self) -> tuple[float, float]:
        """Return the lowest and the highest position of Y, m."""
        return min(self._positions()), max(self._positions())

    def _positions(self) -> list[float]:
        return [step.position for step in self.steps if isinstance(step, Move) and step.axis == "Y"]

    def check(self, travel: tuple[float, float] | None) -> None:
        """Check that the program stays within the travel of the axis (m), where that is known.

        Raises
        ------
        MethodError
            The program leaves the travel.
        """
        if travel is None:
            return
        low, high = self.reach()
        if low < travel[0] - 1e-9 or high > travel[1] + 1e-9:
            raise MethodError(
                f"{self.name} would move from Y{_mm(low)} to Y{_mm(high)}, but the axis travels from {_mm(travel[0])} "
                f"to {_mm(travel[1])} mm (setting 'travel'): move the artefacts, or reduce 'margin' or "
                "'warm_up_travel'. No program was written.",
                code="scan.program.outside_travel",
            )


def measuring_pass(settings: CrossbeamScanSettings) -> Program:
    """Return the pass over all artefacts in +Y, with the measuring feed only, so that the machine stays cold."""
    low, high = pass_ends(settings)
    count = len(settings.positions)
    height = () if settings.scan_z is None else (Move(settings.scan_z, settings.warm_up_feed, "Z"),)
    return Program(
        PASS, f"measuring pass over {count} artefact{'s' if count > 1 else ''}", (*height, *_pass(low, high, settings))
    )


def pass_ends(settings: CrossbeamScanSettings) -> tuple[float, float]:
    """Return start and end of a measuring pass, m."""
    if not settings.positions:
        raise MethodError(
            "The scans need the positions of the artefacts: set 'positions' to the positions of the axis at which the "
            "profiler is over the middle of each artefact, such as ['350 mm', '550 mm'].",
            code="scan.positions.missing",
        )
    beyond = settings.scan_length / 2 + settings.margin
    return settings.positions[0] - beyond, settings.positions[-1] + beyond


def pocket_pass(settings: CrossbeamScanSettings, number: int) -> Program:
    """Return the pass over the pocket for one lift of the spindle; ``number`` counts from 1."""
    beyond = settings.pocket_scan_length / 2 + settings.margin
    low, high = settings.pocket_position - beyond, settings.pocket_position + beyond
    lift = settings.pocket_lifts[number - 1]
    rise = Move(settings.pocket_z + lift, settings.warm_up_feed, "Z")
    return Program(
        f"pocket_{number}.nc",
        f"pass over the pocket, spindle {lift * MM:g} mm above where it was cut",
        (rise, *_pass(low, high, settings)),
    )


def _pass(low: float, high: float, settings: CrossbeamScanSettings) -> tuple[Move | Dwell, ...]:
    return Move(low, settings.measuring_feed), Dwell(DWELL), Move(high, settings.measuring_feed)


def warm_up_piece(settings: CrossbeamScanSettings, number: int, seconds: float, start: float) -> Program:
    """Return warm-up moves back and forth of a given duration from a start (m); the last stroke is shorter.

    Raises
    ------
    MethodError
        The ends of the moves coincide.
    """
    low, high = sorted(settings.warm_up_travel or pass_ends(settings))
    feed = settings.warm_up_feed
    if high - low < _SHORTEST:
        raise MethodError(
            f"warm_up_travel: expected two different ends, so that the axis moves; found Y{_mm(low)} and Y{_mm(high)}.",
            code="scan.warm_up.travel",
        )
    steps: list[Move] = [Move(low, feed)]
    remaining = seconds - abs(start - low) / feed
    stroke = (high - low) / feed
    cycles = max(0, int(remaining / (2 * stroke)))
    steps += [Move(high, feed), Move(low, feed)] * cycles
    rest = (remaining - 2 * stroke * cycles) / 2 * feed
    if rest >= _SHORTEST:
        steps += [Move(low + rest, feed), Move(low, feed)]
    return Program(f"warm_up_{number}.nc", f"warm-up moves, {seconds / MINUTE:.1f} min", tuple(steps))


def texts(programs: Sequence[Program], settings: CrossbeamScanSettings) -> dict[str, str]:
    """Check that all programs stay within the travel; return their texts by file name.

    Raises
    ------
    MethodError
        A program leaves the travel.
    """
    for program in programs:
        program.check(settings.travel)
    return {program.name: program.text() for program in programs}


def _mm(metres: float) -> str:
    return f"{round(metres * MM, 3) + 0.0:.3f}"  # + 0.0: no -0.000
