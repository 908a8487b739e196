"""Files that are dropped on the page Results: stored, shown with the proposed columns, corrected, added as a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tornado.web import HTTPError

from errormotion.dashboard.pages.page import Guarded
from errormotion.dashboard.uploads import MAX_UPLOAD, Uploads
from errormotion.datasets.files.reading import parse_json
from errormotion.errors import ErrormotionError
from errormotion.record.adding.add import add
from errormotion.record.adding.draft import draft_of
from errormotion.record.adding.questions import take_proposals
from errormotion.record.adding.request import Request

UPLOAD = "/results/add/file"
"""Address to which files are sent; only there a request may be as large as a file."""
MAX_ANSWERS = 500
"""Largest number of answers."""
MAX_TEXT = 4000
"""Longest answer, characters."""


class _Adding(Guarded):
    controls = True

    @property
    def uploads(self) -> Uploads:
        """The uploads beside the runs of this server."""
        return Uploads(self.context.lab.runs)

    def body(self) -> tuple[str, dict[str, str]]:
        """Return key and answers of the JSON document of a request.

        Raises
        ------
        HTTPError
            The document has another form.
        """
        try:
            found = parse_json(self.request.body)
        except ValueError:
            found = None
        key = found.get("key") if isinstance(found, dict) else None
        answers = found.get("answers") if isinstance(found, dict) else None
        texts = isinstance(answers, dict) and all(isinstance(text, str) for text in answers.values())
        if not isinstance(key, str) or not isinstance(answers, dict) or not texts:
            raise HTTPError(400, reason="Expected a JSON object with a key and answers")
        if len(answers) > MAX_ANSWERS or any(len(each) > MAX_TEXT for pair in answers.items() for each in pair):
            raise HTTPError(400, reason="The answers are too long")
        return key, answers


@contextmanager
def _about(paths: Sequence[Path]) -> Iterator[None]:
    """Name the files in errors as the person knows them, without the folder of the upload."""
    try:
        yield
    except ErrormotionError as error:
        text = str(error)
        for path in paths:
            text = text.replace(str(path), path.name)
        error.args = (text,)
        raise


class File(_Adding):
    """A file of an upload; the body of the request is its content."""

    async def post(self) -> None:
        """Store the file, and send the key of the upload."""
        if len(self.request.body) > MAX_UPLOAD:
            raise HTTPError(400, reason=f"Expected a file of at most {MAX_UPLOAD >> 20} MiB")
        key, name, changed = (self.value(each) for each in ("key", "name", "changed"))
        seconds = int(changed) / 1e3 if changed.isascii() and changed.isdigit() and len(changed) <= 13 else None
        found = await self.in_thread(self.uploads.store, key, name, self.request.body, seconds)
        await self.send({"key": found})


class Table(_Adding):
    """The draft of an upload, as JSON."""

    async def post(self) -> None:
        """Send tables, proposed columns and questions."""
        key, answers = self.body()
        paths = self.uploads.files(key)
        with _about(paths):
            found = await self.in_slow_thread(draft_of, paths, self.context.lab.runs, answers)
        await self.send(found.plain())


class Save(_Adding):
    """Addition of an upload as a run."""

    async def post(self) -> None:
        """Add the files, and send the key of the run; files that are in the record only if this is requested."""
        key, answers = self.body()
        again = parse_json(self.request.body).get("again") is True
        paths = self.uploads.files(key)
        with _about(paths):
            run, known = await self.in_slow_thread(_added, paths, self.context.lab.runs, answers, again)
        if not known:
            self.uploads.forget(key)
        await self.send({"run": run, "known": known})


class Cancel(_Adding):
    """Removal of an upload."""

    async def post(self) -> None:
        """Remove the files."""
        key, _ = self.body()
        await self.in_thread(self.uploads.forget, key)
        await self.send({})


def _added(paths: Sequence[Path], runs: Path, answers: dict[str, str], again: bool) -> tuple[str, bool]:
    """Return the key of the run of added files, and whether it was in the record already."""
    from errormotion.report import write_run_report

    of_files: dict[str, Any] = {key: text for key, text in answers.items() if key != "machine"}
    request = Request(tuple(paths), runs, machine=answers.get("machine", ""), answers=of_files, again=again, shown=True)
    found = add(request, take_proposals, report=write_run_report)
    return found.folder.path.name, found.known


HANDLERS: tuple[tuple[str, type[Guarded]], ...] = (
    (UPLOAD, File),
    (r"/results/add/table\.json", Table),
    (r"/results/add/save", Save),
    (r"/results/add/cancel", Cancel),
)
"""Routes of this page."""
