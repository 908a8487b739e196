"""How far the path of a new NC program is from where the old one was meant, point by point."""

from collections.abc import Callable, Sequence
from types import SimpleNamespace

import numpy as np

from errormotion.compensation.program.reading.items import LINE, Move, Setting, Unchanged
from errormotion.compensation.program.reading.offsets import Offsets
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.writing.path import Path
from errormotion.compensation.program.writing.rewriting import Rewriting

ORIGINS = Offsets(
    systems=np.arange(27.0).reshape(9, 3) * 1e-3,
    homes=np.array([[0.0, 0.0, 0.3], [0.1, 0.1, 0.3]]),
    tools={k: np.array([0.0, 0.001 * k, 0.05 * k]) for k in (1, 2, 3)},
)
"""Work offsets and tools that are all known."""


CHORD = 3e-8
"""Largest distance of an arc from the polyline in its place, m."""


def field(shift: Callable[[np.ndarray], np.ndarray]) -> Callable[..., SimpleNamespace]:
    """Return a correction of the positions alone."""
    return lambda places, _: SimpleNamespace(offset=shift(places), valid=np.ones(len(places), bool))


zero = field(np.zeros_like)


def rewritten(lines: Sequence[str], correcting: object, **settings: float) -> list[str]:
    """Return the new lines of a program."""
    return list(Rewriting(Reader(ORIGINS), correcting, **settings).lines(lines))


def moves_of(lines: Sequence[str]) -> list[Move | Unchanged | Setting]:
    """Return the moves of a program."""
    return [item for item in Reader(ORIGINS).items(lines) if isinstance(item, Move)]


def dense(move: Move, points: int) -> np.ndarray:
    """Return positions of the machine's axes along a move, m: so many, or as many as an arc needs."""
    path = Path([move])
    if move.kind > LINE:
        radius = float(path.radius(path.arcs)[0]) * move.frame.scale
        points = max(8, int(abs(move.sweep) / np.sqrt(8 * CHORD / radius)) + 2)
    index = np.zeros(points, int)
    return path.machine(index, path.points(index, np.linspace(0, 1, points)))


def to_line(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Return the distances of points from a polyline, m."""
    a, ab = line[:-1], np.diff(line, axis=0)
    size = np.maximum((ab * ab).sum(axis=1), 1e-30)
    best = np.full(len(points), np.inf)
    for k, point in enumerate(points):
        t = np.clip(((point - a) * ab).sum(axis=1) / size, 0, 1)
        best[k] = np.sqrt((((a + t[:, None] * ab) - point) ** 2).sum(axis=1).min())
    return best


def deviations(
    lines: Sequence[str],
    correcting: Callable[..., SimpleNamespace],
    actual: Callable[[np.ndarray], np.ndarray] = np.asarray,
    **settings: float,
) -> list[tuple[str, float]]:
    """Return of every cut its block and the largest distance, m, both ways, of where it was meant and where it is.

    ``actual`` makes positions where the tool is of positions that are commanded; without it the new path is compared
    with the corrected one.
    """
    tagged = [f"{line} (@{k})" if line.strip() not in ("", "%") else line for k, line in enumerate(lines)]
    new = rewritten(tagged, correcting, **settings)
    groups: dict[str, list[Move]] = {}
    tag = ""
    for item, text in zip(Reader(ORIGINS).items(new), new, strict=True):
        tag = text[text.index("(@") :] if "(@" in text else tag
        if isinstance(item, Move):
            groups.setdefault(tag, []).append(item)
    found = []
    for move in moves_of(tagged):
        if move.kind < LINE:
            continue
        tag = move.block.text[move.block.text.index("(@") :]
        meant = dense(move, 1000)
        if actual is np.asarray:
            meant = meant + correcting(meant, np.zeros_like(meant)).offset
        made = np.concatenate([actual(dense(each, 2 if actual is np.asarray else 60)) for each in groups[tag]])
        away = max(
            to_line(meant[:: len(meant) // 50 + 1], made).max(), to_line(made[:: len(made) // 50 + 1], meant).max()
        )
        found.append((move.block.text, float(away)))
    return found
