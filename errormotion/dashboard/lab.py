"""The runs of one folder for the dashboard, and the files of a run that can be downloaded."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from errormotion.dashboard.cache import Cache, stamp
from errormotion.datasets.files import events
from errormotion.datasets.files.reading import leaves
from errormotion.datasets.files.runfile import FILE
from errormotion.errors import RunError
from errormotion.plugins import FigureOfMerit
from errormotion.record.runs.entry import Entry, read_entry
from errormotion.record.runs.listing import MAX_DEPTH, list_runs
from errormotion.record.text import FIELD, MM_FROM
from errormotion.report.text import DASH, rounded, signs

MAX_KEY = 600
"""Longest key of a run, characters."""
MAX_ENTRIES = 64
"""Number of entries of runs that are kept, for the pages of one run."""
FILES = {"report": "report.html", "pdf": "report.pdf", "xlsx": "report.xlsx", "run": FILE, "log": "log.jsonl"}
"""Files of a run folder that can be downloaded, by keyword; the keyword ``errors`` is the error dataset."""


class NotFoundError(RunError):
    """The run or the file does not exist."""


@dataclass(frozen=True)
class Choice:
    """A selection of runs; an empty text selects every run."""

    machine: str = ""
    method: str = ""
    status: str = ""
    verdict: str = ""
    text: str = ""
    since: str = ""


@dataclass(frozen=True)
class Row:
    """One run in the table, as text."""

    key: str
    started: str
    machine: str
    test: str
    method: str
    figure: str
    value: str
    uncertainty: str
    unit: str
    verdict: str
    status: str
    imported: bool = False


@dataclass(frozen=True)
class Table:
    """Selected runs, newest first, the possible values of filters, and remarks for the user."""

    rows: tuple[Row, ...]
    total: int
    machines: tuple[str, ...]
    methods: tuple[str, ...]
    statuses: tuple[str, ...]
    verdicts: tuple[str, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Lab:
    """A folder of runs."""

    runs: Path
    _entries: Cache[Entry] = field(default_factory=lambda: Cache(MAX_ENTRIES), compare=False)

    def table(self, choice: Choice) -> Table:
        """Return the runs of a selection.

        Raises
        ------
        RunError
            The date is invalid, or there are too many runs.
        """
        if not self.runs.is_dir():
            return Table((), 0, (), (), (), (), (f"The folder {self.runs} does not exist yet.",))
        found = list_runs([self.runs], since=_date(choice.since))
        chosen = [(path, entry) for path, entry in found.runs if _fits(entry, choice)]
        remarks = [f"{found.undated} runs have no known date."] if found.undated else []
        if found.waiting:
            remarks.append(f"{found.waiting} runs: figures of merit not read yet; reload the page.")
        root = self.runs.resolve()
        return Table(
            tuple(_row(path.relative_to(root).as_posix(), entry) for path, entry in chosen),
            len(found.runs),
            _values(found.machines),
            _values(found.methods),
            _values(entry.status for _, entry in found.runs),
            _values(entry.verdict for _, entry in found.runs),
            (*remarks, *(f"Not read: {reason}" for reason in found.skipped)),
        )

    def folder(self, key: str) -> Path:
        """Return the folder of a run.

        Raises
        ------
        NotFoundError
            The key is not that of a run in the folder of runs.
        """
        parts = key.split("/")
        if len(key) <= MAX_KEY and key.isprintable() and "\\" not in key and 0 < len(parts) <= MAX_DEPTH + 1:
            root = self.runs.resolve()
            path = root.joinpath(*parts)
            if not any(part in ("", ".", "..") for part in parts) and _inside(path / FILE, root):
                return path
        raise NotFoundError(f"No run {key[:MAX_KEY]!r} in {self.runs}.", code="run.not_found")

    def entry(self, key: str) -> Entry:
        """Return the entry of a run.

        Raises
        ------
        RunError
            The run does not exist, or its ``run.json`` cannot be read.
        """
        return self._entry(self.folder(key))

    def file(self, key: str, word: str) -> Path:
        """Return a file of a run by its keyword: a key of `FILES`, or ``errors``.

        Raises
        ------
        RunError
            The run or the file does not exist, or a link leads out of the folder.
        """
        folder = self.folder(key)
        name = self._entry(folder).errors if word == "errors" else FILES.get(word, "")
        if name and _inside(folder / name, folder):
            return folder / name
        raise NotFoundError(f"Run {key!r} has no file '{word[:20]}'.", code="run.file.not_found")

    def run(self, key: str) -> tuple[Entry, tuple[str, ...]]:
        """Return the entry of a run, and the keywords of its files.

        Raises
        ------
        RunError
            As `entry`.
        """
        folder = self.folder(key)
        entry = self._entry(folder)
        names = {**FILES, "errors": entry.errors}
        return entry, tuple(word for word, name in names.items() if name and _inside(folder / name, folder))

    def _entry(self, folder: Path) -> Entry:
        """Return the entry of a folder, read again only after a change of its files."""
        try:
            key = tuple(stamp(folder / name) for name in (FILE, events.FILE) if (folder / name).is_file())
        except OSError:
            key = ()
        return self._entries.get(key, lambda: read_entry(folder)) if key else read_entry(folder)


def figure_text(figure: FigureOfMerit) -> tuple[str, str, str]:
    """Return value, expanded uncertainty (k = 2) and printed unit of a figure of merit."""
    factor, unit = FIELD.get(figure.unit, (1.0, figure.unit))
    if figure.unit == "m" and abs(figure.value) >= MM_FROM:
        factor, unit = 1e3, "mm"
    value, expanded = rounded(factor * figure.value, factor * figure.expanded_uncertainty)
    return value, expanded, signs(unit)


def _row(key: str, entry: Entry) -> Row:
    started = f"{entry.time:%Y-%m-%d %H:%M}" if entry.time is not None else "unknown"
    name, texts = "", ("", "", "")
    if entry.figures:
        name, texts = entry.figures[0].name, figure_text(entry.figures[0])
        if not math.isfinite(entry.figures[0].value):
            texts = (DASH, DASH, texts[2])
    return Row(
        key,
        started,
        entry.machine,
        entry.test,
        entry.method,
        name,
        *texts,
        entry.verdict,
        entry.status,
        bool(entry.imported),
    )


def _fits(entry: Entry, choice: Choice) -> bool:
    exact = ((choice.machine, entry.machine), (choice.method, entry.method), (choice.status, entry.status))
    if any(wanted and wanted != found for wanted, found in (*exact, (choice.verdict, entry.verdict))):
        return False
    texts = (entry.test, entry.machine, entry.campaign, entry.folder, *(note.text for note in entry.notes))
    return all(any(word in text.casefold() for text in texts) for word in choice.text.casefold().split())


def _values(texts: Iterable[str]) -> tuple[str, ...]:
    return tuple(sorted({text for text in texts if text}))


def _date(text: str) -> datetime | None:
    if not text:
        return None
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        raise RunError(
            f"since: expected a date, as in 2026-03-31; found {text[:40]!r}", code="request.date.form"
        ) from None


def _inside(path: Path, folder: Path) -> bool:
    """Return whether a path is a file in a folder, and no link leads out of it."""
    try:
        return path.is_file() and not leaves(folder, path)
    except (OSError, ValueError):
        return False
