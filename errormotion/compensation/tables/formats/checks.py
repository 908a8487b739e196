"""Checks of several formats."""

from __future__ import annotations

import numpy as np

from errormotion.compensation.tables.table import AxisTable
from errormotion.errors import DatasetError

CHECK_SIGN = "Check the sign with one value before use: it is from memory (inverted = true reverses it)."
"""Remark of formats whose sign is not stated by a document of the manufacturer."""


def check_points(table: AxisTable, most: int, control: str) -> None:
    """Raise an error for more points than a control accepts."""
    if table.positions.size > most:
        raise DatasetError(
            f"{control} accepts at most {most} points; this table has {table.positions.size}. State a larger "
            "step (--step)",
            code="table.points.too_many",
        )


def check_even(table: AxisTable, control: str) -> None:
    """Raise an error for points at unequal distances."""
    if np.isnan(table.step):
        raise DatasetError(
            f"{control} requires points at equal distances; state the distance (--step)",
            code="table.points.not_equidistant",
        )


def one_direction(table: AxisTable, control: str) -> tuple[str, ...]:
    """Return the remark of controls that do not distinguish directions."""
    if table.reversal < 1e-9:
        return ()
    return (
        f"{control} does not distinguish directions: the table contains the mean of both. Half of the reversal, up to "
        f"{0.5e6 * table.reversal:.2f} um, remains for the backlash compensation of the control.",
    )
