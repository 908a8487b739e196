"""Draw docs/figures/history.png: a figure of one machine over two years, with a collision and its note."""

from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np

from errormotion.record.control import chart
from errormotion.record.series import Series
from errormotion.record.steps import model_of

BLUE, ORANGE, GREEN, GREY = "#1f5a96", "#d9822b", "#2e8b57", "#555b66"
FIRST, STEP, COLLISION = datetime(2024, 1, 10, 8, tzinfo=UTC), 14, datetime(2025, 3, 3, tzinfo=UTC)

rng = np.random.default_rng(8)
dates = [FIRST + timedelta(days=30.4 * month) for month in range(24)]
u = rng.uniform(0.3e-6, 0.8e-6, 24)
y = 12e-6 + 0.5e-6 * rng.normal(size=24) + u * rng.normal(size=24) + 6e-6 * (np.arange(24) >= STEP)
series = Series(np.array([date.timestamp() for date in dates]), y, u)
model = model_of(series)
limits = chart(series, model)

figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
bounds = [0, *(step.index for step in model.steps), 24]
for first, last in pairwise(bounds):
    part = slice(first, last)
    label = "control limits" if first == 0 else None
    axes.fill_between(dates[part], 1e6 * limits.lower[part], 1e6 * limits.upper[part], color=GREEN, alpha=0.15, lw=0)
    axes.plot(dates[part], 1e6 * limits.upper[part], color=GREEN, lw=0.9, ls="--", label=label)
    axes.plot(dates[part], 1e6 * limits.lower[part], color=GREEN, lw=0.9, ls="--")
    axes.plot(dates[part], 1e6 * limits.centre[part], color=GREEN, lw=1.1, label="centre" if first == 0 else None)
for step in model.steps:
    axes.axvspan(dates[step.first], dates[step.last], color=ORANGE, alpha=0.25, lw=0, label="time of the step")
    text = f"step of {1e6 * step.size:.1f} ± {1e6 * step.half_width:.1f} µm"
    axes.annotate(
        text, (dates[step.first], 1e6 * limits.centre[step.index]), (-8, 0), textcoords="offset points", ha="right"
    )
axes.errorbar(dates, 1e6 * y, yerr=2e6 * u, fmt="o", ms=3.5, lw=0.9, color=BLUE, label="value with U (k = 2)")
axes.axvline(COLLISION, color=GREY, ls=":", label="note: hit the vice")
axes.set_ylabel("EZ after 60 min / µm")
axes.legend(loc="upper left", frameon=False, fontsize=8)
axes.spines[["top", "right"]].set_visible(False)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
