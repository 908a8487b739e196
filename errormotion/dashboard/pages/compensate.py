"""Page Compensate: choose bench and model, start in shadow mode or armed, show every offset, ramp to zero."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any
from urllib.parse import urlencode

import numpy as np
from tornado.web import HTTPError

from errormotion.arrays import Array
from errormotion.campaign.compensation.following import Status, is_working, read_status, request_stop
from errormotion.compensation.online.audit import Verdict
from errormotion.compensation.online.follower import State as States
from errormotion.dashboard.cache import TimedCache
from errormotion.dashboard.compensations import Bench, Compensations, Model, Start, rows
from errormotion.dashboard.curves import thin
from errormotion.dashboard.figures import following_item
from errormotion.dashboard.pages.effect import EffectOfRuns, Report
from errormotion.dashboard.pages.page import Context, Guarded
from errormotion.errors import CompensationError

SPANS = (("10 min", 600), ("1 h", 3600), ("8 h", 28800))
"""Possible time spans of the curves, s."""
STATES = tuple(States)
LISTS_TIMEOUT = 5.0
"""Time for which the page waits for benches and models, s."""
MAX_POINTS = 1000
"""Number of points of a reduced curve."""
LATE = 3.0
"""Time without a new state after which a running compensation is reported as late, in periods, and at least in s."""


class _Compensating(Guarded):
    def initialize(self, context: Context, compensations: Compensations) -> None:  # type: ignore[override]
        """Set the context and the compensations of the server."""
        super().initialize(context)
        self.compensations = compensations


class Compensate(_Compensating):
    """The page; `State` and `Curves` provide its values."""

    share = "stopping"

    async def get(self) -> None:
        """Send the page without values; it has the stop buttons, and waits for benches and models a short time only."""
        known, read = self.compensations, True
        benches: list[Bench] = []
        models: list[Model] = []
        if self.context.control:
            try:
                found = self.in_slow_thread(lambda: (known.benches(), known.models()))
                benches, models = await asyncio.wait_for(found, LISTS_TIMEOUT)
            except (TimeoutError, HTTPError):
                read = False
        await self.show(
            "compensate.html.j2",
            control=self.context.control,
            runs=known.runs,
            folder=known.folder,
            benches=benches,
            models=models,
            read=read,
            states=STATES,
            spans=SPANS,
            chosen=self.value("run"),
        )


class Begin(_Compensating):
    """Start of a compensation."""

    controls = True

    async def post(self) -> None:
        """Start a compensation in shadow mode, or armed by the name of the machine."""
        mode = self.get_body_argument("mode", "shadow")
        if mode not in ("shadow", "armed"):
            raise HTTPError(400, reason="Expected shadow or armed")
        arm = self.get_body_argument("machine", "", strip=False) if mode == "armed" else None
        chosen = [self.get_body_argument(name, "") for name in ("bench", "model")]
        await self.in_slow_thread(self.compensations.start, *chosen, arm)
        self.finish({"next": "/compensate"})


class Stop(_Compensating):
    """Request to a compensation to ramp to zero and end."""

    controls = stops = True

    async def post(self) -> None:
        """Write the request, which the compensation checks for in each period."""
        key = self.get_body_argument("run", "")
        await self.in_stop_thread(lambda: request_stop(self.compensations.folder_of(key)))
        self.finish({"next": "/compensate?" + urlencode({"run": key})})


class State(_Compensating):
    """Present state of the compensations, as JSON."""

    share = "stopping"

    async def get(self) -> None:
        """Send the state."""
        key = self.value("run", 255)
        self.set_header("Content-Type", "application/json")
        known = self.compensations
        self.finish(
            await self.in_state_thread(_STATES.get, (known.runs, key, len(known.starts)), lambda: _state(known, key))
        )


class Curves(_Compensating):
    """Prediction, offset and offset in effect over time, as JSON: reduced, in um, null if unknown."""

    async def get(self) -> None:
        """Send the curves of one compensation."""
        span = self.value("span") or str(SPANS[0][1])
        if span not in {str(each) for _, each in SPANS}:
            raise HTTPError(400, reason="Unknown span")
        self.set_header("Content-Type", "application/json")
        known, key = self.compensations, self.value("run", 255)
        self.finish(
            await self.in_thread(_CURVES.get, (known.runs, key, span), lambda: _curves(known, key, float(span)))
        )


class Figure(_Compensating):
    """Axes of the curves, as JSON for BokehJS; `Curves` provides their data."""

    async def get(self) -> None:
        """Send the axes."""
        await self.send({"item": await self.in_thread(following_item)})


def handlers(context: Context) -> list[tuple[str, type[Guarded], dict[str, Any]]]:
    """Return the routes of this page."""
    bench = context.watch.plan.source if context.watch is not None else None
    given = {"context": context, "compensations": Compensations(context.lab.runs, context.campaigns, bench)}
    pages = {"": Compensate, "/start": Begin, "/stop": Stop}
    data = {r"/state\.json": State, r"/curves\.json": Curves, r"/figure\.json": Figure}
    own = [(f"/compensate{path}", handler, given) for path, handler in {**pages, **data}.items()]
    effects = {"/compensate/effect": EffectOfRuns, r"/compensate/effect\.html": Report}
    return [*own, *((path, handler, {"context": context}) for path, handler in effects.items())]


_STATES: TimedCache[str] = TimedCache(0.2)
_CURVES: TimedCache[str] = TimedCache(1.0)
"""Answers that are computed once for all clients."""


def _state(known: Compensations, key: str) -> str:
    """Return the list of compensations, and the details of one, as a JSON document."""
    listed = known.listed()
    found: dict[str, Any] = {
        "list": [_row(*each) for each in listed],
        "starts": [_start(each) for each in known.starts],
    }
    key = key or (listed[0][0] if listed else "")
    found["chosen"] = _chosen(known, key) if key else None
    return json.dumps(found, ensure_ascii=False)


def _row(name: str, working: bool, status: Status | None, wrong: str) -> dict[str, Any]:
    if status is None:
        return {"key": name, "working": working, "wrong": wrong[:300]}
    return {
        "key": name,
        "working": working,
        "machine": status.machine,
        "armed": status.armed,
        "state": status.state,
        "stopping": status.stopping,
        "time": status.time.isoformat(),
        "wrong": "",
    }


def _start(start: Start) -> dict[str, Any]:
    code = start.code
    shown = {"bench": start.bench, "model": start.model, "armed": start.armed, "time": start.time.isoformat()}
    return {**shown, "code": code, "printed": start.printed() if code else ""}


def _chosen(known: Compensations, key: str) -> dict[str, Any]:
    try:
        following = known.following(key)
    except CompensationError as error:
        return {"key": key, "wrong": str(error)}
    following.read()
    try:
        status = read_status(following.folder)
    except CompensationError as error:
        return {"key": key, "wrong": str(error)}
    working = is_working(following.folder)
    silent = (datetime.now(UTC) - status.time).total_seconds()
    limits = status.limits
    with following.lock:
        entries, first = list(rows(list(following.entries))), following.first
    return {
        "key": key,
        "wrong": "",
        "working": working,
        "late": silent if working and silent > max(LATE, LATE * limits.period) else 0.0,
        "status": json.loads(status.model_dump_json()),
        "zero": status.at_zero,
        "audit": {
            "entries": following.reader.count,
            "complete": following.complete,
            "broken": following.broken,
            "hash": following.reader.hash,
            "keyed": following.reader.verdict is Verdict.UNBROKEN,
            "ended": following.reader.ended,
            "model": str(first.get("model") or "")[:200],
            "started": str(first.get("time") or "")[:40],
        },
        "rows": entries,
    }


def _curves(known: Compensations, key: str, seconds: float) -> str:
    following = known.following(key)
    following.read()
    with following.lock:
        points = list(following.points)
    times = np.array([_milliseconds(each.get("time")) for each in points], dtype=float)
    ends = np.nanmax(times) if np.isfinite(times).any() else 0.0
    kept = np.flatnonzero(times >= ends - 1e3 * seconds)
    found = {}
    for k, axis in enumerate("XYZ"):
        asked, half, offset, applied = (
            _column([points[i] for i in kept], name, k, factor)
            for name, factor in (("target", 1e6), ("uncertainty", 2e6), ("offset", 1e6), ("applied", 1e6))
        )
        some = np.unique(np.concatenate([thin(each, MAX_POINTS) for each in (asked, offset)])) if len(kept) else kept
        columns = {"x": times[kept], "asked": asked, "low": asked - half, "high": asked + half}
        columns |= {"offset": offset, "applied": applied}
        found[axis] = {name: [_plain(each) for each in values[some]] for name, values in columns.items()}
    return json.dumps(found)


def _column(points: Sequence[dict[str, Any]], name: str, k: int, factor: float) -> Array:
    """Return one number of each entry; NaN if it is unknown or invalid."""

    def of(values: Any) -> float:
        value = values[k] if isinstance(values, list) and len(values) == 3 else None
        return factor * value if isinstance(value, int | float) else math.nan

    return np.array([of(each.get(name)) for each in points], dtype=float)


def _milliseconds(text: Any) -> float:
    try:
        return 1e3 * (datetime.fromisoformat(str(text)) - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(seconds=1)
    except (ValueError, TypeError, OverflowError):
        return math.nan


def _plain(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None
