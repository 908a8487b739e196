"""Checks of NetCDF files and Zarr folders of unknown origin before a library reads them.

A dataset contains data only. Its values are in the file or folder itself, not in linked files; they are numbers and
texts, not serialised objects; and the stated sizes are in proportion to the size on disk, so that a small file
cannot require a large memory.
"""

from __future__ import annotations

import math
import os
import stat
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np

from errormotion.datasets.files.hdf5 import Stored, violations, wrong_types
from errormotion.datasets.files.reading import parse_json, read_bytes
from errormotion.errors import DatasetError

OWN_BYTES = 64 << 20
"""Bytes of values that any dataset may state."""
PER_BYTE = 1100
"""Bytes of values for each byte of the file or folder; deflate, the codec of NetCDF, reaches 1032."""
MUCH = 512 << 20
"""Bytes of values that a file or folder may state in addition to `OWN_BYTES` at any compression."""
PER_BYTE_OF_MUCH = 64
"""Bytes of values for each byte of the file or folder above `MUCH`. Reading needs up to five copies of the values."""
MAX_VARIABLES = 2000
PER_CHUNK_OF_HDF5, PER_CHUNK_OF_ZARR = 6 << 10, 1 << 10
"""Bytes that a reader needs for each chunk, also for one that is not stored."""
MAX_METADATA = 16 << 20
"""Largest size of a zarr.json, bytes."""
DEEPEST = 24
"""Largest number of levels of folders in a Zarr folder."""
CODECS = ("bytes", "transpose", "blosc", "zstd", "crc32c", "vlen-utf8")
"""Accepted codecs of Zarr v3, which decode numbers and texts only."""
DECODED = 8
"""Least bytes of one value that is scaled, or may be missing, when it is read."""
_DECODED = ("scale_factor", "add_offset", "_FillValue", "missing_value")
"""Attributes of such values."""
_COMPRESSORS = ("blosc", "zstd")
_CRC_BYTES = 4
"""What the codec crc32c appends, bytes."""
MAX_TEXT = 1 << 20
"""Largest size of a text of fixed length, bytes."""
_TEXT, _WIDE = "string", "fixed_length_utf32"
_NUMBERS = ("bool", *(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)),
            "float16", "float32", "float64")  # fmt: skip


def check_netcdf(path: Path) -> None:
    """Refuse a NetCDF-4 file that refers to other files, or states sizes out of proportion.

    Raises
    ------
    DatasetError
        With all reasons in one message.
    OSError, KeyError, RuntimeError
        The file is damaged.
    """
    size = path.stat().st_size
    with h5py.File(path) as file:
        file.attrs.get("_nc3_strict")  # h5netcdf leaves an incomplete object if this fails
        if len(file) > MAX_VARIABLES:
            raise DatasetError(
                f"{path}: expected at most {MAX_VARIABLES} variables; found {len(file)}", code="file.variables.too_many"
            )
        messages, total, variables = [], 0, {}
        for name in file:
            if not is_inside(file, name):
                messages.append(f"{name!r:.100}: expected values in this file; found a link")
                continue
            variable = file[name]
            if not isinstance(variable, h5py.Dataset):
                continue  # groups are not read
            if variable.external or variable.is_virtual:
                messages.append(f"{name!r:.100}: expected values in this file; found a reference to another one")
            messages += [f"{name!r:.100}: {text}" for text in wrong_types(variable)]
            pieces, decoded = variable.chunks or (), any(each in variable.attrs for each in _DECODED)
            item = max(DECODED if decoded else 1, variable.id.get_type().get_size())
            chunks = math.prod(_counts(variable.shape, pieces)) if pieces else 0
            values = max(_number(variable.shape or ()), math.prod(pieces)) * item
            total += max(values, chunks * PER_CHUNK_OF_HDF5)
            variables[name] = variable
        messages += [f"/: {text}" for text in wrong_types(file)]
        if not messages and total <= _most(size):  # what follows reads as much as the file states
            stored = Stored(path, size, file)
            messages += [f"{name!r:.100}: {text}" for name, each in variables.items() for text in violations(each)]
            total += stored.texts(variables.values(), _most(size) - total)
    _raise(path, messages, total, size)


def is_inside(group: h5py.Group, name: str) -> bool:
    """Return whether a group of HDF5 contains an object, not a link to another place, which is not followed."""
    # Group.get and "in" open the file of an external link, which may be a pipe.
    try:
        return bool(group.id.links.get_info(name.encode("utf-8", "surrogateescape")).type == h5py.h5l.TYPE_HARD)
    except (KeyError, RuntimeError, ValueError):  # there is none
        return False


def datasets_in(path: Path, group: h5py.Group) -> dict[str, h5py.Dataset]:
    """Return the datasets of numbers and texts of fixed length in a group of a HDF5 file, by their paths in it.

    Links are not followed, so that everything is in this file; nothing is read.

    Raises
    ------
    DatasetError
        There are too many objects, or too many levels of groups.
    """
    seen: set[int] = set()

    def inside(parent: h5py.Group, prefix: str, depth: int) -> Iterator[tuple[str, h5py.Dataset]]:
        for name in parent:
            if not is_inside(parent, name):
                continue
            each = parent[name]
            address = h5py.h5o.get_info(each.id).addr
            if address in seen:  # a group may contain itself
                continue
            seen.add(address)
            if len(seen) > MAX_VARIABLES:
                raise DatasetError(
                    f"{path}: expected at most {MAX_VARIABLES} variables; found more", code="file.variables.too_many"
                )
            if isinstance(each, h5py.Dataset) and each.shape is not None and _has_values(each.dtype):
                yield prefix + name, each
            elif isinstance(each, h5py.Group):
                if depth == DEEPEST:
                    raise DatasetError(
                        f"{path}: is damaged, or malicious: expected at most {DEEPEST} levels of groups; found more",
                        code="file.malicious",
                    )
                yield from inside(each, f"{prefix}{name}/", depth + 1)

    return dict(inside(group, "", 1))


def check_datasets(path: Path, datasets: Mapping[str, h5py.Dataset]) -> None:
    """Refuse datasets of `datasets_in` that refer to other files, or whose sizes are out of proportion.

    Raises
    ------
    DatasetError
        With all reasons in one message.
    """
    size, total, messages = path.stat().st_size, 0, []
    for name, each in datasets.items():
        if each.external or each.is_virtual:
            messages.append(f"{name!r:.100}: expected values in this file; found a reference to another one")
        chunk = math.prod(each.chunks or (0,))
        total += max(_number(each.shape), chunk) * each.dtype.itemsize
    if not messages and total <= _most(size):
        messages = [f"{name!r:.100}: {text}" for name, each in datasets.items() for text in violations(each)]
    _raise(path, messages, total, size)


def _has_values(kind: np.dtype[Any]) -> bool:
    return not kind.hasobject and (kind.names is not None or kind.base.kind in "biufSUM")


def check_classic(path: Path) -> None:
    """Refuse a NetCDF-3 file that states more values than it may: its variables may name the same bytes.

    Raises
    ------
    DatasetError
        The file has too many variables or values.
    OSError, ValueError, TypeError
        The file is damaged.
    """
    from scipy.io import netcdf_file

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of scipy, that arrays refer to the file
        with netcdf_file(path, "r", mmap=True) as file:
            count = len(file.variables)
            total = sum(
                math.prod(each.data.shape) * max(DECODED, each.data.dtype.itemsize) for each in file.variables.values()
            )
    if count > MAX_VARIABLES:
        raise DatasetError(
            f"{path}: expected at most {MAX_VARIABLES} variables; found {count}", code="file.variables.too_many"
        )
    _raise(path, [], total, path.stat().st_size)


def stated_schema(path: Path) -> str:
    """Return the schema that a NetCDF-4 file states, without reading anything else; empty if it states none.

    Raises
    ------
    OSError, RuntimeError
        The file cannot be read, or is not one.
    """
    with h5py.File(path) as file:
        if "schema" not in file.attrs:
            return ""
        attribute = h5py.h5a.open(file.id, b"schema")
        return str(file.attrs["schema"]) if math.prod(attribute.shape) == 1 else ""


def check_zarr(path: Path) -> None:
    """Refuse a Zarr folder with links, formats other than v3, codecs of objects, or sizes out of proportion.

    Raises
    ------
    DatasetError
        With all reasons in one message.
    OSError, ValueError
        The folder cannot be read, or its metadata are not JSON.
    """
    if not (path / "zarr.json").exists():
        raise DatasetError(
            f"{path}: expected a Zarr folder of format 3 (zarr.json); found another format", code="zarr.format"
        )
    size = sum(_files(path, path, DEEPEST))
    root = _metadata(path / "zarr.json")
    held = root.get("consolidated_metadata")
    if held is not None and (not isinstance(held, dict) or not isinstance(held.get("metadata"), dict)):
        raise DatasetError(
            f"{path}: consolidated_metadata: expected an object with 'metadata'; found another one",
            code="zarr.metadata.form",
        )
    arrays: dict[str, Any] = dict(held["metadata"]) if held else {}
    folders = {each.name for each in path.iterdir() if each.is_dir()}
    for name in arrays:
        if name not in folders:
            raise DatasetError(
                f"{path}: {name!r:.100}: expected a folder of this name with its array; found none",
                code="zarr.array.missing",
            )
    for each in sorted(path.iterdir()):
        if each.name in arrays:
            continue  # the root has its metadata; the file in the folder, which a power cut may damage, is not read
        if (each / "zarr.json").exists():
            arrays[each.name] = _metadata(each / "zarr.json")
        elif each.is_dir():
            raise DatasetError(
                f"{path}: {each.name!r:.100}: expected an array (zarr.json); found a folder without it",
                code="zarr.array.missing",
            )
    if len(arrays) > MAX_VARIABLES:
        raise DatasetError(
            f"{path}: expected at most {MAX_VARIABLES} arrays; found {len(arrays)}", code="file.variables.too_many"
        )
    messages, total = [], 0
    for name, metadata in arrays.items():
        if isinstance(metadata, dict) and metadata.get("node_type") == "group":
            continue  # groups are not read
        wrong = _wrong(metadata)
        if wrong:
            messages.append(f"{name!r:.100}: {wrong}")
            continue
        chunks = math.prod(_counts(metadata["shape"], _chunk_shape(metadata)))
        total += max(_stated(metadata), chunks * PER_CHUNK_OF_ZARR)
        messages += [f"{name!r:.100}: {text}" for text in _wrong_chunks(path / name, metadata, size)]
    _raise(path, messages, total, size)


def _most(size: int) -> int:
    """Return the bytes of values that a file or folder of some bytes may state."""
    return OWN_BYTES + min(PER_BYTE * size, max(MUCH, PER_BYTE_OF_MUCH * size))


def _number(shape: Sequence[int]) -> int:
    """Return a number of values; an empty dimension counts as one, since the others may have coordinates."""
    return math.prod(max(1, size) for size in shape)


def _counts(shape: Sequence[int], chunk: Sequence[int]) -> list[int]:
    """Return the number of chunks along each dimension."""
    return [-(-size // each) for size, each in zip(shape, chunk, strict=True)]


def _raise(path: Path, messages: list[str], total: int, size: int) -> None:
    if total > _most(size):
        messages.append(
            f"expected at most {_most(size)} bytes of values in a file or folder of {size} bytes; it states {total}"
        )
    if messages:
        raise DatasetError(f"{path}: is damaged, or malicious:", messages, code="file.malicious")


def _files(folder: Path, store: Path, depth: int) -> Iterator[int]:
    """Yield the sizes of the files of a store; links, pipes and devices are refused."""
    if depth == 0:
        raise DatasetError(
            f"{store}: expected at most {DEEPEST} levels of folders; found more", code="zarr.folders.too_deep"
        )
    with os.scandir(folder) as inside:
        for each in inside:
            if each.is_dir(follow_symlinks=False):
                yield from _files(Path(each.path), store, depth - 1)
                continue
            state = each.stat(follow_symlinks=False)
            if not stat.S_ISREG(state.st_mode):
                raise DatasetError(
                    f"{each.path}: expected a file in this folder; found a link, a pipe or a device",
                    code="zarr.entry.no_file",
                )
            yield state.st_size


def _metadata(file: Path) -> dict[str, Any]:
    metadata = parse_json(read_bytes(file, MAX_METADATA))
    if not isinstance(metadata, dict):
        raise DatasetError(f"{file}: expected an object; found {type(metadata).__name__}", code="zarr.metadata.form")
    return metadata


def _wrong(metadata: Any) -> str:
    """Return a violation in the metadata of an array; empty if there is none."""
    if not isinstance(metadata, dict) or metadata.get("zarr_format") != 3 or metadata.get("node_type") != "array":
        return "expected an array of Zarr v3"
    shape: Any = metadata.get("shape")
    names = metadata.get("dimension_names")
    if not _is_shape(shape, 0):
        return f"expected a shape of whole numbers; found {shape!r:.100}"
    if not _item(metadata):
        return f"expected data_type {', '.join(_NUMBERS)} or {_TEXT}; found {metadata.get('data_type')!r:.100}"
    if not _is_shape(_chunk_shape(metadata), 1) or len(_chunk_shape(metadata)) != len(shape):
        return f"expected chunks of whole numbers; found {metadata.get('chunk_grid')!r:.100}"
    if names is not None and not (isinstance(names, list) and len(names) == len(shape)):
        return f"expected a dimension name for each of {len(shape)} dimensions; found {names!r:.100}"
    if metadata.get("storage_transformers"):
        return "expected no storage_transformers"
    codecs = metadata.get("codecs")
    messages = (
        [each.get("name") if isinstance(each, dict) else each for each in codecs] if isinstance(codecs, list) else []
    )
    if not messages or not all(each in CODECS for each in messages):
        return f"expected codecs of {', '.join(CODECS)}; found {messages!r:.100}"
    if len({*messages}) < len(messages) or {*_COMPRESSORS} <= {*messages}:
        return f"expected each codec once, and one of {' and '.join(_COMPRESSORS)} at most; found {messages!r:.100}"
    return ""


def _is_shape(value: Any, least: int) -> bool:
    return isinstance(value, list) and all(type(each) is int and least <= each < 1 << 53 for each in value)


def _chunk_shape(metadata: Mapping[str, Any]) -> Any:
    grid = metadata.get("chunk_grid")
    inner = grid.get("configuration") if isinstance(grid, dict) and grid.get("name") == "regular" else None
    return inner.get("chunk_shape") if isinstance(inner, dict) else None


def _item(metadata: Mapping[str, Any]) -> int:
    """Return the bytes of one value; 0 if it is neither a number nor a text."""
    kind = metadata.get("data_type")
    if isinstance(kind, dict):
        configuration = kind.get("configuration")
        length = configuration.get("length_bytes") if isinstance(configuration, dict) else None
        known = kind.get("name") == _WIDE and type(length) is int and 0 < length <= MAX_TEXT
        return int(length) if known and length is not None else 0
    return 16 if kind == _TEXT else int(np.dtype(kind).itemsize) if kind in _NUMBERS else 0


def _stated(metadata: Mapping[str, Any]) -> int:
    """Return the bytes of the values of an array, or of one chunk if this is larger."""
    attributes = metadata.get("attributes")
    decoded = isinstance(attributes, dict) and any(each in attributes for each in _DECODED)
    item = max(DECODED if decoded else 1, _item(metadata))
    return int(max(_number(metadata["shape"]), math.prod(_chunk_shape(metadata))) * item)


def _wrong_chunks(folder: Path, metadata: Mapping[str, Any], size: int) -> Iterator[str]:
    """Yield violations in the decompressed sizes that the chunks of an array state."""
    names = [each["name"] for each in metadata["codecs"]]
    packed = next((name for name in _COMPRESSORS if name in names), "")
    if not packed or not (folder / "c").exists():
        return
    checked = _CRC_BYTES if "crc32c" in names[names.index(packed) :] else 0
    items = math.prod(_chunk_shape(metadata))
    counts = _counts(metadata["shape"], _chunk_shape(metadata))
    largest = _most(size) if metadata["data_type"] == _TEXT else items * _item(metadata)
    for file in _chunks(str(folder / "c"), counts):
        with open(file, "rb", buffering=0) as chunk:  # a record has thousands of chunks: a buffer would take as long
            head = chunk.read(18)
            stated = _blosc_size(head) if packed == "blosc" else _zstd_size(head)
            longer = stated is not None and packed == "zstd" and _continues(chunk, head, checked)
        if stated is None:
            wrong = "that states its size; it is truncated or damaged: copy the folder again"
        elif longer:
            wrong = "of one Zstandard frame; found more behind it"
        elif stated > largest:
            wrong = f"of at most {largest} bytes; it states {stated}"
        else:
            continue
        yield f"{Path(file).relative_to(folder)}: expected a chunk {wrong}"
        return


def _chunks(path: str, counts: Sequence[int]) -> Iterator[str]:
    """Yield the files of an array with some chunks along each dimension.

    Others, temporary or written before a crash, are not opened by a reader.
    """
    if not counts:
        if os.path.isfile(path):
            yield path
        return
    try:
        with os.scandir(path) as inside:
            chunks = [each.path for each in inside if _is_below(each.name, counts[0])]
    except NotADirectoryError:
        return
    if len(counts) == 1:
        yield from chunks
    else:
        for each in chunks:
            yield from _chunks(each, counts[1:])


def _is_below(name: str, count: int) -> bool:
    return name.isascii() and name.isdigit() and int(name) < count


def _blosc_size(head: bytes) -> int | None:
    """Return the decompressed size of a Blosc chunk; None if it is too short."""
    return int(struct.unpack_from("<I", head, 4)[0]) if len(head) >= 16 else None


def _zstd_field(head: bytes) -> tuple[int, int]:
    """Return the place and the width of the decompressed size in the head of a frame (RFC 8878, section 3.1.1.1)."""
    descriptor = head[4]
    single, flag = descriptor >> 5 & 1, descriptor >> 6
    return 5 + (1 - single) + (0, 1, 2, 4)[descriptor & 3], (1 if single else 0, 2, 4, 8)[flag]


def _zstd_size(head: bytes) -> int | None:
    """Return the decompressed size that a Zstandard frame states; None if it states none."""
    if len(head) < 6 or head[:4] != b"\x28\xb5\x2f\xfd":
        return None
    start, width = _zstd_field(head)
    field = head[start : start + width]
    if not width or len(field) < width:
        return None
    return int.from_bytes(field, "little") + (256 if width == 2 else 0)


def _continues(chunk: FileIO, head: bytes, after: int) -> bool:
    """Return whether a chunk has more than one Zstandard frame and some bytes: a decoder would add further frames."""
    place = sum(_zstd_field(head))
    size = chunk.seek(0, 2)
    while place + 3 <= size:
        chunk.seek(place)
        block = int.from_bytes(chunk.read(3), "little")  # RFC 8878, section 3.1.1.2: last, type, size
        repeated = block >> 1 & 3 == 1
        place += 3 + (1 if repeated else block >> 3)
        if block & 1:
            return place + (4 if head[4] & 4 else 0) + after < size
    return False  # truncated: the decoder refuses it
