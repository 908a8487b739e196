"""Datasets on disk: NetCDF-4 files and Zarr v3 folders, written atomically."""

from __future__ import annotations

import json
import math
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.indexes import RangeIndex

from errormotion.datasets.checks import storable_violations
from errormotion.datasets.files.containers import MUCH, check_classic, check_netcdf, check_zarr
from errormotion.datasets.files.hdf5 import WIDTH
from errormotion.datasets.files.reading import require_regular
from errormotion.datasets.files.writing import reason, replace_bytes, whole_folder, writing
from errormotion.datasets.groups import with_present_groups
from errormotion.datasets.schemas import SCHEMA
from errormotion.datasets.storage.compression import as_stored, encoding
from errormotion.datasets.storage.netcdf import compose_netcdf, open_netcdf
from errormotion.datasets.storage.zarr_folder import open_zarr
from errormotion.errors import DatasetError, ErrormotionError

_NETCDF = (".nc", ".nc4", ".h5")
_NUMERICAL = ("/numpy/", "/scipy/")
_READERS = ("/zarr/", "/numcodecs/", "/h5py/", "/h5netcdf/")
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_CLASSIC_SIGNATURES = (b"CDF\1", b"CDF\2")  # with 64-bit counts, CDF-5, scipy reads others than stated

# Longer time coordinates get no index, which would load them into memory.
_MAX_INDEX = 100_000


def load(path: str | Path) -> xr.Dataset:
    """Open a dataset.

    An error dataset is read into memory, and its groups of sources get their present names. Values of a raw dataset
    are read when they are used; a long ``time`` has no index, and evenly spaced times are not stored: they follow
    from the attributes ``sample_rate`` (Hz) and ``time_start`` (s, 0 if missing).

    Parameters
    ----------
    path : str or Path
        NetCDF-4 file, Zarr folder, or ``.csv`` file for `errormotion.datasets.text.readings_csv`.

    Returns
    -------
    Dataset

    Raises
    ------
    DatasetError
        The file does not exist, cannot be read, is not a dataset, or is truncated.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        from errormotion.datasets.text.readings_csv import read_csv

        return read_csv(path)
    engine = _engine_of(path)
    with _reading(path):
        if engine == "h5netcdf":
            check_netcdf(path)
            ds = open_netcdf(path)
        elif engine == "zarr":
            check_zarr(path)
            known = open_zarr(path)
            ds = _opened(path, engine, consolidated=_is_consolidated(path)) if known is None else known
        else:
            check_classic(path)
            ds = _opened(path, engine)
        ds = _tidy(ds)
        if ds.attrs.get("schema") == SCHEMA:
            with ds:
                ds = with_present_groups(ds.load())
        return _with_indexes(ds)


def save(ds: xr.Dataset, path: str | Path, *, overwrite: bool = False) -> Path:
    """Write a dataset to a temporary file, flush it to the disk and rename it.

    Large influences of an error dataset are rounded, see `errormotion.datasets.storage.compression.as_stored`. A NetCDF
    file is composed in memory, a Zarr folder one variable at a time (in pieces for dask arrays).
    Evenly spaced times that the attributes ``sample_rate`` and ``time_start`` state are omitted.

    Parameters
    ----------
    ds : Dataset
    path : str or Path
        ``.nc`` for a NetCDF-4 file, ``.zarr`` for a Zarr v3 folder.
    overwrite : bool
        Replace an existing file or folder.

    Returns
    -------
    Path

    Raises
    ------
    DatasetError
        The path exists, the suffix is unknown, an attribute cannot be stored, or the file cannot be written (no
        partial file remains).
    """
    path = Path(path)
    if path.suffix not in (*_NETCDF, ".zarr"):
        raise DatasetError(
            f"{path}: expected a name that ends in .nc (NetCDF-4 file) or .zarr (Zarr folder)", code="file.name.ending"
        )
    _refuse_existing(path, overwrite)
    unstorable = storable_violations(ds)
    if unstorable:
        raise DatasetError(f"{path}: cannot be written:", unstorable, code="file.content.unstorable")
    with writing(path):
        if path.suffix == ".zarr":
            from errormotion.datasets.storage.folder_store import FolderStore  # loads zarr

            with whole_folder(path) as part:
                storable(ds).to_zarr(FolderStore(part), mode="w-", zarr_format=3, consolidated=False)
                _refuse_existing(path, overwrite)
        else:
            # Composed in memory, since HDF5 crashes the process if the disk is full while a file is open.
            ready = storable(ds)
            content = compose_netcdf(ready, encoding(ready))
            _refuse_existing(path, overwrite)
            replace_bytes(path, content)
    return path


def storable(ds: xr.Dataset) -> xr.Dataset:
    """Return a dataset in the form for the disk: texts of free length, no former encoding, no derivable times."""
    index = ds.xindexes.get("time")
    if isinstance(index, RangeIndex) and math.isclose(index.step * ds.attrs.get("sample_rate", 0.0), 1.0):
        ds = ds.drop_vars("time").assign_attrs(time_start=float(index.start))
    ds = as_stored(ds).drop_encoding()
    # Zarr v3 has no type for texts of fixed width; objects are stored as texts of free length.
    texts = {name: variable.astype(object) for name, variable in ds.variables.items() if variable.dtype.kind in "UT"}
    return (
        ds.drop_indexes([name for name in texts if name in ds.xindexes])
        .assign(texts)
        .set_coords([name for name in texts if name in ds.coords])
    )


def _engine_of(path: Path) -> str:
    """Return the xarray engine for a path; DatasetError states what it is instead of a dataset."""
    if path.is_dir():
        if (path / "zarr.json").exists() or (path / ".zgroup").exists():
            return "zarr"
        inside = sorted(item.name for item in path.iterdir() if item.suffix in (".zarr", ".nc"))
        hint = f" Did you mean {path / inside[0]}?" if inside else ""
        raise DatasetError(f"{path}: is a folder without zarr.json, not a dataset.{hint}", code="zarr.folder.other")
    try:
        require_regular(path)
        with path.open("rb") as file:
            head = file.read(8)
    except OSError as error:
        raise DatasetError(
            f"{path}: cannot be read: {reason(error, 'there is no such file')}", code="file.unreadable"
        ) from error
    if head == _HDF5_SIGNATURE:
        return "h5netcdf"
    if not head:
        raise DatasetError(
            f"{path}: is empty; expected a NetCDF-4 file. Writing was interrupted: create it again", code="file.empty"
        )
    if head.startswith(_CLASSIC_SIGNATURES):
        return "scipy"
    if _HDF5_SIGNATURE.startswith(head):
        raise DatasetError(f"{path}: is truncated; create it again or copy it again", code="file.truncated")
    raise DatasetError(
        f"{path}: is not a dataset; expected a NetCDF file, a Zarr folder or a .csv file of readings. For a text log "
        "use 'errormotion import'",
        code="file.kind.unknown",
    )


def _opened(path: Path, engine: str, **options: bool) -> xr.Dataset:
    """Open a file or folder by an engine of xarray; times are numbers."""
    return xr.open_dataset(
        path,
        engine=engine,
        backend_kwargs=options,
        decode_times=False,
        decode_timedelta=False,
        create_default_indexes=False,
    )


def _is_consolidated(folder: Path) -> bool:
    """Return whether the root of a Zarr folder contains the metadata of its arrays, which then take precedence."""
    root = json.loads((folder / "zarr.json").read_text(encoding="utf-8"))
    return bool(root.get("consolidated_metadata"))


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except DatasetError as error:
        if not str(error).startswith(str(path)):
            error.args = (f"{path}: {error}",)
        raise
    except PermissionError as error:
        raise DatasetError(f"{path}: cannot be read: permission denied", code="file.no_permission") from error
    except MemoryError as error:
        raise DatasetError(f"{path}: needs more memory than this computer has", code="file.memory") from error
    except Exception as error:
        # Errors of h5py, zarr and xarray for truncated files and other formats.
        what = "is truncated" if "truncated" in str(error) else "is damaged, or not a dataset of errormotion"
        raise DatasetError(
            f"{path}: {what}; create it again or copy it again. (Reader: {error})", code="file.damaged"
        ) from error


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Name the file in errors of the project, and convert errors of reading damaged values to such an error."""
    try:
        yield
    except ErrormotionError as error:
        if str(path) not in str(error):
            error.args = (f"{path}: {error}",)
        raise
    except MemoryError as error:
        raise DatasetError(f"{path}: needs more memory than this computer has", code="file.memory") from error
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise DatasetError(
            f"{path}: its values cannot be evaluated ({type(error).__name__}: {error})", code="file.values.unreadable"
        ) from error
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        if isinstance(error, ValueError) and any(part in frames[-1].filename for part in _NUMERICAL):
            raise DatasetError(
                f"{path}: its values cannot be evaluated ({error})", code="file.values.unreadable"
            ) from error
        if not any(part in frame.filename for frame in frames for part in _READERS):
            raise
        raise DatasetError(
            f"{path}: is damaged or incomplete; copy it again, or measure again. (Reader: {error})", code="file.damaged"
        ) from error


def _refuse_existing(path: Path, overwrite: bool) -> None:
    if not overwrite and (path.exists() or path.is_symlink()):
        raise DatasetError(f"{path}: already exists; choose another name, or allow overwriting", code="file.exists")


def _tidy(ds: xr.Dataset) -> xr.Dataset:
    """Return a dataset with types that do not depend on the file format: plain texts, numbers and arrays."""
    texts = {name: variable for name, variable in ds.variables.items() if variable.dtype.kind in "OST"}
    if texts:
        coords = [name for name in texts if name in ds.coords]
        ds = ds.assign({name: _text(variable) for name, variable in texts.items()}).set_coords(coords)
        ds = ds.drop_indexes([name for name in coords if name in ds.xindexes])
    ds.attrs = _tidy_attrs(ds.attrs)
    for name in ("notes", "doubts_uncertainty"):
        if isinstance(stated := ds.attrs.get(name), str):  # a list of one sentence is read as a text
            ds.attrs[name] = [stated]
    for variable in ds.variables.values():
        variable.attrs = _tidy_attrs(variable.attrs)
    return ds


def _text(variable: xr.Variable) -> xr.Variable:
    values = [item.decode() if isinstance(item, bytes) else str(item) for item in variable.values.ravel().tolist()]
    needed = WIDTH * len(values) * max(map(len, values), default=0)  # every text has the width of the longest one
    if needed > MUCH:
        raise DatasetError(
            f"its texts need {needed} bytes, since all have the width of the longest; at most {MUCH}",
            code="file.texts.too_long",
        )
    array = np.array(values, dtype=str).reshape(variable.shape)
    return xr.Variable(variable.dims, array, variable.attrs)


def _tidy_attrs(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(name): _tidy_value(value) for name, value in attrs.items()}


def _tidy_value(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in "OSUT":
        return [str(item) for item in value.tolist()]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list) and value and all(isinstance(item, (int, float)) for item in value):
        return np.array(value)
    return value


def _with_indexes(ds: xr.Dataset) -> xr.Dataset:
    for dim, size in ds.sizes.items():
        if dim in ds.coords and ds.coords[dim].dims == (dim,) and (dim != "time" or size <= _MAX_INDEX):
            ds = ds.set_xindex(str(dim))
    rate = ds.attrs.get("sample_rate")
    if "time" in ds.sizes and "time" not in ds.variables and isinstance(rate, (int, float)) and rate > 0:
        start, size = float(ds.attrs.get("time_start", 0.0)), ds.sizes["time"]
        if not math.isfinite(start + size / rate) or not 1 / rate > 0:
            raise DatasetError(
                f"sample_rate, time_start: expected finite times; found {rate:g} Hz, {start:g} s",
                code="raw.time.not_finite",
            )
        # Half a step before the end, so that the number of times does not depend on rounding; the step is 1 / rate.
        index = RangeIndex.arange(start, start + (size - 0.5) / rate, 1 / rate, dim="time")
        ds = ds.assign_coords(xr.Coordinates.from_xindex(index))
        ds["time"].attrs["units"] = "s"
    return ds
