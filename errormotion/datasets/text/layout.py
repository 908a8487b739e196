"""Layouts of readings: a row for each reading in the order of measurement, and several readings in a row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.text.table_reader import Cells

FORWARD, BACKWARD = "forward", "backward"
"""Directions in which a target is approached: with increasing and with decreasing position (ISO 230-2)."""
_SAME = 0.02
"""Largest difference between positions of one target, as a fraction of the smallest distance of targets."""


def passes(positions: Array, lines: NDArray[np.int64], mistakes: Mistakes) -> tuple[list[str], list[str], list[str]]:
    """Return run, approach and target of each reading from the sequence of positions, (n,) each.

    Targets are visited one after another, in one direction or forth and back; at the reversal the last target is
    measured once or twice. The passes of each direction are numbered in their order, the targets by position.

    Parameters
    ----------
    positions : ndarray, (n,)
        Position of the axis of each reading, of any unit.
    lines : ndarray, (n,)
        Line of each reading.
    mistakes : Mistakes
        Receives passes that leave out several targets.
    """
    number = targets(positions)
    run: list[int] = []
    way: list[int] = []
    start, direction = 0, 0
    counts = {1: 0, -1: 0}

    def close(end: int) -> None:
        sense = direction or (1 if len(set(number.tolist())) == 1 else 0)
        if not sense:  # a single reading between two passes goes on in the direction of the next one
            sense = int(np.sign(number[end] - number[start])) if end < len(number) else -(way[-1] if way else -1)
        counts[sense] += 1
        run.extend([counts[sense]] * (end - start))
        way.extend([sense] * (end - start))

    for k in range(1, len(number)):
        step = int(np.sign(number[k] - number[k - 1]))
        if step == 0 or (direction and step != direction):
            close(k)
            start, direction = k, 0
        elif not direction:
            direction = step
    close(len(number))
    sizes: dict[tuple[int, int], list[int]] = {}
    for k, each in enumerate(zip(run, way, strict=True)):
        sizes.setdefault(each, []).append(k)
    longest = max(map(len, sizes.values()))
    for (_, _), rows in list(sizes.items())[:-1]:  # the last pass may have been interrupted
        if len(rows) < longest - 1:
            first, last = int(lines[rows[0]]), int(lines[rows[-1]])
            mistakes.add(
                last,
                f"sequence: the pass of lines {first} to {last} has {len(rows)} of {longest} targets; state run, "
                "approach and target by labels if the targets were not visited one after another",
                "sequence: passes of other lengths",
            )
    approach = [FORWARD if sense > 0 else BACKWARD for sense in way]
    return [str(each) for each in run], approach, [str(each + 1) for each in number]


def targets(positions: Array) -> NDArray[np.int64]:
    """Return the number of the target of each reading by its position, from 0, (n,).

    Readings of a position differ slightly from pass to pass; targets are groups with gaps between them that are much
    larger than their widths.
    """
    order = np.sort(positions[np.isfinite(positions)])
    steps = np.diff(order)
    large = steps[steps > _SAME * steps.max(initial=0.0)]
    gap = _SAME * large.min() if large.size else 0.0
    starts = np.concatenate([order[:1], order[1:][steps > gap]])
    return np.clip(np.searchsorted(starts, positions, side="right") - 1, 0, None)


def tall(table: Cells, keys: Mapping[str, int], columns: Sequence[int], labels: Sequence[Mapping[str, str]]) -> Cells:
    """Return a table with one reading in each row from one with several.

    Parameters
    ----------
    table : Cells
        With ``keys``, the columns with labels by dimension, and ``columns``, those with readings.
    labels : sequence of mapping of str to str
        Labels of the readings of each column, by dimension; all have the same dimensions.

    Returns
    -------
    Cells
        The labels of ``keys`` in their columns, those of the readings in the following ones, then the readings.
    """
    n, m = len(table.lines), len(columns)
    texts = {number: [text for text in table.texts[number] for _ in range(m)] for number in keys.values()}
    width = len(table.head[1])
    for k, dim in enumerate(labels[0]):
        texts[width + k] = [each[dim] for each in labels] * n
    values = np.stack([table.numbers[number] for number in columns], axis=1).ravel()
    titles = [*table.head[1], *labels[0], table.head[1][columns[0]]]
    return Cells((table.head[0], titles), np.repeat(table.lines, m), texts, {width + len(labels[0]): values})
