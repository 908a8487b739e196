"""Measure: choose or edit a campaign, see its plan, start it, follow it, answer it and stop it."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tornado.web import HTTPError

from errormotion.campaign.background import processes
from errormotion.campaign.background.elsewhere import measuring_elsewhere
from errormotion.campaign.background.preliminary import preliminary, samples
from errormotion.campaign.background.processes import Background
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.form.fields import Form
from errormotion.dashboard.campaigns import Campaigns, hash_of
from errormotion.dashboard.course import course
from errormotion.dashboard.figures import errors_item
from errormotion.dashboard.kept import Lately
from errormotion.dashboard.pages.page import Guarded
from errormotion.datasets.files.reading import parse_json
from errormotion.errors import ErrormotionError, RunError
from errormotion.report.text import signs

SHOWN = 8
"""Processes that have ended and are shown."""


class _OfCampaigns(Guarded):
    def campaigns(self) -> Campaigns:
        """Return the campaign files of this server."""
        bench = self.context.watch.plan.source if self.context.watch is not None else None
        return Campaigns(self.context.campaigns, self.context.control, bench)

    def body(self, *names: str) -> list[str]:
        """Return texts of the JSON that a request carries.

        Raises
        ------
        HTTPError
            It is no JSON object, or one of them is missing or no text.
        """
        try:
            found = parse_json(self.request.body)
        except ValueError:
            found = None
        if not isinstance(found, dict) or not all(isinstance(found.get(name), str) for name in names):
            raise HTTPError(400, reason=f"Expected a JSON object with the texts {', '.join(names)}")
        self.found = found
        return [found[name] for name in names]


class Measure(_OfCampaigns):
    """The page."""

    async def get(self) -> None:
        """Show the campaign files and one of them."""
        campaigns = self.campaigns()
        names = await self.apart(campaigns.names)
        name = self.get_query_argument("file", None)
        name = (names[0] if names else "") if name is None else self.word("file")
        text = await self.apart(campaigns.read, name)
        self.show(
            "measure.html.j2",
            control=self.context.control,
            names=names,
            name=name,
            text=text,
            before=hash_of(text),
        )


class Fields(_OfCampaigns):
    """The form of a text, as JSON, after a change that a request may state.

    ``place`` and ``value``: of a field; ``add``: true, a test is added; ``remove``: number of the test to be removed.
    """

    async def post(self) -> None:
        """Send text, fields and mistakes."""
        name, text = self.body("file", "text")
        number = self.found.get("remove")
        if self.found.get("add") is True:
            form = await self.apart(self.campaigns().with_test, name, text)
        elif number is not None:
            if type(number) is not int or number < 0:
                raise HTTPError(400, reason="remove: expected the number of a test")
            form = await self.apart(self.campaigns().without_test, name, text, number)
        else:
            place = self.found.get("place", [])
            if not isinstance(place, list) or not all(type(each) in (str, int) for each in place) or len(place) > 20:
                raise HTTPError(400, reason="place: expected keys")
            written = self.found.get("value", "")
            form = await self.apart(self.campaigns().form, name, text, tuple(place), str(written))
        self.finish(_plain(form))


class Plan(_OfCampaigns):
    """What a campaign will do and how well it will measure, as JSON."""

    async def post(self) -> None:
        """Compute it."""
        name, text = self.body("file", "text")
        self.finish({"tests": await self.apart_slow(self.campaigns().plan, name, text)})


class Save(_OfCampaigns):
    """Write a campaign file."""

    controls = True

    async def post(self) -> None:
        """Save it, and send the hash of what is saved."""
        name, text, before = self.body("file", "text", "before")
        await self.apart(self.campaigns().save, name, text, before)
        self.finish({"file": name, "before": hash_of(text)})


class Start(_OfCampaigns):
    """Save a campaign and run it in a process of its own."""

    controls = True

    async def post(self) -> None:
        """Start it."""
        name, text, before = self.body("file", "text", "before")
        path = await self.apart(self.campaigns().save, name, text, before)
        process = await self.apart(processes.start, path, self.context.lab.runs)
        self.finish({"process": process, "before": hash_of(text)})


class Resume(_OfCampaigns):
    """Continue the campaign of a run in a process of its own."""

    controls = True

    async def post(self) -> None:
        """Start it."""
        (key,) = self.body("run")
        self.finish({"process": await self.apart(processes.resume, self.context.lab.folder(key))})


class Stop(_OfCampaigns):
    """Ask a process to stop."""

    controls = True

    async def post(self) -> None:
        """Send the request to end."""
        (name,) = self.body("process")
        await self.apart(processes.stop, self.context.lab.runs, name)
        self.finish({})


class Answer(_OfCampaigns):
    """State that a request to the operator is done."""

    controls = True

    async def post(self) -> None:
        """Pass it on."""
        (name,) = self.body("process")
        number = self.found.get("number")
        if type(number) is not int:
            raise HTTPError(400, reason="number: expected a whole number")
        await self.apart(processes.answer, self.context.lab.runs, name, number)
        self.finish({})


class Processes(Guarded):
    """The processes of the folder of runs, as JSON."""

    async def get(self) -> None:
        """Send those that live, and the last ones that have ended."""
        runs = self.context.lab.runs
        self.finish({"processes": await self.apart(_PROCESSES.get, runs, lambda: _processes(runs))})


class Live(Guarded):
    """The errors of a run that is still measuring, as JSON for BokehJS."""

    async def get(self) -> None:
        """Identify the samples so far, and draw the errors with their uncertainty."""
        path = self.context.lab.folder(self.word("run", 600))
        self.finish(await self.apart_slow(_LIVE.get, path, lambda: _live(path)))


_PROCESSES: Lately[list[dict[str, Any]]] = Lately(0.3)
_LIVE: Lately[dict[str, Any]] = Lately(2.0)
"""Figures of growing runs, so that many clients do not keep the server identifying."""


def _live(path: Path) -> dict[str, Any]:
    folder = RunFolder.open(path)
    count = samples(folder)
    try:
        return {"samples": count, "item": errors_item(course(preliminary(folder))), "why": ""}
    except ErrormotionError as error:
        return {"samples": count, "item": None, "why": str(error)}


def _processes(runs: Path) -> list[dict[str, Any]]:
    found = processes.found(runs)
    shown = [each for each in found if each.alive] + [each for each in found if not each.alive][:SHOWN]
    busy = {name for each in found if each.alive for name in each.tests.values()}
    others = measuring_elsewhere(runs, busy)
    busy |= {each.name for each in others}
    own = [_process(runs, each, busy) | {"elsewhere": False} for each in shown]
    return [*(_process(runs, each, busy) | {"elsewhere": True} for each in others), *own]


def _process(runs: Path, each: Background, busy: set[str]) -> dict[str, Any]:
    tests = [{"name": name, "run": run, "status": _status(runs / run)} for name, run in each.tests.items()]
    open_ = [test["run"] for test in tests if test["status"] not in ("finished", "")]
    resumable = not each.alive and bool(open_) and not busy & set(each.tests.values())
    known = {key: None if isinstance(value, float) and not math.isfinite(value) else value
             for key, value in asdict(each).items()}  # fmt: skip
    return {**known, "note": signs(each.note), "tests": tests, "resume": open_[-1] if resumable else ""}


def _status(path: Path) -> str:
    """Return the state of a run; empty where its folder is gone."""
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
"""Addresses of this page."""
