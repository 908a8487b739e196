"""Schedule of a campaign: cold passes, then for each warm-up time the warm-up moves and a measuring pass.

Time 0 is the start of the warm-up. Warm-up times include the measuring passes, which move the axis as well, although
more slowly. A pass starts at its warm-up time; the time of each scan is measured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan.acquisition.programs import (
    MINUTE,
    Program,
    measuring_pass,
    pass_ends,
    pocket_pass,
    texts,
    warm_up_piece,
)

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from errormotion.methods.crossbeam_scan.acquisition.programs import Dwell
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings


PROGRAM_INTERVAL = 5.0
"""Time between two programs, in which the control starts the next one, s."""


@dataclass(frozen=True)
class Item:
    """One program of the campaign.

    Attributes
    ----------
    program : str
        File name.
    start, seconds : float
        Planned start since the start of the warm-up, and planned duration; s.
    cycle : int
        Number of the measuring pass; -1 for warm-up moves.
    """

    program: str
    start: float
    seconds: float
    cycle: int = -1

    @property
    def end(self) -> float:
        """Planned end, s."""
        return self.start + self.seconds


@dataclass(frozen=True)
class Schedule:
    """The programs of a campaign in chronological order.

    Attributes
    ----------
    items : tuple of Item
    programs : mapping of str to Program
        By file name.
    warm_up : tuple of float
        Warm-up time of each pass, 0 for the cold ones, s.
    """

    items: tuple[Item, ...]
    programs: Mapping[str, Program]
    warm_up: tuple[float, ...]

    @property
    def cycles(self) -> int:
        """Number of measuring passes."""
        return len(self.warm_up)

    @property
    def cold(self) -> int:
        """Number of measuring passes on the cold machine."""
        return self.warm_up.count(0.0)

    @property
    def seconds(self) -> float:
        """Duration of the campaign, s."""
        return self.items[-1].end - self.items[0].start

    def of_cycle(self, cycle: int) -> Item:
        """Return the measuring pass with this number."""
        return next(item for item in self.items if item.cycle == cycle)

    def before(self, cycle: int) -> Item | None:
        """Return the warm-up moves before a pass; None before a cold one."""
        index = self.items.index(self.of_cycle(cycle))
        return self.items[index - 1] if index and self.items[index - 1].cycle < 0 else None

    def to_json(self) -> str:
        """Return the items as JSON."""
        return json.dumps([item.__dict__ for item in self.items])


def schedule(settings: CrossbeamScanSettings) -> Schedule:
    """Return the schedule of a campaign.

    Raises
    ------
    MethodError
        No artefacts, a program that leaves the travel, or warm-up times too close together for a pass.
    """
    passing = measuring_pass(settings)
    low, high = pass_ends(settings)
    first, again = passing.seconds(low), passing.seconds(high)
    cold = 1 + settings.cold_repeats
    start = -(first + PROGRAM_INTERVAL + settings.cold_repeats * (again + PROGRAM_INTERVAL))
    items: list[Item] = []
    for number in range(cold):
        items.append(Item(passing.name, start, again if number else first, number))
        start = items[-1].end + PROGRAM_INTERVAL
    programs = {passing.name: passing}
    free = 0.0  # end of the previous program
    for number, due in enumerate(settings.warm_up, 1):
        seconds = due - PROGRAM_INTERVAL - free
        if seconds <= 0:
            raise MethodError(
                f"warm_up: the pass at {due / MINUTE:g} min can start at {(free + PROGRAM_INTERVAL) / MINUTE:.1f} min "
                f"at the earliest: a measuring pass takes {first / MINUTE:.1f} min. Expected times further apart.",
                code="scan.warm_up.too_short",
            )
        piece = warm_up_piece(settings, number, seconds, high)
        programs[piece.name] = piece
        items.append(Item(piece.name, free, piece.seconds(high)))
        items.append(Item(passing.name, due, passing.seconds(piece.end), cold + number - 1))
        free = items[-1].end + PROGRAM_INTERVAL
    for program in programs.values():
        program.check(settings.travel)
    return Schedule(tuple(items), programs, (*[0.0] * cold, *settings.warm_up))


def program_texts(settings: CrossbeamScanSettings) -> dict[str, str]:
    """Return the NC programs of a test, of scans or of the pocket, by file name.

    Raises
    ------
    MethodError
        As for `schedule`.
    """
    if settings.procedure == "profiler_pose":
        return texts([pocket_pass(settings, k) for k in range(1, len(settings.pocket_lifts) + 1)], settings)
    return texts(list(schedule(settings).programs.values()), settings)


def steps(settings: CrossbeamScanSettings) -> list[Step]:
    """Return every step of the axis Y, and of Z where the settings state it, in the order of the programs.

    Raises
    ------
    MethodError
        As for `schedule`.
    """
    if settings.procedure == "profiler_pose":
        programs = [pocket_pass(settings, k) for k in range(1, len(settings.pocket_lifts) + 1)]
    else:
        plan = schedule(settings)
        programs = [plan.programs[item.program] for item in plan.items]
    return list(_steps(programs))


def _steps(programs: list[Program]) -> Iterator[Step]:
    position = dict.fromkeys("XYZ", math.nan)
    for program in programs:
        for step in program.steps:
            if isinstance(step, Dwell):
                yield Step("rest", None, math.nan, step.seconds)
                continue
            distance = abs(step.position - position[step.axis])
            position[step.axis] = step.position
            yield Step("move", (position["X"], position["Y"], position["Z"]), step.feed, distance / step.feed)
