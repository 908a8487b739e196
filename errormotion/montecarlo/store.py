"""Trials on disk during an evaluation; each file is complete and on the disk, or missing."""

from __future__ import annotations

import io
import json
import re
import shutil
from pathlib import Path
from typing import Any, Self

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.files.writing import is_part, make_folder, replace_bytes, replace_text
from errormotion.errors import RunError

KEY = "evaluation.json"
_CHUNK = re.compile(r"block-(\d{4,})-(\d+)-(\d+)\.npy")

MAX_KEY = 2**20
"""Largest size of the file of the key, bytes; a larger file is not one of this program."""


class Store:
    """A folder of trials; a context manager.

    Parameters
    ----------
    folder : path
        Folder of the trials; it is created if missing.
    key : mapping
        Data that identify the evaluation.

    Raises
    ------
    RunError
        The folder contains trials of another evaluation or other files, or cannot be written.
    """

    def __init__(self, folder: str | Path, key: dict[str, Any]) -> None:
        self.folder, self._key = Path(folder), key

    def __enter__(self) -> Self:
        file = self.folder / KEY
        try:
            make_folder(self.folder)
            if file.exists():
                stored = json.loads(_small(file))
                if stored != self._key:
                    keys = set(self._key) | set(stored if isinstance(stored, dict) else {})
                    differ = [
                        k for k in sorted(keys) if not isinstance(stored, dict) or stored.get(k) != self._key.get(k)
                    ]
                    raise RunError(
                        f"{self.folder}: contains trials of another evaluation ({', '.join(differ)} differ). Remove "
                        "the folder, or give another name to --out",
                        code="monte_carlo.folder.other",
                    )
            # A process that ended during its start leaves such a part.
            elif any(not is_part(each.name) for each in self.folder.iterdir()):
                raise RunError(
                    f"{self.folder}: expected an empty folder or trials of this evaluation; found other files",
                    code="monte_carlo.folder.not_empty",
                )
            else:
                replace_text(file, json.dumps(self._key, indent=1))
        except (OSError, ValueError, RecursionError) as error:
            raise RunError(
                f"{self.folder}: expected a writable folder for the trials; {error}",
                code="monte_carlo.folder.unwritable",
            ) from error
        return self

    def __exit__(self, *_: object) -> None:
        """Keep the trials, from which an interrupted evaluation is continued."""

    def block(self, number: int, size: int) -> Array | None:
        """Return a complete block (size, k), memory-mapped; None if it does not exist."""
        return self._read(self._block_file(number), size)

    def chunks(self, number: int, size: int) -> list[range]:
        """Return the stored trials of a block."""
        stored = []
        for file in sorted(self.folder.glob(f"block-{number:04d}-*.npy")):
            match = _CHUNK.fullmatch(file.name)
            if match is None:
                continue
            first, stop = int(match[2]), int(match[3])
            if first < stop <= size and self._read(file, stop - first) is not None:
                stored.append(range(first, stop))
        return stored

    def keep(self, number: int, trials: range, values: Array) -> None:
        """Write some trials (n, k) of a block."""
        self._save(self.folder / f"block-{number:04d}-{trials.start}-{trials.stop}.npy", values)

    def join(self, number: int, size: int) -> Array:
        """Join the trials of a block into one file, and return them, memory-mapped."""
        parts = self.chunks(number, size)
        files = [self.folder / f"block-{number:04d}-{part.start}-{part.stop}.npy" for part in parts]
        whole: Array | None = None
        for part, file in zip(parts, files, strict=True):
            values = np.load(file, allow_pickle=False)
            whole = np.full((size, values.shape[1]), np.nan) if whole is None else whole
            whole[part.start : part.stop] = values
        if whole is None:
            raise RunError(f"{self.folder}: the trials of block {number} are missing", code="monte_carlo.block.missing")
        self._save(self._block_file(number), whole)
        for file in files:
            file.unlink(missing_ok=True)
        joined = self.block(number, size)
        return whole if joined is None else joined

    def remove(self) -> None:
        """Remove the folder; the evaluation is finished."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _block_file(self, number: int) -> Path:
        return self.folder / f"block-{number:04d}.npy"

    def _read(self, file: Path, size: int) -> Array | None:
        """Return the values of a file; None if it is not one of this program."""
        try:
            values = np.load(file, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None
        return values if values.ndim == 2 and len(values) == size and values.dtype == np.float64 else None

    def _save(self, file: Path, values: Array) -> None:
        stream = io.BytesIO()
        np.save(stream, np.asarray(values, dtype=np.float64), allow_pickle=False)
        replace_bytes(file, stream.getbuffer())


def _small(file: Path) -> str:
    """Return the text of a file; ValueError if it is too large."""
    if file.stat().st_size > MAX_KEY:
        raise ValueError(f"{file.name} is larger than {MAX_KEY} bytes")
    return file.read_text(encoding="utf-8")
