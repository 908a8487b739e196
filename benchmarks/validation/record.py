"""Histories of figures: false alarms and power of steps, coverage of intervals, and rate outside of the limits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from errormotion.record.control import chart
from errormotion.record.series import YEAR, Series
from errormotion.record.steps import Model, model_of

TITLE = "History of a figure"
SEEDS = 500
SLOPE, BAR, U = 2e-6, 1e-6, (0.5e-6, 1.5e-6)
"""Trend, m per year; standard uncertainty of a bar that all runs share, and range of the rest, m."""
COUNTS, TAUS, SIZE = (12, 24, 60), (0.0, 1e-6, 3e-6), 4.0
DAYS = (60, 180)


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield (
        f"{seeds} virtual histories in each row: runs at random times in three years, a trend of {SLOPE * 1e6:g} um a "
        f"year, standard uncertainties of {U[0] * 1e6:g} um to {U[1] * 1e6:g} um from run to run, {BAR * 1e6:g} um of "
        "a bar that all runs share, and a reproducibility of the machine that is not stated in the runs. `false "
        "steps`, `false departures`: share of histories in which one is found although there is none. `trend`: share "
        "of its 95 % intervals that contain the true trend. `outside`: share of the values outside of their limits, "
        "without a trend; 0.27 % with known reproducibility. The same number of further histories has a step of "
        f"{SIZE:g} standard deviations of a value, in the middle. `found`: share in which a step is found; `time`, "
        "`size`: share of these whose 95 % intervals contain the true time and size."
    )
    yield from (
        "",
        "| runs | reproducibility | false steps | false departures | trend | outside | found | time | size |",
        "|---|---|---|---|---|---|---|---|---|",
    )
    for count in COUNTS:
        for tau in TAUS:
            yield row(count, tau, seeds)
    yield from (
        "",
        "The same without a step, where the variation of the machine is alike in neighbouring runs: its correlation is "
        "exp(-d / T) over the time d. `alike`: share of histories that state it.",
        "",
        "| runs | reproducibility | T | alike | false steps | false departures | trend |",
        "|---|---|---|---|---|---|---|",
    )
    for count in COUNTS[:2]:
        for tau in TAUS[1:]:
            for days in DAYS:
                rng = np.random.default_rng(count)
                found = [model_of(made(rng, count, tau, SLOPE, days)) for _ in range(seeds)]
                alike = np.mean([each.fit is not None and each.fit.duration > 0 for each in found])
                steps, single, trend = rates_of(found)
                yield (
                    f"| {count} | {tau * 1e6:g} um | {days} days | {alike:.1%} | {steps:.1%} | {single:.1%} | "
                    f"{trend:.1%} |"
                )


def rates_of(found: list[Model]) -> tuple[float, float, float]:
    """Return the shares of models with steps, with departures, and with the true trend in its interval."""
    trend = np.mean([each.trend[1] <= SLOPE <= each.trend[2] for each in found])
    return (
        float(np.mean([bool(m.steps) for m in found])),
        float(np.mean([bool(m.departing) for m in found])),
        float(trend),
    )


def row(count: int, tau: float, seeds: int) -> str:
    """Return one row of the table."""
    rng = np.random.default_rng(count)
    steps, single, trend = rates_of([model_of(made(rng, count, tau, SLOPE)) for _ in range(seeds)])
    outside: float = 0.0
    for _ in range(seeds):
        values = made(rng, count, tau, 0.0)
        outside += float(np.mean(chart(values, model_of(values)).outside(values.value))) / seeds
    hits, times, sizes = 0, 0, 0
    for _ in range(seeds):
        values = made(rng, count, tau, SLOPE)
        true = SIZE * np.sqrt(np.mean(values.u**2) - BAR**2 + tau**2)
        shifted = values.value + true * (np.arange(count) >= count // 2)
        model = model_of(Series(values.time, shifted, values.u, values.influence, values.identities))
        if not model.steps:
            continue
        hits += 1
        step = max(model.steps, key=lambda step: abs(step.size))
        times += step.first < count // 2 <= step.last
        sizes += abs(step.size - true) <= step.half_width
    rates = f"{steps:.1%} | {single:.1%} | {trend:.1%} | {outside:.2%} | {hits / seeds:.1%}"
    known = f"{times / hits:.1%} | {sizes / hits:.1%}" if hits else "- | -"
    return f"| {count} | {tau * 1e6:g} um | {rates} | {known} |"


def made(rng: np.random.Generator, count: int, tau: float, slope: float, days: float = 0.0) -> Series:
    """Return a history drawn from its own covariance."""
    t, u = np.sort(rng.uniform(0, 3 * YEAR, count)), rng.uniform(*U, count)
    between = rng.normal(size=count)
    if days:
        R = np.exp(-np.abs(np.subtract.outer(t, t)) / (86400 * days)) + 1e-9 * np.eye(count)
        between = np.linalg.cholesky(R) @ between
    y = 5e-6 + slope * t / YEAR + u * rng.normal(size=count) + tau * between + BAR * rng.normal()
    return Series(t, y, np.sqrt(u**2 + BAR**2), np.full((1, count), BAR), ["bar"])
