"""Siemens SINUMERIK: leadscrew or measuring system error compensation, and sag or cross compensation.

* ``$AA_ENC_COMP[e, N, axis]``: the axis by its own position. The value is added to the actual position, so that a
  positive one moves the axis in the negative direction: it is the error with its own sign. One direction.
* ``$AN_CEC[t, N]``: another axis by the position of a base axis, for both directions or for each. The value changes the
  setpoint of the output axis: a positive one moves it in the positive direction (from memory; a comment of the example
  in the manual of 802D sl agrees).

Values are in mm in double precision, at equal steps, linear in between, constant outside the table.
"""

from __future__ import annotations

import re
from typing import ClassVar

import numpy as np
from pydantic import Field

from errormotion.arrays import Array
from errormotion.compensation.tables.contract import FileText, TableSettings, Written
from errormotion.compensation.tables.formats.checks import CHECK_SIGN, check_even, check_points, one_direction
from errormotion.compensation.tables.table import AxisTable

DECIMALS = 6
"""Of a value in mm."""

MAX_CHARACTERS = 24
"""Maximum length of the name of a program (from memory)."""


class SiemensSettings(TableSettings):
    """Settings of the format."""

    machine_axis: str = Field(
        default="", pattern="^[A-Z]*[0-9]*$", description="name of the machine axis; default: letter and 1, such as Y1"
    )
    output_axis: str = Field(
        default="", pattern="^[A-Z]*[0-9]*$", description="name of the axis corrected by a sag table; default likewise"
    )
    encoder: int = Field(default=0, ge=0, le=1, description="measuring system of the leadscrew table")
    table: int = Field(default=0, ge=0, le=62, description="index of the (first) sag table")
    most_points: int = Field(
        default=5000, ge=2, description="MD38000 MM_ENC_COMP_MAX_POINTS or MD18342 MM_CEC_MAX_POINTS; 200 on 808D, 828D"
    )
    inverted: bool = Field(default=False, description="write the values of a sag table with opposite sign")
    program: bool = Field(default=False, description="write a part program NAME.MPF that assigns the table, ending M30")


class SiemensTable:
    """The format."""

    id: ClassVar[str] = "siemens"
    title: ClassVar[str] = "Siemens SINUMERIK, $AA_ENC_COMP or $AN_CEC"
    source: ClassVar[str] = (
        "Siemens, Function Manual Extended Functions (K3: Compensations), 03/2013, 6FC5397-1BP40-3BA1, and 09/2009, "
        "6FC5397-1BP20-0BA0; SINUMERIK 808D Function Manual 01/2017 (sign of $AA_ENC_COMP); sign of $AN_CEC from memory"
    )
    Settings: ClassVar[type[TableSettings]] = SiemensSettings

    def write(self, table: AxisTable, settings: SiemensSettings) -> Written:
        """Return the file.

        Raises
        ------
        DatasetError
            Points at unequal distances, or more than the control accepts.
        """
        check_even(table, "SINUMERIK")
        check_points(table, settings.most_points, "This SINUMERIK (setting most_points)")
        base = settings.machine_axis or f"{table.axis}1"
        if table.component == table.axis:
            return _leadscrew(table, settings, base)
        return _sag(table, settings, base, settings.output_axis or f"{table.component}1")


def _leadscrew(table: AxisTable, settings: SiemensSettings, axis: str) -> Written:
    values = np.round(-1e3 * table.mean, DECIMALS) + 0.0
    key, unit = f"[{settings.encoder},{{}},{axis}]", f"[{settings.encoder},{axis}]"
    lines = [
        *(f"$AA_ENC_COMP{key.format(number)}={value:.{DECIMALS}f}" for number, value in enumerate(values)),
        f"$AA_ENC_COMP_STEP{unit}={1e3 * table.step:.{DECIMALS}f}",
        f"$AA_ENC_COMP_MIN{unit}={1e3 * table.positions[0]:.{DECIMALS}f}",
        f"$AA_ENC_COMP_MAX{unit}={1e3 * table.positions[-1]:.{DECIMALS}f}",
        f"$AA_ENC_COMP_IS_MODULO{unit}=0",
    ]
    sign = "sign: value = error, added to the actual position; positive moves the axis in the negative direction"
    held = -values / 1e3
    remarks = (
        f"Load with MD32700 ENC_COMP_ENABLE[{settings.encoder}] = 0, then set it to 1 and reference {axis}; MD38000 "
        f"MM_ENC_COMP_MAX_POINTS[{settings.encoder}] must be at least {values.size}.",
        "The value at the reference point should be 0, so that the axis does not jump when the table takes effect.",
        *one_direction(table, "This table"),
    )
    return Written(_file("AX_EEC_INI", table, sign, lines, settings.program), held, held, remarks=remarks)


def _sag(table: AxisTable, settings: SiemensSettings, base: str, output: str) -> Written:
    both = table.reversal < 1e-9
    directions = ((table.mean, 0),) if both else ((table.forward, 1), (table.backward, -1))
    lines: list[str] = []
    held: list[Array] = []
    turn = -1.0 if settings.inverted else 1.0
    for index, (offset, direction) in enumerate(directions, start=settings.table):
        values = np.round(1e3 * offset, DECIMALS) + 0.0
        held.append(values / 1e3)
        lines += [
            *(f"$AN_CEC[{index},{number}]={turn * value + 0.0:.{DECIMALS}f}" for number, value in enumerate(values)),
            f"$AN_CEC_INPUT_AXIS[{index}]=({base})",
            f"$AN_CEC_OUTPUT_AXIS[{index}]=({output})",
            f"$AN_CEC_STEP[{index}]={1e3 * table.step:.{DECIMALS}f}",
            f"$AN_CEC_MIN[{index}]={1e3 * table.positions[0]:.{DECIMALS}f}",
            f"$AN_CEC_MAX[{index}]={1e3 * table.positions[-1]:.{DECIMALS}f}",
            f"$AN_CEC_DIRECTION[{index}]={direction}",
            f"$AN_CEC_MULT_BY_TABLE[{index}]=0",
            f"$AN_CEC_IS_MODULO[{index}]=0",
        ]
    sign = (
        f"sign: value = {'-' if settings.inverted else ''}correction, added to the setpoint of {output} (from memory)"
    )
    numbers = ", ".join(str(settings.table + k) for k in range(len(directions)))
    remarks = (
        CHECK_SIGN,
        f"MD18342 MM_CEC_MAX_POINTS[{numbers}] must be at least {table.positions.size}; enable with SD41300 "
        f"CEC_TABLE_ENABLE[{numbers}] and MD32710 CEC_ENABLE of {output}.",
    )
    return Written(_file("NC_CEC_INI", table, sign, lines, settings.program), held[0], held[-1], remarks=remarks)


def _file(name: str, table: AxisTable, sign: str, lines: list[str], program: bool) -> dict[str, FileText]:
    file, head, end = f"{table.name}.INI", [f"%_N_{name}", "CHANDATA(1)"], "M17"
    if program:
        own = re.sub("[^A-Z0-9_]", "_", table.name.upper())[:MAX_CHARACTERS]
        file, head, end = f"{own}.MPF", [f"%_N_{own}_MPF", ";$PATH=/_N_MPF_DIR"], "M30"
    comments = [*table.comments, sign, "unit: mm"]
    return {file: "\n".join([*head, *(f"; {text}" for text in comments), *lines, end]) + "\n"}
