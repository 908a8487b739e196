"""Import of logs: conversion of texts with columns to raw datasets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import xarray as xr

from errormotion import plugins
from errormotion.datasets.files.tomlfile import nearest, read_toml
from errormotion.datasets.schemas import raw_schemas, variants
from errormotion.datasets.storage.disk import save
from errormotion.datasets.text.log_import import read_log
from errormotion.datasets.validation import validate
from errormotion.errors import DatasetError

LogReader = Callable[[Path, Path], xr.Dataset]


def import_log(log: str | Path, map_file: str | Path, out: str | Path, *, overwrite: bool = False) -> xr.Dataset:
    """Convert a log to a raw dataset, and write it.

    Parameters
    ----------
    log : str or Path
        Text with columns. Empty cells are NaN, and counted in the attribute ``missing_values`` (JSON).
    map_file : str or Path
        TOML. If its key ``schema`` is a raw schema, the map follows `errormotion.datasets.text.log_map.LogMap`;
        otherwise it is the schema of a map of a method.
    out : str or Path
        ``.nc`` or ``.zarr``.
    overwrite : bool
        Replace the file at ``out``.

    Raises
    ------
    DatasetError
        The map or the log is wrong; all mistakes at once, each with its key or line. Nothing is written.
    """
    log, map_file = Path(log), Path(map_file)
    raw = _reader(map_file)(log, map_file).assign_attrs(log=log.name, map=map_file.name)
    validate(raw)
    save(raw, out, overwrite=overwrite)
    return raw


def _reader(map_file: Path) -> LogReader:
    """Return the function that reads logs with a map of this schema."""
    schema = str(read_toml(map_file).get("schema", ""))
    if variants(schema):
        return read_log
    own: dict[str, LogReader] = {}
    for _, readers in plugins.brought("log_readers", "methods", "datasets"):
        own |= readers
    if schema in own:
        return own[schema]
    known = {*own, *(table.id for table in raw_schemas())}
    found = (
        f"found '{schema}'; {nearest(schema, known)}" if schema else f"found none. Known: {', '.join(sorted(known))}"
    )
    raise DatasetError(
        f"{map_file}: schema: expected a raw schema or the schema of a map; {found}", code="import.map.schema"
    )
