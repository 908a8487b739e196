"""Comparisons: rates of agreeing methods, planted mistakes, interpolation."""

from __future__ import annotations

from collections.abc import Iterator

from validation.comparisons import left_out, planted, rates

TITLE = "Comparison"
SEEDS = 200


def section(seeds: int, workers: int = 1) -> Iterator[str]:
    """Yield the lines of the section."""
    yield from ("### Datasets that agree", "", *rates.section(seeds, workers), "")
    yield from ("### Planted mistakes", "", *planted.section(max(seeds // 2, 1), workers), "")
    yield from ("### Instants that were left out", "", *left_out.section(max(seeds // 4, 1), workers))
