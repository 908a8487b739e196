"""Steps of the machine in the NC programs of a campaign."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from errormotion.methods.crossbeam_scan.acquisition.programs import Dwell, Program, pocket_pass
from errormotion.methods.crossbeam_scan.acquisition.schedule import schedule
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import Settings


def steps(settings: Settings) -> list[Step]:
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
