import json

import numpy as np
import pytest
import xarray as xr
from pydantic import BaseModel

from errormotion.datasets import hash_dataset, load, provenance, save
from errormotion.datasets.units import Length


class Settings(BaseModel):
    radius: Length = 0.005
    limit: float = float("inf")


def test_provenance_holds_settings_with_defaults_hash_and_software(drift) -> None:
    raw = drift()
    found = provenance.make(Settings(), raw, [{"serial_number": "7"}], seed=3, steps=("averaged",))
    assert found["settings"] == {"radius": 0.005, "limit": "inf"}
    assert found["raw"] == {"schema": raw.attrs["schema"], "hash": hash_dataset(raw)}
    assert found["instruments"] == [{"serial_number": "7"}]
    assert {"errormotion", "numpy", "python"} <= set(found["software"])
    assert (found["seed"], found["steps"]) == (3, ["averaged"])
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_the_same_work_has_the_same_provenance(drift) -> None:
    assert provenance.make(Settings(), drift(), []) == provenance.make(Settings(), drift(), [])


def test_instruments_come_from_the_raw_dataset_unless_given(drift) -> None:
    raw = drift().assign_attrs(instruments=json.dumps([{"address": "sim://a"}]))
    assert provenance.make({}, raw, None)["instruments"] == [{"address": "sim://a"}]
    assert provenance.make({}, raw, [])["instruments"] == []


def test_an_error_dataset_carries_its_provenance(errors) -> None:
    assert provenance.of(errors())["settings"] == {"average": 0.5}


def test_the_hash_does_not_depend_on_format_chunks_byte_order_or_width_of_texts(drift, tmp_path, monkeypatch) -> None:
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
    monkeypatch.setattr(provenance, "_BLOCK", 2**10)
    assert hash_dataset(ds) == hash_dataset(ds)


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
def test_whatever_changes_changes_the_hash(drift, change) -> None:
    assert hash_dataset(change(drift())) != hash_dataset(drift())


def test_a_nan_is_a_nan_whatever_its_bits() -> None:
    one = xr.Dataset({"a": ("x", np.array([np.nan]))})
    other = xr.Dataset({"a": ("x", np.array([0xFFF8000000000001], dtype=np.uint64).view(float))})
    assert hash_dataset(one) == hash_dataset(other)
