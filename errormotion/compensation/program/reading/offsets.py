"""Work offsets, tools and reference positions of a control: LinuxCNC parameter files (.var) and tool tables (.tbl).

Unknown values are NaN; a cut that depends on them raises an error.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.files.reading import require_regular
from errormotion.errors import ProgramError

SYSTEMS = ("G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3")
UNITS = {"mm": 1e-3, "inch": 25.4e-3}
"""Lengths of the units of programs, m."""

MAX_FILE = 1 << 20
"""Maximum size of a parameter file or tool table, bytes."""

_FIRST = 5221  # X of G54; the other systems follow at intervals of 20, the rotation follows 9 after
_TOOL = re.compile(r"([TPXYZABCUVWDIJQ])\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)", re.IGNORECASE)


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
        Offset of G92, m.
    homes : array (2, 3)
        Positions of G28 and G30 in machine coordinates, m.
    tools : mapping of int to array (3,)
        Offset of each tool, m; X, Y, Z.
    system : int
        Index of the active system, 0 for G54.
    """

    systems: Array = field(default_factory=lambda: np.full((9, 3), math.nan))
    rotations: Array = field(default_factory=lambda: np.zeros(9))
    g92: Array = field(default_factory=lambda: np.zeros(3))
    homes: Array = field(default_factory=lambda: np.full((2, 3), math.nan))
    tools: dict[int, Array] = field(default_factory=dict)
    system: int = 0

    def with_system(self, name: str, origin: tuple[float, float, float]) -> Offsets:
        """Return the offsets with another origin of one system, m."""
        if name.upper() not in SYSTEMS:
            raise ProgramError(f"offset of '{name}': expected one of {', '.join(SYSTEMS)}")
        systems = self.systems.copy()
        systems[SYSTEMS.index(name.upper())] = origin
        return replace(self, systems=systems)


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
    for number, line in enumerate(_lines(path), 1):
        words = line.split()
        if not words:
            continue
        try:
            key, value = int(words[0]), float(words[1])
        except (ValueError, IndexError):
            raise ProgramError(f"{path}, line {number}: expected a number and a value; found '{line[:40]}'") from None
        if not math.isfinite(value):
            raise ProgramError(f"{path}, line {number}: expected a finite value; found '{words[1][:40]}'")
        values[key] = value

    def three(first: int) -> list[float]:
        return [scale * values.get(first + k, math.nan) for k in range(3)]

    starts = [_FIRST + 20 * k for k in range(len(SYSTEMS))]
    active = values.get(5220, 1.0)
    if active not in range(1, len(SYSTEMS) + 1):
        raise ProgramError(f"{path}, parameter 5220: expected a coordinate system from 1 to 9; found {active:g}")
    return Offsets(
        systems=np.array([three(start) for start in starts]),
        rotations=np.array([values.get(start + 9, 0.0) for start in starts]),
        g92=np.nan_to_num(three(5211)) if values.get(5210) else np.zeros(3),
        homes=np.array([three(5161), three(5181)]),
        system=int(active) - 1,
    )


def read_tools(path: Path, unit: str = "mm") -> dict[int, Array]:
    """Return the offsets of the tools of a LinuxCNC tool table, m.

    Raises
    ------
    ProgramError
        Not such a file.
    """
    tools: dict[int, Array] = {}
    for number, line in enumerate(_lines(path), 1):
        plain = line.partition(";")[0].strip()
        if not plain:
            continue
        words = {letter.upper(): float(value) for letter, value in _TOOL.findall(plain)}
        if _TOOL.sub("", plain).strip() or "T" not in words:
            raise ProgramError(f"{path}, line {number}: expected a tool, such as 'T1 P1 Z80.25'; found '{line[:40]}'")
        offset = UNITS[unit] * np.array([words.get(axis, 0.0) for axis in "XYZ"])
        if not np.isfinite(offset).all():
            raise ProgramError(f"{path}, line {number}: expected finite offsets; found '{line[:40]}'")
        tools[int(words["T"])] = offset
    return tools


def _lines(path: Path) -> list[str]:
    try:
        if require_regular(path).st_size > MAX_FILE:
            raise ProgramError(f"{path}: expected a file of at most {MAX_FILE} bytes")
        return path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise ProgramError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ProgramError(f"{path}: expected text; found other bytes at {error.start}") from None
