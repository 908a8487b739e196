"""NetCDF-4 files: those of `errormotion` are read by h5py, all others and what is written by h5netcdf.

h5netcdf looks up a variable by its path for each of its properties, 35 to 40 times for each variable that is read or
written. For the small variables of an error dataset this takes most of the time. Files are therefore written with each
object looked up once, and read without h5netcdf where all dimensions, values and attributes have the form that
h5netcdf has given them: numbers of this computer, or texts of free length.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5netcdf
import h5py  # type: ignore[import-untyped]
import numpy as np
import xarray as xr
from xarray.backends import AbstractDataStore, BackendArray, CachingFileManager, H5NetCDFStore
from xarray.backends.locks import HDF5_LOCK
from xarray.core import indexing

_HELD = "_File__h5file"
"""Attribute of h5netcdf that contains the file of h5py. If it has another name, this module has no effect."""


class _Remembering:
    """A file of h5py that looks up each object once; the cache is cleared when an object is deleted."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._found: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __getitem__(self, path: Any) -> Any:
        if path == "/":
            return self
        if not isinstance(path, str):  # a reference
            return self._file[path]
        if path not in self._found:
            self._found[path] = self._file[path]
        return self._found[path]

    def __setitem__(self, path: str, value: Any) -> None:
        self._file[path] = value

    def __delitem__(self, path: str) -> None:
        self._found.clear()
        del self._file[path]

    def __contains__(self, path: Any) -> bool:
        return path in self._file

    def __iter__(self) -> Iterator[str]:
        return iter(self._file)

    def __len__(self) -> int:
        return len(self._file)

    def close(self) -> None:
        self._found.clear()
        self._file.close()


class File(h5netcdf.File):  # type: ignore[misc, unused-ignore]
    """A NetCDF-4 file of h5netcdf that looks up each of its objects once."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if hasattr(self, _HELD):
            setattr(self, _HELD, _Remembering(getattr(self, _HELD)))


_HIDDEN = {"CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST", "_Netcdf4Dimid", "_Netcdf4Coordinates"}
"""Attributes that state dimensions."""
_OF_FILE = {"_NCProperties", "_nc3_strict"}
_RENAMED = "_nc4_non_coord_"
_NO_VALUES = b"This is a netCDF dimension but not a netCDF variable"


class _UnusualError(Exception):
    """A file has something that only h5netcdf reads."""


class _Array(BackendArray):
    """An array of a NetCDF-4 file, whose values are read where they are used."""

    def __init__(self, files: CachingFileManager[h5py.File], name: str, variable: h5py.Dataset) -> None:
        self.shape, self.dtype = variable.shape, variable.dtype
        self._files, self._name = files, name

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER_1VECTOR, self._read)

    def _read(self, key: tuple[Any, ...]) -> Any:
        with HDF5_LOCK:
            variable = self._files.acquire()[self._name]
            return (variable.asstr() if self.dtype.kind == "O" else variable)[key]


class _Store(AbstractDataStore):
    """What xarray decodes: the variables and attributes of a file that `errormotion` wrote.

    Raises
    ------
    _UnusualError
        Another program may have written the file.
    """

    def __init__(self, path: Path) -> None:
        self._files = CachingFileManager(h5py.File, str(path), mode="r")
        try:
            with HDF5_LOCK:
                self._read(self._files.acquire(), str(path))
        except BaseException:
            self.close()
            raise

    def _read(self, file: h5py.File, path: str) -> None:
        found = {name: file[name] for name in file}
        if not all(isinstance(each, h5py.Dataset) and not name.startswith(_RENAMED) for name, each in found.items()):
            raise _UnusualError
        scales = {name: each for name, each in found.items() if h5py.h5ds.is_scale(each.id)}
        dims = {int(_numbers(each, "_Netcdf4Dimid", ())): name for name, each in scales.items()}
        self._attributes = _attributes(file, _OF_FILE)
        self._variables = {
            name: self._variable(name, each, dims, path)
            for name, each in found.items()
            if name not in scales or not bytes(each.attrs.get("NAME", b"")).startswith(_NO_VALUES)
        }

    def _variable(self, name: str, variable: h5py.Dataset, known: Mapping[int, str], path: str) -> xr.Variable:
        array = _Array(self._files, name, variable)
        text = h5py.check_string_dtype(array.dtype)
        if text.length is not None if text else array.dtype.kind not in "fiu" or not array.dtype.isnative:
            raise _UnusualError
        if not array.shape:
            dims: tuple[str, ...] = ()
        else:
            try:
                dims = tuple(known[k] for k in _numbers(variable, "_Netcdf4Coordinates", (len(array.shape),)).tolist())
            except KeyError:
                raise _UnusualError from None
        chunks = variable.chunks
        encoding: dict[str, Any] = {"dtype": str if text else array.dtype, "contiguous": not chunks}
        encoding["chunksizes"] = chunks or None
        if chunks:
            encoding["preferred_chunks"] = dict(zip(dims, chunks, strict=True))
        encoding |= dict.fromkeys(("zlib", "szip", "bzip2", "blosc", "zstd", "shuffle", "fletcher32"), False)
        if chunks:
            encoding |= {"shuffle": variable.shuffle, "fletcher32": variable.fletcher32}
            if variable.compression == "gzip":
                encoding |= {"zlib": True, "complevel": variable.compression_opts}
            elif variable.compression is not None:
                raise _UnusualError
        encoding |= {"source": path, "original_shape": array.shape}
        return xr.Variable(dims, indexing.LazilyIndexedArray(array), _attributes(variable, _HIDDEN), encoding)

    def get_variables(self) -> dict[str, xr.Variable]:  # type: ignore[override, unused-ignore]
        return self._variables

    def get_attrs(self) -> dict[str, Any]:  # type: ignore[override, unused-ignore]
        return self._attributes

    def close(self) -> None:
        self._files.close()  # type: ignore[no-untyped-call, unused-ignore]


def _numbers(variable: h5py.Dataset, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return an attribute of whole numbers."""
    if not h5py.h5a.exists(variable.id, name.encode()):
        raise _UnusualError
    attribute = h5py.h5a.open(variable.id, name.encode())
    if attribute.shape != shape:
        raise _UnusualError
    found = np.empty(shape, np.int32)
    attribute.read(found)
    return found


def _attributes(owner: h5py.Dataset | h5py.File, hidden: set[str]) -> dict[str, Any]:
    """Return the attributes as h5netcdf does: an array with one value is this value."""
    found = {}
    for name in owner.attrs:
        if name in hidden:
            continue
        value = owner.attrs[name]
        if isinstance(value, np.ndarray) and value.dtype.kind == "O":
            value = value.tolist()
        if isinstance(value, (bytes, h5py.Empty)) or (isinstance(value, np.ndarray) and value.dtype.kind == "S"):
            raise _UnusualError
        found[name] = value[0] if isinstance(value, (list, np.ndarray)) and len(value) == 1 else value
    return found


def _store(path: Path) -> AbstractDataStore:
    try:
        return _Store(path)
    except _UnusualError:
        return H5NetCDFStore(CachingFileManager(File, str(path), mode="r", kwargs={"decode_vlen_strings": True}))


def open_netcdf(path: Path) -> xr.Dataset:
    """Open a NetCDF-4 file; its values are read when they are used, and times are numbers."""
    store = _store(path)
    ds = xr.open_dataset(
        store, engine="store", decode_times=False, decode_timedelta=False, create_default_indexes=False
    )
    ds.encoding["source"] = str(path)
    return ds


def compose_netcdf(ds: xr.Dataset, encoding: Mapping[Any, dict[str, Any]]) -> bytes:
    """Return the bytes of a NetCDF-4 file."""
    composed = io.BytesIO()  # kept here: Python 3.13 refuses to close a buffer whose content is in use
    store = H5NetCDFStore(File(composed, "w"), mode="w")
    try:
        ds.dump_to_store(store, encoding=encoding)
    finally:
        store.close()  # type: ignore[no-untyped-call, unused-ignore]
    return composed.getvalue()
