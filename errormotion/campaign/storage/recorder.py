"""The thread that writes raw data to disk during the measurement."""

from __future__ import annotations

import errno
import logging
import queue
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import xarray as xr

from errormotion.campaign.folder import Presence
from errormotion.campaign.storage.store import RawStore
from errormotion.datasets.clock import RecordClock
from errormotion.errors import RunError

COMMIT_INTERVAL = 0.5
"""Longest time until new samples are visible to readers, s; a crash loses at most twice as much."""

log = logging.getLogger(__name__)


class DiskFullError(RunError):
    """The disk is full."""

    code = "store.disk.full"


class Recorder:
    """Writes datasets in the background, at least twice a second.

    Parameters
    ----------
    path : Path
        The raw store; created with the first dataset if missing.
    dim : str
        The dimension that grows.
    expected : float
        Expected total length; in seconds if the samples have a ``sample_rate``.
    attrs : dict
        Attributes of the store, unless the method sets them.
    others : sequence of str
        Further dimensions that grow.
    """

    def __init__(
        self, path: Path, dim: str, expected: float, attrs: dict[str, Any], others: Sequence[str] = ()
    ) -> None:
        self._path, self._dim, self._expected, self._attrs = path, dim, expected, attrs
        self._others = tuple(others)
        self._place = Presence(path.parent)
        self._store = RawStore(path, dim, self._others) if path.exists() else None
        self._clock = RecordClock(self.attrs, self.committed, self._end())
        self._queue: queue.Queue[xr.Dataset | None] = queue.Queue(maxsize=8)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="errormotion-recorder", daemon=True)

    @property
    def committed(self) -> int:
        """Number of samples on disk."""
        return self._store.committed if self._store else 0

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes of the store, including the counts of dropped and invalid samples."""
        return self._store.attrs if self._store else {}

    def put(self, chunk: xr.Dataset) -> None:
        """Queue a dataset for writing; it must not be changed afterwards. Blocks while the queue is full.

        Raises
        ------
        DiskFullError
            The disk is full. Committed data remain complete.
        FolderGoneError
            The folder was moved or deleted.
        RunError
            The data do not fit the store, or cannot be written.
        """
        while True:
            if self._error is not None:
                self._raise()
            try:
                self._queue.put(chunk, timeout=0.2)
            except queue.Full:
                continue
            return

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        while self._thread.is_alive():
            try:
                self._queue.put(None, timeout=0.2)
            except queue.Full:
                continue
            break
        self._thread.join()
        if self._error is not None and (error is None or not isinstance(error, Exception)):
            self._raise()

    def _work(self) -> None:
        try:
            self._write_all()
        except BaseException as error:
            log.exception("the recorder stopped")
            if isinstance(error, RunError) and self._store:  # data were refused; those before are kept
                with suppress(OSError, RunError):
                    self._commit(self._store)
            self._error = error

    def _write_all(self) -> None:
        waiting_since: float | None = None
        while True:
            limit = None if waiting_since is None else max(waiting_since + COMMIT_INTERVAL - time.monotonic(), 0.0)
            try:
                chunk = self._queue.get(timeout=limit)
                if chunk is None:
                    break
                if any(chunk.sizes.get(dim, 1) for dim in (self._dim, *self._others)):
                    self._append(chunk)
                    waiting_since = waiting_since or time.monotonic()
            except queue.Empty:
                pass
            if self._store and waiting_since is not None and time.monotonic() - waiting_since >= COMMIT_INTERVAL:
                self._commit(self._store)
                waiting_since = None
        if self._store:
            self._commit(self._store)
            self._store.close()

    def _commit(self, store: RawStore) -> None:
        store.attrs.update(self._clock.attributes())
        store.commit()

    def _end(self) -> float | None:
        """Return the time of the last sample on disk, s; None without samples at a constant rate."""
        rate = self.attrs.get("sample_rate")
        if not (rate and self._dim == "time" and self.committed):
            return None
        return float(self.attrs.get("time_start", 0.0)) + (self.committed - 1) / float(rate)

    def _append(self, chunk: xr.Dataset) -> None:
        if self._store is None:
            first = chunk.assign_attrs({k: v for k, v in self._attrs.items() if k not in chunk.attrs})
            with self._place.held():
                self._store = RawStore.create(self._path, first, self._dim, self._expected, self._others)
        self._store.append(chunk)

    def _raise(self) -> None:
        error = self._error
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskFullError(f"The disk is full: {self._saved()} are stored in {self._path}.") from error
        if isinstance(error, OSError):
            raise RunError(
                f"{self._path} cannot be written: {error.strerror}; {self._saved()} are stored.",
                code="store.unwritable",
            ) from error
        if isinstance(error, RunError):
            raise error
        raise RunError(
            f"The recorder of {self._path} stopped: {type(error).__name__}: {error}", code="store.recorder.stopped"
        ) from error

    def _saved(self) -> str:
        text = f"{self.committed} along '{self._dim}'"
        rate = self.attrs.get("sample_rate")
        return f"{self.committed} samples ({self.committed / rate:.1f} s)" if rate and self._dim == "time" else text
