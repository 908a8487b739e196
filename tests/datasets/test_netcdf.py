"""NetCDF-4 files agree with the reader and writer of xarray, and each object is looked up once."""

import io
import pickle
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from errormotion.datasets.storage import netcdf
from errormotion.datasets.storage.compression import encoding
from errormotion.datasets.storage.disk import storable
from errormotion.datasets.storage.netcdf import compose_netcdf, open_netcdf

PLAIN = {"decode_times": False, "decode_timedelta": False, "create_default_indexes": False}


def example(kind: str) -> xr.Dataset:
    rng = np.random.default_rng(5)
    if kind == "empty":
        return xr.Dataset()
    if kind == "dimension named like a variable of others":
        return xr.Dataset({"x": (("y", "z"), rng.normal(size=(2, 3)))}, coords={"y": [1.0, 2.0]}, attrs={"n": [1, 2]})
    if kind == "variable named like its last dimension":
        return xr.Dataset({"x": (("y", "x"), rng.normal(size=(2, 3))), "z": ("x", [1, 2, 3])}, coords={"y": [1.0, 2.0]})
    if kind == "variable named like its first dimension":
        return xr.Dataset({"x": (("x", "y"), rng.normal(size=(2, 3)))}, coords={"y": ["a", "b", "c"]})
    if kind == "coordinates after the variables that use them":
        return xr.Dataset({"a": (("t", "s"), rng.normal(size=(4, 2))), "b": ("s", [1, 2]), "t": ("t", np.arange(4.0))})
    return xr.Dataset(
        {
            "value": (("place", "freedom"), rng.normal(size=(6, 3)), {"units": "m"}),
            "long": (("place", "k"), rng.normal(size=(6, 4000))),
            "count": ("place", np.arange(6)),
            "gap": ("place", [1.0, np.nan, 2.0, 3.0, 4.0, 5.0]),
            "whether": ("place", [True, False] * 3),
            "alone": ((), 4.5),
            "none": ("nothing", np.zeros(0)),
        },
        coords={
            "freedom": ["EX", "EY", "EZ"],
            "place": np.linspace(0, 1, 6),
            "name": ("place", ["a", "ö", "", "b", "c", "d"]),
        },
        attrs={"schema": "other", "notes": ["one", "two"], "number": 3, "rate": 2.5, "long": "ü" * 400},
    ).drop_vars("none" if kind == "usual" else [])


KINDS = (
    "empty",
    "dimension named like a variable of others",
    "variable named like its last dimension",
    "variable named like its first dimension",
    "coordinates after the variables that use them",
    "dimension without places",
    "usual",
)
COMPRESSED = {"zlib": True, "complevel": 1, "shuffle": True, "chunksizes": (1, 4000)}


def by_xarray(ds: xr.Dataset, how: Mapping[str, Any] | None = None) -> bytes:
    composed = io.BytesIO()
    ds.to_netcdf(composed, engine="h5netcdf", encoding=encoding(ds) if how is None else how)
    return composed.getvalue()


LINKS = ("CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "_Netcdf4Dimid", "_Netcdf4Coordinates")


def content(data: bytes) -> dict[str, Any]:
    """Return all that a file has: its objects in order, and their values, types, filters, attributes and links."""
    with h5py.File(io.BytesIO(data)) as file:
        return {name: (list(file), *_described(file, each)) for name, each in [("/", file), *file.items()]}


def _described(file: h5py.File, each: h5py.File | h5py.Dataset) -> Iterator[Any]:
    yield [name for name in each.attrs if name not in LINKS]
    for name in sorted(each.attrs):
        value, kind = each.attrs[name], h5py.h5a.open(each.id, name.encode())
        if name == "DIMENSION_LIST":
            yield name, [[file[link].name for link in links] for links in value]
        elif name == "REFERENCE_LIST":
            yield name, sorted((file[link].name, int(axis)) for link, axis in value)
        else:
            yield name, repr(np.asarray(value).tolist()), kind.dtype, kind.shape, h5py.check_string_dtype(kind.dtype)
    if isinstance(each, h5py.Dataset):
        yield each.shape, each.maxshape, each.dtype, h5py.check_string_dtype(each.dtype), repr(each.fillvalue)
        yield each.chunks, each.compression, each.compression_opts, each.shuffle, each.fletcher32
        yield each.id.get_create_plist().get_attr_creation_order(), repr(np.asarray(each[()]).tolist())


@pytest.mark.parametrize("kind", KINDS)
def test_files_have_the_content_of_those_of_xarray(kind: str) -> None:
    ready = storable(example(kind))
    how = {"long": COMPRESSED} if kind == "usual" else {}
    assert content(compose_netcdf(ready, how)) == content(by_xarray(ready, how))


@pytest.mark.parametrize("kind", KINDS)
def test_files_are_read_as_xarray_reads_them(kind: str, tmp_path: Path) -> None:
    file = tmp_path / "some.nc"
    file.write_bytes(by_xarray(storable(example(kind))))
    with open_netcdf(file) as found, xr.open_dataset(file, engine="h5netcdf", **PLAIN) as expected:
        assert found.encoding["source"] == expected.encoding["source"]
        for name in expected.variables:
            assert repr(found[name].encoding) == repr(expected[name].encoding)  # a fill value is NaN
        xr.testing.assert_identical(found.load(), expected.load())


def _group(file: h5py.File) -> None:
    file.create_group("more")


def _fixed_text(file: h5py.File) -> None:
    file["long"].attrs["units"] = np.bytes_("mm")


def _other_byte_order(file: h5py.File) -> None:
    file.create_dataset("turned", data=np.arange(6, dtype=">f8")).dims[0].attach_scale(file["place"])


def _without_identifiers(file: h5py.File) -> None:
    del file["long"].attrs["_Netcdf4Coordinates"]


def test_usual_datasets_are_written_without_h5netcdf(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(netcdf, "H5NetCDFStore", None)
    ready = storable(example("usual"))
    assert compose_netcdf(ready, encoding(ready))


def test_arrays_of_dask_are_written(tmp_path: Path) -> None:
    ds = xr.Dataset({"v": (("t", "s"), np.arange(12.0).reshape(4, 3)), "n": ("t", [1, 2, 3, 4])})
    (tmp_path / "some.nc").write_bytes(compose_netcdf(ds.chunk({"t": 2}), {}))
    with open_netcdf(tmp_path / "some.nc") as found:
        xr.testing.assert_equal(found.load(), ds)


def test_a_dimension_that_no_file_can_have_is_refused() -> None:
    with pytest.raises(ValueError, match="Forward slashes"):
        compose_netcdf(xr.Dataset({"v": ("m/s", [1.0, 2.0])}), {})


@pytest.mark.parametrize(("dtype", "fill"), [("u1", -1), ("i2", 100_000), ("f8", "nan"), ("f4", -9)])
def test_fill_values_are_those_of_xarray(dtype: str, fill: object) -> None:
    ds = xr.Dataset({"v": ("t", np.array([1, 2], dtype), {"_FillValue": fill})})
    assert content(compose_netcdf(ds, {})) == content(by_xarray(ds, {}))


@pytest.mark.parametrize("change", [_group, _fixed_text, _other_byte_order, _without_identifiers])
def test_files_of_other_programs_are_read_as_xarray_reads_them(
    change: Callable[[h5py.File], None], tmp_path: Path
) -> None:
    file = tmp_path / "some.nc"
    file.write_bytes(by_xarray(storable(example("usual"))))
    with h5py.File(file, "r+") as written:
        change(written)
    with open_netcdf(file) as found, xr.open_dataset(file, engine="h5netcdf", **PLAIN) as expected:
        xr.testing.assert_identical(found.load(), expected.load())


def test_an_open_file_can_be_sent_to_another_process(tmp_path: Path) -> None:
    file = tmp_path / "some.nc"
    file.write_bytes(by_xarray(storable(example("usual"))))
    with open_netcdf(file) as found, pickle.loads(pickle.dumps(found)) as other:
        xr.testing.assert_identical(found.load(), other.load())


def test_each_object_is_looked_up_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ds = storable(example("usual"))
    lookups, plain = [], h5py.Group._get
    monkeypatch.setattr(h5py.Group, "_get", lambda *args, **kwargs: lookups.append(args) or plain(*args, **kwargs))

    def count(act: object) -> float:
        lookups.clear()
        act()  # type: ignore[operator]
        return len(lookups) / len(ds.variables)

    file = tmp_path / "some.nc"
    ours = count(lambda: file.write_bytes(compose_netcdf(ds, encoding(ds))))
    assert ours < count(lambda: by_xarray(ds)) / 2

    def read() -> None:
        with open_netcdf(file) as found:
            found.load()

    assert count(read) < 3  # to describe it, and for its values
