"""A folder that Zarr writes until a file cannot be written; then it takes no other, and can be removed."""

from __future__ import annotations

from pathlib import Path

from zarr.core.buffer import Buffer
from zarr.storage import LocalStore


class FolderStore(LocalStore):
    """Writes each file in the thread that runs Zarr's event loop.

    Zarr starts writing all variables, raises the first error and does not wait for the others; in threads they would
    create the folder again after it was removed.

    Parameters
    ----------
    root : Path
        The folder.
    """

    def __init__(self, root: Path, *, read_only: bool = False) -> None:
        super().__init__(root, read_only=read_only)
        self._failed = False

    async def set(self, key: str, value: Buffer) -> None:
        """Write one file; after an error nothing more."""
        if self._failed:
            raise OSError(f"{self.root}: an earlier file could not be written")
        path = self.root / key
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(value.as_numpy_array().data)
        except OSError:
            self._failed = True
            raise
