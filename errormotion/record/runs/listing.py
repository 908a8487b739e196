"""Every run of one or more folders, newest first, and a selection of them."""

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

DEEPEST = 3
"""Folders between the given one and a run folder, at most."""
MOST_RUNS = 200_000
"""Run folders of one call."""
MOST_READ = 100
"""Error datasets that one call opens, for runs whose run.json has no figures of merit."""
SETTLING_TIME = 2_000_000_000
"""A file that was changed less than this before it was read may change again within its time stamp, ns."""


@dataclass
class Folder:
    """One folder of runs: what its run folders state, and what could not be read."""

    path: Path
    entries: dict[str, Entry] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    _kept: index.Kept = field(default_factory=dict)
    _stale: bool = False

    def read(self, names: Iterable[str], whole: bool) -> None:
        """Read the run folders of these names, those that have not changed from the index.

        ``whole``: these are all run folders; the index forgets others.
        """
        known, now = index.load(self.path), time.time_ns()
        self._kept = {} if whole else dict(known)
        for name in names:
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
        """Write the index where it has changed."""
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

    ``skipped`` states for each run folder that could not be read the reason, ``waiting`` how many runs have figures
    of merit that were not read yet, ``undated`` how many were left out because their time is unknown.
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
        Only runs of this machine, of this method, or with this name; upper and lower case are the same.
    since : datetime, optional
        Only runs that were created at this time or later; without a time zone it is UTC.

    Raises
    ------
    RunError
        A path does not exist, or holds more than MOST_RUNS runs.
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
    """Return the notes on the chosen runs and on machines, and a sentence for each that cannot be read."""
    found = [
        Note(events.instant(each.at) or entry.time, entry.machine, entry.folder, each.text, each.by, each.noted)
        for _, entry in chosen
        for each in entry.notes
    ]
    damaged: list[str] = []
    places = {folder.path for folder in folders} | {path.resolve() for path in paths}
    for place in sorted(place for place in places if not (place / "run.json").exists()):
        made, wrong = events.read(place)
        damaged += wrong
        found += [
            Note(events.instant(each.at), each.machine, "", each.text, each.by, each.noted)
            for each in made
            if _same(machine, each.machine)
        ]
    if start is not None:
        found = [note for note in found if note.time is not None and note.time >= start]
    return tuple(sorted(found, key=lambda note: note.time or datetime.min.replace(tzinfo=UTC))), damaged


def _stamp(folder: str) -> Stamp:
    """Return times of change and sizes of the files of a run that an entry is read from."""
    status = os.stat(os.path.join(folder, "run.json"))
    try:
        notes = os.stat(os.path.join(folder, events.FILE))
    except OSError:
        return Stamp(status.st_mtime_ns, status.st_size)
    return Stamp(status.st_mtime_ns, status.st_size, notes.st_mtime_ns, notes.st_size)


def _order(found: tuple[Folder, Entry]) -> tuple[datetime, str]:
    return found[1].time or datetime.min.replace(tzinfo=UTC), found[1].folder


def _same(wanted: str | None, found: str) -> bool:
    return wanted is None or wanted.casefold() == found.casefold()


def _complete(chosen: Iterable[tuple[Folder, Entry]]) -> int:
    """Read figures of merit from error datasets, MOST_READ at most; return how many runs still lack theirs."""
    lacking = [(folder, entry) for folder, entry in chosen if entry.lacks_figures]
    for folder, entry in lacking[:MOST_READ]:
        from errormotion import datasets  # 0.5 s to load: only where a dataset is opened
        from errormotion.datasets.results.merit import figures_of

        try:
            with datasets.load(folder.path / entry.folder / entry.errors) as errors:
                folder.change(entry.with_figures(figures_of(errors)))
        except Exception as error:  # noqa: BLE001 - of a foreign plugin, or a damaged file
            kind = "" if isinstance(error, ErrormotionError) else f"{type(error).__name__}: "
            name = f"{entry.folder} (figures)"
            folder.skipped[name] = f"{folder.path / entry.folder}: figures of merit cannot be read: {kind}{error}"
    return max(0, len(lacking) - MOST_READ)


def _found(paths: Sequence[Path]) -> dict[Path, tuple[list[str], bool]]:
    """Return the folders of runs below paths with the names of their run folders, and whether these are all of them."""
    found: dict[Path, dict[str, None]] = {}
    whole = set()
    count = 0
    for path in paths:
        if not path.is_dir():
            raise RunError(f"{path}: expected a run folder, or a folder of runs; there is no such folder")
        single = (path / "run.json").exists()
        for parent, name in (
            [(path.resolve().parent, path.resolve().name)] if single else _walk(path.resolve(), DEEPEST)
        ):
            count += 1
            if count > MOST_RUNS:
                raise RunError(f"{path}: expected at most {MOST_RUNS} runs; give a folder with fewer")
            found.setdefault(parent, {})[name] = None
            if not single:
                whole.add(parent)
    return {parent: (list(names), parent in whole) for parent, names in found.items()}


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
