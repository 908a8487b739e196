"""Checks that several formats need."""

from __future__ import annotations

import numpy as np

from errormotion.compensation.tables.table import AxisTable
from errormotion.errors import DatasetError

CHECK_SIGN = "Check the sign with one value before the table is used: it is from memory (inverted = true turns it)."
"""Remark of formats whose sign no document of the maker states."""


def check_points(table: AxisTable, most: int, control: str) -> None:
    """Refuse more points than a control takes."""
    if table.positions.size > most:
        raise DatasetError(
            f"{control} takes at most {most} points; this table has {table.positions.size}. State a larger "
            "step (--step)"
        )


def check_even(table: AxisTable, control: str) -> None:
    """Refuse points at unequal distances."""
    if np.isnan(table.step):
        raise DatasetError(f"{control} needs points at equal distances; state the distance (--step)")


def one_direction(table: AxisTable, control: str) -> tuple[str, ...]:
    """Return the remark on the directions where a control knows one only."""
    if table.reversal < 1e-9:
        return ()
    return (
        f"{control} knows one direction: the table has the mean of both. Half of the reversal, up to "
        f"{0.5e6 * table.reversal:.2f} um, remains for the backlash compensation of the control.",
    )
