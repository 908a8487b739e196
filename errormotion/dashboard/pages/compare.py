"""Compare: whether several results of one machine agree, and why not; and one figure of a machine over time."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import xarray as xr
from tornado.web import HTTPError

from errormotion.compare import compare
from errormotion.compare.report import write as write_comparison
from errormotion.compare.text import cause_text, probability, verdict
from errormotion.dashboard.figures import comparison_item
from errormotion.dashboard.kept import Kept, stamp
from errormotion.dashboard.lab import Choice, Lab
from errormotion.dashboard.pages.page import LONGEST_MESSAGE, Guarded
from errormotion.dashboard.pages.results import REPORT_POLICY, loaded, millimetres
from errormotion.errors import DatasetError, ErrormotionError
from errormotion.kinematics.iso import DOF
from errormotion.record.history import history
from errormotion.record.page import write as write_history
from errormotion.record.runs.entry import Entry
from errormotion.record.runs.listing import list_runs

MOST_COMPARED = 20
"""Results of one comparison."""
MOST_LISTED = 200
"""Runs that are offered."""
MOST_CAUSES = 3
"""Causes of a pair on the page; its report holds all of them."""

MADE: Kept[xr.Dataset] = Kept(4)


@dataclass(frozen=True)
class Question:
    """What a browser asks to compare: keys of runs, and what `errormotion.compare.compare` takes."""

    runs: tuple[str, ...]
    at: tuple[float, ...] | None
    freedoms: tuple[str, ...]
    since: float | None
    same_start: bool


class _Comparing(Guarded):
    def question(self) -> Question:
        """Return the question of the query.

        Raises
        ------
        HTTPError
            Too many runs, or a key that is too long.
        DatasetError
            A coordinate is no number.
        """
        runs = tuple(dict.fromkeys(self.get_query_arguments("run")))
        if len(runs) > MOST_COMPARED or any(len(key) > 600 for key in runs):
            raise HTTPError(400, reason=f"At most {MOST_COMPARED} runs are compared")
        texts = [self.word(axis) for axis in "xyz"]
        at = tuple(millimetres(text) for text in texts) if any(texts) else None
        freedoms = tuple(each for each in DOF if each in self.get_query_arguments("freedom"))
        since = _minutes(self.word("since")) if self.word("since") else None
        return Question(runs, at, freedoms, since, self.word("same_start") == "1")


class Compare(_Comparing):
    """The page."""

    async def get(self) -> None:
        """Show the runs that can be compared, and the comparison of those that are chosen."""
        question, machine = self.question(), self.word("machine")
        asked = {"machine": self.word("history_machine"), "figure": self.word("figure")}
        table = await self.apart(self.context.lab.table, Choice(machine=machine))
        found, wrong, wrong_history = None, "", ""
        try:
            found = await self.apart_slow(_compared, self.context.lab, question) if len(question.runs) > 1 else None
        except ErrormotionError as error:
            wrong = str(error)
        try:
            if all(asked.values()):
                await self.apart_slow(_followed, self.context.lab.runs, *asked.values())
        except ErrormotionError as error:
            wrong_history = str(error)
        self.show(
            "compare.html.j2",
            table=table,
            rows=[row for row in table.rows if row.method][:MOST_LISTED],
            more=sum(bool(row.method) for row in table.rows) > MOST_LISTED,
            machine_chosen=machine,
            question=question,
            freedoms=DOF,
            since=self.word("since"),
            point=[self.word(axis) for axis in "xyz"],
            query=self.request.query,
            found=_stated(found) if found is not None else None,
            wrong=wrong[:LONGEST_MESSAGE],
            figures=sorted({row.figure for row in table.rows if row.figure}),
            asked=asked,
            wrong_history=wrong_history[:LONGEST_MESSAGE],
            history="/compare/history.html?" + urlencode(asked) if all(asked.values()) and not wrong_history else "",
        )


class Figure(_Comparing):
    """The figure of a comparison, as JSON for BokehJS."""

    async def get(self) -> None:
        """Draw it."""
        found = await self.apart_slow(_compared, self.context.lab, self.question())
        self.finish({"item": await self.apart(comparison_item, found)})


class Report(_Comparing):
    """The whole report of a comparison, in a sandbox."""

    async def get(self) -> None:
        """Send it."""
        found = await self.apart_slow(_compared, self.context.lab, self.question())
        self.set_header("Content-Security-Policy", REPORT_POLICY)
        self.finish(await self.apart_slow(_page, write_comparison, found))


class History(Guarded):
    """The report of one figure over time, in a sandbox."""

    async def get(self) -> None:
        """Send it."""
        found = await self.apart_slow(_followed, self.context.lab.runs, self.word("machine"), self.word("figure"))
        self.set_header("Content-Security-Policy", REPORT_POLICY)
        self.finish(await self.apart_slow(_page, write_history, found))


def _compared(lab: Lab, question: Question) -> xr.Dataset:
    files = {name: lab.file(key, "errors") for key, name in _names(lab, question.runs).items()}
    asked = {name: value for name, value in asdict(question).items() if name != "runs"}

    def make() -> xr.Dataset:
        return compare({name: loaded(file) for name, file in files.items()}, **asked)

    return MADE.get((*asked.values(), *(stamp(file) for file in files.values())), make)


def _minutes(text: str) -> float:
    """Return a time that a browser states in min, s."""
    try:
        value = 60.0 * float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetError(f"reference: expected a time in min, such as 10; found {text[:40]!r}")
    return value


def _names(lab: Lab, keys: Sequence[str]) -> dict[str, str]:
    """Return the names of runs in a comparison: the test, with start and end of its folder where it is not unique."""
    entries = {key: lab.entry(key) for key in keys}
    tests = Counter(entry.test or "run" for entry in entries.values())

    def name(entry: Entry) -> str:
        test = entry.test or "run"
        return test if tests[test] == 1 else f"{test} {entry.folder[:16]} {entry.folder[-8:]}"

    return {key: name(entry) for key, entry in entries.items()}


def _stated(ds: xr.Dataset) -> dict[str, Any]:
    """Return what the page says of a comparison, as text."""
    names, pairs = [str(name) for name in ds["dof"].values], []
    for j, pair in enumerate(ds["pair"].values):
        en = np.abs(ds["en"].values[j])
        share = f"{100 * np.mean(en[np.isfinite(en)] <= 1):.0f} %" if np.isfinite(en).any() else "unknown"
        p = [probability(float(each)) for each in (ds["p"].values[j], *ds["curve_p"].values[j])]
        causes = [cause_text(ds, j, rank) for rank in range(min(ds.sizes["rank"], MOST_CAUSES))]
        pairs.append(
            {
                "name": str(pair),
                "cells": [share, f"{np.nanmax(en, initial=0.0):.2f}", *p],
                "causes": [each for each in causes if each is not None],
            }
        )
    head = ["|En| ≤ 1", "largest |En|", "p", *(f"p of {name}" for name in names)]
    notes = [str(note) for note in ds.attrs["notes"] if note]
    return {
        "verdict": verdict(ds),
        "agree": bool(ds.attrs["fit_p"] >= 0.05),
        "head": head,
        "pairs": pairs,
        "notes": notes,
    }


def _followed(runs: Path, machine: str, figure: str) -> xr.Dataset:
    return history(list_runs([runs], machine=machine), machine, figure)


def _page(write: Callable[[xr.Dataset, Path], Path], found: xr.Dataset) -> bytes:
    """Return the page that a function writes."""
    with tempfile.TemporaryDirectory() as place:
        return write(found, Path(place) / "page.html").read_bytes()
