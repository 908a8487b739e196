"""Error datasets from files, run folders and folders of runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import xarray as xr

from errormotion import datasets
from errormotion.errors import DatasetError

ERRORS = "errors.nc"
RUN = "run.json"
LARGEST_RUN_FILE = 16 << 20
"""Bytes of a run file that are read."""


def load(paths: Sequence[Path], names: dict[str, Path] | None = None) -> dict[str, xr.Dataset]:
    """Return error datasets by name.

    Parameters
    ----------
    paths : sequence of Path
        An error dataset; a run folder; or a folder of runs, which stands for the newest result of each of its tests.
    names : mapping of str to Path, optional
        Further ones, with their names.

    Raises
    ------
    DatasetError
        Nothing there, or no error dataset.
    """
    found: dict[str, xr.Dataset] = {}
    for path in paths:
        for name, file in _files(path):
            _add(found, name, file)
    for name, path in (names or {}).items():
        files = _files(path)
        if len(files) != 1:
            raise DatasetError(f"{path}: expected one error dataset for the name '{name}'; found {len(files)}")
        _add(found, name, files[0][1])
    return found


def _add(found: dict[str, xr.Dataset], name: str, file: Path) -> None:
    own, number = name, 1
    while own in found:
        number += 1
        own = f"{name} ({number})"
    found[own] = datasets.load(file)


def _files(path: Path) -> list[tuple[str, Path]]:
    """Return names and files of the error datasets that a path stands for."""
    if path.is_file():
        return [(path.stem if path.name != ERRORS else _test(path.parent)[0], path)]
    if (path / ERRORS).is_file():
        return [(_test(path)[0], path / ERRORS)]
    if not path.is_dir():
        raise DatasetError(f"{path}: there is no such file or folder")
    newest: dict[str, tuple[str, Path]] = {}
    for file in sorted(path.glob(f"*/{ERRORS}")):
        test, started = _test(file.parent)
        if test not in newest or started >= newest[test][0]:
            newest[test] = (started, file)
    if not newest:
        raise DatasetError(f"{path}: expected an error dataset ({ERRORS}), a run folder, or a folder of runs")
    return [(test, file) for test, (_, file) in newest.items()]


def _test(folder: Path) -> tuple[str, str]:
    """Return the test of a run folder, and when it started; the name of the folder where no test is stated."""
    try:
        file = folder / RUN
        run = json.loads(file.read_text(encoding="utf-8")) if file.stat().st_size <= LARGEST_RUN_FILE else {}
    except (OSError, ValueError):
        run = {}
    run = run if isinstance(run, dict) else {}
    test = run.get("test")
    name = test.get("name") if isinstance(test, dict) else test
    return (str(name) if name else folder.name), str(run.get("started", ""))
