"""State of a control before a program starts: work offsets, parameters, tools; LinuxCNC parameter files (.var).

Unknown values are NaN; a cut that depends on them raises an error.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from errormotion.arrays import Array
from errormotion.compensation.program.reading.files import UNITS as UNITS
from errormotion.compensation.program.reading.files import text_of
from errormotion.compensation.program.reading.tools import Cutter, Table
from errormotion.compensation.program.reading.tools import read_tools as read_tools
from errormotion.errors import ProgramError

SYSTEMS = ("G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3")
LAST_PARAMETER = 5602
"""Largest number of a parameter of LinuxCNC."""

_FIRST = 5221  # X of G54; the other systems follow at intervals of 20, the rotation follows 9 after
_LINE = re.compile(r"\s*(\d{1,5})\s+([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?!\S)")


@dataclass(frozen=True)
class Offsets:
    """Offsets of a control before a program starts.

    Attributes
    ----------
    systems : array (9, 3)
        Origins of G54 to G59.3 in machine coordinates, m.
    rotations : array (9,)
        About Z, degrees.
    g92 : array (3,)
        Offset of G92 that is active, m.
    stored : array (3,)
        Offset that G92.3 makes active, m.
    homes : array (2, 3)
        Positions of G28 and G30 in machine coordinates, m.
    tools : mapping of int to array (3,)
        Offset of each tool, m; X, Y, Z.
    cutters : mapping of int to Cutter
        The other columns of the tool table.
    system : int
        Index of the active system, 0 for G54.
    unit : str
        ``mm`` or ``inch``: the unit of the machine and of its parameters.
    parameters : mapping of int to float
        Parameters that are stated, in units of the machine.
    table : str
        The tool table as it is in its file; empty: `tools` and `cutters` do not come from a file.
    notes : tuple of str
        What differs from the look of the files.
    """

    systems: Array = field(default_factory=lambda: np.full((9, 3), math.nan))
    rotations: Array = field(default_factory=lambda: np.zeros(9))
    g92: Array = field(default_factory=lambda: np.zeros(3))
    stored: Array = field(default_factory=lambda: np.full(3, math.nan))
    homes: Array = field(default_factory=lambda: np.full((2, 3), math.nan))
    tools: dict[int, Array] = field(default_factory=dict)
    cutters: dict[int, Cutter] = field(default_factory=dict)
    system: int = 0
    unit: str = "mm"
    parameters: dict[int, float] = field(default_factory=dict)
    table: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if np.any(self.g92) and np.isnan(self.stored).all():
            object.__setattr__(self, "stored", self.g92)

    def with_system(self, name: str, origin: tuple[float, float, float]) -> Offsets:
        """Return the offsets with another origin of one system, m."""
        if name.upper() not in SYSTEMS:
            raise ProgramError(f"offset of '{name}': expected one of {', '.join(SYSTEMS)}", code="program.offset.name")
        systems = self.systems.copy()
        systems[SYSTEMS.index(name.upper())] = origin
        return replace(self, systems=systems)

    def with_tools(self, table: Table) -> Offsets:
        """Return the offsets with the tools of a table."""
        return replace(
            self,
            tools=table.offsets,
            cutters=table.cutters,
            table=table.text,
            notes=(*self.notes, *table.notes),
        )


def read_parameters(path: Path, unit: str = "mm") -> Offsets:
    """Return the offsets of a LinuxCNC parameter file.

    Parameters
    ----------
    path : Path
        Numbers and values in two columns.
    unit : str
        ``mm`` or ``inch``: the unit of the machine and of the file.

    Raises
    ------
    ProgramError
        Not such a file.
    """
    scale = UNITS[unit]
    values: dict[int, float] = {}
    for number, line in enumerate(text_of(path).splitlines(), 1):
        if not line.strip():
            continue
        found = _LINE.match(line)
        if found is None:
            raise ProgramError(
                f"{path}, line {number}: expected a number and a value; found '{line[:40]}'",
                code="program.parameters.form",
            )
        key, value = int(found[1]), float(found[2])
        if not 0 < key <= LAST_PARAMETER or key in values:
            raise ProgramError(
                f"{path}, line {number}: expected a parameter from 1 to {LAST_PARAMETER} that no other line states; "
                f"found {key}",
                code="program.parameters.number",
            )
        if not math.isfinite(value):
            raise ProgramError(
                f"{path}, line {number}: expected a finite value; found '{found[2][:40]}'",
                code="program.parameters.value",
            )
        values[key] = value

    def three(first: int) -> list[float]:
        return [scale * values.get(first + k, math.nan) for k in range(3)]

    starts = [_FIRST + 20 * k for k in range(len(SYSTEMS))]
    active = values.get(5220, 1.0)
    if active not in range(1, len(SYSTEMS) + 1):
        raise ProgramError(
            f"{path}, parameter 5220: expected a coordinate system from 1 to 9; found {active:g}",
            code="program.parameters.system",
        )
    return Offsets(
        systems=np.array([three(start) for start in starts]),
        rotations=np.array([values.get(start + 9, 0.0) for start in starts]),
        g92=np.array(three(5211)) if values.get(5210) else np.zeros(3),
        stored=np.array(three(5211)),
        homes=np.array([three(5161), three(5181)]),
        system=int(active) - 1,
        unit=unit,
        parameters=values,
    )
