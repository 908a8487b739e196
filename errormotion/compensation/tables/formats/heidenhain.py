"""HEIDENHAIN: a compensation value table (.COM), and the assignment of tables to axes (.CMA).

The columns are those of the newer controls: AXISPOS, BACKLASH, and the key of the axis that is corrected. A value is
the error with its own sign, the actual minus the nominal position, which the control subtracts, according to the
manuals of the TNC 306, 360 and 407 and to a published converter from laser measurements. No manual of a newer control
that states the sign was found. The first line of the text (``BEGIN``) is that of the same converter; the last
(``[END]``) is from memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from pydantic import Field

from errormotion.arrays import Array
from errormotion.compensation.tables.contract import FileText, TableSettings, Written
from errormotion.compensation.tables.formats.checks import CHECK_SIGN, check_points
from errormotion.compensation.tables.table import AxisTable
from errormotion.errors import DatasetError

DECIMALS = 4
"""Of a value in mm: 0.1 um (from memory)."""


class HeidenhainSettings(TableSettings):
    """Settings of the format."""

    axis_key: str = Field(
        default="", pattern="^[A-Za-z0-9_]{0,12}$", description="key of the axis in CfgAxes/axisList; default: letter"
    )
    component_key: str = Field(
        default="", pattern="^[A-Za-z0-9_]{0,12}$", description="key of the corrected axis; default: its letter"
    )
    most_points: int = Field(default=256, ge=2, description="points of one table; 256 on TNC 407 to 425")
    inverted: bool = Field(default=False, description="write the values with opposite sign")


class HeidenhainTable:
    """The format."""

    id: ClassVar[str] = "heidenhain"
    title: ClassVar[str] = "HEIDENHAIN, .COM and .CMA tables"
    source: ClassVar[str] = (
        "HEIDENHAIN, Technical Manual MANUALplus 620, pages 716 to 718 (columns, assignment); Technical Manual TNC "
        "407, page 153 and module 9095 (limits, sign: error); Technical Manual TNC 306, page 121 (sign: error); "
        "resolution and last line of the text from memory"
    )
    Settings: ClassVar[type[TableSettings]] = HeidenhainSettings

    def write(self, table: AxisTable, settings: HeidenhainSettings) -> Written:
        """Return both files.

        Raises
        ------
        DatasetError
            More points than the control accepts, or points closer than its resolution.
        """
        check_points(table, settings.most_points, "This HEIDENHAIN control (setting most_points)")
        position = np.round(1e3 * table.positions, DECIMALS)
        if (np.diff(position) <= 0).any():
            raise DatasetError(
                "HEIDENHAIN requires increasing positions; state a larger step (--step)",
                code="table.positions.not_increasing",
            )
        turn = 1.0 if settings.inverted else -1.0
        values = [np.round(1e3 * offset, DECIMALS) + 0.0 for offset in (table.forward, table.backward)]
        axis, corrected = settings.axis_key or table.axis, settings.component_key or table.component
        both = table.reversal >= 1e-9
        columns = {"AXISPOS": _cells(position), **({"BACKLASH": _cells(turn * values[1])} if both else {})}
        columns[corrected] = _cells(turn * values[0])
        name = table.name.lower()
        sign = (
            f"sign: value = {'-' if settings.inverted else ''}error, actual minus nominal (manuals of TNC 306 and 407; "
            "not stated for newer controls)"
        )
        comments = [*table.comments, sign, "unit: mm, positions from the machine datum"]
        tables: dict[str, FileText] = {
            f"{name}.com": _text(f"{name}.com", columns, comments),
            f"{name}.cma": _text(f"{name}.cma", {axis: [f"{name}.com"], "ACTIVE": ["*"]}, [f"{corrected} = F({axis})"]),
        }
        remarks = (
            CHECK_SIGN,
            "Only one .CMA table is active: if the control already has one, add the line to it.",
        )
        return Written(tables, values[0] / 1e3, values[1] / 1e3, remarks=remarks)


def _text(name: str, columns: Mapping[str, Sequence[str]], comments: Sequence[str]) -> str:
    lines = [("NR", *columns), *((str(k), *row) for k, row in enumerate(zip(*columns.values(), strict=True)))]
    width = 2 + max(len(cell) for line in lines for cell in line)
    body = ["".join(cell.ljust(width) for cell in line).rstrip() for line in lines]
    return "\r\n".join([f"BEGIN {name.upper()} MM", *body, "[END]", *(f"; {text}" for text in comments)]) + "\r\n"


def _cells(values: Array) -> list[str]:
    return [f"{value + 0.0:+.{DECIMALS}f}" for value in values]
