"""Items that the reader returns for the lines of a program, in their order."""

from __future__ import annotations

from dataclasses import dataclass

from errormotion.compensation.program.reading.frames import Frame, Triple
from errormotion.instruments.nc_words import Block

RAPID, LINE, CLOCKWISE, COUNTERCLOCKWISE = 0, 1, 2, 3

PLANES = ((0, 1, 2), (2, 0, 1), (1, 2, 0))
"""Of G17, G18, G19: the two axes of the plane, right-handed with the third."""

UNCHANGED = {
    "machine": "positions in machine coordinates (G53, G28, G30)",
    "probe": "probing moves (G38)",
    "unknown": "rapid moves while the position of an axis is unknown",
}
"""Kinds of moves that are not corrected."""


@dataclass(slots=True)
class Text:
    """An unchanged line without a move.

    Attributes
    ----------
    text : str
    motion : int, optional
        Motion that it states for the following moves.
    dwell : float
        s.
    """

    text: str
    motion: int | None = None
    dwell: float = 0.0


@dataclass(slots=True)
class Unchanged:
    """A move that is not corrected: in machine coordinates, to an unknown position, or of a probe.

    Attributes
    ----------
    text : str
    axes : tuple of int
        Axes that it moves to a commanded position: from then on without correction.
    motion : int
        Motion of following moves that do not state one; -1: none.
    explicit : bool
        Whether its line has the word of the motion.
    kind : str
        ``machine``, ``unknown`` or ``probe``.
    """

    text: str
    line: int
    axes: tuple[int, ...]
    motion: int
    explicit: bool
    kind: str


@dataclass(slots=True)
class Setting:
    """G92 or G10 L20: values of the axes at their present position, to which the present correction is added."""

    block: Block
    frame: Frame


@dataclass(slots=True)
class Move:
    """A move between known positions, in units of the program.

    Attributes
    ----------
    block : Block
    kind : int
        ``RAPID``, ``LINE``, ``CLOCKWISE`` or ``COUNTERCLOCKWISE``.
    explicit : bool
        Whether its block has the word of the motion.
    start, end : (x, y, z)
    centre : (float, float)
        Of an arc, in the two axes of its plane.
    sweep : float
        Angle of an arc with its sign in the plane, rad; 0 for a line.
    plane : int
        Index in ``PLANES``.
    frame : Frame
    absolute, centre_absolute : bool
        G90, G90.1.
    feed_mode : int
        93, 94 or 95.
    feed : float
        F in units of the program; NaN before the first F.
    speed : float
        S, 1/min; NaN before the first S.
    """

    block: Block
    kind: int
    explicit: bool
    start: Triple
    end: Triple
    centre: tuple[float, float]
    sweep: float
    plane: int
    frame: Frame
    absolute: bool
    centre_absolute: bool
    feed_mode: int
    feed: float
    speed: float


Item = Text | Unchanged | Setting | Move
