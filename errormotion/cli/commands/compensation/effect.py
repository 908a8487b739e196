"""``errormotion compensate effect``: the reduction of errors by a compensation, from results without and with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from errormotion.cli.commands.results.compare import Stated, over_one
from errormotion.cli.output import show, show_json, table
from errormotion.cli.page import Page, new_files
from errormotion.cli.results import load
from errormotion.cli.tolerances import exit_code
from errormotion.compensation.effect import Effect, effect
from errormotion.compensation.effect.magnitude import Interval
from errormotion.compensation.effect.text import FIGURES_HEAD, HEAD, figure_rows, limits, rows, verdict
from errormotion.tolerances.table import load_tolerances


def run(
    before: Path,
    after: Path,
    *,
    at: tuple[float, float, float] | None,
    over: str | None,
    select: Sequence[str],
    freedoms: list[str],
    since: float | None,
    tolerances: Path | None,
    page: Page | None,
    as_json: bool,
) -> int:
    """Compare two results, print the effect, and write the page. Return the exit code of the decisions on tolerances.

    Raises
    ------
    DatasetError
        The results cannot be read or compared, or a file already exists.
    BenchError
        The file of tolerances is invalid.
    """
    files = new_files(page)
    limited = None if tolerances is None else load_tolerances(tolerances)
    results = load([], {"before": before, "after": after}).results
    stated = Stated([], [], {}, None, over=over, select=select)
    results = {name: over_one(name, ds, stated) for name, ds in results.items()}
    found = effect(results["before"], results["after"], at=at, freedoms=freedoms, since=since, tolerances=limited)
    if page is not None:
        from errormotion.compensation.effect.report import write

        write(found, results["after"], page.file, page.form)
    if as_json:
        show_json(plain(found))
    else:
        show(text(found))
        for path in files:
            show(f"written: {path}")
    return code_of(found)


def code_of(found: Effect) -> int:
    """Return the exit code of the decisions on the result with compensation and on the reduction."""
    return exit_code([each.plain() for each in (found.after, found.gained) if each is not None])


def text(found: Effect) -> str:
    """Return the effect as text."""
    sentences = verdict(found)
    limited = set(limits(found))
    lines = [line for line in sentences if line not in limited]
    lines += ["", table(HEAD, rows(found))]
    if found.figures:
        lines += ["", table(FIGURES_HEAD, figure_rows(found))]
    if limited:
        lines += ["", *[line for line in sentences if line in limited]]
    return "\n".join([*lines, "", *found.notes])


def plain(found: Effect) -> dict[str, Any]:
    """Return the effect for JSON output, SI."""
    judged = {"before": found.before, "after": found.after, "reduction": found.gained}
    return {
        "ok": True,
        "verdict": verdict(found),
        "parts": [
            {
                "name": part.name,
                "unit": part.unit,
                "before": _interval(part.before),
                "after": _interval(part.after),
                "reduction": _interval(part.reduction),
                "outcome": part.outcome,
                "correctable": part.correctable,
                "perfect_model": part.perfect,
                "measurement": part.floor,
                "reference": part.reference,
            }
            for part in found.parts
        ],
        "figures": [
            {
                "name": pair.name,
                "unit": pair.unit,
                "before": dict(zip(("value", "expanded_uncertainty"), pair.before, strict=True)),
                "after": dict(zip(("value", "expanded_uncertainty"), pair.after, strict=True)),
                "reduction": _interval(pair.reduction),
            }
            for pair in found.figures
        ],
        "conformity": {name: each.plain() for name, each in judged.items() if each is not None},
        "notes": list(found.notes),
    }


def _interval(interval: Interval) -> dict[str, float | None]:
    return {name: each if math.isfinite(each) else None for name, each in interval._asdict().items()}
