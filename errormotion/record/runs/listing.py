"""Listing and selection of the runs of one or more folders."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from errormotion.datasets.files import events
from errormotion.errors import ErrormotionError, RunError
from errormotion.record.runs import index
from errormotion.record.runs.entry import Entry, read_entry
from errormotion.record.runs.index import Stamp

MAX_DEPTH = 3
"""Largest depth of a run folder below the given folder."""
MAX_RUNS = 200_000
"""Largest number of run folders of one call."""
MAX_READ = 100
"""Largest number of error datasets that one call reads, for runs without figures of merit in ``run.json``."""
SETTLING_TIME = 2_000_000_000
"""Age from which a modification time is reliable, ns: a younger file may change again within the same time stamp."""


@dataclass
class Folder:
    """One folder of runs: the entries of its runs, and the runs that could not be read."""

    path: Path
    entries: dict[str, Entry] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    _kept: index.Entries = field(default_factory=dict)
    _stale: bool = False

    def read(self, names: Iterable[str], whole: bool) -> None:
        """Read the run folders of these names; unchanged ones are taken from the index.

        ``whole`` states that these are all run folders; others are removed from the index.
        """
        known, now = index.load(self.path), time.time_ns()
        self._kept = {} if whole else dict(known)
        for name in names:
            if not (name.isprintable() and _is_text(self.path)):  # no page and no index can state it
                found = ascii(str(self.path / name))
                self.skipped[found] = f"{found}: expected a folder with a name of printable characters; rename it"
                continue
            try:
                stamp = _stamp(os.path.join(self.path, name))
                if name in known and known[name][0] == stamp:
                    entry = known[name][1]
                else:
                    entry = read_entry(self.path / name)
                    self._stale = True
            except (OSError, RunError) as error:
                self.skipped[name] = str(error)
                continue
            self.entries[name] = entry
            if entry.partial:
                self.skipped[f"{name} (in part)"] = entry.partial
            for number, reason in enumerate(entry.damaged_notes):
                self.skipped[f"{name} (note {number})"] = reason
            if now - max(stamp.changed, stamp.notes_changed) > SETTLING_TIME:
                self._kept[name] = (stamp, entry)
        self._stale |= len(self._kept) != len(known)

    def change(self, entry: Entry) -> None:
        """Replace an entry by one with more content."""
        self.entries[entry.folder] = entry
        if entry.folder in self._kept:
            self._kept[entry.folder] = (self._kept[entry.folder][0], entry)
            self._stale = True

    def keep(self) -> None:
        """Write the index if it has changed."""
        if self._stale:
            index.save(self.path, self._kept)
            self._stale = False


@dataclass(frozen=True)
class Note:
    """A note on a run or on a machine; ``run`` is the name of the run folder, empty for a machine."""

    time: datetime | None
    machine: str
    run: str
    text: str
    by: str
    noted: str


@dataclass(frozen=True)
class Listing:
    """Runs, newest first, with their paths, and the notes on them and on their machines, oldest first.

    ``skipped`` states the reason for each run folder that could not be read, ``waiting`` the number of runs whose
    figures of merit were not read yet, ``undated`` the number of runs left out because their time is unknown.
    """

    runs: tuple[tuple[Path, Entry], ...]
    skipped: tuple[str, ...]
    waiting: int = 0
    undated: int = 0
    machines: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()


def list_runs(
    paths: Sequence[Path],
    *,
    machine: str | None = None,
    method: str | None = None,
    test: str | None = None,
    since: datetime | None = None,
) -> Listing:
    """Return the runs of folders, newest first.

    Parameters
    ----------
    paths : sequence of Path
        Run folders, folders of runs, or folders of those.
    machine, method, test : str, optional
        Only runs of this machine, this method or this test; upper and lower case are equivalent.
    since : datetime, optional
        Only runs created at this time or later; without a time zone it is in UTC.

    Raises
    ------
    RunError
        A path does not exist, or contains more than `MAX_RUNS` runs.
    """
    folders = []
    for path, (names, whole) in _found(paths).items():
        folders.append(Folder(path))
        folders[-1].read(names, whole)
    everything = [(folder, entry) for folder in folders for entry in folder.entries.values()]
    chosen = [
        (folder, entry)
        for folder, entry in everything
        if _same(machine, entry.machine) and _same(method, entry.method) and _same(test, entry.test)
    ]
    undated, start = 0, None
    if since is not None:
        start = since.replace(tzinfo=UTC) if since.tzinfo is None else since
        undated = sum(entry.time is None for _, entry in chosen)
        chosen = [(folder, entry) for folder, entry in chosen if entry.time is not None and entry.time >= start]
    chosen.sort(key=_order, reverse=True)
    waiting = _complete(chosen)
    for folder in folders:
        folder.keep()
    notes, damaged = _notes(paths, folders, chosen, machine, start)
    return Listing(
        tuple((folder.path / entry.folder, folder.entries[entry.folder]) for folder, entry in chosen),
        (*(reason for folder in folders for reason in folder.skipped.values()), *damaged),
        waiting,
        undated,
        tuple(sorted({entry.machine for _, entry in everything})),
        tuple(sorted({entry.method for _, entry in everything})),
        notes,
    )


def _notes(
    paths: Sequence[Path],
    folders: Sequence[Folder],
    chosen: Sequence[tuple[Folder, Entry]],
    machine: str | None,
    start: datetime | None,
) -> tuple[tuple[Note, ...], list[str]]:
    """Return the notes on the chosen runs and on machines, and a sentence for each unreadable note."""
    notes = [
        Note(events.instant(each.at) or entry.time, entry.machine, entry.folder, each.text, each.by, each.noted)
        for _, entry in chosen
        for each in entry.notes
    ]
    damaged: list[str] = []
    noted = {folder.path for folder in folders} | {path.resolve() for path in paths}
    for path in sorted(path for path in noted if not (path / "run.json").exists()):
        made, wrong = events.read(path)
        damaged += wrong
        notes += [
            Note(events.instant(each.at), each.machine, "", each.text, each.by, each.noted)
            for each in made
            if _same(machine, each.machine)
        ]
    if start is not None:
        notes = [note for note in notes if note.time is not None and note.time >= start]
    return tuple(sorted(notes, key=lambda note: note.time or datetime.min.replace(tzinfo=UTC))), damaged


def _is_text(path: Path) -> bool:
    """Return whether a path is text in UTF-8; the bytes of a file name may be none."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _stamp(folder: str) -> Stamp:
    """Return modification times and sizes of the files from which an entry is read."""
    status = os.stat(os.path.join(folder, "run.json"))
    try:
        notes = os.stat(os.path.join(folder, events.FILE))
    except OSError:
        return Stamp(status.st_mtime_ns, status.st_size)
    return Stamp(status.st_mtime_ns, status.st_size, notes.st_mtime_ns, notes.st_size)


def _order(folder_and_entry: tuple[Folder, Entry]) -> tuple[datetime, str]:
    return folder_and_entry[1].time or datetime.min.replace(tzinfo=UTC), folder_and_entry[1].folder


def _same(wanted: str | None, found: str) -> bool:
    return wanted is None or wanted.casefold() == found.casefold()


def _complete(chosen: Iterable[tuple[Folder, Entry]]) -> int:
    """Read figures of merit from at most `MAX_READ` error datasets; return how many runs are still without figures."""
    lacking = [(folder, entry) for folder, entry in chosen if entry.lacks_figures]
    for folder, entry in lacking[:MAX_READ]:
        from errormotion import datasets  # takes 0.5 s to import
        from errormotion.datasets.results.merit import figures_of

        try:
            with datasets.load(folder.path / entry.folder / entry.errors) as errors:
                folder.change(entry.with_figures(figures_of(errors)))
        except Exception as error:  # noqa: BLE001 - of a foreign plugin, or a damaged file
            kind = "" if isinstance(error, ErrormotionError) else f"{type(error).__name__}: "
            name = f"{entry.folder} (figures)"
            folder.skipped[name] = f"{folder.path / entry.folder}: figures of merit cannot be read: {kind}{error}"
    return max(0, len(lacking) - MAX_READ)


def _found(paths: Sequence[Path]) -> dict[Path, tuple[list[str], bool]]:
    """Return the folders of runs below paths, the names of their run folders, and whether these are all run folders."""
    folders: dict[Path, dict[str, None]] = {}
    whole = set()
    count = 0
    for path in paths:
        if not path.is_dir():
            raise RunError(
                f"{path}: no such folder; expected a run folder or a folder of runs", code="run.folder.not_found"
            )
        single = (path / "run.json").exists()
        for parent, name in (
            [(path.resolve().parent, path.resolve().name)] if single else _walk(path.resolve(), MAX_DEPTH)
        ):
            count += 1
            if count > MAX_RUNS:
                raise RunError(
                    f"{path}: expected at most {MAX_RUNS} runs; choose a folder with fewer runs", code="runs.too_many"
                )
            folders.setdefault(parent, {})[name] = None
            if not single:
                whole.add(parent)
    return {parent: (list(names), parent in whole) for parent, names in folders.items()}


def _walk(path: Path, depth: int) -> Iterator[tuple[Path, str]]:
    """Yield parent and name of each run folder; links to folders and hidden folders are not followed."""
    try:
        with os.scandir(path) as inside:
            names = sorted(
                each.name for each in inside if not each.name.startswith(".") and each.is_dir(follow_symlinks=False)
            )
    except OSError:
        return
    for name in names:
        if os.path.exists(os.path.join(path, name, "run.json")):
            yield path, name
        elif depth > 1:
            yield from _walk(path / name, depth - 1)
