"""Error datasets by name: files, run folders, and folders of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import xarray as xr

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.storage.raw_paths import is_runs_folder
from errormotion.datasets.storage.disk import reading
from errormotion.errors import DatasetError, RunError


def load(
    paths: Sequence[Path], names: Mapping[str, Path], *, every: bool = False
) -> tuple[dict[str, xr.Dataset], list[str]]:
    """Return error datasets by name, and a message for each omitted run.

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
    found: dict[str, xr.Dataset] = {}
    omitted: list[str] = []
    for path in paths:
        for name, file in _files(path, omitted, every):
            _add(found, name, file)
    for name, path in names.items():
        files = _files(path, omitted)
        if len(files) != 1:
            raise DatasetError(f"{path}: expected one error dataset for the name '{name}'; found {len(files)}")
        _add(found, name, files[0][1])
    return found, omitted


def _add(found: dict[str, xr.Dataset], name: str, file: Path) -> None:
    own, number = name, 1
    while own in found:
        number += 1
        own = f"{name} ({number})"
    with reading(file):
        found[own] = datasets.load(file)
        datasets.validate(found[own])


def _files(path: Path, omitted: list[str], every: bool = False) -> list[tuple[str, Path]]:
    """Return names and files of the error datasets of a file, a run folder or a folder of runs."""
    if path.is_file():
        return [(path.stem, path)]
    if not path.is_dir():
        raise DatasetError(f"{path}: no such file or folder")
    if not is_runs_folder(path):
        folder = RunFolder.open(path)
        return [(str(folder.data["test"]), _errors(folder))]
    newest: dict[str, tuple[str, Path]] = {}
    everything: list[tuple[str, Path]] = []
    for file in sorted(path.glob("*/run.json")):
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
        raise DatasetError(f"{path}: none of the runs has errors; identify them first")
    return everything if every else [(test, errors) for test, (_, errors) in newest.items()]


def _errors(folder: RunFolder) -> Path:
    if folder.errors is None or not folder.errors.is_file():
        raise RunError(f"{folder.path}: the run has no error dataset yet; identify its raw data first")
    return folder.errors
