"""Page Compare: agreement of several results of one machine, and one figure of a machine over time."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import xarray as xr
from tornado.web import HTTPError

from errormotion.compare import compare
from errormotion.compare.report import write as write_comparison
from errormotion.compare.text import cause_text, probability, verdict, within
from errormotion.dashboard.cache import Cache, stamp
from errormotion.dashboard.figures import comparison_item
from errormotion.dashboard.lab import Choice, Lab
from errormotion.dashboard.pages.page import MAX_MESSAGE, Guarded
from errormotion.dashboard.pages.results import REPORT_POLICY, loaded, millimetres
from errormotion.errors import DatasetError, ErrormotionError
from errormotion.kinematics.iso import DOF
from errormotion.record.history import history
from errormotion.record.page import write as write_history
from errormotion.record.runs.entry import Entry
from errormotion.record.runs.listing import list_runs

MAX_COMPARED = 20
"""Largest number of results of one comparison."""
MAX_LISTED = 200
"""Number of runs in the list."""
MAX_CAUSES = 3
"""Number of causes of a pair on the page; the report states all causes."""

COMPARISONS: Cache[xr.Dataset] = Cache(4)


@dataclass(frozen=True)
class Selection:
    """Query of a comparison: keys of runs, and arguments of `errormotion.compare.compare`."""

    runs: tuple[str, ...]
    at: tuple[float, ...] | None
    freedoms: tuple[str, ...]
    since: float | None
    same_start: bool


class _Comparing(Guarded):
    def selection(self) -> Selection:
        """Return the selection in the query.

        Raises
        ------
        HTTPError
            There are too many runs, or a key is too long.
        DatasetError
            A coordinate is not a number.
        """
        runs = tuple(dict.fromkeys(self.get_query_arguments("run")))
        if len(runs) > MAX_COMPARED or any(len(key) > 600 for key in runs):
            raise HTTPError(400, reason=f"At most {MAX_COMPARED} runs are compared")
        texts = [self.value(axis) for axis in "xyz"]
        at = tuple(millimetres(text) for text in texts) if any(texts) else None
        freedoms = tuple(each for each in DOF if each in self.get_query_arguments("freedom"))
        since = _minutes(self.value("since")) if self.value("since") else None
        return Selection(runs, at, freedoms, since, self.value("same_start") == "1")


class Compare(_Comparing):
    """The page."""

    async def get(self) -> None:
        """Show the list of runs, and the comparison of the selected ones."""
        selection, machine = self.selection(), self.value("machine")
        requested = {"machine": self.value("history_machine"), "figure": self.value("figure")}
        table = await self.in_thread(self.context.lab.table, Choice(machine=machine))
        found, wrong, wrong_history = None, "", ""
        try:
            found = (
                await self.in_slow_thread(_compared, self.context.lab, selection) if len(selection.runs) > 1 else None
            )
        except ErrormotionError as error:
            wrong = str(error)
        try:
            if all(requested.values()):
                await self.in_slow_thread(_history_of, self.context.lab.runs, *requested.values())
        except ErrormotionError as error:
            wrong_history = str(error)
        await self.show(
            "compare.html.j2",
            table=table,
            rows=[row for row in table.rows if row.method][:MAX_LISTED],
            more=sum(bool(row.method) for row in table.rows) > MAX_LISTED,
            machine_chosen=machine,
            selection=selection,
            freedoms=DOF,
            since=self.value("since"),
            point=[self.value(axis) for axis in "xyz"],
            query=self.request.query,
            found=_stated(found) if found is not None else None,
            wrong=wrong[:MAX_MESSAGE],
            figures=sorted({row.figure for row in table.rows if row.figure}),
            requested=requested,
            wrong_history=wrong_history[:MAX_MESSAGE],
            history="/compare/history.html?" + urlencode(requested)
            if all(requested.values()) and not wrong_history
            else "",
        )


class Figure(_Comparing):
    """Figure of a comparison, as JSON for BokehJS."""

    async def get(self) -> None:
        """Send the figure."""
        found = await self.in_slow_thread(_compared, self.context.lab, self.selection())
        await self.send({"item": await self.in_thread(comparison_item, found)})


class Report(_Comparing):
    """Report of a comparison, in a sandbox."""

    async def get(self) -> None:
        """Send the report."""
        found = await self.in_slow_thread(_compared, self.context.lab, self.selection())
        self.set_header("Content-Security-Policy", REPORT_POLICY)
        self.finish(await self.in_slow_thread(_page, write_comparison, found))


class History(Guarded):
    """Report of one figure over time, in a sandbox."""

    async def get(self) -> None:
        """Send the report."""
        found = await self.in_slow_thread(
            _history_of, self.context.lab.runs, self.value("machine"), self.value("figure")
        )
        self.set_header("Content-Security-Policy", REPORT_POLICY)
        self.finish(await self.in_slow_thread(_page, write_history, found))


def _compared(lab: Lab, selection: Selection) -> xr.Dataset:
    files = {name: lab.file(key, "errors") for key, name in _names(lab, selection.runs).items()}
    options = {name: value for name, value in asdict(selection).items() if name != "runs"}

    def make() -> xr.Dataset:
        return compare({name: loaded(file) for name, file in files.items()}, **options)

    return COMPARISONS.get((*options.values(), *(stamp(file) for file in files.values())), make)


def _minutes(text: str) -> float:
    """Return a time in s from a text in min."""
    try:
        value = 60.0 * float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetError(
            f"reference: expected a time in min, such as 10; found {text[:40]!r}", code="request.time.form"
        )
    return value


def _names(lab: Lab, keys: Sequence[str]) -> dict[str, str]:
    """Return the names of runs in a comparison: the test, with date and id of the run folder if it is not unique."""
    entries = {key: lab.entry(key) for key in keys}
    tests = Counter(entry.test or "run" for entry in entries.values())

    def name(entry: Entry) -> str:
        test = entry.test or "run"
        return test if tests[test] == 1 else f"{test} {entry.folder[:16]} {entry.folder[-8:]}"

    return {key: name(entry) for key, entry in entries.items()}


def _stated(ds: xr.Dataset) -> dict[str, Any]:
    """Return the results of a comparison as text for the page."""
    names, pairs = [str(name) for name in ds["dof"].values], []
    for j, pair in enumerate(ds["pair"].values):
        p = [probability(float(each)) for each in (ds["p"].values[j], *ds["curve_p"].values[j])]
        causes = [cause_text(ds, j, rank) for rank in range(min(ds.sizes["rank"], MAX_CAUSES))]
        pairs.append(
            {
                "name": str(pair),
                "cells": [*within(ds["en"].values[j]), *p],
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


def _history_of(runs: Path, machine: str, figure: str) -> xr.Dataset:
    return history(list_runs([runs], machine=machine), machine, figure)


def _page(write: Callable[[xr.Dataset, Path], Path], found: xr.Dataset) -> bytes:
    """Return the content of the page that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        return write(found, Path(folder) / "page.html").read_bytes()
