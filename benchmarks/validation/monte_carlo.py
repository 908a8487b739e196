"""Linear uncertainties of all methods compared with the Monte Carlo method, JCGM 101."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from errormotion import datasets, montecarlo, plugins
from errormotion.montecarlo.result import lines
from errormotion.plugins import MethodSubject
from errormotion.testing.run import subjects_of

TITLE = "Linear uncertainties and Monte Carlo"
SEEDS = 2000
LARGE = 10**6
"""Bytes of raw data above which only a fifth of the trials are run, because an identification takes long."""


def section(seeds: int, workers: int = 1) -> Iterator[str]:
    """Yield the lines of the section; ``seeds`` is the number of trials."""
    logging.getLogger("errormotion").setLevel(logging.ERROR)
    yield (
        f"Raw data of the conformance kit for each method, evaluated by {seeds} trials (of large data {seeds // 5}) "
        "through the identification of the method with random draws of all sources (JCGM 101); see [Monte "
        "Carlo](explanation/monte-carlo.md). `u ratio`: standard uncertainty of the trials over the linear one, root "
        f"mean square over the points; with {seeds} trials each point varies by {1 / np.sqrt(2 * seeds):.1%}. "
        "`difference`: largest distance of an end of the linear 95 % interval from that of the trials, in standard "
        f"uncertainties; an end is known to about {2.67 / np.sqrt(seeds):.2f} of them. `verdict`: of clause 8 with "
        "one meaningful digit; the procedure continues until it is clear (`--monte-carlo auto`), in contrast to this "
        "table."
    )
    yield from ("", "| method | trials | freedom | u ratio | difference | verdict |", "|---|---|---|---|---|---|")
    for plugin in plugins.available("methods"):
        for subject in subjects_of("methods", plugin.id):
            if hasattr(subject.plugin, "trial_model"):
                yield from _rows(subject, seeds, workers)


def _rows(subject: MethodSubject, seeds: int, workers: int) -> Iterator[str]:
    """Yield one row for each freedom."""
    name = subject.plugin.info.id + (f", {subject.name.replace('_', ' ')}" if subject.name else "")
    raw, _ = subject.make(0)
    trials = seeds // 5 if raw.nbytes > LARGE else seeds
    settings = subject.effective_settings()
    with TemporaryDirectory() as folder:
        path = datasets.save(raw, Path(folder) / "raw.nc")
        found = montecarlo.evaluate(
            path, subject.plugin.info.id, settings, subject.identify(raw), Path(folder) / "trials", trials=trials,
            scheduler="sync" if workers < 2 else "processes", workers=workers,
        )  # fmt: skip
    for line in lines(found):
        one = found.sel(dof=line.name)
        linear, u = (one[key].values.ravel() for key in ("linear_uncertainty", "uncertainty"))
        moving = linear > 0
        ratio = np.sqrt(np.mean((u[moving] / linear[moving]) ** 2))
        distance = one["distance"].max("limit").values.ravel()
        worst = np.max(distance[moving] / linear[moving])
        yield f"| {name} | {trials} | {line.name} | {ratio:.3f} | {worst:.2f} | {line.word} |"
