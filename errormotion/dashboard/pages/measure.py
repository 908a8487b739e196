"""Page Measure: edit a campaign, show its plan, start it, show its progress, answer requests, stop it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tornado.ioloop import IOLoop
from tornado.web import HTTPError

from errormotion.campaign.background import processes
from errormotion.campaign.background.other_processes import runs_of_other_processes
from errormotion.campaign.background.preliminary import preliminary, samples
from errormotion.campaign.background.processes import Background
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.form.fields import Form
from errormotion.campaign.planning.release import WORD, require_word
from errormotion.campaign.runner import MEASURING
from errormotion.dashboard.cache import TimedCache
from errormotion.dashboard.campaigns import Campaigns, hash_of
from errormotion.dashboard.curves import curves_of
from errormotion.dashboard.figures import errors_item
from errormotion.dashboard.pages.page import Guarded
from errormotion.datasets.files.reading import parse_json
from errormotion.errors import ErrormotionError, RunError
from errormotion.report.text import signs

SHOWN = 8
"""Number of ended processes that are shown."""


class _OfCampaigns(Guarded):
    def campaigns(self) -> Campaigns:
        """Return the campaign files of this server."""
        bench = self.context.watch.plan.source if self.context.watch is not None else None
        return Campaigns(self.context.campaigns, self.context.control, bench)

    def body(self, *names: str) -> list[str]:
        """Return texts of the JSON document of a request.

        Raises
        ------
        HTTPError
            The document is no JSON object, or a text is missing.
        """
        try:
            found = parse_json(self.request.body)
        except ValueError:
            found = None
        if not isinstance(found, dict) or not all(isinstance(found.get(name), str) for name in names):
            raise HTTPError(400, reason=f"Expected a JSON object with the texts {', '.join(names)}")
        self.found = found
        return [found[name] for name in names]

    async def released(self, start: Callable[..., str], *values: Any) -> dict[str, Any]:
        """Start a process, and return its name as ``process``; empty until the person has released its motions.

        The text ``release`` of the request is what the person typed, and ``motions`` what the page showed. Without
        them, or if the motions are others now, nothing is started; the answer has the ``motions`` and the ``word`` that
        releases them.
        """
        typed, shown = self.found.get("release", ""), self.found.get("motions")
        if not isinstance(typed, str):
            raise HTTPError(400, reason="release: expected a text")

        def release(motions: Sequence[str]) -> None:
            if not typed or (shown != list(motions) and typed.strip() == WORD):
                raise _UnreleasedError(tuple(motions))
            require_word(typed)

        try:
            return {"process": await self.in_thread(start, *values, release)}
        except _UnreleasedError as found:
            return {"process": "", "motions": found.motions, "word": WORD}


class _UnreleasedError(Exception):
    """The motions of a process have not been released."""

    def __init__(self, motions: tuple[str, ...]) -> None:
        super().__init__(*motions)
        self.motions = motions


class Measure(_OfCampaigns):
    """The page."""

    share = "stopping"

    async def get(self) -> None:
        """Show the list of campaign files and one campaign."""
        campaigns = self.campaigns()
        IOLoop.current().spawn_callback(self.context.planner.prepare)
        names = await self.in_thread(campaigns.names)
        name = self.get_query_argument("file", None)
        name = (names[0] if names else "") if name is None else self.value("file")
        text = await self.in_thread(campaigns.read, name)
        await self.show(
            "measure.html.j2",
            control=self.context.control,
            names=names,
            name=name,
            text=text,
            before=hash_of(text),
        )


class Fields(_OfCampaigns):
    """Form of a campaign text, as JSON, after an optional change.

    ``place`` and ``value`` change a field; ``add``: true adds a test; ``remove`` is the number of a test to remove.
    """

    async def post(self) -> None:
        """Send text, fields and mistakes."""
        name, text = self.body("file", "text")
        number = self.found.get("remove")
        if self.found.get("add") is True:
            form = await self.in_thread(self.campaigns().with_test, name, text)
        elif number is not None:
            if type(number) is not int or number < 0:
                raise HTTPError(400, reason="remove: expected the number of a test")
            form = await self.in_thread(self.campaigns().without_test, name, text, number)
        else:
            place = self.found.get("place", [])
            if not isinstance(place, list) or not all(type(each) in (str, int) for each in place) or len(place) > 20:
                raise HTTPError(400, reason="place: expected keys")
            written = self.found.get("value", "")
            form = await self.in_thread(self.campaigns().form, name, text, tuple(place), str(written))
        await self.send(_plain(form))


class Plan(_OfCampaigns):
    """Motions and expected uncertainty of a campaign, as JSON."""

    async def post(self) -> None:
        """Send the plan."""
        name, text = self.body("file", "text")
        self.finish(
            {"tests": await self.ending_with_the_client(self.context.planner.plan(self.campaigns(), name, text))}
        )


class Save(_OfCampaigns):
    """Saving of a campaign file."""

    controls = True

    async def post(self) -> None:
        """Save the file, and send its hash."""
        name, text, before = self.body("file", "text", "before")
        await self.in_thread(self.campaigns().save, name, text, before)
        self.finish({"file": name, "before": hash_of(text)})


class Start(_OfCampaigns):
    """Saving of a campaign, and its start in a separate process."""

    controls = True

    async def post(self) -> None:
        """Start the campaign, or send the motions that the person must release first."""
        name, text, before = self.body("file", "text", "before")
        path = await self.in_thread(self.campaigns().save, name, text, before)
        started = await self.released(processes.start, path, self.context.lab.runs)
        self.finish(started | {"before": hash_of(text)})


class Resume(_OfCampaigns):
    """Continuation of the campaign of a run in a separate process."""

    controls = True

    async def post(self) -> None:
        """Continue the campaign, or send the motions that the person must release first."""
        (key,) = self.body("run")
        folder = await self.in_thread(self.context.lab.folder, key)
        self.finish(await self.released(processes.resume, folder))


class Stop(_OfCampaigns):
    """Stop of a process."""

    controls = stops = True

    async def post(self) -> None:
        """Stop the process."""
        (name,) = self.body("process")
        await self.in_stop_thread(processes.stop, self.context.lab.runs, name)
        self.finish({})


class Answer(_OfCampaigns):
    """Answer to a request to the operator."""

    controls = True

    async def post(self) -> None:
        """State that the request is done."""
        (name,) = self.body("process")
        number = self.found.get("number")
        if type(number) is not int:
            raise HTTPError(400, reason="number: expected a whole number")
        await self.in_thread(processes.answer, self.context.lab.runs, name, number)
        self.finish({})


class Processes(Guarded):
    """Processes of the folder of runs, as JSON."""

    share = "stopping"

    async def get(self) -> None:
        """Send the running processes, and the last ended ones."""
        runs = self.context.lab.runs
        self.finish({"processes": await self.in_state_thread(_PROCESSES.get, runs, lambda: _processes(runs))})


class Live(Guarded):
    """Errors of a run in progress, as JSON for BokehJS."""

    async def get(self) -> None:
        """Identify the samples so far, and send the figure of the errors."""
        path = await self.in_thread(self.context.lab.folder, self.value("run", 600))
        await self.send(await self.in_slow_thread(_LIVE.get, path, lambda: _live(path)))


_PROCESSES: TimedCache[list[dict[str, Any]]] = TimedCache(0.3)
_LIVE: TimedCache[dict[str, Any]] = TimedCache(2.0)
"""Answers that are computed once for all clients."""


def _live(path: Path) -> dict[str, Any]:
    folder = RunFolder.open(path)
    count = samples(folder)
    try:
        return {"samples": count, "item": errors_item(curves_of(preliminary(folder))), "why": ""}
    except ErrormotionError as error:
        return {"samples": count, "item": None, "why": str(error)}


def _processes(runs: Path) -> list[dict[str, Any]]:
    found = processes.found(runs)
    shown = [each for each in found if each.alive] + [each for each in found if not each.alive][:SHOWN]
    busy = {name for each in found if each.alive for name in each.tests.values()}
    others = runs_of_other_processes(runs, busy)
    busy |= {each.name for each in others}
    own = [_process(runs, each, busy) | {"elsewhere": False} for each in shown]
    return [*(_process(runs, each, busy) | {"elsewhere": True} for each in others), *own]


def _process(runs: Path, each: Background, busy: set[str]) -> dict[str, Any]:
    tests = [{"name": name, "run": run, "status": _status(runs / run)} for name, run in each.tests.items()]
    open_ = [test["run"] for test in tests if test["status"] not in ("finished", "")]
    resumable = not each.alive and bool(open_) and not busy & set(each.tests.values())
    known = {key: None if isinstance(value, float) and not math.isfinite(value) else value
             for key, value in asdict(each).items()}  # fmt: skip
    known |= {"note": signs(each.note), "measuring": each.stage == MEASURING}
    return {**known, "tests": tests, "resume": open_[-1] if resumable else ""}


def _status(path: Path) -> str:
    """Return the state of a run; empty if its folder is gone."""
    try:
        return str(RunFolder.open(path).data.get("status", ""))
    except RunError:
        return ""


def _plain(form: Form) -> dict[str, Any]:
    return {
        "text": form.text,
        "mistakes": form.mistakes,
        "count": form.count,
        "groups": [asdict(group) for group in form.groups],
    }


HANDLERS: tuple[tuple[str, type[Guarded]], ...] = (
    (r"/measure", Measure),
    (r"/measure/form\.json", Fields),
    (r"/measure/plan\.json", Plan),
    (r"/measure/save", Save),
    (r"/measure/start", Start),
    (r"/measure/resume", Resume),
    (r"/measure/stop", Stop),
    (r"/measure/answer", Answer),
    (r"/measure/processes\.json", Processes),
    (r"/measure/live\.json", Live),
)
"""Routes of this page."""
