"""Zarr v3 folders read, and their chunks encoded, without the library zarr.

The library takes 0.1 s to load and a few milliseconds for each variable, and copies a record twice. This module reads
what `errormotion` writes: chunks of a regular grid that are plain or compressed by Zstandard or Blosc, numbers in the
order of this computer, and texts of free length. Folders with anything else are left to the library. The bytes of a
chunk go straight to where they are used.
"""

from __future__ import annotations

import json
import math
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import AbstractDataStore, BackendArray
from xarray.backends.zarr import FillValueCoder
from xarray.core import indexing

from errormotion.datasets.files.hashing import cores
from errormotion.errors import DatasetError

_COMPRESSORS = ("blosc", "zstd")
_FILLS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_RUN = 2**14
"""Bytes that are read in the time that another run takes to begin: a chunk with more runs is read as a whole."""


def open_zarr(path: Path) -> xr.Dataset | None:
    """Open a Zarr folder; its values stay on the disk until they are used, and times are numbers.

    Parameters
    ----------
    path : Path
        A folder that `errormotion.datasets.files.containers.check_zarr` has passed.

    Returns
    -------
    Dataset or None
        None where the folder has something that only the library reads.
    """
    root = _json(path / "zarr.json")
    held = root.get("consolidated_metadata")
    arrays = held["metadata"] if held else {each.parent.name: _json(each) for each in sorted(path.glob("*/zarr.json"))}
    arrays = {name: each for name, each in arrays.items() if each.get("node_type") != "group"}
    if root.get("node_type") != "group" or not all(_known(name, each) for name, each in arrays.items()):
        return None
    ds = xr.open_dataset(
        _Store({name: _variable(path / name, each) for name, each in arrays.items()}, root.get("attributes", {})),
        engine="store",
        decode_times=False,
        decode_timedelta=False,
        create_default_indexes=False,
    )
    ds.encoding["source"] = str(path)
    return ds


def values_of(folder: Path, metadata: Mapping[str, Any], window: tuple[slice, ...]) -> np.ndarray:
    """Return a window of an array as it is stored, without decoding."""
    return _Array(folder, metadata)._read(window)


def fill_of(metadata: Mapping[str, Any]) -> Any:
    """Return the value of chunks that have no file."""
    fill = metadata.get("fill_value")
    return _FILLS.get(fill, fill) if isinstance(fill, str) and metadata["data_type"] != "string" else fill


def dtype_of(metadata: Mapping[str, Any]) -> np.dtype[Any]:
    """Return the type of the stored values; texts are objects."""
    return np.dtype(object if metadata["data_type"] == "string" else metadata["data_type"])


def encoded(values: np.ndarray, metadata: Mapping[str, Any]) -> bytes:
    """Return the content of the file of a chunk; `values` are those to be stored, of the size of a chunk.

    Raises
    ------
    DatasetError
        The array has a codec that this module does not write.
    """
    from numcodecs import blosc
    from numcodecs.zstd import compress as to_zstd

    coder, *compressors = metadata["codecs"]
    content: Any
    if coder["name"] == "vlen-utf8":
        texts = [str(text).encode() for text in values.ravel().tolist()]
        content = b"".join([struct.pack("<I", len(texts)), *(struct.pack("<I", len(t)) + t for t in texts)])
    else:
        content = np.ascontiguousarray(values, dtype_of(metadata).newbyteorder("<"))
    if not compressors:
        return bytes(content if isinstance(content, bytes) else content.tobytes())
    (compressor,) = compressors
    stated = compressor["configuration"]
    if compressor["name"] == "blosc":
        mode = {"noshuffle": blosc.NOSHUFFLE, "shuffle": blosc.SHUFFLE, "bitshuffle": blosc.BITSHUFFLE}[
            stated["shuffle"]
        ]
        return bytes(blosc.compress(content, stated["cname"].encode(), stated["clevel"], mode, stated["blocksize"]))
    if compressor["name"] == "zstd":
        return bytes(to_zstd(content, stated["level"], stated["checksum"]))
    raise DatasetError(
        f"expected a chunk compressed by {' or '.join(_COMPRESSORS)}; found {compressor['name']!r}",
        code="zarr.compressor.unknown",
    )


def _json(file: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(file.read_bytes())
    return content


def _known(name: str, metadata: Mapping[str, Any]) -> bool:
    """Whether this module reads an array."""
    coder, *compressors = metadata["codecs"]
    kind, dims = metadata["data_type"], metadata.get("dimension_names") or ()
    keys = metadata.get("chunk_key_encoding")
    return (
        "/" not in name
        and len(dims) == len({*dims}) == len(metadata["shape"])
        and all(isinstance(dim, str) for dim in dims)
        and isinstance(keys, dict)
        and keys.get("name") == "default"
        and (keys.get("configuration") or {}).get("separator", "/") == "/"
        and len(compressors) <= 1
        and all(isinstance(each, dict) and each.get("name") in _COMPRESSORS for each in compressors)
        and isinstance(coder, dict)
        and (_are_texts(coder, metadata) if kind == "string" else _are_numbers(coder, metadata))
    )


def _are_texts(coder: Mapping[str, Any], metadata: Mapping[str, Any]) -> bool:
    unmasked = "_FillValue" not in metadata.get("attributes", {})
    return coder.get("name") == "vlen-utf8" and isinstance(metadata.get("fill_value"), str) and unmasked


def _are_numbers(coder: Mapping[str, Any], metadata: Mapping[str, Any]) -> bool:
    """Whether the values are numbers in the byte order of this computer, with a fill value of their type."""
    if not isinstance(metadata["data_type"], str) or sys.byteorder != "little":
        return False
    dtype, fill = np.dtype(metadata["data_type"]), fill_of(metadata)
    order = (coder.get("configuration") or {}).get("endian", "little" if dtype.itemsize == 1 else "")
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        fits = type(fill) is int and limits.min <= fill <= limits.max
    else:
        fits = type(fill) is bool if dtype.kind == "b" else type(fill) in (int, float)
    return coder.get("name") == "bytes" and order == "little" and fits


def _variable(folder: Path, metadata: Mapping[str, Any]) -> xr.Variable:
    dims = tuple(metadata.get("dimension_names") or ())
    array = _Array(folder, metadata)
    attributes = dict(metadata.get("attributes", {}))
    if "_FillValue" in attributes:
        attributes["_FillValue"] = FillValueCoder.decode(attributes["_FillValue"], array.dtype)
    encoding = {"chunks": array.chunk, "preferred_chunks": dict(zip(dims, array.chunk, strict=True))}
    return xr.Variable(dims, indexing.LazilyIndexedArray(array), attributes, encoding)


class _Store(AbstractDataStore):
    """What xarray decodes: variables and attributes."""

    def __init__(self, variables: dict[str, xr.Variable], attributes: dict[str, Any]) -> None:
        self._variables, self._attributes = variables, attributes

    def get_variables(self) -> dict[str, xr.Variable]:  # type: ignore[override, unused-ignore]
        return self._variables

    def get_attrs(self) -> dict[str, Any]:  # type: ignore[override, unused-ignore]
        return self._attributes


class _Array(BackendArray):
    """An array of a Zarr folder, whose chunks are read where their values are used.

    Attributes
    ----------
    shape, chunk : tuple of int
    dtype : dtype
    """

    def __init__(self, folder: Path, metadata: Mapping[str, Any]) -> None:
        self.shape = tuple(metadata["shape"])
        self.chunk = tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"])
        self._text = metadata["data_type"] == "string"
        self.dtype = dtype_of(metadata)
        self._folder = folder
        self._compressor = metadata["codecs"][1]["name"] if len(metadata["codecs"]) > 1 else ""
        self._fill = fill_of(metadata)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._read)

    def _read(self, key: tuple[int | slice, ...]) -> np.ndarray:
        """Return the values of a window with steps; an axis with a single index is left out."""
        ranges = [
            range(*each.indices(size)) if isinstance(each, slice) else range(each, each + 1)
            for each, size in zip(key, self.shape, strict=True)
        ]
        if not all(ranges):
            box = np.empty([len(each) for each in ranges], self.dtype)
        else:
            box = self._box([min(each[0], each[-1]) for each in ranges], [max(each[0], each[-1]) for each in ranges])
            steps: tuple[Any, ...] = (*(slice(None, None, each.step) for each in ranges), ...)
            box = box[steps]
        kept: tuple[Any, ...] = (*(slice(None) if isinstance(each, slice) else 0 for each in key), ...)
        return np.asarray(box[kept])  # with the dots, a single text remains an array

    def _box(self, first: Sequence[int], last: Sequence[int]) -> np.ndarray:
        """Return the values from one place to another, both included."""
        box = np.empty([b - a + 1 for a, b in zip(first, last, strict=True)], self.dtype)

        def read(place: tuple[int, ...]) -> None:
            """Read what one chunk has of the box."""
            begin = [k * size for k, size in zip(place, self.chunk, strict=True)]
            spans = [
                (max(a, o), min(b + 1, o + size)) for a, b, o, size in zip(first, last, begin, self.chunk, strict=True)
            ]
            part: tuple[Any, ...] = tuple(slice(a - o, b - o) for (a, b), o in zip(spans, first, strict=True))
            target = box[(*part, ...)]
            self._chunk_into(place, [slice(a - o, b - o) for (a, b), o in zip(spans, begin, strict=True)], target)

        places = list(
            product(*(range(a // size, b // size + 1) for a, b, size in zip(first, last, self.chunk, strict=True)))
        )
        if self._compressor and len(places) > 1 and cores() > 1:
            with ThreadPoolExecutor(min(cores(), len(places)), thread_name_prefix="chunk") as pool:
                list(pool.map(read, places))
        else:
            for place in places:
                read(place)
        return box

    def _chunk_into(self, place: tuple[int, ...], window: Sequence[slice], target: np.ndarray) -> None:
        """Read a window of one chunk into a part of a box."""
        path = self._folder.joinpath("c", *map(str, place))
        try:
            with open(path, "rb", buffering=0) as file:
                if self._compressor or self._text or not self._runs_into(file, window, target):
                    target[...] = self._whole(file)[tuple(window)]
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            target[...] = self._fill  # a chunk of nothing else has no file
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror or error}", code="file.unreadable") from error
        except (RuntimeError, TypeError, ValueError, struct.error) as error:
            raise DatasetError(
                f"{self._folder.parent}: is damaged or incomplete; copy it again, or measure again. "
                f"({path.relative_to(self._folder.parent)}: {error})",
                code="file.damaged",
            ) from error

    def _runs_into(self, file: Any, window: Sequence[slice], target: np.ndarray) -> bool:
        """Read a window of a plain chunk run by run; False, and nothing is read, where there are too many."""
        axis = len(self.chunk) - 1  # of the runs; the axes behind it are whole, in the chunk and in the box
        while axis > 0 and target.shape[axis] == self.chunk[axis] and target[(0,) * (axis - 1)].flags.c_contiguous:
            axis -= 1
        inner = math.prod(self.chunk[axis + 1 :])
        if axis < 0 or math.prod(target.shape[:axis]) * _RUN > math.prod(self.chunk) * self.dtype.itemsize:
            return False
        self._check_size(file.seek(0, 2))
        for row in np.ndindex(*target.shape[:axis]):
            start = 0
            for k, within in enumerate(window[: axis + 1]):
                start = start * self.chunk[k] + within.start + (row[k] if k < axis else 0)
            file.seek(start * inner * self.dtype.itemsize)
            into = target[row].reshape(-1).view(np.uint8).data
            while into:
                read = file.readinto(into)
                if not read:
                    raise ValueError("it ends too early")
                into = into[read:]
        return True

    def _whole(self, file: Any) -> np.ndarray:
        """Return all values of a chunk."""
        content = file.read()
        if self._compressor:
            content = _decompressed(content, self._compressor)
        if self._text:
            return np.array(list(_texts(content, math.prod(self.chunk))), object).reshape(self.chunk)
        self._check_size(len(content))
        return np.frombuffer(content, self.dtype).reshape(self.chunk)

    def _check_size(self, size: int) -> None:
        expected = math.prod(self.chunk) * self.dtype.itemsize
        if size != expected:
            raise ValueError(f"expected a chunk of {expected} bytes; found {size}")


def _decompressed(content: bytes, compressor: str) -> bytes:
    from numcodecs.blosc import decompress as from_blosc
    from numcodecs.zstd import decompress as from_zstd

    # Blosc itself trusts the length that a chunk states, and would read beyond its end.
    if compressor == "blosc" and (len(content) < 16 or struct.unpack_from("<I", content, 12)[0] != len(content)):
        raise ValueError(f"its {len(content)} bytes are not those that it states")
    plain: bytes = (from_blosc if compressor == "blosc" else from_zstd)(content)
    return plain


def _texts(content: bytes, count: int) -> Iterator[str]:
    """Yield the texts of a chunk: their number, then the length of each and its bytes in UTF-8."""
    (found,) = struct.unpack_from("<I", content)
    if found != count:
        raise ValueError(f"expected {count} texts; found {found}")
    position = 4
    for _ in range(count):
        (length,) = struct.unpack_from("<I", content, position)
        position += 4 + length
        if position > len(content):
            raise ValueError("a text is longer than the chunk")
        yield content[position - length : position].decode()
