"""The settings of an LJ-X8000A on three levels: environment, common settings, and sixteen programs.

Levels and types are those of the manufacturer's header LJX8_IF_Linux.h; sizes of the blocks are those of the
manufacturer's sample (60, 20 and 10980 bytes).
"""

from __future__ import annotations

WRITE, RUNNING, SAVED = 0, 1, 2
"""Levels: write area, running settings, save area."""
ENVIRONMENT, COMMON, PROGRAM_0, PROGRAM_15 = 0x01, 0x02, 0x10, 0x1F
"""Types of a setting."""
ALL = 0xFF
"""Category: the whole block of a type."""
SIZES = {ENVIRONMENT: 60, COMMON: 20}
PROGRAM_SIZE = 10980
MAX_ITEM = 64
"""Bytes kept of one item; assumed."""
TRIGGER_MODE, SAMPLING, BATCH, BATCH_POINTS = (0, 0x01), (0, 0x02), (0, 0x03), (0, 0x0A)
"""Category and item in a program. The item that switches batches on is assumed."""
TRIGGER_MODES = ("continuous", "external", "encoder")
EXTERNAL = 1
MAX_BATCH_POINTS = 42000

Target = tuple[int, int, int, bytes]
"""Type, category, item, and four bytes that specify the item."""


class SettingLevels:
    """The settings on their three levels.

    A block of category FF and the items are stored separately: the layout of the block is not documented.

    Parameters
    ----------
    delivered : dict
        (category, item) to bytes: settings of a program as delivered.
    """

    def __init__(self, delivered: dict[tuple[int, int], bytes]) -> None:
        self._delivered = delivered
        self._levels: list[dict[Target, bytes]] = [{}, {}, {}]

    def read(self, level: int, target: Target) -> bytes | None:
        """Return a setting; None for an unknown level or type."""
        if level > SAVED or not _exists(target):
            return None
        kind, category, item, _ = target
        size = _size(target)
        default = self._delivered.get((category, item), b"") if kind >= PROGRAM_0 else b""
        data = self._levels[level].get(target, default)
        return data.ljust(size or max(4, -(-len(data) // 4) * 4), b"\0")

    def write(self, level: int, target: Target, data: bytes) -> bool:
        """Write a setting to a level and those below it; False if level, type or value is invalid.

        The manufacturer's library always sends 20 kB; bytes beyond the size of the setting are ignored.
        """
        if level > SAVED or not _exists(target) or not _allowed(target, data):
            return False
        for each in self._levels[: level + 1]:
            each[target] = data[: _size(target) or MAX_ITEM].rstrip(b"\0")
        return True

    def initialise(self, level: int, program: int) -> None:
        """Set a program as delivered, on a level and those below it."""
        for each in self._levels[: level + 1]:
            for target in [target for target in each if target[0] == PROGRAM_0 + program]:
                del each[target]

    def reflect(self, level: int) -> None:
        """Copy the write area to the levels up to ``level``."""
        for number in range(RUNNING, level + 1):
            self._levels[number] = dict(self._levels[WRITE])

    def rewrite(self, level: int) -> None:
        """Copy a level to the write area."""
        self._levels[WRITE] = dict(self._levels[level])

    def restart(self) -> None:
        """Copy the saved settings to all levels."""
        self._levels = [dict(self._levels[SAVED]) for _ in self._levels]

    def reset(self) -> None:
        """Set everything as delivered."""
        self._levels = [{}, {}, {}]

    def value(self, program: int, item: tuple[int, int]) -> int:
        """Return the running value of a setting of a program."""
        data = self.read(RUNNING, (PROGRAM_0 + program, *item, bytes(4)))
        return int.from_bytes((data or b"")[:4], "little")


def _size(target: Target) -> int:
    """Return the bytes of the block of a type; 0 for one item."""
    return SIZES.get(target[0], PROGRAM_SIZE) if target[1] == ALL else 0


def _exists(target: Target) -> bool:
    kind = target[0]
    return kind in SIZES or PROGRAM_0 <= kind <= PROGRAM_15


def _allowed(target: Target, data: bytes) -> bool:
    kind, category, item, _ = target
    value = int.from_bytes(data[:2], "little")
    if kind < PROGRAM_0:
        return True
    match (category, item):
        case (0, 0x01):
            return data[0] < len(TRIGGER_MODES)
        case (0, 0x03):
            return data[0] <= 1
        case (0, 0x0A):
            return 1 <= value <= MAX_BATCH_POINTS
    return True
