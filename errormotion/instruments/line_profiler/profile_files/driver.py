"""Recorded scans in files, with the interface of a profiler."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from glob import glob
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from errormotion.datasets.files.reading import require_regular
from errormotion.errors import InstrumentError, ReplayError
from errormotion.instruments.driver import Openable
from errormotion.instruments.line_profiler.profile_files.readers import READERS, read_scan
from errormotion.instruments.line_profiler.profile_files.settings import ProfileFileSettings
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject
from errormotion.plugins.readings import Profiles, Scan

FORMAT = "errormotion-scans/1"
BLOCK = 100


class ProfileFiles(Openable):
    """Recorded scans, one per file: PLY, PCD, XYZ (with Open3D), CSV height maps, NetCDF.

    Parameters
    ----------
    address : str
        A file, or a pattern such as ``scans/*.ply``, whose files are read in the order of their names.
        ``replay://file`` is a recording: a list of files with their hashes; the files must be unchanged.
    settings : ProfileFileSettings, optional
    record : Path, optional
        List of the files that is written.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="profile_files",
        kind="line_profiler",
        summary="Scans in files: PLY, PCD, XYZ point clouds, CSV height maps, NetCDF",
        status="simulated_only",
    )
    Settings: ClassVar[type[ProfileFileSettings]] = ProfileFileSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        from errormotion.instruments.line_profiler.profile_files.conformance import scan_file

        return InstrumentSubject(cls, str(scan_file()))

    def __init__(
        self, address: str, settings: ProfileFileSettings | None = None, *, record: Path | None = None
    ) -> None:
        self.address = address
        self.settings = ProfileFileSettings() if settings is None else settings
        self._record = record
        self._files: dict[Path, str] | None = None  # with their hashes

    @property
    def rate(self) -> float:
        """Profiles per second, as in the settings."""
        return self.settings.rate

    def open(self) -> None:
        """Find the files and read their hashes; idempotent.

        Raises
        ------
        InstrumentError
            No file was found, a file has an unknown format, or a file of a recording has changed.
        """
        if self._files is not None:
            return
        scheme, mark, rest = self.address.rpartition("://")
        if scheme == "replay":
            self._files = _read_list(Path(rest))
            return
        if mark and scheme != "file":
            raise InstrumentError(
                f"Expected a file or a pattern such as scans/*.ply; found '{self.address}'", code="scans.address.form"
            )
        paths = [Path(rest)] if Path(rest).is_file() else [Path(name) for name in sorted(glob(rest))]
        if not paths:
            raise InstrumentError(
                f"Expected scans of {', '.join(sorted(READERS))}; found no file '{rest}'", code="scans.not_found"
            )
        files = {path: _hash(path) for path in paths}
        if self._record is not None:
            _write_list(self._record, files)
        self._files = files

    def close(self) -> None:
        """Close the files; idempotent."""
        self._files = None

    def identify(self) -> Identity:
        """Return the identity of the files: their formats and hashes."""
        files = self._opened()
        together = hashlib.sha256("".join(files.values()).encode()).hexdigest()
        return Identity(
            manufacturer="files",
            model=", ".join(sorted({path.suffix.lower().lstrip(".") for path in files})),
            serial_number=(together if len(files) > 1 else next(iter(files.values())))[:16],
            details={"address": self.address, "files": {path.name: digest for path, digest in files.items()}},
        )

    def scans(self) -> Iterator[Scan]:
        """Yield the scans as height maps, in the order of the file names; InstrumentError if one is invalid."""
        for path in self._opened():
            yield read_scan(path, self.settings)

    def read(self) -> np.ndarray[Any, Any]:
        """Return the heights of the first profile, m, (point,); NaN where missing."""
        return np.asarray(next(self.scans()).heights[0])

    def stream(self, block: int | None = None) -> Iterator[Profiles]:
        """Yield the profiles of all scans in blocks of at most ``block`` (100), each from one scan."""
        first, size = 0, block or BLOCK
        for scan in self.scans():
            for start in range(0, len(scan.y), size):
                heights, y = scan.heights[start : start + size], scan.y[start : start + size]
                unknown = int(np.isnan(heights).sum())
                yield Profiles(
                    values=heights.T,
                    first=first,
                    rate=self.rate,
                    host_time=time.monotonic(),
                    invalid={"no value": unknown} if unknown else {},
                    x=scan.x,
                    y=y,
                    trigger=first + np.arange(len(y)),
                    encoder=np.full(len(y), np.nan),
                )
                first += len(y)

    def _opened(self) -> dict[Path, str]:
        if self._files is None:
            raise InstrumentError(
                f"The profile_files at {self.address} are not open: use them in a 'with' block, or call open() first",
                code="instrument.not_open",
            )
        return self._files


def _hash(path: Path) -> str:
    try:
        require_regular(path)
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InstrumentError(f"{path} cannot be read: {error.strerror}", code="scans.file.unreadable") from None
    except ValueError as error:  # a name with the character NUL
        raise InstrumentError(f"{str(path)!r} is not a file name: {error}", code="scans.file.name") from None


def _write_list(path: Path, files: dict[Path, str]) -> None:
    lines = [FORMAT, *(f"{digest} {os.path.relpath(file, path.parent)}" for file, digest in files.items())]
    try:
        with path.open("x", encoding="utf-8") as out:
            out.write("\n".join(lines) + "\n")
    except OSError as error:
        raise InstrumentError(
            f"The recording {path} cannot be created: {error.strerror}", code="recording.not_created"
        ) from None


def _read_list(path: Path) -> dict[Path, str]:
    try:
        require_regular(path)
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayError(f"The recording {path} cannot be read: {error}", code="recording.unreadable") from None
    pairs = [line.partition(" ") for line in lines[1:]]
    if not pairs or lines[0] != FORMAT or not all(name for _, _, name in pairs):
        raise ReplayError(
            f"{path} is not a list of scans: expected a first line '{FORMAT}' and at least one file",
            code="recording.form",
        )
    files = {path.parent / name: digest for digest, _, name in pairs}
    for file, digest in files.items():
        if _hash(file) != digest:
            raise ReplayError(f"{file} has changed since it was recorded in {path}", code="recording.file.changed")
    return files
