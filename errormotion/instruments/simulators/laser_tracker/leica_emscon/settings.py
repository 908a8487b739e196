"""Blocks of parameters that a client sets and reads back: defaults, limits, and the event of a change.

The limits are those of the header's comments; those marked (a) are assumed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import NUMBERS
from errormotion.instruments.simulators.laser_tracker.leica_emscon.status import Event, Status, out_of_range, wrong

Check = Callable[[Sequence[Any]], int]
NO_REGION = 10
"""Region type of newer headers for no region; the 3.6 header has 0 (sphere) and 1 (box)."""


def flags(*positions: int, first: int = 1) -> Check:
    """Return a check that the values at these positions are 0 or 1."""

    def check(values: Sequence[Any]) -> int:
        return next((wrong(i + first) for i in positions if values[i] not in (0, 1)), Status.OK)

    return check


def within(position: int, low: float, high: float) -> Check:
    """Return a check of the range of one value."""
    return lambda values: Status.OK if low <= values[position] <= high else out_of_range(position + 1)


def among(position: int, most: int) -> Check:
    """Return a check that a value is an enumerator from 0 to ``most``."""
    return lambda values: Status.OK if 0 <= values[position] <= most else wrong(position + 1)


def together(*checks: Check) -> Check:
    """Return a check that returns the first failure of several checks."""
    return lambda values: next((status for check in checks if (status := check(values))), Status.OK)


@dataclass
class Block:
    """The values of one block, in SI, with the command that reads them."""

    get: str
    event: int | None
    values: list[Any]
    check: Check = field(default=lambda _: Status.OK)


MAX_POINTS = 10_000_000  # (a)
SHORTEST, LONGEST = 500, 100_000  # ms, of a stationary measurement (a)


def blocks(*, newest: bool) -> dict[int, Block]:
    """Return all blocks with their defaults, by the number of the command that sets them.

    ``newest`` also accepts region types of headers after 3.6.
    """

    def region(first: int) -> Check:
        kinds = (0, 1, NO_REGION) if newest else (0, 1)
        return together(
            flags(first),
            lambda values: Status.OK if values[first + 1] in kinds else wrong(first + 2),
        )

    points = [0, 0, 0]
    sphere = [0.01, 50, 0, 0.0]
    sphere_check = together(within(0, 1e-6, 100.0), within(1, 0, MAX_POINTS), flags(2), within(3, 0.0, 100.0))
    named: dict[str, Block] = {
        "SetTemperatureRange": Block("GetTemperatureRange", Event.TEMPERATURE_RANGE, [1], among(0, 3)),
        "SetStationOrientationParams": Block("GetStationOrientationParams", Event.ORIENTATION, [0.0] * 6),
        "SetTransformationParams": Block(
            "GetTransformationParams", Event.TRANSFORMATION, [0.0] * 6 + [1.0], within(6, 1e-6, 1e6)
        ),
        "SetBoxRegionParams": Block("GetBoxRegionParams", Event.BOX_REGION, [(0.0, 0.0, 0.0)] * 2),
        "SetSphereRegionParams": Block(
            "GetSphereRegionParams", Event.SPHERE_REGION, [(0.0, 0.0, 0.0), 1.0], within(1, 1e-9, 1e3)
        ),
        "SetStationaryModeParams": Block(
            "GetStationaryModeParams", Event.STATIONARY, [2000, 0], together(within(0, SHORTEST, LONGEST), flags(1))
        ),
        "SetContinuousTimeModeParams": Block(
            "GetContinuousTimeModeParams",
            Event.CONTINUOUS_TIME,
            [10, *points],
            together(within(0, 1, 99_999), within(1, 0, MAX_POINTS), region(2)),
        ),
        "SetContinuousDistanceModeParams": Block(
            "GetContinuousDistanceModeParams",
            Event.CONTINUOUS_DISTANCE,
            [0.01, *points],
            together(within(0, 1e-6, 100.0), within(1, 0, MAX_POINTS), region(2)),
        ),
        "SetSphereCenterModeParams": Block(
            "GetSphereCenterModeParams", Event.SPHERE_CENTRE, list(sphere), sphere_check
        ),
        "SetCircleCenterModeParams": Block(
            "GetCircleCenterModeParams", Event.CIRCLE_CENTRE, list(sphere), sphere_check
        ),
        "SetGridModeParams": Block(
            "GetGridModeParams",
            Event.GRID,
            [(0.01, 0.01, 0.01), *points],
            together(within(1, 0, MAX_POINTS), region(2)),
        ),
        "SetSearchParams": Block(
            "GetSearchParams", Event.SEARCH, [0.05, 10_000], together(within(0, 1e-6, 10.0), within(1, 1, 10**7))
        ),
        "SetAdmParams": Block(
            "GetAdmParams", Event.ADM, [1e-5, 1000, 3], together(within(1, 1, 10**6), within(2, 0, 1000))
        ),
        "SetTransformationInputParams": Block(
            "GetTransformationInputParams", None, [0, *([0.0] * 6), 1.0, *([0.0] * 7)], among(0, 1)
        ),
        "SetStatisticMode": Block("GetStatisticMode", Event.STATISTICS, [0, 0], together(among(0, 1), among(1, 1))),
        "SetCameraParams": Block(
            "GetCameraParams", Event.CAMERA, [128] * 3, together(*(within(i, 0, 255) for i in range(3)))
        ),
        "SetLaserOnTimer": Block("GetLaserOnTimer", None, [0, 0], together(within(0, 0, 999), within(1, 0, 59))),
        "SetTriggerSource": Block("GetTriggerSource", Event.TRIGGER_SOURCE, [1], among(0, 3)),
        "SetExternTriggerParams": Block(
            "GetExternTriggerParams", Event.TRIGGER, [1, 0, 1, 0], together(flags(0, 2), among(1, 2))
        ),
    }
    return {NUMBERS[name]: block for name, block in named.items()}
