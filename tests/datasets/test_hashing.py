import hashlib
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import xarray as xr
from blake3 import blake3
from coded import raises

from errormotion.datasets import hash_dataset, load, save
from errormotion.datasets.files.hashing import LEAF, DatasetHasher, has_hash


def record(samples: int = 3 * LEAF + 777, seed: int = 0) -> xr.Dataset:
    """Five channels and two temperatures, each longer than a leaf, with lost samples."""
    rng = np.random.default_rng(seed)
    distance = rng.normal(size=(5, samples)).astype("f4")
    distance[2, 5::1000] = np.nan
    return xr.Dataset(
        {
            "distance": (("channel", "time"), distance, {"units": "m"}),
            "temperature": (("time", "sensor"), rng.normal(size=(samples, 2))),
            "level": ("height", [0.01, 0.05]),
        },
        attrs={"sample_rate": 20e3},
    )


def defined(variable: xr.Variable, new: Callable) -> bytes:
    """The digests of the leaves of a numeric variable by the definition, value by value."""
    values = variable.values
    axis, inner = values.ndim, 1
    while axis and inner * values.shape[axis - 1] <= LEAF:
        axis -= 1
        inner *= values.shape[axis]
    if axis == 0:
        return new(values.tobytes()).digest() if values.size else b""
    rows = values.reshape(-1, values.shape[axis - 1], inner)
    step = LEAF // inner
    leaves = [row[k : k + step] for row in rows for k in range(0, row.shape[0], step)]
    return b"".join(new(leaf.tobytes()).digest() for leaf in leaves)


@pytest.mark.parametrize(
    "shape",
    [
        (),
        (0,),
        (3, 0),
        (0, 2 * LEAF),
        (7,),
        (LEAF,),
        (LEAF + 1,),
        (5, 2 * LEAF + 3),
        (LEAF, 5),
        (3, 400, 300),
        (2, 3, 99000),
    ],
)
@pytest.mark.parametrize("dtype", ["<f4", "<f8", "<u2"])
@pytest.mark.parametrize(("form", "new"), [("blake3-tree", blake3), ("sha256-tree", hashlib.sha256)])
def test_the_hash_is_the_one_that_is_defined(shape, dtype, form, new) -> None:
    values = np.random.default_rng(1).integers(0, 1000, shape).astype(dtype)
    ds = xr.Dataset({"a": ([f"d{k}" for k in range(len(shape))], values)}, attrs={"machine": "m"})
    lines = [["attributes", {"machine": "m"}], ["a", list(ds["a"].dims), list(shape), dtype, {}]]
    text = "".join(json.dumps(line) + "\n" for line in lines).encode()
    assert hash_dataset(ds, form) == f"{form}:" + new(text + defined(ds["a"].variable, new)).hexdigest()
    assert has_hash(ds, hash_dataset(ds, form))
    assert hash_dataset(ds).startswith("blake3-tree:")


@pytest.mark.parametrize("step", [LEAF, 2 * LEAF, 1000, LEAF + 1, 10**6])
def test_supplied_parts_result_in_the_same_hash_and_are_not_read_again(step) -> None:
    ds = record()
    unreadable = ds.map(lambda each: xr.zeros_like(each) if "time" in each.dims else each, keep_attrs=True)
    with DatasetHasher(unreadable) as hasher:
        for start in range(0, ds.sizes["time"], step):
            window = slice(start, start + step)
            part = ds.isel(time=window)
            for name in ("distance", "temperature"):
                hasher.update(name, part[name].values, time=window)
        assert hasher.value() == hash_dataset(ds)


@pytest.mark.parametrize("step", [LEAF, 1000, LEAF + 1, 40_001])
def test_parts_may_come_in_any_order_from_several_threads(step) -> None:
    ds = record()
    unreadable = ds.map(lambda each: xr.zeros_like(each) if "time" in each.dims else each, keep_attrs=True)
    starts = np.random.default_rng(0).permutation(np.arange(0, ds.sizes["time"], step))
    with DatasetHasher(unreadable) as hasher, ThreadPoolExecutor(4) as pool:

        def hand_over(start: int) -> None:
            window = slice(start, start + step)
            for name in ("distance", "temperature"):
                hasher.update(name, ds.isel(time=window)[name].values, time=window)

        list(pool.map(hand_over, starts.tolist()))
        assert hasher.value() == hash_dataset(ds)


def test_what_is_not_handed_over_is_read() -> None:
    ds = record()
    with DatasetHasher(ds) as hasher:
        hasher.update("distance", ds["distance"].values[:, :1000], time=slice(0, 1000))
        hasher.update("distance", ds["distance"].values[:, 5000:], time=slice(5000, None))
        hasher.update("distance", ds["distance"].values[:, 800:1200], time=slice(800, 1200))  # a part of it twice
        hasher.update("temperature", ds["temperature"].values[:, :1], sensor=slice(0, 1))
        assert hasher.value() == hash_dataset(ds)


@pytest.mark.parametrize("chunks", [(1, 50_000), (5, 4096), (2, 300_000)])
def test_the_chunks_of_a_large_store_do_not_matter(chunks, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("errormotion.datasets.files.hashing._TILE", 2**18)
    ds = record()
    ds.to_zarr(tmp_path / "raw.zarr", consolidated=False, encoding={"distance": {"chunks": chunks}})
    with xr.open_zarr(tmp_path / "raw.zarr", consolidated=False, chunks=None) as back:
        assert hash_dataset(back) == hash_dataset(ds)
    assert hash_dataset(ds.chunk({"time": 30_000})) == hash_dataset(ds)


def test_each_chunk_of_a_store_is_read_once(tmp_path, monkeypatch) -> None:
    import zarr

    monkeypatch.setattr("errormotion.datasets.files.hashing._TILE", 2**18)
    record().to_zarr(tmp_path / "raw.zarr", consolidated=False, encoding={"distance": {"chunks": (5, 20_000)}})
    read: list[str] = []
    get = zarr.storage.LocalStore.get

    async def counted(self, key, *arguments, **keywords):
        read.append(key)
        return await get(self, key, *arguments, **keywords)

    with xr.open_zarr(tmp_path / "raw.zarr", consolidated=False, chunks=None) as back:
        monkeypatch.setattr(zarr.storage.LocalStore, "get", counted)
        hash_dataset(back)
    chunks = [key for key in read if key.startswith("distance/c/")]
    assert len(chunks) == len(set(chunks)) == 10


def test_a_hash_of_the_first_form_is_still_recognised() -> None:
    ds = xr.Dataset(
        {"a": (("x", "t"), np.arange(12.0).reshape(3, 4)), "n": ("t", list("pqrs")), "b": 3}, attrs={"k": 1.5}
    )
    large = xr.Dataset({"a": (("x", "t"), (np.arange(3_000_000) % 977).astype("f4").reshape(3, -1))})
    # As version 0.1.0 wrote them.
    stored = "sha256:ed2fd7300a6282dac36284f5d1c0079eedec5e4b25bfe1adc3a8d7d6abb7b400"
    stored_large = "sha256:9a14978dea8c2cc4ed25ac965c07d6cc1b9fdd821a84a26e5bd4cb821a3b7187"
    assert has_hash(ds, stored)
    assert has_hash(large, stored_large)
    assert has_hash(ds, hash_dataset(ds))
    assert not has_hash(large, stored)
    assert not has_hash(ds, "md5:0")
    with raises("hash.form.unknown"):
        hash_dataset(ds, "md5")


def test_the_hash_does_not_depend_on_format_chunks_byte_order_or_width_of_texts(drift, tmp_path) -> None:
    ds = drift(n=5000)
    expected = hash_dataset(ds)
    for name in ("a.nc", "a.zarr"):
        with load(save(ds, tmp_path / name)) as back:
            assert hash_dataset(back) == expected
    encoding = {"distance": {"chunks": (2, 700)}}
    ds.drop_vars(["channel", "direction", "height", "sensor"]).to_zarr(
        tmp_path / "b.zarr", consolidated=False, encoding=encoding
    )
    texts = {name: ds[name] for name in ("channel", "direction", "height", "sensor")}
    with xr.open_zarr(tmp_path / "b.zarr", consolidated=False, chunks=None, decode_times=False) as back:
        assert hash_dataset(back.assign_coords(texts)) == expected
    swapped = ds.assign(distance=ds["distance"].astype(">f8")).assign_coords(channel=ds["channel"].astype("U9"))
    assert hash_dataset(swapped) == expected


def test_the_hash_of_evenly_spaced_times_reads_none_of_them(drift, tmp_path) -> None:
    ds = drift(n=40).drop_vars(["time", "temperature"]).assign_attrs(sample_rate=20e3, time_start=0.0)
    with load(save(ds, tmp_path / "raw.zarr")) as back:
        assert hash_dataset(back) == hash_dataset(ds)
        assert not back["time"].variable._in_memory


@pytest.mark.parametrize(
    "change",
    [
        lambda ds: ds.assign(bar_radius=0.0050000001),
        lambda ds: ds.assign(distance=ds["distance"].astype("f4")),
        lambda ds: ds.assign(distance=ds["distance"].transpose("time", "channel")),
        lambda ds: ds.rename(bar_radius="radius"),
        lambda ds: ds.assign_attrs(machine="another"),
        lambda ds: ds.assign_coords(channel=["X1", "X2", "Y1", "Y2", "W"]),
        lambda ds: ds.assign(distance=ds["distance"].where(ds["time"] != 10.0)),
    ],
)
def test_any_change_changes_the_hash(drift, change) -> None:
    assert hash_dataset(change(drift())) != hash_dataset(drift())


def test_the_bits_of_a_nan_do_not_change_the_hash() -> None:
    one = xr.Dataset({"a": ("x", np.array([np.nan]))})
    other = xr.Dataset({"a": ("x", np.array([0xFFF8000000000001], dtype=np.uint64).view(float))})
    assert hash_dataset(one) == hash_dataset(other)
