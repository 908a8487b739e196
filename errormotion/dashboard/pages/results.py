"""Page Results: the table of runs, and one run with its report, figure and files."""

from __future__ import annotations

import asyncio
import math
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import xarray as xr
from tornado.web import HTTPError

from errormotion import datasets
from errormotion.dashboard.cache import Cache, stamp
from errormotion.dashboard.curves import CurveSet, as_csv, curves_of
from errormotion.dashboard.figures import errors_item
from errormotion.dashboard.lab import Choice, Lab, figure_text
from errormotion.dashboard.pages.page import POLICY, Guarded
from errormotion.dashboard.space import Drawing, drawing, has_volume
from errormotion.datasets.results.merit import figures_of
from errormotion.datasets.storage.disk import reading
from errormotion.errors import DatasetError
from errormotion.record.runs.entry import MAX_FIGURES

PAGE = 100
"""Number of runs on one page of the table."""
CHUNK = 1 << 18
"""Size of the parts in which a file is sent, bytes."""
SEND_TIMEOUT = 30.0
"""Time limit for the transfer of a chunk, s."""
MAX_COORDINATE = 20.0
"""Largest coordinate of a functional point, m."""
REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "img-src data:; font-src data:; form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
)
"""Content security policy of a report: the file has access to neither the network nor the dashboard."""
TYPES = {"report": "text/html; charset=utf-8", "run": "application/json", "log": "application/x-ndjson"}


class Results(Guarded):
    """The table of runs with filters."""

    async def get(self) -> None:
        """Show the runs that match the filters."""
        choice = Choice(**{each.name: self.value(each.name) for each in fields(Choice)})
        table = await self.in_thread(self.context.lab.table, choice)
        first = PAGE * (_whole(self.value("page") or "1", 1, 10**6) - 1)
        kept = {name: value for name, value in asdict(choice).items() if value}
        last = max(1, math.ceil(len(table.rows) / PAGE))
        links = {number: "?" + urlencode({**kept, "page": number}) for number in range(1, last + 1)}
        await self.show(
            "results.html.j2",
            table=table,
            rows=table.rows[first : first + PAGE],
            choice=choice,
            number=first // PAGE + 1,
            links=links,
            runs=self.context.lab.runs,
            control=self.context.control,
        )


class Run(Guarded):
    """One run."""

    async def get(self) -> None:
        """Show figures of merit, figure, report and files of a run."""
        key = self.value("run", 600)
        entry, files = await self.in_thread(self.context.lab.run, key)
        shown = await self.in_thread(_result, self.context.lab, key) if "errors" in files else None
        merit = entry.figures if entry.figures is not None or shown is None else shown["figures"]
        figures = [(each.name, *figure_text(each)) for each in merit or ()]
        await self.show("run.html.j2", key=key, entry=entry, files=files, figures=figures, result=shown)


class Figure(Guarded):
    """Figure of a run, as JSON for BokehJS."""

    async def get(self) -> None:
        """Send the figure of the errors at the functional point of the query."""
        found = await self.in_thread(_curves, self.context.lab, self.value("run", 600), *self.point_and_indices())
        freedoms = [text for text in self.get_query_arguments("freedom") if len(text) < 20]
        item = await self.in_thread(errors_item, found, freedoms)
        point = [1e3 * float(each) if math.isfinite(each) else None for each in found.point]
        await self.send({"item": item, "point": point})

    def point_and_indices(self) -> tuple[tuple[float, ...] | None, dict[str, int]]:
        """Return functional point (m) and indices of the query.

        Raises
        ------
        DatasetError
            A coordinate or an index is not a number.
        """
        texts = [self.value(axis) for axis in "xyz"]
        point = None if not any(texts) else tuple(millimetres(text) for text in texts)
        others = [text.partition(":") for text in self.get_query_arguments("at")[:10]]
        return point, {dim: _whole(index, 0, 10**9) for dim, _, index in others}


class Space(Figure):
    """Errors of a volume in space, as a page for a frame."""

    async def get(self) -> None:
        """Send the drawing of the error vectors at the functional point of the query."""
        found = await self.in_thread(_drawing, self.context.lab, self.value("run", 600), *self.point_and_indices())
        self.set_header("Content-Security-Policy", POLICY.replace("frame-ancestors 'none'", "frame-ancestors 'self'"))
        await self.show("space.html.j2", found=found)


class Values(Figure):
    """Values of a run at a functional point, as comma-separated text."""

    async def get(self) -> None:
        """Send the table."""
        key = self.value("run", 600)
        found = await self.in_thread(_curves, self.context.lab, key, *self.point_and_indices())
        self.set_header("Content-Type", "text/csv; charset=utf-8")
        self.set_header("Content-Disposition", f'attachment; filename="{_safe(key)}.csv"')
        self.finish(await self.in_thread(as_csv, found))


class File(Guarded):
    """A file of a run folder."""

    async def get(self) -> None:
        """Send the file; a report is shown in a sandbox, other files are downloaded."""
        key, word = self.value("run", 600), self.value("file")
        path = await self.in_thread(self.context.lab.file, key, word)
        self.set_header("Content-Type", TYPES.get(word, "application/octet-stream"))
        if word == "report" and not self.value("save"):
            self.set_header("Content-Security-Policy", REPORT_POLICY)
        else:
            self.set_header("Content-Disposition", f'attachment; filename="{_safe(key)}-{_safe(path.name)}"')
        with path.open("rb") as file:
            while chunk := await self.in_thread(file.read, CHUNK):
                self.write(chunk)
                try:
                    await asyncio.wait_for(self.flush(), SEND_TIMEOUT)
                except TimeoutError:
                    raise HTTPError(408, reason="The client does not accept the file") from None


LOADED: Cache[xr.Dataset] = Cache(6)
"""Results used last, so that a change of the functional point does not read the file again."""


def loaded(path: Path) -> xr.Dataset:
    """Return a checked error dataset.

    Raises
    ------
    DatasetError
        The file cannot be read, or is not an error dataset.
    """

    def load() -> xr.Dataset:
        with reading(path), datasets.load(path) as found:
            datasets.validate(found)
            return found.load()

    return LOADED.get(stamp(path), load)


def _curves(lab: Lab, key: str, point: tuple[float, ...] | None, select: dict[str, int]) -> CurveSet:
    return curves_of(loaded(lab.file(key, "errors")), point, select)


def _drawing(lab: Lab, key: str, point: tuple[float, ...] | None, select: dict[str, int]) -> Drawing:
    return drawing(loaded(lab.file(key, "errors")), point, select)


def _result(lab: Lab, key: str) -> dict[str, Any]:
    """Return the result of a run for its page: freedoms, functional point (mm), further dimensions, notes."""
    ds = loaded(lab.file(key, "errors"))
    found = curves_of(ds)
    names = [(each.freedom, each.name, each.unit) for each in found.curves]
    point = [f"{1e3 * each:.10g}" for each in found.point]
    others = {dim: size - 1 for dim, size in found.others.items()}
    return {
        "figures": figures_of(ds)[:MAX_FIGURES],
        "freedoms": names,
        "point": point,
        "movable": ds.attrs.get("component") != "beam",
        "others": others,
        "volume": has_volume(ds),
        "notes": ds.em.notes,
        "frame": str(ds.attrs.get("frame", "")),
    }


def millimetres(text: str) -> float:
    """Return a coordinate in m from a text in mm.

    Raises
    ------
    DatasetError
        The text is not a number, or the number is too large.
    """
    try:
        value = float(text) / 1e3
    except ValueError:
        value = math.nan
    if not abs(value) <= MAX_COORDINATE:
        raise DatasetError(
            f"functional point: expected three numbers in mm, as in 0, 0, -150; found {text[:40]!r}",
            code="request.point.form",
        )
    return value


def _whole(text: str, low: int, high: int) -> int:
    if text.isascii() and text.isdigit() and len(text) <= 9 and low <= int(text) <= high:
        return int(text)
    raise DatasetError(f"expected a whole number from {low} to {high}; found {text[:40]!r}", code="request.number.form")


def _safe(text: str) -> str:
    """Return a file name that is safe in a header and on every system."""
    return "".join(each if each.isascii() and (each.isalnum() or each in "-_.") else "_" for each in text)[-150:]
