"""NetCDF-4 files by h5netcdf, with each object of the file looked up once.

h5netcdf looks up a variable by its path for each of its properties, 35 to 40 times for each variable that is read or
written. For the small variables of an error dataset this takes most of the time.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5netcdf
import xarray as xr
from xarray.backends import CachingFileManager, H5NetCDFStore

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


def open_netcdf(path: Path) -> xr.Dataset:
    """Open a NetCDF-4 file; its values are read when they are used, and times are numbers."""
    store = H5NetCDFStore(CachingFileManager(File, str(path), mode="r", kwargs={"decode_vlen_strings": True}))
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
