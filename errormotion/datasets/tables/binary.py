"""Tables in binary files: TDMS of LabVIEW, MATLAB, HDF5 and NetCDF, where all columns have one length."""

from __future__ import annotations

import logging
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.files.containers import check_classic, check_datasets, datasets_in, is_inside
from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.table import Cells, Table
from errormotion.errors import DatasetError

MAX_VALUES = 1 << 28
"""Largest number of values of a file."""
MAX_UNPACKED = 1 << 30
"""Largest size of the compressed variables of a MATLAB file when unpacked, bytes."""
_COMPRESSED = 15
"""Type of a compressed element of a MATLAB file (miCOMPRESSED)."""
_MATLAB_ARRAYS = frozenset(
    {"double", "single", "logical", "char", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
)
"""Classes of MATLAB whose size is stated; a cell or a structure may contain any number of values."""


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
        # A value has at least one bit in the file (digital lines share bytes).
        if sum(len(channel) for channel in channels) > min(MAX_VALUES, 8 * path.stat().st_size):
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

    _require_small(path)
    sizes = {name: shape for name, shape, kind in whosmat(path) if kind in _MATLAB_ARRAYS}
    if sum(math.prod(shape) for shape in sizes.values()) > MAX_VALUES:
        raise DatasetError(f"{path}: expected at most {MAX_VALUES} values; found more", code="file.too_large")
    if not sizes:  # loadmat would read all variables
        return {}, {}, []
    arrays = loadmat(path, variable_names=list(sizes))
    return _columns({name: arrays[name] for name in sizes if name in arrays}), {}, []


def _require_small(path: Path) -> None:
    """Raise DatasetError if the compressed elements of a MATLAB file contain more than `MAX_UNPACKED`."""
    rest = MAX_UNPACKED
    with path.open("rb") as file:
        head = file.read(128)
        order = {b"IM": "<", b"MI": ">"}.get(head[126:128])
        if order is None:
            return  # of version 4, which does not compress
        while len(tag := file.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            after = file.tell() + length
            unpacking = zlib.decompressobj()
            while kind == _COMPRESSED and file.tell() < after and not unpacking.eof:
                packed = file.read(min(1 << 20, after - file.tell()))
                if not packed:
                    break
                while packed and not unpacking.eof:
                    rest -= len(unpacking.decompress(packed, 1 << 20))
                    packed = unpacking.unconsumed_tail
                    if rest < 0:
                        raise DatasetError(
                            f"{path}: expected at most {MAX_UNPACKED} bytes when unpacked; found more",
                            code="file.too_large",
                        )
            file.seek(after)


def _hdf5(path: Path, form: Format) -> Columns:
    import h5py  # type: ignore[import-untyped]

    with h5py.File(path, "r") as file:
        group = file
        for part in form.sheet.split("/") if form.sheet else ():
            if not is_inside(group, part) or not isinstance(group[part], h5py.Group):
                names = [name for name in group if is_inside(group, name)]
                raise DatasetError(
                    f"{path}: no group '{form.sheet}' in this file; {nearest(part, names)}", code="file.sheet.unknown"
                )
            group = group[part]
        found = datasets_in(path, group)
        check_datasets(path, found)
        units = {name: _unit(each) for name, each in found.items()}
        return _columns({name: each[()] for name, each in found.items()}), units, []


def _unit(dataset: Any) -> str:
    """Return the unit of a dataset of HDF5: an attribute that is one text."""
    import h5py

    for name in ("units", "unit"):
        if name in dataset.attrs:
            stated = h5py.h5a.open(dataset.id, name.encode())
            if stated.get_type().get_class() == h5py.h5t.STRING and math.prod(stated.shape) == 1:
                unit = np.asarray(dataset.attrs[name]).reshape(-1)[0]
                return unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    return ""


def _netcdf3(path: Path, _form: Format) -> Columns:
    from scipy.io import netcdf_file

    check_classic(path)
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
