"""Intervals of the effect of a compensation, against the true reduction of drawn records."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from errormotion.compensation.effect.magnitude import Curve, magnitude, ratio

TITLE = "Effect of a compensation"
SEEDS = 1000


class Case(NamedTuple):
    """A case, um: errors before, remaining share, and the standard uncertainties."""

    points: int
    freedoms: int
    error: float
    left: float
    noise: float
    drift: float
    shared: float


CASES = (
    Case(20, 1, 10, 0.1, 0.3, 0.3, 0.0),
    Case(20, 3, 10, 0.1, 0.3, 0.3, 0.05),
    Case(20, 3, 10, 0.0, 0.3, 0.3, 0.0),
    Case(20, 3, 10, 0.02, 0.3, 0.3, 0.0),
    Case(20, 3, 10, 1.0, 0.3, 0.3, 0.1),
    Case(20, 1, 10, 0.1, 0.05, 1.0, 0.0),
    Case(200, 3, 10, 0.05, 0.3, 1.0, 0.0),
    Case(6, 1, 10, 0.5, 0.5, 0.1, 0.0),
)


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield (
        f"{seeds} pairs of records of one known truth each: a warm-up, and a residual of another shape, `left` as a "
        "share of its size. Both have white noise, an independent linear drift of the instrument, a reference state "
        "with the same noise as each value, and a common scale and thermometer (`shared`, as a share of the error). "
        "Share of the 95 % intervals of the ratio that contain the true ratio (`held`), that are too high and too "
        "low, and the same for the intervals of the magnitude after compensation; the median width of the intervals "
        f"of the ratio. The standard error of a share of 95 % is {100 * np.sqrt(0.05 * 0.95 / seeds):.1f}%. Without a "
        "residual the lower end is 0, and 97.5 % are expected; intervals are intentionally wide if a drift could "
        "have hidden a residual."
    )
    yield from (
        "",
        "| points | freedoms | error/um | left | noise/um | drift/um | shared | ratio held | too high | too low "
        "| magnitude held | width |",
        "|" + "---|" * 12,
    )
    for number, case in enumerate(CASES):
        yield row(case, np.random.default_rng(number), seeds)


def row(case: Case, rng: np.random.Generator, runs: int) -> str:
    """Return one line of the table."""
    n, d = case.points, case.freedoms
    t = np.linspace(0.0, 1.0, n + 1)[1:, None]
    before = case.error * (1 - np.exp(-3 * t)) * np.array([1.0, 0.5, -0.7])[:d]
    after = case.left * case.error * np.sin(5 * t) * np.array([1.0, -0.5, 0.3])[:d]
    effects = _effects(case, t, before, after)
    own = np.broadcast_to(case.noise**2 * np.eye(d), (n, d, d))
    true = np.sqrt((after**2).sum() / (before**2).sum())
    size = np.sqrt((after**2).sum() / n)
    ratios, sizes = [], []
    for _ in range(runs):
        z = rng.normal(size=len(effects[0]))
        first, second = (
            Curve.of(m + np.tensordot(z, F, 1) + case.noise * rng.normal(size=m.shape), own, F)
            for m, F in zip((before, after), effects, strict=True)
        )
        ratios.append(ratio(second, first))
        sizes.append(magnitude(second))
    high, low = (100 * np.mean([each[k] > true if k == 1 else each[k] < true for each in ratios]) for k in (1, 2))
    held = 100 * np.mean([each.low <= size <= each.high for each in sizes])
    width = np.median([each.high - each.low for each in ratios])
    stated = f"{n} | {d} | {case.error:g} | {case.left:.0%} | {case.noise:g} | {case.drift:g} | {case.shared:.0%}"
    return f"| {stated} | {100 - high - low:.1f}% | {high:.1f}% | {low:.1f}% | {held:.1f}% | {width:.3f} |"


def _effects(case: Case, t: np.ndarray, before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the effects of the sources on both records, (source, n, d) each."""
    nothing, line = np.zeros_like(before), t * np.ones_like(before)
    pairs = [(case.shared * before, case.shared * after)]
    pairs += [(0.3 * case.shared * case.error * line,) * 2, (case.drift * line, nothing), (nothing, case.drift * line)]
    for k in range(case.freedoms):
        reference = nothing.copy()
        reference[:, k] = case.noise
        pairs += [(reference, nothing), (nothing, reference)]
    first, second = zip(*pairs, strict=True)
    return np.array(first), np.array(second)
