"""A run folder: ``runs/<utc>-<test>-<id>/`` and its ``run.json``.

``run.json`` is replaced by a rename and is therefore complete at any time. All paths in it are relative to the folder,
which can be moved together with its neighbours.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from errormotion.datasets.files.reading import leaves
from errormotion.datasets.files.runfile import SCHEMA, read_run
from errormotion.datasets.files.writing import make_folder, replace_bytes, replace_text, whole_folder
from errormotion.datasets.provenance import make, plain
from errormotion.errors import RunError

if TYPE_CHECKING:
    from errormotion.campaign.files import BenchPlan

RESERVE_BYTES = 2**18
"""Disk space reserved during a measurement, bytes; released at its end, so that run.json and the log can be written."""

CHECK_DURATION = 0.2
"""Longest time for which `is_locked` holds a lock, s; a lock held longer means that another process uses the run."""

log = logging.getLogger(__name__)


Status = Literal["running", "finished", "interrupted", "failed"]
"""State of a run."""


def new_entries(bench: BenchPlan) -> dict[str, Any]:
    """Return the entries of ``run.json`` of a new measurement with a bench."""
    of_bench = {"name": bench.name, "machine": bench.machine, "file": bench.source.name, "text": bench.text}
    return {"acquired": False, "bench": of_bench, **first_entries()}


def first_entries() -> dict[str, Any]:
    """Return the entries of ``run.json`` of a new run that depend on no bench."""
    return {
        "status": "running",
        "reason": "",
        "software": make({}, None, None)["software"],
        "samples": {},
        "raw": "raw.zarr",
        "errors": None,
        "report": None,
        "log": "log.jsonl",
        "steps": [],
    }


class FolderGoneError(RunError):
    """A folder was moved or deleted while data were written to it."""

    code = "run.folder.gone"


class Presence:
    """A folder that must not be moved, deleted or replaced while data are written to it.

    Parameters
    ----------
    path : Path
        The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._identity = self._found()

    def _found(self) -> tuple[int, int] | None:
        try:
            state = self.path.stat()
        except OSError:
            return None
        return state.st_dev, state.st_ino

    def check(self) -> None:
        """Check the folder.

        Raises
        ------
        FolderGoneError
            The folder is gone, or another folder has its path.
        """
        if self._identity is None or self._found() != self._identity:
            raise FolderGoneError(
                f"The folder {self.path} is missing: it was moved or deleted while data were written."
            )

    @contextmanager
    def held(self) -> Iterator[None]:
        """Check the folder before and after something is written to it.

        Raises
        ------
        FolderGoneError
            As `check`.
        """
        self.check()
        try:
            yield
        finally:
            self.check()


class RunFolder:
    """One run on disk.

    Attributes
    ----------
    path : Path
        The folder.
    data : dict
        Content of ``run.json``.
    """

    def __init__(self, path: Path, data: dict[str, Any]) -> None:
        self.path = path
        self.data = data
        self._is_locked = False

    @classmethod
    def create(
        cls,
        runs: Path,
        test: str,
        run_id: str,
        data: dict[str, Any],
        fill: Callable[[Path], Mapping[str, Any]] | None = None,
    ) -> Self:
        """Create a folder with its ``run.json``, by a rename.

        ``fill(folder)`` writes further files into the folder before the rename, and returns further entries of
        ``run.json``, which replace others. If it raises an error, there is no folder.

        Raises
        ------
        RunError
            The folder exists, or cannot be created.
        """
        name = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{test}-{run_id}"
        path = runs / name
        if path.exists():
            raise RunError(f"{path}: already exists; a run is never overwritten", code="run.folder.exists")
        try:
            make_folder(runs)
            with whole_folder(path) as part:
                further = fill(part) if fill is not None else {}
                folder = cls(part, {"schema": SCHEMA, "id": run_id, "test": test, "created": now(), **data, **further})
                folder.save()
        except OSError as error:
            raise RunError(
                f"{path}: the run folder cannot be created: {error.strerror}", code="run.folder.not_created"
            ) from error
        folder.path = path
        return folder

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Read a run folder.

        Raises
        ------
        RunError
            The path is not a run folder, or its ``run.json`` is damaged.
        """
        path = Path(path)
        return cls(path, read_run(path))

    def read(self) -> None:
        """Read ``run.json`` again.

        Raises
        ------
        RunError
            The file is damaged or gone.
        """
        self.data = read_run(self.path)

    def save(self, *, status: Status | None = None, **changes: Any) -> None:
        """Change fields of ``run.json`` and write the file.

        Raises
        ------
        RunError
            The folder was moved or deleted since it was created or opened.
        OSError
            The file cannot be written.
        """
        if "updated" in self.data and not self.present:
            raise RunError(f"{self.path} is gone: it was moved or deleted during the run", code="run.folder.gone")
        self.data |= changes | ({} if status is None else {"status": status}) | {"updated": now()}
        replace_text(self.path / "run.json", json.dumps(plain(self.data), indent=1, ensure_ascii=False) + "\n")

    def step(self, name: str, outcome: str, **details: Any) -> None:
        """Append an entry to the steps of this run."""
        self.data.setdefault("steps", []).append({"step": name, "outcome": outcome, "time": now(), **details})

    @property
    def present(self) -> bool:
        """Whether the folder still exists at its path."""
        return (self.path / "run.json").exists()

    @property
    def raw(self) -> Path:
        """The raw store.

        Raises
        ------
        RunError
            It is a link to a target outside the folder.
        """
        return self.inside("raw.zarr")

    @property
    def log(self) -> Path:
        """The log."""
        return self.path / "log.jsonl"

    @property
    def errors(self) -> Path | None:
        """The error dataset of the last identification; None before it.

        Raises
        ------
        RunError
            ``run.json`` states a file outside the folder.
        """
        name = self.data.get("errors")
        if name is None or name == "":
            return None
        if isinstance(name, str) and "\0" not in name and not Path(name).is_absolute() and ".." not in Path(name).parts:
            return self.inside(name)
        raise RunError(
            f"{self.path / 'run.json'}: errors: expected a file in this folder; found {name!r:.100}",
            code="run.errors.outside",
        )

    def inside(self, name: str) -> Path:
        """Return a path in this folder.

        Raises
        ------
        RunError
            A link leads out of the folder.
        """
        path = self.path / name
        if leaves(self.path, path):
            raise RunError(
                f"{path}: expected a file in this folder; it is, or lies behind, a link to another place",
                code="run.file.link",
            )
        return path

    @property
    def finished(self) -> bool:
        """Return whether the run has its result."""
        return bool(self.data.get("status") == "finished")

    def take_reserve(self) -> None:
        """Reserve disk space."""
        with suppress(OSError):
            replace_bytes(self.path / ".reserve", os.urandom(RESERVE_BYTES))

    def give_reserve(self) -> None:
        """Release the reserved disk space."""
        (self.path / ".reserve").unlink(missing_ok=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against other processes; the lock ends with the process. A nested call has no effect.

        Raises
        ------
        RunError
            Another process uses this run.
        """
        try:
            import fcntl
        except ImportError:  # Windows: no lock
            yield
            return
        if self._is_locked:
            yield
            return
        descriptor = os.open(self.path, os.O_RDONLY)
        try:
            end = time.monotonic() + CHECK_DURATION
            while not self._is_locked:
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    self._is_locked = True
                except BlockingIOError as error:
                    if time.monotonic() > end:
                        raise RunError(
                            f"{self.path}: another process is using this run; wait until it ends, or stop it",
                            code="run.folder.used",
                        ) from error
                    time.sleep(CHECK_DURATION / 10)
            yield
        finally:
            self._is_locked = False
            os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Return whether a process holds the lock of a file or folder; simultaneous checks do not affect each other."""
    import fcntl

    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # opening a pipe would wait for its writer
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def list_runs(runs: Path, skipped: list[str] | None = None) -> list[RunFolder]:
    """Return the run folders in a folder, the oldest first; unreadable ones are logged, and appended to ``skipped``."""
    folders = []
    for path in sorted(runs.iterdir()) if runs.is_dir() else []:
        if path.is_dir() and not path.name.startswith(".") and os.path.lexists(path / "run.json"):
            try:
                folders.append(RunFolder.open(path))
            except RunError as error:
                log.warning("skipped: %s", error)
                if skipped is not None:
                    skipped.append(str(error))
    return sorted(folders, key=lambda folder: str(folder.data.get("created", "")))


def now() -> str:
    """Return the present time in UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
