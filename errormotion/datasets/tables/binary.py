"""Tables in binary files: TDMS of LabVIEW, MATLAB, HDF5 and NetCDF, where all columns have one length."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.table import Cells, Table
from errormotion.errors import DatasetError

MAX_VALUES = 1 << 28
"""Largest number of values of a file."""


class ArrayCells(Cells):
    """Columns that are arrays."""

    def __init__(self, columns: Sequence[np.ndarray[Any, Any]]) -> None:
        self._columns = columns
        self.lines = np.arange(1, len(columns[0]) + 1, dtype=np.int64)

    def texts(self, column: int) -> Sequence[str]:
        """Return the cells of a column as text, (n,)."""
        values = self._columns[column]
        if np.issubdtype(values.dtype, np.datetime64):
            return [str(each) for each in values.astype("datetime64[us]")]
        return [
            each.decode("utf-8", "replace") if isinstance(each, bytes) else "" if each != each else str(each)
            for each in values.tolist()
        ]

    def top(self, count: int) -> ArrayCells:
        """Return the first rows, at most ``count``."""
        return ArrayCells([column[:count] for column in self._columns])

    def numbers(self, columns: Sequence[int]) -> dict[int, Array]:
        """Return the columns that contain numbers only, (n,) each."""
        numeric = {k: self._columns[k] for k in columns if np.issubdtype(self._columns[k].dtype, np.number)}
        return {k: np.asarray(values, dtype=float) for k, values in numeric.items() if not np.iscomplexobj(values)}


def binary_table(path: Path, form: Format, kind: str) -> Table:
    """Return the table of a binary file; ``kind`` is tdms, matlab, hdf5 or netcdf3.

    Raises
    ------
    DatasetError
        The file cannot be read, or has no columns of one length.
    """
    try:
        columns, units, notes = {"tdms": _tdms, "matlab": _matlab, "hdf5": _hdf5, "netcdf3": _netcdf3}[kind](path, form)
    except DatasetError:
        raise
    except Exception as error:  # readers of others raise errors of any kind for damaged files
        raise DatasetError(
            f"{path}: cannot be read as {kind}: {error}. Is the file complete?", code="file.unreadable"
        ) from error
    lengths = {name: len(values) for name, values in columns.items()}
    if not lengths:
        raise DatasetError(
            f"{path}: expected columns of numbers; found none. Is the file complete?", code="file.no_numbers"
        )
    longest = max(lengths.values())
    usual = [name for name, length in lengths.items() if length == longest]
    others = [name for name in lengths if name not in usual]
    if others:
        notes.append(f"columns of another length than {longest} are left out: {', '.join(others[:5])}")
    if sum(lengths.values()) > MAX_VALUES:
        raise DatasetError(
            f"{path}: expected at most {MAX_VALUES} values; found {sum(lengths.values())}", code="file.too_large"
        )
    known = form.model_copy(update={"header": True, "decimal": "."})
    cells = ArrayCells([np.asarray(columns[name]) for name in usual])
    return Table(path, known, usual, [units.get(name, "") for name in usual], 1, [], cells, notes)


Columns = tuple[Mapping[str, Any], Mapping[str, str], list[str]]


def _tdms(path: Path, form: Format) -> Columns:
    from nptdms import TdmsFile
    from nptdms.log import log_manager

    log_manager.set_level(logging.ERROR)  # it warns of what is refused or noted here
    columns: dict[str, Any] = {}
    units: dict[str, str] = {}
    notes: list[str] = []
    with TdmsFile.open(path) as file:
        groups = [group for group in file.groups() if group.channels()]
        if form.sheet:
            names = [group.name for group in groups]
            if form.sheet not in names:
                raise DatasetError(
                    f"{path}: no group '{form.sheet}'; {nearest(form.sheet, names)}", code="file.sheet.unknown"
                )
            groups = [group for group in groups if group.name == form.sheet]
        elif len(groups) > 1:
            names = [f"'{group.name}'" for group in groups]
            raise DatasetError(
                f"{path}: expected one group; found {', '.join(names)}. Set format.sheet in the map",
                code="file.sheet.several",
            )
        channels = groups[0].channels() if groups else []
        if sum(len(channel) for channel in channels) > MAX_VALUES:
            raise DatasetError(f"{path}: expected at most {MAX_VALUES} values; found more", code="file.too_large")
        for channel in channels:
            columns[channel.name] = channel[:]
            units[channel.name] = str(
                channel.properties.get("unit_string", "") or channel.properties.get("NI_UnitDescription", "")
            )
        steps = {channel.properties.get("wf_increment") for channel in channels}
        if channels and len(steps) == 1 and (step := steps.pop()) and "time" not in columns:
            columns = {"time": channels[0].time_track(), **columns}
            units["time"] = "s"
            notes.append(f"times from the sample interval of the file, {float(step):.6g} s")
    return columns, units, notes


def _matlab(path: Path, _form: Format) -> Columns:
    from scipy.io import loadmat, whosmat

    sizes = {name: shape for name, shape, _ in whosmat(path)}
    if sum(int(np.prod(shape)) for shape in sizes.values()) > MAX_VALUES:
        raise DatasetError(f"{path}: expected at most {MAX_VALUES} values; found more", code="file.too_large")
    return _columns({name: array for name, array in loadmat(path).items() if not name.startswith("__")}), {}, []


def _hdf5(path: Path, form: Format) -> Columns:
    import h5py  # type: ignore[import-untyped]

    found: dict[str, Any] = {}
    units: dict[str, str] = {}
    with h5py.File(path, "r") as file:
        group = file[form.sheet] if form.sheet else file

        def take(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and item.shape is not None and item.size <= MAX_VALUES:
                found[name] = item[()]
                unit = item.attrs.get("units", item.attrs.get("unit", ""))
                units[name] = unit.decode() if isinstance(unit, bytes) else str(unit)

        group.visititems(take)
    return _columns(found), units, []


def _netcdf3(path: Path, _form: Format) -> Columns:
    from scipy.io import netcdf_file

    found: dict[str, Any] = {}
    units: dict[str, str] = {}
    with netcdf_file(path, "r", mmap=False) as file:
        for name, variable in file.variables.items():
            found[name] = variable[:].copy()
            unit = getattr(variable, "units", b"")
            units[name] = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    return _columns(found), units, []


def _columns(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return vectors by name; a matrix is its columns, a record its fields."""
    columns: dict[str, Any] = {}
    for name, array in arrays.items():
        values = np.asarray(array)
        if values.dtype.names:
            columns |= {f"{name}.{part}": np.ravel(values[part]) for part in values.dtype.names}
            continue
        if values.dtype.kind not in "biufSUM":
            continue
        values = np.squeeze(values)
        if values.ndim == 1 and values.size > 1:
            columns[name] = values
        elif values.ndim == 2:
            tall = values if values.shape[0] >= values.shape[1] else values.T
            columns |= {f"{name} {k + 1}": tall[:, k] for k in range(tall.shape[1])}
    return columns
