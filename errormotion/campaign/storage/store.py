"""The raw store: a Zarr v3 folder that grows during a measurement and is complete at any time.

Samples are written in blocks along one dimension. The order of writing keeps the folder consistent if the process is
killed at any time:

1. the chunks of a block are written, each to a temporary file that is renamed;
2. then the root ``zarr.json`` is replaced by a rename. It contains the (consolidated) metadata of all arrays, which
   therefore get their new length simultaneously: a reader of the store sees complete samples only.

Chunks written before a crash between 1 and 2 are invisible; the next opening of the store overwrites them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import xarray as xr
import zarr
from xarray.conventions import encode_cf_variable
from zarr.codecs import BloscCodec

from errormotion.campaign.folder import Presence, replace_text
from errormotion.datasets.files.containers import MAX_METADATA
from errormotion.datasets.files.reading import parse_json, read_bytes
from errormotion.datasets.files.writing import sync
from errormotion.errors import RunError

BLOCK_BYTES = 24 * 2**20
"""Largest size of one block of all appended variables in memory, bytes."""

MAX_BLOCK_LENGTH = 2**18
"""Largest number of samples in one block."""

BEFORE_COMMIT = {"zarr_format", "node_type", "attributes"}
"""Keys of the metadata of a store before its first commit."""

MAX_SAMPLES = 2**53
"""A length from this on is invalid."""

PER_CHUNK = ("dropped", "invalid", "time_start")
"""Attributes that differ between the datasets that a method yields."""


class RawStore:
    """A raw store, to which datasets are appended along one dimension.

    Parameters
    ----------
    path : Path
        The ``.zarr`` folder.
    dim : str
        The dimension that grows.

    Attributes
    ----------
    count : int
        Samples appended, including those not yet committed.
    committed : int
        Samples visible to a reader of the folder.
    """

    def __init__(self, path: Path, dim: str) -> None:
        self.path = path
        self.dim = dim
        self._group = zarr.open_group(str(path), mode="r+", use_consolidated=False)
        self._root = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
        self._static: dict[str, dict[str, Any]] = {}
        self._arrays: dict[str, _Column] = {}
        for name, array in sorted(self._group.arrays()):
            metadata = json.loads((path / name / "zarr.json").read_text(encoding="utf-8"))
            if dim in _dims(metadata):
                self._arrays[name] = _Column(path / name, array, metadata, dim)
            else:
                self._static[name] = metadata
        if not self._arrays:
            raise RunError(f"{path}: expected at least one variable along '{dim}'; found none")
        self.block = next(iter(self._arrays.values())).block
        self.count = self.committed = committed_length(path, dim)
        for column in self._arrays.values():
            column.load(self.count)
        self._unsynced: set[Path] = set()
        self._presence = Presence(path)

    @classmethod
    def create(cls, path: Path, first: xr.Dataset, dim: str, expected: float = np.inf) -> Self:
        """Create a store for datasets like this one, without samples.

        Parameters
        ----------
        path : Path
            The folder to create; it must not exist.
        first : Dataset
            The first dataset to append. Variables without the dimension ``dim`` are stored once, here. A variable whose
            ``encoding`` has ``dtype`` (an integer), ``scale_factor``, ``add_offset`` and ``_FillValue`` is packed
            accordingly if this is lossless.
        dim : str
            The dimension that grows.
        expected : float
            Expected total length, from which the chunk size follows; in seconds if the samples have a ``sample_rate``.
        """
        if not path.parent.is_dir():  # otherwise zarr would create it
            raise RunError(f"{path.parent} is gone: it was moved or deleted before data were written to it")
        if dim not in first.dims:
            raise RunError(f"expected data along '{dim}'; the method yielded dims {', '.join(map(str, first.dims))}")
        growing = {str(name): variable for name, variable in _stored(first, dim).items() if dim in variable.dims}
        packings = {name: _packing(variable) for name, variable in growing.items()}
        length = expected * float(first.attrs.get("sample_rate", 1.0))
        block = _block_length(growing, packings, dim, length)
        skeleton = first.isel({dim: slice(0, 0)}).drop_vars(
            [n for n in first.variables if n not in _stored(first, dim)]
        )
        skeleton = skeleton.drop_attrs(deep=False).assign_attrs(_plain(first.attrs))
        encoding: dict[str, dict[str, Any]] = {}
        # Every version of xarray stores objects as texts of variable length; an empty array of objects has no type.
        texts = {
            name: variable.astype(object if variable.size else np.dtypes.StringDType())
            for name, variable in skeleton.variables.items()
            if variable.dtype.kind == "U"
        }
        coordinates = [name for name in texts if name in skeleton.coords]
        skeleton = skeleton.drop_indexes([name for name in coordinates if name in skeleton.xindexes])
        skeleton = skeleton.assign(texts).set_coords(coordinates).drop_encoding()
        for name, variable in growing.items():
            chunks = tuple(block if d == dim else max(n, 1) for d, n in variable.sizes.items())
            encoding[name] = {"chunks": chunks} | packings[name]
            if variable.dtype.kind in "fiub":
                encoding[name]["compressors"] = [_codec(np.dtype(packings[name].get("dtype", variable.dtype)))]
            if variable.dtype.kind == "f":
                encoding[name] |= {"fill_value": packings[name].get("_FillValue", np.nan)}
        part = path.with_name(path.name + ".part")
        # xarray's stub lacks zarr_format=3 with encodings per variable
        cast(Any, skeleton).to_zarr(part, mode="w", zarr_format=3, consolidated=False, encoding=encoding)
        for each in (*part.rglob("*"), part):  # otherwise a power failure would leave empty files
            _sync(each)
        part.rename(path)
        _sync(path.parent)
        store = cls(path, dim)
        store.commit()
        return store

    def append(self, chunk: xr.Dataset) -> None:
        """Append samples; complete blocks are written, the remainder with :meth:`commit`.

        Raises
        ------
        RunError
            The dataset does not continue the store, has other variables, or the folder was moved or deleted.
        OSError
            The data cannot be written.
        """
        if self.dim not in chunk.dims:
            raise RunError(f"expected data along '{self.dim}'; the method yielded {dict(chunk.sizes)}")
        length = chunk.sizes[self.dim]
        self._check_continues(chunk)
        values = {name: self._encoded(name, variable) for name, variable in _stored(chunk, self.dim).items()
                  if self.dim in variable.dims}  # fmt: skip
        if set(values) != set(self._arrays):
            raise RunError(
                f"{self.path}: expected the variables {', '.join(sorted(self._arrays))} along '{self.dim}'; "
                f"the method yielded {', '.join(sorted(values))}"
            )
        taken = 0
        while taken < length:
            fill = self.count % self.block
            take = min(self.block - fill, length - taken)
            for name, column in self._arrays.items():
                column.put(fill, values[name], taken, take)
            self.count += take
            taken += take
            if self.count % self.block == 0:
                self._write_block()
        self._add_counts(chunk.attrs)

    def commit(self) -> None:
        """Write every sample to disk, then make all visible to readers.

        Raises
        ------
        FolderGoneError
            The folder was moved or deleted; nothing is written to its former path.
        OSError
            The data cannot be written.
        """
        with self._presence.held():
            self._commit()

    def _commit(self) -> None:
        if self.count % self.block:
            self._write_block()
        for path in self._unsynced:
            _sync(path)
        self._unsynced.clear()
        root = dict(self._root)
        root["consolidated_metadata"] = {
            "kind": "inline",
            "must_understand": False,
            "metadata": self._static | {name: column.metadata(self.count) for name, column in self._arrays.items()},
        }
        replace_text(self.path / "zarr.json", json.dumps(root))  # indented, it would take ten times as long
        self.committed = self.count

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes of the dataset; written with the next :meth:`commit`."""
        return cast(dict[str, Any], self._root["attributes"])

    def _write_block(self) -> None:
        """Write the current block of every array."""
        self._presence.check()
        start = (self.count - 1) // self.block * self.block
        for column in self._arrays.values():
            self._unsynced.add(column.write(start, self.count))

    def _encoded(self, name: str, variable: xr.Variable) -> np.ndarray:
        if name not in self._arrays:
            raise RunError(
                f"{self.path}: the method yielded the variable '{name}', which is missing in its first dataset"
            )
        column = self._arrays[name]
        expected = {d: n for d, n in zip(column.dims, column.shape, strict=True) if d != self.dim}
        found = {str(d): n for d, n in variable.sizes.items() if d != self.dim}
        if found != expected:
            raise RunError(f"{self.path}: '{name}' has the sizes {found}; expected {expected}")
        packed = _encode(variable.transpose(*column.dims), column.packing)
        if packed is None:
            raise RunError(
                f"{self.path}: expected '{name}' in integer steps of {column.packing['scale_factor']!r}, as the "
                "encoding states; found other values. Correct the encoding in the instrument or method, or omit it."
            )
        return packed

    def _check_continues(self, chunk: xr.Dataset) -> None:
        rate, start = chunk.attrs.get("sample_rate"), chunk.attrs.get("time_start")
        origin = self.attrs.get("time_start", 0.0)
        if self.dim != "time" or rate is None or start is None:
            return
        expected = origin + self.count / rate
        if self.count and abs(start - expected) * rate > 0.5:
            raise RunError(
                f"{self.path}: expected the next samples at {expected:.6f} s; the method yielded samples from "
                f"{start:.6f} s. The method must fill gaps with NaN."
            )

    def _add_counts(self, attrs: Mapping[Any, Any]) -> None:
        """Add the counts of dropped and invalid samples, by reason."""
        self.attrs["dropped"] = int(self.attrs.get("dropped", 0)) + int(attrs.get("dropped", 0))
        total: dict[str, int] = _counts(self.attrs.get("invalid"))
        for reason, count in _counts(attrs.get("invalid")).items():
            total[reason] = total.get(reason, 0) + count
        self.attrs["invalid"] = json.dumps(total)


class _Column:
    """One array along the growing dimension, with its current block in memory."""

    def __init__(self, path: Path, array: Any, metadata: dict[str, Any], dim: str) -> None:
        self.path = path
        self.array = array
        self.dims = _dims(metadata)
        self.axis = self.dims.index(dim)
        self.block = int(array.chunks[self.axis])
        self.packing = {
            key: metadata["attributes"][key] for key in ("scale_factor", "add_offset") if key in metadata["attributes"]
        }
        if self.packing:
            self.packing |= {"dtype": array.dtype.name, "_FillValue": metadata["fill_value"]}
        self._metadata = metadata
        shape = list(array.shape)
        shape[self.axis] = self.block
        self._values = np.empty(shape, dtype=array.dtype)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.array.shape)

    def _at(self, start: int, stop: int) -> tuple[slice, ...]:
        return tuple(slice(start, stop) if axis == self.axis else slice(None) for axis in range(len(self.dims)))

    def load(self, count: int) -> None:
        """Read the last, incomplete block, and discard data beyond it."""
        self._resize(count)
        start = count // self.block * self.block
        if count > start:
            self._values[self._at(0, count - start)] = self.array[self._at(start, count)]

    def put(self, fill: int, values: np.ndarray, first: int, length: int) -> None:
        self._values[self._at(fill, fill + length)] = values[self._at(first, first + length)]

    def write(self, start: int, stop: int) -> Path:
        """Write one block; return the file of its chunk."""
        self._resize(stop)
        self.array[self._at(start, stop)] = self._values[self._at(0, stop - start)]
        index = tuple(start // self.block if axis == self.axis else 0 for axis in range(len(self.dims)))
        return self.path / str(self.array.metadata.encode_chunk_key(index))

    def _resize(self, length: int) -> None:
        if self.array.shape[self.axis] != length:
            shape = list(self.array.shape)
            shape[self.axis] = length
            self.array.resize(tuple(shape))

    def metadata(self, count: int) -> dict[str, Any]:
        shape = list(self._metadata["shape"])
        shape[self.axis] = count
        return self._metadata | {"shape": shape}


def committed_length(path: Path, dim: str) -> int:
    """Return the number of samples visible to a reader of a store; 0 before the first commit.

    Raises
    ------
    RunError
        The metadata of the store cannot be read, or are damaged.
    """
    file = path / "zarr.json"
    try:
        root = parse_json(read_bytes(file, MAX_METADATA))
        if set(root) <= BEFORE_COMMIT and root["zarr_format"] == 3:
            return 0
        for metadata in root["consolidated_metadata"]["metadata"].values():
            if dim in _dims(metadata):
                length = metadata["shape"][_dims(metadata).index(dim)]
                if isinstance(length, int) and 0 <= length < MAX_SAMPLES:
                    return length
        raise ValueError(f"no variable has a length along '{dim}'")
    except OSError as error:
        raise RunError(f"{file}: cannot be read: {error.strerror}") from error
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise RunError(f"{file}: is damaged; restore it from a copy ({error})") from error


def _dims(metadata: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(metadata.get("dimension_names") or ())  # a scalar has no dimensions


def _sync(path: Path) -> None:
    if path.exists():  # a chunk that is entirely NaN has no file
        sync(path)


def _stored(dataset: xr.Dataset, dim: str) -> dict[str, xr.Variable]:
    """Return the stored variables: all but the times of evenly spaced samples, which follow from rate and start."""
    regular = dim == "time" and "sample_rate" in dataset.attrs
    return {str(n): v for n, v in dataset.variables.items() if not (regular and n == "time")}


def _plain(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    """Return attributes as JSON values, without those of one chunk; ``time_start`` is kept as that of the store."""
    kept = {str(k): v for k, v in attrs.items() if k not in PER_CHUNK or k == "time_start"}
    return {k: v.tolist() if isinstance(v, np.generic | np.ndarray) else v for k, v in kept.items()}


def _counts(value: Any) -> dict[str, int]:
    if not value:
        return {}
    return {str(k): int(v) for k, v in (json.loads(value) if isinstance(value, str) else value).items()}


def _packing(variable: xr.Variable) -> dict[str, Any]:
    """Return the integer packing that a variable's encoding states, if it is lossless; else an empty one."""
    keys = ("dtype", "scale_factor", "add_offset", "_FillValue")
    wanted = variable.encoding
    if variable.dtype.kind != "f" or any(key not in wanted for key in keys):
        return {}
    dtype = np.dtype(wanted["dtype"])
    packing = {
        "dtype": dtype.name,
        "scale_factor": float(wanted["scale_factor"]),
        "add_offset": float(wanted["add_offset"]),
        "_FillValue": int(wanted["_FillValue"]),
    }
    return packing if dtype.kind in "iu" and _encode(variable, packing) is not None else {}


def _encode(variable: xr.Variable, packing: Mapping[str, Any]) -> np.ndarray | None:
    """Return the numbers to store; None if the packing would lose more than the rounding error."""
    values = variable.values
    if not packing:
        if values.dtype.kind == "U":
            return values.astype(object)
        if values.dtype.kind in "fiu":  # needs no encoding
            return values
        return np.asarray(encode_cf_variable(xr.Variable(variable.dims, values)).values)
    scale, offset, fill = packing["scale_factor"], packing["add_offset"], packing["_FillValue"]
    limits = np.iinfo(packing["dtype"])
    steps = values - offset
    steps /= scale
    whole = np.rint(steps)
    missing = np.isnan(steps)
    some = bool(missing.any())
    with np.errstate(invalid="ignore"):
        steps -= whole
        # 1e-6 of a step is far above the rounding of float64 (and that of 16 bit steps), far below half a step
        good = np.abs(steps, out=steps) < 1e-6
        good &= whole >= limits.min
        good &= whole <= limits.max
        good &= whole != fill
    if some:
        good |= missing
        whole[missing] = fill
    packed: np.ndarray | None = whole.astype(packing["dtype"]) if good.all() else None
    return packed


def _codec(stored: np.dtype[Any]) -> BloscCodec:
    """Return the compression of a variable as stored.

    In readings of two bytes the low byte is mostly noise and the high byte hardly changes: shuffling bytes saves 7 %
    of the size compared with shuffling bits, in the same time.
    """
    if stored.kind in "iu" and stored.itemsize == 2:
        return BloscCodec(cname="zstd", clevel=5, shuffle="shuffle")
    return BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle")


def _block_length(
    growing: Mapping[str, xr.Variable], packings: Mapping[str, Mapping[str, Any]], dim: str, expected: float
) -> int:
    """Return the samples of one block: a power of two within the size limits, not far above the expected total."""
    per_sample = 0
    for name, variable in growing.items():
        size = np.dtype(packings[name].get("dtype", variable.dtype)).itemsize
        per_sample += max(size, 1) * int(np.prod([n for d, n in variable.sizes.items() if d != dim], dtype=np.int64))
    most = min(MAX_BLOCK_LENGTH, max(BLOCK_BYTES // max(per_sample, 1), 1))
    if np.isfinite(expected) and expected >= 1:
        most = min(most, 1 << int(np.ceil(np.log2(expected))))
    return 1 << int(np.log2(max(most, 1)))
