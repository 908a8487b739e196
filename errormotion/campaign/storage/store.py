"""The raw store: a Zarr v3 folder that grows during a measurement and is complete at any time.

Samples are written in blocks along one dimension, or several that grow independently, such as samples and index pulses;
no variable has two of them. The order of writing keeps all committed samples if the process is
killed, or the power fails, at any time. A commit

1. writes the chunks with new samples. A chunk that already has committed samples is replaced by a rename, after its new
   content is on the disk; then the names in the folders are flushed, too;
2. replaces the root ``zarr.json`` in the same way. It contains the (consolidated) metadata of all arrays, which
   therefore get their new length simultaneously: a reader of the store sees complete samples only.

Chunks written before a crash between 1 and 2 are invisible; the next opening of the store overwrites them. The
``zarr.json`` of each array is a copy for readers that do not use the root: it is written when the store is closed, and
when a store is opened whose copies are damaged or old.

A commit rewrites the last, incomplete block of each array. A block is therefore short: about the samples of a second.
"""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import xarray as xr
from zarr.codecs import BloscCodec

from errormotion.campaign.folder import Presence
from errormotion.campaign.storage.column import Column, dims_of, encode, fits, is_text
from errormotion.campaign.storage.fixed import Fixed, plain_attrs, stored_variables
from errormotion.datasets.files.containers import MAX_METADATA
from errormotion.datasets.files.reading import parse_json, read_bytes
from errormotion.datasets.files.writing import is_part, replace_all, replace_text, sync, whole_folder
from errormotion.errors import RunError

BLOCK_BYTES = 24 * 2**20
"""Largest size of one block of all appended variables in memory, bytes."""

SMALL_BLOCK_BYTES = 2**18
"""Size of a block that is written in a few milliseconds, bytes; a block may have it at any rate of samples."""

MAX_BLOCK_LENGTH = 2**18
"""Largest number of samples in one block."""

BEFORE_COMMIT = {"zarr_format", "node_type", "attributes"}
"""Keys of the metadata of a store before its first commit."""

MAX_SAMPLES = 2**53
"""A length from this on is invalid."""

_KINDS = "biufU"
"""Kinds of the types that are stored: numbers, booleans and texts."""


@dataclass
class _Track:
    """The arrays along one growing dimension: how much is appended, and how much a reader of the folder sees."""

    dim: str
    arrays: dict[str, Column]
    block: int
    count: int
    committed: int

    @property
    def waiting(self) -> bool:
        """Whether the present block is not full and has samples that are not yet committed."""
        return self.count % self.block > 0 and self.count > self.committed


class RawStore:
    """A raw store, to which datasets are appended along one dimension or several.

    Parameters
    ----------
    path : Path
        The ``.zarr`` folder.
    dim : str
        The dimension that grows.
    others : sequence of str
        Further ones; a dataset may have no values along them.
    """

    def __init__(self, path: Path, dim: str, others: Sequence[str] = ()) -> None:
        self.path = path
        self.dim = dim
        dims = (dim, *others)
        self._root = parse_json(read_bytes(path / "zarr.json", MAX_METADATA))
        self._static: dict[str, dict[str, Any]] = {}
        arrays: dict[str, dict[str, Column]] = {each: {} for each in dims}
        for name, metadata in sorted(_array_metadata(path, self._root).items()):
            along = _growing(name, dims_of(metadata), dims)
            if along:
                arrays[along][name] = Column(path / name, metadata, along)
            else:
                self._static[name] = metadata
        self._tracks: list[_Track] = []
        for each, columns in arrays.items():
            if not columns:
                raise RunError(
                    f"{path}: expected at least one variable along '{each}'; found none", code="store.dim.missing"
                )
            length = committed_length(path, each)
            self._tracks.append(_Track(each, columns, next(iter(columns.values())).block, length, length))
        self._arrays = {name: column for track in self._tracks for name, column in track.arrays.items()}
        self._presence = Presence(path)
        self._unsynced: set[Path] = set()
        _remove_parts(path)
        self._write_copies()
        for track in self._tracks:
            for column in track.arrays.values():
                column.load(track.count)
        self._fixed = Fixed.read(path, self._static, dim, dims)

    @property
    def count(self) -> int:
        """Samples appended along ``dim``, including those not yet committed."""
        return self._tracks[0].count

    @property
    def committed(self) -> int:
        """Samples along ``dim`` visible to a reader of the folder."""
        return self._tracks[0].committed

    @classmethod
    def create(
        cls, path: Path, first: xr.Dataset, dim: str, expected: float = np.inf, others: Sequence[str] = ()
    ) -> Self:
        """Create a store for datasets like this one, without samples.

        Parameters
        ----------
        path : Path
            The folder to create; it must not exist.
        first : Dataset
            The first dataset to append. Variables without the dimension ``dim`` are stored once, here; all datasets to
            append must have the same. A variable whose ``encoding`` has ``dtype`` (an integer), ``scale_factor``,
            ``add_offset`` and ``_FillValue`` is packed accordingly if this is lossless.
        dim : str
            The dimension that grows.
        expected : float
            Expected total length, from which the chunk size follows; in seconds if the samples have a ``sample_rate``.
        others : sequence of str
            Further dimensions that grow.
        """
        if not path.parent.is_dir():  # otherwise zarr would create it
            raise RunError(
                f"{path.parent} is gone: it was moved or deleted before data were written to it", code="run.folder.gone"
            )
        dims = (dim, *others)
        for each in dims:
            if each not in first.dims:
                raise RunError(
                    f"expected data along '{each}'; the method yielded dims {', '.join(map(str, first.dims))}",
                    code="method.data.dim",
                )
        for name, variable in stored_variables(first, dim).items():
            if variable.dtype.kind not in _KINDS and not is_text(variable):
                raise RunError(
                    f"expected numbers or texts; '{name}' has the type {variable.dtype}", code="method.data.type"
                )
        stored = stored_variables(first, dim)
        along = {name: each for name, variable in stored.items() if (each := _growing(name, variable.dims, dims))}
        growing = {name: stored[name] for name in along}
        packings = {name: _packing(variable) for name, variable in growing.items()}
        length, rate = (
            (expected * float(first.attrs.get("sample_rate", 1.0))),
            float(first.attrs.get("sample_rate", 0.0)),
        )
        blocks = {
            each: _block_length(
                {name: growing[name] for name, its in along.items() if its == each}, packings, each, length, rate
            )
            for each in dims
        }
        skeleton = first.isel({each: slice(0, 0) for each in dims}).drop_vars(
            [n for n in first.variables if n not in stored_variables(first, dim)]
        )
        skeleton = skeleton.drop_attrs(deep=False).assign_attrs(plain_attrs(first.attrs))
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
            chunks = tuple(blocks[along[name]] if d == along[name] else max(n, 1) for d, n in variable.sizes.items())
            encoding[name] = {"chunks": chunks} | packings[name]
            if variable.dtype.kind in "fiub":
                encoding[name]["compressors"] = [_codec(np.dtype(packings[name].get("dtype", variable.dtype)))]
            if variable.dtype.kind == "f":
                encoding[name] |= {"fill_value": packings[name].get("_FillValue", np.nan)}
        with whole_folder(path) as part:
            # xarray's stub lacks zarr_format=3 with encodings per variable
            cast(Any, skeleton).to_zarr(part, mode="w", zarr_format=3, consolidated=False, encoding=encoding)
        store = cls(path, dim, others)
        store.commit()
        return store

    def append(self, chunk: xr.Dataset) -> None:
        """Append samples; complete blocks are written, the remainder with :meth:`commit`.

        Raises
        ------
        RunError
            The dataset does not continue the store, has other variables or attributes, another value of a variable
            that does not grow, or the folder was moved or deleted. Nothing of the dataset is appended.
        OSError
            The data cannot be written.
        """
        if self.dim not in chunk.dims:
            raise RunError(
                f"expected data along '{self.dim}'; the method yielded {dict(chunk.sizes)}", code="method.data.dim"
            )
        dims = [track.dim for track in self._tracks]
        values = {name: self._encoded(name, variable) for name, variable in stored_variables(chunk, self.dim).items()
                  if _growing(name, variable.dims, dims)}  # fmt: skip
        if set(values) != set(self._arrays):
            raise RunError(
                f"{self.path}: expected the variables {', '.join(sorted(self._arrays))} along "
                f"{' and '.join(repr(dim) for dim in dims)}; the method yielded {', '.join(sorted(values))}",
                code="method.data.variables",
            )
        self._fixed.check(chunk, {name: column.attributes for name, column in self._arrays.items()}, self.attrs)
        self._check_continues(chunk)
        for track in self._tracks:
            length, taken = chunk.sizes[track.dim], 0
            while taken < length:
                fill = track.count % track.block
                take = min(track.block - fill, length - taken)
                for name, column in track.arrays.items():
                    column.put(fill, values[name], taken, take)
                track.count += take
                taken += take
                if track.count % track.block == 0:
                    self._write_block(track)
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

    def close(self) -> None:
        """Commit, and write the length of each array to its own metadata, for readers that do not use the root."""
        with self._presence.held():
            self._commit()
            self._write_copies()

    def _commit(self) -> None:
        for track in self._tracks:
            if track.waiting:
                self._write_block(track)
        for path in sorted(self._unsynced, key=lambda path: path.is_dir()):  # files before the names of them
            sync(path)
        self._unsynced.clear()
        root = dict(self._root)
        root["consolidated_metadata"] = {
            "kind": "inline",
            "must_understand": False,
            "metadata": self._metadata(),
        }
        replace_text(self.path / "zarr.json", json.dumps(root))  # indented, it would take ten times as long
        for track in self._tracks:
            track.committed = track.count

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes of the dataset; written with the next :meth:`commit`."""
        return cast(dict[str, Any], self._root["attributes"])

    def _write_block(self, track: _Track) -> None:
        """Write the current block of every array along one dimension."""
        self._presence.check()
        start = (track.count - 1) // track.block * track.block
        contents = {column.file(start): column.content(track.count - start) for column in track.arrays.values()}
        for name in track.arrays:
            self._unsynced |= _make_folders(self.path / name, contents)
        # Files without committed samples are flushed by the commit, all at once.
        is_committed = start < track.committed
        replace_all(contents, flush=is_committed)
        if not is_committed:
            self._unsynced |= {*contents, *(file.parent for file in contents)}

    def _metadata(self) -> dict[str, Any]:
        growing = {
            name: column.metadata(track.count) for track in self._tracks for name, column in track.arrays.items()
        }
        return self._static | growing

    def _write_copies(self) -> None:
        """Write the metadata of each array to its folder, unless they are there."""
        for name, metadata in self._metadata().items():
            file = self.path / name / "zarr.json"
            try:
                if parse_json(read_bytes(file, MAX_METADATA)) == metadata:
                    continue
            except (OSError, ValueError, RecursionError):
                pass
            replace_text(file, json.dumps(metadata))

    def _encoded(self, name: str, variable: xr.Variable) -> np.ndarray:
        if name not in self._arrays:
            raise RunError(
                f"{self.path}: the method yielded the variable '{name}', which is missing in its first dataset",
                code="method.data.variables",
            )
        column = self._arrays[name]
        along = column.dims[column.axis]
        expected = {d: n for d, n in zip(column.dims, column.shape, strict=True) if d != along}
        sizes = {str(d): n for d, n in variable.sizes.items() if d != along}
        if sizes != expected:
            raise RunError(
                f"{self.path}: '{name}' has the sizes {sizes}; expected {expected}", code="method.data.sizes"
            )
        if not (column.packing or fits(variable, column.dtype)):
            raise RunError(
                f"{self.path}: expected '{name}' of the type {column.dtype}, as in the first dataset; found "
                f"{variable.dtype}",
                code="method.data.type",
            )
        packed = encode(variable.transpose(*column.dims), column.packing)
        if packed is None:
            raise RunError(
                f"{self.path}: expected '{name}' in integer steps of {column.packing['scale_factor']!r}, as the "
                "encoding states; found other values. Correct the encoding in the instrument or method, or omit it.",
                code="method.data.steps",
            )
        return packed

    def _check_continues(self, chunk: xr.Dataset) -> None:
        rate, start = chunk.attrs.get("sample_rate"), chunk.attrs.get("time_start")
        origin = self.attrs.get("time_start", 0.0)
        if self.dim != "time" or rate is None:
            return
        if "time" in chunk.variables and chunk.sizes["time"]:  # not stored: rate and start state it
            first, last = (float(chunk["time"].values[k]) for k in (0, -1))
            if abs((last - first) * rate - (chunk.sizes["time"] - 1)) > 0.5:
                raise RunError(
                    f"{self.path}: expected {chunk.sizes['time']} samples at {rate} Hz; their times are from "
                    f"{first:.6f} s to {last:.6f} s. The method must fill gaps with NaN.",
                    code="method.data.times",
                )
        if start is None:
            return
        expected = origin + self.count / rate
        if self.count and abs(start - expected) * rate > 0.5:
            raise RunError(
                f"{self.path}: expected the next samples at {expected:.6f} s; the method yielded samples from "
                f"{start:.6f} s. The method must fill gaps with NaN.",
                code="method.data.times",
            )

    def _add_counts(self, attrs: Mapping[Any, Any]) -> None:
        """Add the counts of dropped and invalid samples, by reason."""
        self.attrs["dropped"] = int(self.attrs.get("dropped", 0)) + int(attrs.get("dropped", 0))
        total: dict[str, int] = _counts(self.attrs.get("invalid"))
        for reason, count in _counts(attrs.get("invalid")).items():
            total[reason] = total.get(reason, 0) + count
        self.attrs["invalid"] = json.dumps(total)


def _growing(name: str, of: Sequence[Hashable], dims: Sequence[str]) -> str:
    """Return the growing dimension of a variable; empty if it has none."""
    growing = [dim for dim in dims if dim in of]
    if len(growing) > 1:
        raise RunError(
            f"expected '{name}' along one of {', '.join(dims)}, which grow independently; found two",
            code="method.data.dim",
        )
    return growing[0] if growing else ""


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
            if dim in dims_of(metadata):
                length = metadata["shape"][dims_of(metadata).index(dim)]
                if isinstance(length, int) and 0 <= length < MAX_SAMPLES:
                    return length
        raise ValueError(f"no variable has a length along '{dim}'")
    except OSError as error:
        raise RunError(f"{file}: cannot be read: {error.strerror}", code="run.file.unreadable") from error
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise RunError(f"{file}: is damaged; restore it from a copy ({error})", code="run.file.damaged") from error


def _array_metadata(path: Path, root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the metadata of all arrays: those of the root, or before the first commit those of their folders."""
    held = root.get("consolidated_metadata")
    if held:
        return dict(held["metadata"])
    return {each.parent.name: parse_json(read_bytes(each, MAX_METADATA)) for each in path.glob("*/zarr.json")}


def _make_folders(array: Path, files: Iterable[Path]) -> set[Path]:
    """Create missing folders of chunks below that of an array; return the folders with a new name."""
    changed = set()
    for file in files:
        if file.is_relative_to(array):
            for part in reversed([each for each in file.parents if each.is_relative_to(array) and each != array]):
                if not part.is_dir():
                    part.mkdir()  # without its parents: a folder that was moved is not created again
                    changed.add(part.parent)
    return changed


def _remove_parts(path: Path) -> None:
    """Remove temporary files of a process that was killed."""
    for file in path.rglob("*.part*"):
        if is_part(file.name) or file.suffix == ".partial":  # those of this package, and of zarr in earlier versions
            file.unlink(missing_ok=True)


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
    return packing if dtype.kind in "iu" and encode(variable, packing) is not None else {}


def _codec(stored: np.dtype[Any]) -> BloscCodec:
    """Return the compression of a variable as stored.

    In readings of two bytes the low byte is mostly noise and the high byte hardly changes: shuffling bytes saves 7 %
    of the size compared with shuffling bits, in the same time.
    """
    if stored.kind in "iu" and stored.itemsize == 2:
        return BloscCodec(cname="zstd", clevel=5, shuffle="shuffle")
    return BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle")


def _block_length(
    growing: Mapping[str, xr.Variable],
    packings: Mapping[str, Mapping[str, Any]],
    dim: str,
    expected: float,
    rate: float,
) -> int:
    """Return the samples of one block: a power of two within the size limits, not far above the expected total.

    A commit rewrites a block: one of more than the samples of a second is small.
    """
    per_sample = 0
    for name, variable in growing.items():
        size = np.dtype(packings[name].get("dtype", variable.dtype)).itemsize
        per_sample += max(size, 1) * int(np.prod([n for d, n in variable.sizes.items() if d != dim], dtype=np.int64))
    most = min(MAX_BLOCK_LENGTH, max(BLOCK_BYTES // max(per_sample, 1), 1))
    most = min(most, max(SMALL_BLOCK_BYTES // max(per_sample, 1), 1 << int(np.ceil(np.log2(max(rate, 1.0))))))
    if np.isfinite(expected) and expected >= 1:
        most = min(most, 1 << int(np.ceil(np.log2(expected))))
    return 1 << int(np.log2(max(most, 1)))
