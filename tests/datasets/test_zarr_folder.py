"""Zarr folders that are read without the library give what the library gives."""

import json

import numpy as np
import pytest
import xarray as xr
import zarr
from coded import raises
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, TransposeCodec, ZstdCodec

from errormotion.datasets import load
from errormotion.datasets.storage import disk
from errormotion.datasets.storage.disk import reading
from errormotion.datasets.storage.zarr_folder import open_zarr
from errormotion.errors import DatasetError

COMPRESSORS = {"plain": None, "zstd": ZstdCodec(), "blosc": BloscCodec(cname="zstd", shuffle="bitshuffle")}


def folder(path, values, chunks, **options):
    """Write a Zarr folder with one array over dimensions a, b, c."""
    group = zarr.open_group(path, mode="w")
    array = group.create_array(
        "x", shape=values.shape, chunks=chunks, dtype=values.dtype, dimension_names="abc"[: values.ndim],
        **{"compressors": None, "fill_value": values.dtype.type(0)} | options,
    )  # fmt: skip
    array[...] = values
    return path, array


@pytest.mark.parametrize("compressor", COMPRESSORS)
@pytest.mark.parametrize(
    ("shape", "chunks"),
    [
        ((), ()), ((7,), (3,)), ((50_000,), (20_000,)), ((5, 60_000), (5, 25_000)), ((5, 60_000), (2, 60_000)),
        ((60_000, 5), (25_000, 5)), ((60_000, 5), (25_000, 2)), ((4, 3, 20_000), (3, 3, 20_000)),
        ((6, 7, 8), (2, 3, 8)), ((3, 40, 900), (1, 40, 900)),
    ],
)  # fmt: skip
def test_every_window_of_every_layout_is_what_the_library_reads(tmp_path, shape, chunks, compressor) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=shape).astype(np.float32)
    path, array = folder(tmp_path / "x.zarr", values, chunks, compressors=COMPRESSORS[compressor])
    ds = open_zarr(path)
    assert ds is not None
    np.testing.assert_array_equal(ds["x"].values, array[...])
    assert ds["x"].encoding["preferred_chunks"] == dict(zip("abc", chunks, strict=False))
    for _ in range(20):
        key = []
        for size in shape:
            a, b = sorted(rng.integers(0, size + 1, 2))
            step = int(rng.choice([1, 1, 1, 3, -1, -2]))
            run = slice(int(a), int(b), step) if step > 0 else slice(int(b), int(a), step)
            key.append([run, int(rng.integers(size)), rng.integers(0, size, 4)][int(rng.choice([0, 0, 0, 1, 2]))])
        found = ds["x"][tuple(key)].values if shape else ds["x"].values
        np.testing.assert_array_equal(found, xr.DataArray(values, dims=ds["x"].dims)[tuple(key)].values)


@pytest.mark.parametrize("dtype", ["bool", "int8", "uint16", "int32", "int64", "float16", "float32", "float64"])
def test_every_type_of_number_comes_back(tmp_path, dtype) -> None:
    values = np.arange(-3, 9).reshape(3, 4).astype(dtype)
    ds = open_zarr(folder(tmp_path / "x.zarr", values, (2, 4))[0])
    assert ds is not None
    assert ds["x"].dtype == dtype
    np.testing.assert_array_equal(ds["x"].values, values)


@pytest.mark.parametrize("fill", [np.nan, np.inf, -np.inf, 2.5])
def test_a_chunk_without_a_file_holds_the_fill_value(tmp_path, fill) -> None:
    values = np.arange(40_000.0)
    path, array = folder(tmp_path / "x.zarr", values, (10_000,), fill_value=fill)
    (path / "x" / "c" / "1").unlink()
    ds = open_zarr(path)
    assert ds is not None
    np.testing.assert_array_equal(ds["x"].values, array[...])
    assert (ds["x"].values[10_000:20_000] == fill).all() or np.isnan(ds["x"].values[10_000:20_000]).all()


def test_packed_readings_are_unpacked(tmp_path) -> None:
    values = np.where(np.arange(1000) % 7, np.arange(1000) * 1e-8, np.nan)
    packing = {"dtype": "int16", "scale_factor": 1e-8, "add_offset": 0.0, "_FillValue": -32768}
    path = tmp_path / "x.zarr"
    xr.Dataset({"x": ("time", values)}).to_zarr(path, zarr_format=3, consolidated=False, encoding={"x": packing})
    ds = open_zarr(path)
    assert ds is not None
    xr.testing.assert_identical(ds.load(), xr.open_zarr(path, consolidated=False).load())


@pytest.mark.parametrize("attribute", [np.nan, -999.0])
def test_a_missing_value_of_floating_numbers_is_masked(tmp_path, attribute) -> None:
    values = np.array([1.0, np.nan, 3.0])
    path = tmp_path / "x.zarr"
    ds = xr.Dataset({"x": ("time", values)})
    ds.to_zarr(path, zarr_format=3, consolidated=False, encoding={"x": {"_FillValue": attribute}})
    found = open_zarr(path)
    assert found is not None
    xr.testing.assert_identical(found.load(), xr.open_zarr(path, consolidated=False).load())


@pytest.mark.parametrize(
    "options",
    [
        {"compressors": [ZstdCodec(), Crc32cCodec()]},
        {"filters": [TransposeCodec(order=(1, 0))]},
        {"serializer": BytesCodec(endian="big")},
        {"chunk_key_encoding": {"name": "v2", "separator": "."}},
        {"chunk_key_encoding": {"name": "default", "separator": "."}},
    ],
    ids=str,
)
def test_what_this_reader_does_not_know_is_left_to_the_library(tmp_path, options) -> None:
    values = np.arange(12.0).reshape(3, 4)
    path, _ = folder(tmp_path / "x.zarr", values, (2, 4), **options)
    assert open_zarr(path) is None
    np.testing.assert_array_equal(load(path)["x"].values, values)


def test_consolidated_metadata_count_before_those_of_the_arrays(tmp_path) -> None:
    path, array = folder(tmp_path / "x.zarr", np.arange(10.0), (4,))
    root = json.loads((path / "zarr.json").read_text())
    metadata = {"x": json.loads((path / "x" / "zarr.json").read_text())}
    held = {"kind": "inline", "must_understand": False, "metadata": metadata}
    (path / "zarr.json").write_text(json.dumps(root | {"consolidated_metadata": held}))
    array.resize(12)
    ds = open_zarr(path)
    assert ds is not None
    assert ds.sizes["a"] == 10


@pytest.mark.parametrize("compressor", COMPRESSORS)
@pytest.mark.parametrize("size", [0, 20, -4, 4])
def test_a_chunk_of_another_length_is_damaged(tmp_path, compressor, size) -> None:
    path, _ = folder(tmp_path / "x.zarr", np.arange(40_000.0), (20_000,), compressors=COMPRESSORS[compressor])
    chunk = path / "x" / "c" / "0"
    content = chunk.read_bytes()
    chunk.write_bytes(b"" if size == 0 else content[:size] if size != 4 or compressor != "plain" else content + b"more")
    ds = open_zarr(path)
    assert ds is not None
    with pytest.raises(DatasetError, match=r"x\.zarr: is damaged or incomplete.*x.c.0"), reading(path):
        ds["x"][5:8].values  # noqa: B018
    with pytest.raises(DatasetError, match=r"x\.zarr: is damaged or incomplete.*x.c.0"), reading(path):
        ds["x"].values  # noqa: B018


def test_texts_come_back_and_damaged_ones_are_refused(tmp_path) -> None:
    ds = xr.Dataset({"name": ("k", np.array(["", "µm", "a longer text", "\N{GREEK SMALL LETTER MU}"], object))})
    path = tmp_path / "x.zarr"
    ds.to_zarr(path, zarr_format=3, consolidated=False, encoding={"name": {"compressors": None}})
    found = open_zarr(path)
    assert found is not None
    assert found["name"].values.tolist() == ds["name"].values.tolist()
    chunk = path / "name" / "c" / "0"
    content = chunk.read_bytes()
    longer, other = content[:4] + b"\xff" + content[5:], content[:9] + b"\xff" + content[10:]
    for damaged in (b"", content[:-3], b"\x05" + content[1:], longer, other):
        chunk.write_bytes(damaged)
        with raises("file.damaged"):
            load(path)


def test_a_folder_of_the_library_is_read_the_same_with_and_without_it(tmp_path, monkeypatch, errors) -> None:
    path = disk.save(errors(unseen=(5,)), tmp_path / "errors.zarr")
    ours = load(path)
    monkeypatch.setattr(disk, "open_zarr", lambda _: None)
    xr.testing.assert_identical(ours, load(path))
