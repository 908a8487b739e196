"""LinuxCNC: file of screw compensation of a joint (``COMP_FILE`` of the INI file).

Each line has three numbers: nominal position, forward, reverse, in the unit of length of the machine. With
``COMP_FILE_TYPE = 1`` the last two are trims, which the motion controller adds to the command of the motor; with 0 they
are the positions that the axis reaches, and the trim is the nominal minus these positions. The first line without three
numbers ends the table; comments therefore follow it. Before the first and after the last point the trim is constant; at
standstill the last one remains.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from errormotion.compensation.tables.contract import TableSettings, Written
from errormotion.compensation.tables.formats.checks import check_points
from errormotion.compensation.tables.table import AxisTable
from errormotion.errors import DatasetError

MAX_POINTS = 256
"""EMCMOT_COMP_SIZE of the motion controller."""

DECIMALS = 6
"""Of a number in mm: 1 nm."""


class LinuxCNCTableSettings(TableSettings):
    """Settings of the format."""

    type: Literal[0, 1] = Field(default=1, description="COMP_FILE_TYPE: 1 = trims, 0 = reached positions")
    unit: Literal["mm", "inch"] = Field(default="mm", description="LINEAR_UNITS of the machine")


class LinuxCNCTable:
    """The format."""

    id: ClassVar[str] = "linuxcnc"
    title: ClassVar[str] = "LinuxCNC, COMP_FILE of a joint"
    source: ClassVar[str] = (
        "LinuxCNC 2.9: src/emc/motion/usrmotintf.cc (usrmotLoadComp), control.c (compute_screw_comp), motion.h; tried "
        "on LinuxCNC 2.9"
    )
    Settings: ClassVar[type[TableSettings]] = LinuxCNCTableSettings

    def write(self, table: AxisTable, settings: LinuxCNCTableSettings) -> Written:
        """Return the file.

        Raises
        ------
        DatasetError
            A component that is not the axis, or more than 256 points.
        """
        if table.component != table.axis:
            raise DatasetError(
                f"LinuxCNC compensates a joint along itself; it has no table of {table.component} over {table.axis}",
                code="table.component.not_supported",
            )
        check_points(table, MAX_POINTS, "LinuxCNC")
        scale = 1e3 if settings.unit == "mm" else 1e3 / 25.4
        decimals = DECIMALS if settings.unit == "mm" else DECIMALS + 2
        nominal = np.round(scale * table.positions, decimals)
        if (np.diff(nominal) <= 0).any():
            raise DatasetError(
                "LinuxCNC requires increasing positions; state a larger step (--step)",
                code="table.positions.not_increasing",
            )
        trims = [np.round(scale * offset, decimals) + 0.0 for offset in (table.forward, table.backward)]
        columns = [nominal, *(trims if settings.type else [nominal - trim for trim in trims])]
        rows = [" ".join(f"{value:.{decimals}f}" for value in row) for row in zip(*columns, strict=True)]
        what = "trims, added to the command" if settings.type else "reached positions"
        comments = [
            f"COMP_FILE_TYPE = {settings.type}: nominal, forward, reverse ({what})",
            "sign: a positive trim moves the axis in the positive direction",
            f"unit: {settings.unit}, machine coordinates of the joint",
            *table.comments,
            "The table ends above: the first line without three numbers ends it.",
        ]
        name = f"{table.name}.comp"
        text = "\n".join([*rows, *(f"# {line}" for line in comments)]) + "\n"
        remark = (
            f"In [JOINT_n] of {table.axis}: COMP_FILE = {name}, COMP_FILE_TYPE = {settings.type}; BACKLASH is then "
            "ignored. Allow for the largest trim in FERROR and in the velocity and acceleration of the joint."
        )
        return Written({name: text}, trims[0] / scale, trims[1] / scale, remarks=(remark,))
