"""NetCDF-4 files: those of `errormotion` are read and written by h5py, all others by h5netcdf.

h5netcdf looks up a variable by its path for each of its properties, 35 to 40 times for each variable that is read or
written. For the small variables of an error dataset this takes most of the time. Files are therefore read and written
without h5netcdf where all dimensions, values and attributes have the form that h5netcdf gives them: numbers of this
computer, or texts of free length. Written files have the content and the order of those that h5netcdf writes.
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
"""Before the name of a variable that a dimension has as well, of which it is not the coordinate."""
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
        variables = {name: file[name] for name in file}
        if not all(isinstance(each, h5py.Dataset) for each in variables.values()):
            raise _UnusualError
        scales = {name: each for name, each in variables.items() if h5py.h5ds.is_scale(each.id)}
        dims = {int(_numbers(each, "_Netcdf4Dimid", ())): name for name, each in scales.items()}
        self._attributes = _attributes(file, _OF_FILE)
        self._variables = {
            name.removeprefix(_RENAMED): self._variable(name, each, dims, path)
            for name, each in variables.items()
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
    numbers = np.empty(shape, np.int32)
    attribute.read(numbers)
    return numbers


def _attributes(owner: h5py.Dataset | h5py.File, hidden: set[str]) -> dict[str, Any]:
    """Return the attributes as h5netcdf does: an array with one value is this value."""
    attributes = {}
    for name in owner.attrs:
        if name in hidden:
            continue
        value = owner.attrs[name]
        if isinstance(value, np.ndarray) and value.dtype.kind == "O":
            value = value.tolist()
        if isinstance(value, (bytes, h5py.Empty)) or (isinstance(value, np.ndarray) and value.dtype.kind == "S"):
            raise _UnusualError
        attributes[name] = value[0] if isinstance(value, (list, np.ndarray)) and len(value) == 1 else value
    return attributes


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


class _Composed(H5NetCDFStore):
    """A file of h5py that xarray writes, with the form that h5netcdf gives it: the links to dimensions come last.

    Raises
    ------
    _UnusualError
        The dataset has something that only h5netcdf writes.
    """

    def __init__(self, file: h5py.File) -> None:
        self._file, self.format = file, "NETCDF4"
        self._numbers: dict[Any, int] = {}
        self._scales: dict[Any, h5py.Dataset] = {}
        self._written: dict[Any, tuple[h5py.Dataset, tuple[Any, ...]]] = {}

    def set_attribute(self, key: str, value: Any) -> None:
        _set_attribute(self._file, key, value)

    def set_dimensions(self, variables: Mapping[Any, xr.Variable], unlimited_dims: Any = None) -> None:  # noqa: ARG002
        sizes = {dim: size for variable in variables.values() for dim, size in variable.sizes.items()}
        self._numbers = {dim: number for number, dim in enumerate(sizes)}
        for dim, size in sizes.items():
            named = variables[dim].dims if dim in variables else ()
            if not isinstance(dim, str) or "/" in dim or size == 0 or (named[:1] == (dim,) and len(named) > 1):
                raise _UnusualError
            if named != (dim,):
                self._scales[dim] = scale = self._file.create_dataset(dim, (size,), ">f4", track_order=True)
                scale.attrs.create("_Netcdf4Dimid", self._numbers[dim], dtype=np.int32)
                h5py.h5ds.set_scale(scale.id, _NO_VALUES + f".{size:10}".encode())

    def prepare_variable(self, name: str, variable: xr.Variable, *_: Any, **__: Any) -> tuple[Any, Any]:
        options = {_OPTIONS.get(key, key): value for key, value in variable.encoding.items()}
        if options.pop("zlib", False):
            options["compression"] = "gzip"
        text = (variable.dtype.metadata or {}).get("element_type") is str
        if set(variable.encoding) - _KNOWN or "/" in name or not (text or _is_number(variable.dtype)):
            raise _UnusualError
        attributes = dict(variable.attrs)
        fill = attributes.pop("_FillValue", None)
        if not (fill is None or text):
            try:
                fill = variable.dtype.type(fill)
            except (OverflowError, TypeError, ValueError):
                raise _UnusualError from None
        name = _RENAMED + name if name in self._scales else name
        written = self._file.create_dataset(
            name,
            variable.shape,
            h5py.string_dtype() if text else variable.dtype,
            fillvalue=fill,
            track_order=True,
            **(options if variable.shape else {}),
        )
        if fill is not None:
            _set_attribute(written, "_FillValue", fill)
        for key, value in attributes.items():
            _set_attribute(written, key, value)
        self._written[name] = written, variable.dims
        return written, variable.data

    def link(self) -> None:
        """Link all variables to their dimensions, and state the programs that wrote the file."""
        for name, (written, _) in self._written.items():
            if name in self._numbers:
                self._scales[name] = written
                h5py.h5ds.set_scale(written.id, str(name).encode())
        for name, (written, dims) in self._written.items():
            numbers = [self._numbers[dim] for dim in dims]
            if numbers:
                written.attrs.create("_Netcdf4Dimid", numbers[0], dtype=np.int32)
                written.attrs.create("_Netcdf4Coordinates", numbers, dtype=np.int32)
            for axis, dim in enumerate(dims if name not in self._numbers else ()):
                h5py.h5ds.attach_scale(written.id, self._scales[dim].id, axis)
        programs = f"version=2,h5netcdf={h5netcdf.__version__},hdf5={h5py.version.hdf5_version},h5py={h5py.__version__}"
        self._file.attrs["_NCProperties"] = np.array(programs, h5py.string_dtype("ascii", len(programs)))


_OPTIONS = {"complevel": "compression_opts", "chunksizes": "chunks"}
"""Encodings of xarray with another name in h5py."""
_KNOWN = {*_OPTIONS, "zlib", "shuffle"}


def _is_number(dtype: np.dtype[Any]) -> bool:
    """Whether a type of numbers is one of NetCDF, in the byte order of this computer."""
    return dtype.isnative and (dtype.kind in "iu" or dtype in (np.float32, np.float64))


def _set_attribute(owner: h5py.File | h5py.Dataset, key: str, value: Any) -> None:
    """Write an attribute; a single number is an array with one value."""
    dtype = np.asarray(value).dtype
    if key in _HIDDEN or key in _OF_FILE or not (dtype.kind == "U" or _is_number(dtype)):
        raise _UnusualError
    owner.attrs[key] = np.atleast_1d(value) if np.isscalar(value) and dtype.kind != "U" else value


def compose_netcdf(ds: xr.Dataset, encoding: Mapping[Any, dict[str, Any]]) -> bytes:
    """Return the bytes of a NetCDF-4 file."""
    ds = ds.compute()  # arrays of dask would be omitted
    composed = io.BytesIO()  # kept here: Python 3.13 refuses to close a buffer whose content is in use
    try:
        with h5py.File(composed, "w", track_order=True) as file:
            direct = _Composed(file)
            ds.dump_to_store(direct, encoding=encoding)
            direct.link()
        return composed.getvalue()
    except _UnusualError:
        composed = io.BytesIO()
    store = H5NetCDFStore(File(composed, "w"), mode="w")
    try:
        ds.dump_to_store(store, encoding=encoding)
    finally:
        store.close()  # type: ignore[no-untyped-call, unused-ignore]
    return composed.getvalue()
