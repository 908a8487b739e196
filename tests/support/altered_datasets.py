"""Datasets that are altered: their content, and the structure of NetCDF files and Zarr folders."""

from __future__ import annotations

import json
import pickle
import random
import shutil
import zlib
from pathlib import Path
from typing import Any

import damaged
import h5py
import numpy as np
from altered import ANY, Alteration, UnsuitableError, json_deep, json_value, remove
from numcodecs import GZip, Zstd

from errormotion.datasets.storage import disk as storage
from errormotion.errors import ErrormotionError

HUGE = 10**15
"""Length of a dimension that no memory holds."""
BIG = 1 << 29
"""Length of a dimension that a computer would try to hold."""
SCRIPT = "<script>alert(1)</script>"


class _Pickled:
    """An object that makes a file where its pickle is read."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("unpickled"),)


PICKLE = pickle.dumps(_Pickled())


def content(path: Path, chance: random.Random) -> str:
    """Change variables, dims, coordinates and attributes of a dataset, and store it without a check."""
    try:
        with storage.load(path) as found:
            good = found.load()
    except ErrormotionError:
        raise UnsuitableError from None
    changed = damaged.dataset(good, chance.randrange(10**9))
    beside = path.with_name("altered" + path.suffix)
    try:
        ready = storage.storable(changed)
        if path.is_dir():
            ready.to_zarr(beside, mode="w", zarr_format=3, consolidated=False)
        else:
            ready.to_netcdf(beside, engine="h5netcdf")
    except Exception:  # noqa: BLE001 - what no file can hold is not altered so
        shutil.rmtree(beside, ignore_errors=True)
        beside.unlink(missing_ok=True)
        raise UnsuitableError from None
    remove(path)
    beside.rename(path)
    return "content"


def netcdf(path: Path, chance: random.Random) -> str:
    """Change the structure of a NetCDF file: sizes, types, links to other files, sparse variables."""
    changes = (_enlarge, _enlarge, _bomb, _link, _external, _retype, _no_scale, _nest, _reference, _many)
    try:
        with h5py.File(path, "r+") as file:
            return chance.choice(changes)(file, chance)
    except (OSError, KeyError, RuntimeError, ValueError, TypeError):
        raise UnsuitableError from None


def _variable(file: h5py.File, chance: random.Random) -> h5py.Dataset:
    return file[chance.choice(sorted(name for name, each in file.items() if isinstance(each, h5py.Dataset)))]


def _replaced(file: h5py.File, old: h5py.Dataset, **made: Any) -> None:
    name, attrs = old.name, {key: old.attrs[key] for key in old.attrs if key.isupper() is False}
    scales = [str(dim[0].name) for dim in old.dims if len(dim)]
    del file[name]
    new = file.create_dataset(name, **made)
    for key, value in attrs.items():
        new.attrs[key] = value
    if len(scales) == new.ndim:
        for dim, scale in zip(new.dims, scales, strict=True):
            dim.attach_scale(file[scale])


def _enlarge(file: h5py.File, chance: random.Random) -> str:
    """State a huge size, without any data."""
    old, size = _variable(file, chance), chance.choice((BIG, HUGE))
    if not old.ndim:
        raise ValueError
    _replaced(file, old, shape=(size, *old.shape[1:]), dtype=old.dtype, chunks=(1024, *old.shape[1:]))
    return f"a size of {size:.0e} without data"


def _bomb(file: h5py.File, chance: random.Random) -> str:
    """State a large size, with data that are compressed a thousandfold."""
    old = _variable(file, chance)
    if old.ndim != 1 or old.dtype.kind not in "fiu":
        raise ValueError
    name, rows = old.name, BIG // 8
    _replaced(file, old, shape=(rows,), dtype=old.dtype, chunks=(rows,), compression="gzip")
    deflate = zlib.compressobj(9)
    blocks = [deflate.compress(bytes(1 << 20)) for _ in range(rows * file[name].dtype.itemsize >> 20)]
    file[name].id.write_direct_chunk((0,), b"".join([*blocks, deflate.flush()]))
    return "data compressed a thousandfold"


def _link(file: h5py.File, chance: random.Random) -> str:
    """Replace a variable by a link: to itself, to nothing, to another file."""
    name = _variable(file, chance).name
    del file[name]
    file[name] = chance.choice((h5py.SoftLink(name), h5py.SoftLink("/nothing"), h5py.ExternalLink("other.nc", "/EX")))
    return "a link for a variable"


def _external(file: h5py.File, chance: random.Random) -> str:
    """Take the values of a variable from another file."""
    old = _variable(file, chance)
    if old.dtype.kind not in "fiu":
        raise ValueError
    _replaced(file, old, shape=old.shape, dtype=old.dtype, external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])
    return "values from another file"


def _retype(file: h5py.File, chance: random.Random) -> str:
    """Give a variable another type."""
    old = _variable(file, chance)
    kinds = (
        np.dtype("S5"), np.dtype("V7"), np.dtype([("a", "f8"), ("b", "i4")]), h5py.ref_dtype, np.dtype(bool),
        h5py.vlen_dtype(float), h5py.enum_dtype({"A": 1}, "i4"), np.dtype(">f2"), np.dtype("c16"), np.dtype("u8"),
        np.dtype(("f8", (3,))), h5py.string_dtype(),
    )  # fmt: skip
    _replaced(file, old, shape=old.shape, dtype=chance.choice(kinds))
    return "another type"


def _no_scale(file: h5py.File, chance: random.Random) -> str:
    """Remove the dimension scales, or attach one that does not fit."""
    old = _variable(file, chance)
    for name in ("DIMENSION_LIST", "CLASS", "REFERENCE_LIST", "_Netcdf4Dimid", "_Netcdf4Coordinates"):
        if name in old.attrs and chance.random() < 0.6:
            del old.attrs[name]
    return "no dimension scales"


def _nest(file: h5py.File, chance: random.Random) -> str:
    """Add groups, one in the other."""
    at = file
    for _ in range(300):
        at = at.create_group("g")
    at["x"] = 1.0
    return "nested groups"


def _reference(file: h5py.File, chance: random.Random) -> str:
    """Add attributes of unusual types."""
    holder = file if chance.random() < 0.5 else _variable(file, chance)
    name = chance.choice(sorted(holder.attrs) or ["x"])
    value = chance.choice(
        (
            file.ref, h5py.Empty("f8"), h5py.Empty("S1"), np.array([b"\xff\xfe"]), np.zeros((2, 2)),
            np.array(["a", "b"], dtype=h5py.string_dtype()), np.array(b"\xff", dtype="S3"), 1 + 2j, True,
            np.array([(1.0, 2)], dtype=[("a", "f8"), ("b", "i4")]), np.array([], dtype=float),
            np.array([], dtype=h5py.string_dtype()),
        )
    )  # fmt: skip
    holder.attrs[name] = value
    return f"attribute {name} of another type"


def _many(file: h5py.File, chance: random.Random) -> str:
    """Add many variables."""
    for k in range(1000):
        file[f"extra{k}"] = 1.0
    return "many variables"


NETCDF: tuple[Alteration, ...] = (*ANY, *[content] * 14, netcdf, netcdf, netcdf)


CODECS: tuple[dict[str, Any], ...] = (
    {"name": "numcodecs.pickle", "configuration": {}},
    {"name": "numcodecs.json2", "configuration": {}},
    {"name": "numcodecs.msgpack2", "configuration": {}},
    {"name": "vlen-utf8", "configuration": {}},
    {"name": "vlen-bytes", "configuration": {}},
    {"name": "numcodecs.lzma", "configuration": {}},
    {"name": "numcodecs.zlib", "configuration": {"level": 99}},
    {"name": "sharding_indexed", "configuration": {}},
    {"name": "gzip", "configuration": {"level": 1}},
    {"name": "transpose", "configuration": {"order": [9, 9]}},
    {"name": "../codec", "configuration": {}},
)
"""Codecs of Zarr v3, those of numcodecs that make objects among them."""


def zarr_array(path: Path, chance: random.Random) -> str:
    """Change the metadata of one array of a Zarr store, in its own place and in that of the root."""
    if not path.is_dir():
        raise UnsuitableError
    files = sorted(path.glob("*/zarr.json"))
    if not files:
        raise UnsuitableError
    file = chance.choice(files)
    try:
        metadata = json.loads(file.read_text())
    except ValueError:
        raise UnsuitableError from None
    kind = chance.choice(("shape", "chunks", "codec", "type", "fill", "names", "shard", "transformer", "bomb"))
    shape = metadata.get("shape")
    if not isinstance(shape, list):
        raise UnsuitableError
    if kind == "shape":
        metadata["shape"] = [chance.choice((0, -1, BIG, HUGE, 2**63, 1.5, None)) for _ in shape]
    elif kind == "chunks":
        size = chance.choice((0, -1, BIG, HUGE, 1))
        metadata["chunk_grid"] = {"name": "regular", "configuration": {"chunk_shape": [size for _ in shape]}}
    elif kind == "codec":
        metadata["codecs"] = [chance.choice(CODECS), *metadata["codecs"]][: chance.choice((1, 9))]
    elif kind == "type":
        kinds = ("string", "bytes", "variable_length_bytes", "object", "|O", "bool", "complex128", "float16", "r8",
                 {"name": "fixed_length_utf32", "configuration": {"length_bytes": 4 * BIG}},
                 {"name": "null_terminated_bytes", "configuration": {"length_bytes": HUGE}},
                 {"name": "numpy.datetime64", "configuration": {"unit": "s", "scale_factor": 1}})  # fmt: skip
        metadata["data_type"] = chance.choice(kinds)
    elif kind == "fill":
        metadata["fill_value"] = chance.choice(("NaN", "Infinity", None, "0x7ff", [1], {"a": 1}, "x" * 100, 1e308))
    elif kind == "names":
        metadata["dimension_names"] = chance.choice((None, [], ["a"] * len(shape), ["../x"] * len(shape), ["a"] * 99))
    elif kind == "shard":
        inner = {"chunk_shape": [1 for _ in shape], "codecs": metadata["codecs"], "index_codecs": metadata["codecs"]}
        metadata["codecs"] = [{"name": "sharding_indexed", "configuration": inner}]
    elif kind == "transformer":
        metadata["storage_transformers"] = [{"name": "x", "configuration": {}}]
    else:
        _bomb_of(file.parent, metadata, chance)
    file.write_text(json.dumps(metadata))
    root = path / "zarr.json"
    if root.exists() and chance.random() < 0.7:
        try:
            held = json.loads(root.read_text())
            if held.get("consolidated_metadata"):
                held["consolidated_metadata"]["metadata"][file.parent.name] = metadata
                root.write_text(json.dumps(held))
        except (ValueError, KeyError, TypeError, AttributeError):
            pass
    return f"{kind} of array {file.parent.name}"


def _bomb_of(array: Path, metadata: dict[str, Any], chance: random.Random) -> None:
    """State a large chunk, or keep a small one, that a few bytes decompress to 256 MiB."""
    shape = metadata["shape"]
    if not shape:
        raise UnsuitableError
    if chance.random() < 0.5:
        metadata["shape"] = [1 << 27, *(1 for _ in shape[1:])]
        metadata["chunk_grid"] = {"name": "regular", "configuration": {"chunk_shape": metadata["shape"]}}
    name = chance.choice(("gzip", "zstd", "zstd"))
    settings = {"level": 1} | ({"checksum": False} if name == "zstd" else {})
    metadata["codecs"] = [
        {"name": "bytes", "configuration": {"endian": "little"}}, {"name": name, "configuration": settings}
    ]  # fmt: skip
    block = array / "c" / "/".join("0" for _ in shape)
    shutil.rmtree(array / "c", ignore_errors=True)
    block.parent.mkdir(parents=True)
    packer = {"gzip": GZip(level=1), "zstd": Zstd(level=1)}[name]
    block.write_bytes(packer.encode(bytes(1 << 28)))


def zarr_names(path: Path, chance: random.Random) -> str:
    """Let the names or links of a store lead out of it."""
    if not path.is_dir():
        raise UnsuitableError
    arrays = sorted(each.parent for each in path.glob("*/zarr.json"))
    if not arrays:
        raise UnsuitableError
    array = chance.choice(arrays)
    kind = chance.choice(
        ("consolidated", "link of array", "link of chunk", "link of metadata", "link of store", "loop")
    )
    outside = path.parent / "outside"
    if kind == "consolidated":
        root = json.loads((path / "zarr.json").read_text())
        held = json.loads((array / "zarr.json").read_text())
        names = ("../outside", "..", "/etc", "a/../../outside", ".", "", "a//b", "x" * 300, "a\0b", SCRIPT)
        root["consolidated_metadata"] = {"kind": "inline", "must_understand": False,
                                         "metadata": {chance.choice(names): held, array.name: held}}  # fmt: skip
        (path / "zarr.json").write_text(json.dumps(root))
    elif kind == "link of array":
        shutil.rmtree(outside, ignore_errors=True)
        array.rename(outside)
        array.symlink_to(outside)
    elif kind == "link of chunk":
        chunks = [each for each in array.rglob("*") if each.is_file() and each.name != "zarr.json"]
        if not chunks:
            raise UnsuitableError
        chunk = chance.choice(chunks)
        chunk.unlink()
        chunk.symlink_to(chance.choice(("/etc/passwd", "/dev/zero", outside)))
    elif kind == "link of metadata":
        (array / "zarr.json").unlink()
        (array / "zarr.json").symlink_to(chance.choice(("/etc/passwd", "/dev/zero")))
    elif kind == "link of store":
        shutil.rmtree(outside, ignore_errors=True)
        path.rename(outside)
        path.symlink_to(outside)
    else:
        (array / "loop").symlink_to(path)
    return f"{kind} {array.name}"


def zarr_v2(path: Path, chance: random.Random) -> str:
    """Replace a store by one of Zarr v2 with a codec that makes objects."""
    if not path.is_dir():
        raise UnsuitableError
    shutil.rmtree(path)
    codec = chance.choice(("pickle", "json2", "msgpack2", "vlen-utf8", "vlen-array", "categorize"))
    (path / "EX").mkdir(parents=True)
    (path / ".zgroup").write_text('{"zarr_format": 2}')
    (path / ".zattrs").write_text('{"schema": "errormotion.errors/1"}')
    array = {"zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "compressor": None, "fill_value": None,
             "order": "C", "filters": [{"id": codec}]}  # fmt: skip
    (path / "EX" / ".zarray").write_text(json.dumps(array))
    (path / "EX" / ".zattrs").write_text('{"_ARRAY_DIMENSIONS": ["time"]}')
    (path / "EX" / "0").write_bytes(PICKLE)
    return f"Zarr v2 with {codec}"


ZARR: tuple[Alteration, ...] = (
    *ANY, *[content] * 8, *[zarr_array] * 5, zarr_names, zarr_names, zarr_v2, json_value, json_value, json_deep,
)  # fmt: skip
