"""Comparisons: rates of agreeing methods, repeats, planted mistakes, interpolation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from validation.comparisons import causes, components, left_out, planted, rates, volumes
from validation.comparisons.pool import Pool

TITLE = "Comparison"
SEEDS = 200


def section(seeds: int, workers: int = 1, cache: Path | None = None) -> Iterator[str]:
    """Yield the lines of the section."""
    pool = Pool(workers, cache)
    yield from ("### Datasets that agree", "", *rates.section(seeds, pool), "")
    yield from ("### Volumes and axes that agree", "", *volumes.section(seeds, pool), "")
    yield from ("### Repeats", "", *components.section(seeds, pool), "")
    yield from ("### Planted mistakes", "", *planted.section(max(seeds // 2, 1), pool), "")
    yield from ("### Causes at different functional points", "", *causes.section(max(seeds // 5, 1), pool), "")
    yield from ("### Omitted instants", "", *left_out.section(max(seeds // 4, 1), pool))
