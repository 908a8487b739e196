"""Import of logs: conversion of texts with columns to raw datasets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import xarray as xr

from errormotion import plugins
from errormotion.datasets.files.tomlfile import nearest, read_toml
from errormotion.datasets.maps.form import MAP_SCHEMA
from errormotion.datasets.maps.reading import read_map
from errormotion.datasets.schemas import raw_schemas, variants
from errormotion.datasets.storage.disk import save
from errormotion.datasets.text.log_import import read_log
from errormotion.datasets.validation import validate
from errormotion.errors import DatasetError

LogReader = Callable[[Path, Path], xr.Dataset]


def import_log(
    log: str | Path | Sequence[str | Path], map_file: str | Path, out: str | Path, *, overwrite: bool = False
) -> xr.Dataset:
    """Convert a log to a raw dataset, and write it.

    Parameters
    ----------
    log : str or Path, or several of them
        Tables: text with columns, spreadsheets and others. Empty cells are NaN, and counted in the attribute
        ``missing_values`` (JSON).
    map_file : str or Path
        TOML. Its key ``schema`` states the form: `errormotion.datasets.maps.form.MapFile`, a raw schema
        (`errormotion.datasets.text.log_map.LogMap`), or the schema of a map of a method.
    out : str or Path
        ``.nc`` or ``.zarr``.
    overwrite : bool
        Replace the file at ``out``.

    Raises
    ------
    DatasetError
        The map or the log is wrong; all mistakes at once, each with its key or line. Nothing is written.
    """
    logs = [log] if isinstance(log, str | Path) else log
    raw = import_files([Path(each) for each in logs], Path(map_file))
    save(raw, out, overwrite=overwrite)
    return raw


def import_files(paths: Sequence[Path], map_file: Path) -> xr.Dataset:
    """Return the raw dataset of files with a map of any form, validated.

    Raises
    ------
    DatasetError
        The map or a file is wrong; the form of the map has one file, and there are several.
    """
    schema = str(read_toml(map_file).get("schema", ""))
    if schema == MAP_SCHEMA:
        raw = read_map(paths, map_file)
    else:
        reader = _reader(schema, map_file)
        if len(paths) != 1:
            raise DatasetError(
                f"{map_file}: schema '{schema}': expected one file; found {len(paths)}. A map for several files has "
                f"the schema '{MAP_SCHEMA}'",
                code="map.files",
            )
        raw = reader(paths[0], map_file)
    raw = raw.assign_attrs(log=", ".join(path.name for path in paths), map=map_file.name)
    validate(raw)
    return raw


def _reader(schema: str, map_file: Path) -> LogReader:
    """Return the function that reads logs with a map of this schema."""
    if variants(schema):
        return read_log
    own: dict[str, LogReader] = {}
    for _, readers in plugins.brought("log_readers", "methods", "datasets"):
        own |= readers
    if schema in own:
        return own[schema]
    known = {MAP_SCHEMA, *own, *(table.id for table in raw_schemas())}
    found = (
        f"found '{schema}'; {nearest(schema, known)}" if schema else f"found none. Known: {', '.join(sorted(known))}"
    )
    raise DatasetError(
        f"{map_file}: schema: expected a raw schema or the schema of a map; {found}", code="import.map.schema"
    )
