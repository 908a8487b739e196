"""Comparison of the moves of the plain reader with those of LinuxCNC's interpreter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing

from errormotion.compensation.program.interpreter.canonical import Command, commands
from errormotion.compensation.program.reading.arcs import SMALL
from errormotion.compensation.program.reading.items import COUNTERCLOCKWISE, LINE, PLANES, RAPID, Move, Text, Unchanged
from errormotion.compensation.program.reading.offsets import Offsets
from errormotion.compensation.program.reading.reader import Reader
from errormotion.errors import ProgramError

DIGIT = 1.02e-4
"""Largest difference, in units of the program: the interpreter prints four digits, ours may be truncated."""

_MOTIONS = {"STRAIGHT_TRAVERSE", "STRAIGHT_FEED", "ARC_FEED"}


def check(source: Sequence[str], offsets: Offsets, reader: Reader) -> int:
    """Return the number of moves, which agree between the interpreter and the reader.

    Parameters
    ----------
    source : sequence of str
        Lines of a program.
    offsets : Offsets
    reader : Reader
        A new reader with these offsets.

    Raises
    ------
    ProgramError
        The interpreter reports an error in a line, or its move differs.
    """
    source = [str(text) for text in source]  # lines are counted here, not where they come from
    left: set[int] = set()
    moves = _moves(reader, source, left)
    count = 0
    move: Move | None = None
    with closing(commands(source, offsets, deleted=reader.deleted)) as found:
        for command in found:
            if command.name not in _MOTIONS:
                continue
            if command.line in left:
                continue
            move = move or next(moves, None)  # this also collects the unchanged moves
            if command.line in left:
                continue
            if move is None:
                raise ProgramError(
                    f"line {command.line}: LinuxCNC's interpreter moves, but the reader does not",
                    code="program.readings.differ",
                )
            if move.block.line != command.line:
                raise ProgramError(
                    f"line {move.block.line}: the reader moves; LinuxCNC's interpreter moves at line {command.line}",
                    code="program.readings.differ",
                )
            _same(move, command)
            move = None
            count += 1
    rest = move or next(moves, None)
    if rest is not None:
        raise ProgramError(
            f"line {rest.block.line}: the reader moves, but LinuxCNC's interpreter does not",
            code="program.readings.differ",
        )
    return count


def _moves(reader: Reader, source: Iterable[str], left: set[int]) -> Iterator[Move]:
    for number, item in enumerate(reader.items(source), 1):
        if isinstance(item, Unchanged) or (isinstance(item, Text) and item.motion is not None):
            left.add(number)  # a motion without a position is a move of no length for the interpreter
        elif isinstance(item, Move):
            yield item


def _same(move: Move, command: Command) -> None:
    numbers = command.numbers()
    expected: tuple[float, ...] = move.end
    if command.name == "ARC_FEED":
        if move.kind <= LINE:
            raise _differ(move, command)
        a, b, c = PLANES[move.plane]
        # If an arc ends within rounding of the angle below which it is a full circle, both numbers are correct.
        counts = {math.ceil((abs(move.sweep) - part * SMALL) / (2 * math.pi)) for part in (0.99, 1.01)}
        sense = 1 if move.kind == COUNTERCLOCKWISE else -1
        turns = int(numbers[4]) if abs(int(numbers[4])) in counts and numbers[4] * sense > 0 else sense * max(counts)
        expected = (move.end[a], move.end[b], *move.centre, turns, move.end[c])
    elif move.kind != (RAPID if command.name == "STRAIGHT_TRAVERSE" else LINE):
        raise _differ(move, command)
    # A centre from a radius is as uncertain as the chord is small; LinuxCNC computes it from the same numbers.
    if any(not abs(x - y) <= DIGIT for x, y in zip(expected, numbers, strict=False)):
        raise _differ(move, command)


def _differ(move: Move, command: Command) -> ProgramError:
    return ProgramError(
        f"line {move.block.line} '{move.block.text.strip()[:60]}': read as motion {move.kind} to {move.end}, centre "
        f"{move.centre}; LinuxCNC's interpreter: {command.name}({command.text})",
        code="program.readings.differ",
    )
