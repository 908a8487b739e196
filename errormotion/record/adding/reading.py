"""The raw dataset of files: read as they are if they have a raw schema, else by a map."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from errormotion import datasets, plugins
from errormotion.datasets.importing import import_files
from errormotion.datasets.storage.disk import reading
from errormotion.errors import DatasetError
from errormotion.plugins import Method

_DATASETS = (".nc", ".nc4")
_HEAD = 1 << 16
"""Bytes at the start of a text in which its schema is expected."""
_SCHEMA = re.compile(rb"^\s*#\s*schema\s*=", re.MULTILINE)


def is_raw(path: Path) -> bool:
    """Return whether a file is a dataset, or a text of readings that states its schema: it needs no map."""
    if path.suffix.lower() in _DATASETS:
        return True
    if path.suffix.lower() != ".csv":
        return False
    with path.open("rb") as file:
        return _SCHEMA.search(file.read(_HEAD)) is not None


def read_raw(paths: Sequence[Path], map_file: Path | None) -> xr.Dataset:
    """Return the raw dataset of files, validated; without a map the only file is one of `is_raw`.

    Raises
    ------
    DatasetError
        The map or a file is wrong, the file has results instead of raw data, or there are several without a map.
    """
    if map_file is not None:
        return import_files(paths, map_file)
    if len(paths) != 1:
        names = ", ".join(path.name for path in paths)
        raise DatasetError(
            f"{names}: expected one file, since {paths[0].name} has a schema; add the files one after another",
            code="add.files.several",
        )
    [path] = paths
    with reading(path):
        raw = datasets.load(path)
        if raw.attrs.get("schema") == datasets.SCHEMA:
            raise DatasetError(
                f"{path.name}: contains errors that were identified already; expected raw data. Such results are read "
                "by 'errormotion report' and 'errormotion compare'",
                code="add.file.result",
            )
        datasets.validate(raw)
    return raw


def owner_of(raw: xr.Dataset) -> Any:
    """Return the plugin to which a raw dataset belongs.

    Raises
    ------
    DatasetError
        No plugin has the schema, or the data are readings for a calibration.
    """
    schema = str(raw.attrs.get("schema", "none"))
    owner = plugins.owner_of_schema(schema)
    own = {table.id for table in owner.raw_schemas} if owner is not None else set()
    if owner is None or not (issubclass(owner, Method) or schema in own):
        raise DatasetError(f"expected raw data of a method, or a log; found schema {schema}", code="schema.other")
    if schema in owner.calibrations:
        raise DatasetError(
            "contains readings for a calibration; use 'errormotion calibrate'", code="raw.for_calibration"
        )
    return owner
