"""Linear uncertainties of all methods beside the Monte Carlo method, JCGM 101."""

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


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section; ``seeds`` is the number of trials."""
    logging.getLogger("errormotion").setLevel(logging.ERROR)
    yield (
        f"Raw data of the conformance kit for each method, evaluated by {seeds} trials through the method's own "
        "identification with all sources drawn anew (JCGM 101); see [Monte Carlo](explanation/monte-carlo.md). "
        "`u ratio`: standard uncertainty of the trials over the linear one, root mean square over the places; with "
        f"this number of trials each place varies by {1 / np.sqrt(2 * seeds):.1%}. `difference`: largest distance of "
        "an end of the linear 95 % interval from that of the trials, in standard uncertainties; an end is known to "
        f"about {2.67 / np.sqrt(seeds):.2f} of them. `verdict`: of clause 8 with one meaningful digit."
    )
    yield from ("", "| method | freedom | u ratio | difference | verdict |", "|---|---|---|---|---|")
    for plugin in plugins.available("methods"):
        for subject in subjects_of("methods", plugin.id):
            if hasattr(subject.plugin, "redrawing"):
                yield from _rows(subject, seeds)


def _rows(subject: MethodSubject, trials: int) -> Iterator[str]:
    """Yield one row for each freedom."""
    name = subject.plugin.info.id + (f", {subject.name.replace('_', ' ')}" if subject.name else "")
    raw, _ = subject.make(0)
    settings = subject.effective_settings()
    with TemporaryDirectory() as folder:
        path = datasets.save(raw, Path(folder) / "raw.nc")
        found = montecarlo.evaluate(
            path, subject.plugin.info.id, settings, subject.identify(raw), Path(folder) / "trials", trials=trials
        )
    for line in lines(found):
        one = found.sel(dof=line.name)
        linear, u = (one[key].values.ravel() for key in ("linear_uncertainty", "uncertainty"))
        moving = linear > 0
        ratio = np.sqrt(np.mean((u[moving] / linear[moving]) ** 2))
        distance = one["distance"].max("limit").values.ravel()
        worst = np.max(distance[moving] / linear[moving])
        yield f"| {name} | {line.name} | {ratio:.3f} | {worst:.2f} | {line.word} |"
