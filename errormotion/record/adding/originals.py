"""The original files of an imported run: copies in its folder, known by their SHA-256."""

from __future__ import annotations

import hashlib
import shutil
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from errormotion.campaign.folder import RunFolder
from errormotion.datasets.files.reading import leaves, require_regular
from errormotion.datasets.files.writing import make_folder, whole
from errormotion.errors import DatasetError
from errormotion.record.runs.listing import Listing

KEPT = "imported"
"""Folder of the copies in a run folder, and key of their description in ``run.json``."""
MAP = "map.toml"
"""The map by which the files were read, in the run folder."""
MAX_FILES = 50
"""Largest number of files of one run."""
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Original:
    """A file as it was added: its name, its SHA-256 and its size in bytes."""

    name: str
    sha256: str
    size: int

    def plain(self) -> dict[str, Any]:
        """Return the entry for ``run.json``."""
        return asdict(self)


def originals_of(paths: Sequence[Path]) -> dict[Path, Original]:
    """Return the description of files.

    Raises
    ------
    DatasetError
        A file cannot be read, is a folder, occurs twice or has the name of another one, or there are too many.
    """
    if len(paths) > MAX_FILES:
        raise DatasetError(
            f"Expected at most {MAX_FILES} files of one run; found {len(paths)}. Add them one after another.",
            code="add.files.too_many",
        )
    found: dict[Path, Original] = {}
    for path in paths:
        try:
            size = require_regular(path).st_size
            digest = sha256_of(path)
        except OSError as error:
            hint = ". A folder is added file by file" if path.is_dir() else ""
            raise DatasetError(
                f"{path}: expected a file; {error.strerror or error}{hint}.",
                code="add.file.unreadable",
            ) from error
        if twice := [
            other for other, each in found.items() if same_name(path.name, each.name) or digest == each.sha256
        ]:
            raise DatasetError(
                f"{path}: has the name or the content of {twice[0]}, where case makes no difference; state each file "
                "of a run once, and rename others",
                code="add.file.twice",
            )
        found[path] = Original(path.name, digest, size)
    return found


def same_name(one: str, other: str) -> bool:
    """Return whether two names are those of one file on a disk that ignores case, or keeps composed characters."""
    first, second = (unicodedata.normalize("NFC", name).casefold() for name in (one, other))
    return first == second


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def keep(originals: Mapping[Path, Original], folder: Path) -> list[Path]:
    """Copy files into a run folder, unless they are there, and return the copies.

    Raises
    ------
    DatasetError
        A file changed meanwhile, or cannot be written.
    """
    copies = []
    make_folder(folder / KEPT)
    for path, original in originals.items():
        copy = folder / KEPT / original.name
        if not copy.is_file() or leaves(folder, copy) or sha256_of(copy) != original.sha256:
            with whole(copy) as part:
                shutil.copyfile(path, part)
        if sha256_of(copy) != original.sha256:
            raise DatasetError(f"{path}: changed while it was copied; repeat the command", code="add.file.changed")
        copies.append(copy)
    return copies


def run_of(originals: Iterable[Original], record: Listing) -> RunFolder | None:
    """Return the newest run of these files; None if there is none."""
    wanted = {each.sha256 for each in originals}
    for path, entry in record.runs:
        if wanted == set(entry.imported):
            return RunFolder.open(path)
    return None


def violations(folder: RunFolder) -> list[str]:
    """Return the kept files of a run that are missing or were changed, one sentence each."""
    stated = folder.data.get(KEPT)
    found = []
    for each in stated.get("files", ()) if isinstance(stated, Mapping) else ():
        copy = folder.path / KEPT / Path(str(each.get("name", ""))).name
        if not copy.is_file() or leaves(folder.path, copy):
            found.append(f"{KEPT}/{copy.name}: missing; expected the added file")
        elif sha256_of(copy) != each.get("sha256"):
            found.append(f"{KEPT}/{copy.name}: expected the SHA-256 in run.json; the file was changed")
    return found
