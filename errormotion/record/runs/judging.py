"""Decisions on the tolerances of runs in the record, with limits other than those of the runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from errormotion.errors import ErrormotionError
from errormotion.record.runs.entry import Entry
from errormotion.tolerances.conformity import Conformity, judge, judge_figures
from errormotion.tolerances.table import Tolerances

MAX_READ = 1000
"""Largest number of error datasets that one call reads, newest first; limits of freedoms need them."""


def judge_runs(runs: Sequence[tuple[Path, Entry]], tolerances: Tolerances) -> list[Conformity | None]:
    """Return the decision on each run, newest first; None for a run without errors.

    The decision on a run whose error dataset cannot be read, or is beyond `MAX_READ`, is open; ``failure`` states why.
    """
    conformities = list[Conformity | None]()
    read = 0
    for path, entry in runs:
        if not entry.errors:
            conformities.append(None)
        elif not tolerances.freedoms and entry.figures is not None:
            conformities.append(judge_figures(entry.figures, tolerances))
        else:
            read += 1
            conformities.append(_of_dataset(path / entry.errors, entry, tolerances, read > MAX_READ))
    return conformities


def _of_dataset(file: Path, entry: Entry, tolerances: Tolerances, too_many: bool) -> Conformity:
    from errormotion import datasets

    stated = judge_figures(entry.figures or (), tolerances)
    if too_many:
        return replace(stated, unused=(), failure=f"only {MAX_READ} error datasets are read; select runs with --since")
    try:
        return judge(datasets.load(file), tolerances)
    except ErrormotionError as error:
        return replace(stated, unused=(), failure=str(error))
