"""Small files that state or contain gigabytes are refused before a library reads them; ordinary ones are read."""

import json
import struct
import tracemalloc
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from numcodecs import Blosc, Zstd

from errormotion.datasets.storage.disk import load, save
from errormotion.errors import DatasetError

TEXTS, LENGTH = 20_000, 100_000  # 2 GB of texts in 0.4 MB
MAX_MEMORY = 64 << 20


def refuse(path: Path, match: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match=match):
            load(path)
        assert tracemalloc.get_traced_memory()[1] < MAX_MEMORY
    finally:
        tracemalloc.stop()


def references(raw: bytes) -> list[int]:
    """Return the places of all references to the heaps: length, address, index."""
    heaps, at = set(), raw.find(b"GCOL")
    while at >= 0:
        heaps.add(at)
        at = raw.find(b"GCOL", at + 4)
    found = []
    for heap in heaps:
        at = raw.find(struct.pack("<Q", heap))
        while at >= 4:
            found.append(at - 4)
            at = raw.find(struct.pack("<Q", heap), at + 1)
    return found


def shared(path: Path, **options: object) -> None:
    """Write texts, then make all references name the longest text."""
    texts = np.array(["a", *(f"{k}" for k in range(TEXTS - 1))], object)
    with h5py.File(path, "w") as file:
        file.create_dataset("long", data="x" * LENGTH, dtype=h5py.string_dtype())
        if options.pop("attribute", False):
            file.create_dataset("n", data=1.0).attrs.create("many", texts[:4000], dtype=h5py.string_dtype())
        else:
            variable = file.create_dataset("t", (TEXTS,), h5py.string_dtype(), **options)
            variable[:] = texts
    raw = bytearray(path.read_bytes())
    places = references(bytes(raw))
    [longest] = [raw[at : at + 16] for at in places if raw[at : at + 4] == struct.pack("<I", LENGTH)]
    for at in places:
        raw[at : at + 16] = longest
    path.write_bytes(raw)


@pytest.mark.parametrize(
    "options", [{}, {"chunks": (5000,)}, {"attribute": True}, {"chunks": (500,), "compression": 1}]
)
def test_texts_that_share_one_object_of_the_heap_are_refused(tmp_path: Path, options: dict[str, object]) -> None:
    path = tmp_path / "texts.nc"
    if "compression" in options:  # references in compressed chunks cannot be altered in place: the limit is a bound
        with h5py.File(path, "w") as file:
            file.create_dataset("long", data="x" * LENGTH, dtype=h5py.string_dtype())
            file.create_dataset("t", (TEXTS,), h5py.string_dtype(), **options)[:] = "a"
    else:
        shared(path, **options)
    refuse(path, r"expected at most \d+ bytes of values .* it states")


def test_many_texts_and_long_texts_are_read(tmp_path: Path) -> None:
    names = np.array([f"sensor {k}" for k in range(50_000)])
    ds = xr.Dataset({"value": ("name", np.zeros(names.size))}, {"name": names})
    ds.attrs = {f"text {k}": "x" * 20_000 for k in range(300)}
    path = save(ds, tmp_path / "texts.nc")
    with load(path) as found:
        assert found["name"].values.tolist() == names.tolist()
        assert found.attrs == ds.attrs


@pytest.mark.parametrize("filters", [{}, {"shuffle": True}, {"fletcher32": True}])
def test_chunks_that_contain_more_than_they_state_are_refused(tmp_path: Path, filters: dict[str, bool]) -> None:
    path = tmp_path / "deflated.nc"
    with h5py.File(path, "w") as file:
        variable = file.create_dataset("v", (4000,), "f8", chunks=(1000,), compression=1, **filters)
        variable[:] = np.arange(4000)
        variable.id.write_direct_chunk((2000,), zlib.compress(bytes(200_000_000), 9))
    refuse(path, r"'v': expected chunks of at most 80\d\d bytes; found one that contains more")


def test_other_filters_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "lzf.nc"
    with h5py.File(path, "w") as file:
        file.create_dataset("v", data=np.zeros(4000), chunks=(1000,), compression="lzf")
    refuse(path, "compressed by deflate")


@pytest.mark.parametrize("checked", [False, True])
def test_compressed_values_are_read(tmp_path: Path, checked: bool) -> None:
    path, values = tmp_path / "values.nc", np.random.default_rng(0).normal(size=(300, 100))
    with h5py.File(path, "w") as file:
        file["y"], file["x"] = np.arange(300.0), np.arange(100.0)
        file["y"].make_scale("y")
        file["x"].make_scale("x")
        options = {"chunks": (7, 100), "compression": 1, "shuffle": True, "fletcher32": checked}
        variable = file.create_dataset("v", data=values, **options)
        for axis, name in enumerate("yx"):
            variable.dims[axis].attach_scale(file[name])
        variable.id.write_direct_chunk((7, 0), values[7:14].tobytes(), filter_mask=0b111 if checked else 0b11)
    with load(path) as found:
        np.testing.assert_array_equal(found["v"].values, values)


def zarr(path: Path, codecs: list[str], pack) -> Path:
    """Write a Zarr folder of one array with codecs, and alter its first chunk."""
    save(xr.Dataset({"v": ("x", np.zeros(1000))}), path)
    file = path / "v" / "zarr.json"
    metadata = json.loads(file.read_text())
    known = {each["name"]: each for each in metadata["codecs"]}
    known["blosc"] = {"name": "blosc", "configuration": {"cname": "zstd", "clevel": 5, "shuffle": "noshuffle",
                                                         "typesize": 8, "blocksize": 0}}  # fmt: skip
    metadata["codecs"] = [known.get(name, {"name": name, "configuration": {}}) for name in codecs]
    file.write_text(json.dumps(metadata))
    chunk = path / "v" / "c" / "0"
    chunk.parent.mkdir(exist_ok=True)
    chunk.write_bytes(pack(bytes(8000)))
    return path


def test_further_frames_of_a_chunk_are_refused(tmp_path: Path) -> None:
    bomb = Zstd(level=19).encode(bytes(500_000_000))
    for codecs, end in ((["bytes", "zstd"], b""), (["bytes", "zstd", "crc32c"], b"1234")):
        path = zarr(
            tmp_path / f"{len(codecs)}.zarr", codecs, lambda values, end=end: Zstd().encode(values) + bomb + end
        )
        refuse(path, "expected a chunk of one Zstandard frame; found more behind it")
    skippable = b"\x50\x2a\x4d\x18" + struct.pack("<I", 4) + b"skip"
    refuse(
        zarr(tmp_path / "skip.zarr", ["bytes", "zstd"], lambda values: Zstd().encode(values) + skippable),
        "expected a chunk of one Zstandard frame",
    )


@pytest.mark.parametrize("codecs", [["bytes", "blosc", "zstd"], ["bytes", "zstd", "blosc"]])
def test_a_compressor_within_another_is_refused(tmp_path: Path, codecs: list[str]) -> None:
    inner, outer = (Blosc(), Zstd()) if codecs[1] == "blosc" else (Zstd(), Blosc())
    path = zarr(tmp_path / "twice.zarr", codecs, lambda values: bytes(outer.encode(inner.encode(values))))
    refuse(path, "one of blosc and zstd at most")


@pytest.mark.parametrize("codecs", [["bytes", "zstd"], ["bytes", "blosc"], ["bytes", "zstd", "crc32c"]])
def test_one_frame_is_read(tmp_path: Path, codecs: list[str]) -> None:
    values = np.random.default_rng(0).normal(size=60_000)
    path = tmp_path / "values.zarr"
    options = {"cname": "zstd", "clevel": 5, "shuffle": "shuffle", "typesize": 8, "blocksize": 0}
    xr.Dataset({"v": ("x", values)}).chunk().to_zarr(
        path,
        zarr_format=3,
        consolidated=False,
        encoding={"v": {"compressors": [_codec(name, options) for name in codecs[1:]]}},
    )
    with load(path) as found:
        np.testing.assert_array_equal(found["v"].values, values)


def _codec(name: str, options: dict[str, object]) -> object:
    from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

    return {"zstd": ZstdCodec, "crc32c": Crc32cCodec}[name]() if name != "blosc" else BloscCodec(**options)
