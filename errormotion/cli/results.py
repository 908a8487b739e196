"""Error datasets by name: files, run folders, and folders of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import xarray as xr

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.storage.raw_paths import is_runs_folder
from errormotion.datasets.files.reading import visible
from errormotion.datasets.storage.disk import reading
from errormotion.errors import DatasetError, RunError


@dataclass(frozen=True)
class Loaded:
    """Error datasets by name, the path of each on the command line, and a message for each omitted run.

    ``chosen`` are the names of those that were selected from a folder of runs.
    """

    results: dict[str, xr.Dataset] = field(default_factory=dict)
    paths: dict[str, Path] = field(default_factory=dict)
    chosen: set[str] = field(default_factory=set)
    omitted: list[str] = field(default_factory=list)


def load(paths: Sequence[Path], names: Mapping[str, Path], *, every: bool = False) -> Loaded:
    """Return error datasets by name.

    Parameters
    ----------
    paths : sequence of Path
        Error datasets, run folders, or folders of runs; such a folder selects the newest result of each test.
    names : mapping of str to Path
        Further results by name.
    every : bool
        Select all results of each test in a folder of runs.

    Raises
    ------
    DatasetError, RunError
        A path does not exist or is not an error dataset, or a run has no error dataset.
    """
    found = Loaded()
    for path in paths:
        of_runs = path.is_dir() and is_runs_folder(path)
        for name, file in _files(path, found.omitted, every):
            own = _add(found, name, file, path)
            if of_runs:
                found.chosen.add(own)
    for name, path in names.items():
        files = _files(path, found.omitted)
        if len(files) != 1:
            raise DatasetError(
                f"{path}: expected one error dataset for the name '{name}'; found {len(files)}",
                code="compare.result.ambiguous",
            )
        _add(found, name, files[0][1], path)
    return found


def _add(found: Loaded, name: str, file: Path, path: Path) -> str:
    """Add the dataset of a file, and return its name: that of the test, with a number if it is not unique."""
    own, number = name, 1
    while own in found.results:
        number += 1
        own = f"{name} ({number})"
    with reading(file):
        found.results[own] = datasets.load(file)
        datasets.validate(found.results[own])
    found.paths[own] = path
    return own


def _files(path: Path, omitted: list[str], every: bool = False) -> list[tuple[str, Path]]:
    """Return names and files of the error datasets of a file, a run folder or a folder of runs."""
    if path.is_file():
        return [(path.stem, path)]
    if not path.is_dir():
        raise DatasetError(f"{path}: no such file or folder", code="file.not_found")
    if not is_runs_folder(path):
        folder = RunFolder.open(path)
        return [(str(folder.data["test"]), _errors(folder))]
    newest: dict[str, tuple[str, Path]] = {}
    everything: list[tuple[str, Path]] = []
    for file in visible(path, "*/run.json"):
        try:
            folder = RunFolder.open(file.parent)
            test, created, errors = str(folder.data["test"]), str(folder.data["created"]), _errors(folder)
        except (RunError, KeyError) as error:
            omitted.append(f"omitted: {error}")
            continue
        everything.append((test, errors))
        if test not in newest or created >= newest[test][0]:
            newest[test] = (created, errors)
    if not newest:
        raise DatasetError(f"{path}: none of the runs has errors; identify them first", code="run.no_errors")
    return everything if every else [(test, errors) for test, (_, errors) in newest.items()]


def _errors(folder: RunFolder) -> Path:
    if folder.errors is None or not folder.errors.is_file():
        raise RunError(
            f"{folder.path}: the run has no error dataset yet; identify its raw data first", code="run.no_errors"
        )
    return folder.errors
