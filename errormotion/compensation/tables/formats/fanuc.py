"""FANUC: stored pitch error compensation, as the text file that the control reads.

Parameters 3620 to 3624 of the axis state number of the reference point, first and last number, magnification and
distance. Value k is the change of the compensation from point k - 1 to point k, seen from the negative direction, a
whole number of detection units times the magnification. The compensation is 0 at the reference point: a constant
cannot be stored. Between two points the control outputs the whole value at one position.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from errormotion.arrays import Array
from errormotion.compensation.tables.contract import TableSettings, Written
from errormotion.compensation.tables.formats.checks import CHECK_SIGN, check_even, one_direction
from errormotion.compensation.tables.table import AxisTable
from errormotion.datasets.units import Length
from errormotion.errors import DatasetError

NUMBERS = 1024
"""Compensation points of all axes: 0 to 1023."""

POINTS_OF_AXIS = 128
"""Points between the ends of one axis."""

MAGNIFICATION = 100
"""Largest parameter 3623."""


class FanucSettings(TableSettings):
    """Settings of the format."""

    axis_number: int = Field(default=0, ge=0, le=32, description="number of the controlled axis; 0: X 1, Y 2, Z 3")
    first_number: int = Field(default=0, ge=0, le=NUMBERS - 2, description="lowest number that the table may use")
    detection_unit: Length = Field(default=1e-6, gt=0, description="detection unit of the axis")
    largest_value: int = Field(default=7, ge=1, le=127, description="largest value of one point: 7, or 127")
    most_points: int = Field(default=POINTS_OF_AXIS, ge=2, le=NUMBERS, description="points of one axis")
    inverted: bool = Field(default=False, description="write the values with opposite sign")


class FanucTable:
    """The format."""

    id: ClassVar[str] = "fanuc"
    title: ClassVar[str] = "FANUC, pitch error compensation (parameters 3620 to 3624, N10000 to N11023)"
    source: ClassVar[str] = (
        "FANUC, Series 0i-PB Parameter Manual B-63980EN/01, page 100 (numbers and values); Technical Report A-77810E "
        "(parameters); numbers N10000 + n, range of the values and sign from memory"
    )
    Settings: ClassVar[type[TableSettings]] = FanucSettings

    def write(self, table: AxisTable, settings: FanucSettings) -> Written:
        """Return the file.

        Raises
        ------
        DatasetError
            No table of this axis; points at unequal distances; the reference point (position 0) is none of them; more
            points or larger values than the control accepts.
        """
        if table.component != table.axis:
            raise DatasetError(
                f"FANUC's pitch error compensation acts along its axis; it has no table of {table.component} over "
                f"{table.axis}",
                code="table.component.not_supported",
            )
        check_even(table, "FANUC")
        zero = int(np.abs(table.positions).argmin())
        if abs(table.positions[zero]) > 1e-9:
            raise DatasetError(
                "FANUC counts the compensation from the reference point at position 0, which is not a point of "
                f"the table ({1e3 * table.positions[0]:g} to {1e3 * table.positions[-1]:g} mm in steps of "
                f"{1e3 * table.step:g} mm). State a step of which all points are multiples (--step)",
                code="table.reference.no_point",
            )
        count = table.positions.size
        if count - 1 > settings.most_points or settings.first_number + count > NUMBERS:
            raise DatasetError(
                f"This FANUC control accepts at most {settings.most_points} points per axis (setting most_points), "
                f"numbers up to {NUMBERS - 1}; this table has {count - 1} from {settings.first_number + 1}. State "
                "a larger step (--step)",
                code="table.points.too_many",
            )
        wanted = table.mean - table.mean[zero]
        units = wanted / settings.detection_unit
        magnification = _magnification(units, settings)
        levels = np.round(units / magnification).astype(int)  # of the sums, so that rounding errors do not accumulate
        values = np.diff(levels) * (-1 if settings.inverted else 1)
        held = levels * magnification * settings.detection_unit
        reference = settings.first_number + zero
        axis = settings.axis_number or "XYZ".index(table.axis) + 1
        parameters = {
            3620: reference,
            3621: settings.first_number + 1,
            3622: settings.first_number + count - 1,
            3623: magnification,
            3624: round(1e6 * table.step),
        }
        lines = [f"N{number:05d}A{axis}P{value}" for number, value in parameters.items()]
        lines += [f"N{10000 + settings.first_number + k:05d}P{value}" for k, value in enumerate(values, start=1)]
        sign = "-" if settings.inverted else ""
        comments = [
            *table.comments,
            f"sign: value = {sign}change of the correction from the point before, added to the command (from memory)",
            f"unit: {1e6 * settings.detection_unit:g} um times {magnification}; 3624 in um",
            "The data end above: text after the second per cent sign is not read.",
        ]
        text = "\n".join(["%", *lines, "%", *(f"({_plain(line)})" for line in comments)]) + "\n"
        removed = float(table.mean[zero])
        remarks = (
            CHECK_SIGN,
            f"Compare parameters 3620 to 3624 with the manual of the control (3624 is {parameters[3624]} um here), "
            "then switch it off and on and return to the reference point.",
            *one_direction(table, "This table"),
            *(
                [f"The correction at position 0, {1e6 * removed:.2f} um, is omitted: the table is 0 there."]
                if abs(removed) >= 1e-9
                else []
            ),
        )
        return Written({f"{table.name}.TXT": text}, held, held, "steps", removed, remarks)


def _magnification(units: Array, settings: FanucSettings) -> int:
    """Return the smallest magnification with which no value exceeds the largest one."""
    for magnification in range(1, MAGNIFICATION + 1):
        if np.abs(np.diff(np.round(units / magnification))).max() <= settings.largest_value:
            return magnification
    worst = np.abs(np.diff(units)).max() * settings.detection_unit
    raise DatasetError(
        f"The correction changes by {1e6 * worst:.1f} um between two points; FANUC accepts at most "
        f"{1e6 * settings.largest_value * MAGNIFICATION * settings.detection_unit:.0f} um. State a smaller step "
        "(--step)",
        code="table.step.too_large",
    )


def _plain(text: str) -> str:
    return text.replace("(", "").replace(")", "").replace("%", "per cent").upper()
