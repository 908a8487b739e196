"""The raw store contains the appended data, whichever write was the last."""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.campaign.storage import store as store_module
from errormotion.campaign.storage.store import RawStore, committed_length
from errormotion.errors import RunError

RATE = 1000.0
LSB = 3.1e-8  # m; a step of a 16 bit sensor of 2 mm range


def test_a_new_store_is_synchronised_before_it_is_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: set[str] = set()
    monkeypatch.setattr(store_module, "_sync", lambda path: synced.add(str(path)))
    RawStore.create(tmp_path / "raw.zarr", chunk(0, 10), "time", 1.0)
    files = {str(tmp_path / "raw.zarr.part" / name) for name in ("zarr.json", "distance/zarr.json", "level/c/0")}
    assert synced >= files | {str(tmp_path / "raw.zarr.part"), str(tmp_path)}


def chunk(first: int, n: int, packed: bool = True) -> xr.Dataset:
    """Five channels, two temperatures; every sample differs from its neighbours."""
    index = np.arange(first, first + n)
    distance = (np.arange(5)[:, None] * 1000 + index % 60000) * LSB
    distance[2, index % 17 == 0] = np.nan
    raw = xr.Dataset(
        {
            "distance": (("channel", "time"), distance, {"units": "m"}),
            "temperature": (("time", "sensor"), np.column_stack([20 + index / 7, index / 3]), {"units": "degC"}),
            "level": ("height", [0.01, 0.05]),
        },
        coords={"channel": ["X1", "X2", "Y1", "Y2", "Z"], "sensor": ["frame", "column"]},
        attrs={
            "schema": "test",
            "sample_rate": RATE,
            "time_start": first / RATE,
            "dropped": 1,
            "invalid": '{"dark": 3}',
        },
    )
    if packed:
        raw["distance"].encoding = {"dtype": "uint16", "scale_factor": LSB, "add_offset": 0.0, "_FillValue": 65535}
    return raw


def fill(path: Path, lengths: list[int], expected: float, packed: bool = True) -> xr.Dataset:
    """Append chunks of these lengths, commit each, and return what was appended."""
    first, store = 0, None
    for n in lengths:
        part = chunk(first, n, packed)
        store = store or RawStore.create(path, part, "time", expected / RATE)
        store.append(part)
        store.commit()
        first += n
    return chunk(0, first, packed)


def same(path: Path, wanted: xr.Dataset) -> None:
    with datasets.load(path) as found:
        for name in wanted.variables:
            np.testing.assert_array_equal(found[name].values, wanted[name].values, err_msg=str(name))


@pytest.mark.parametrize("lengths", [[64], [1, 2, 3, 250], [100] * 7, [300, 1]])
@pytest.mark.parametrize("packed", [True, False])
def test_appended_data_are_read_back_exactly(tmp_path: Path, lengths: list[int], packed: bool) -> None:
    wanted = fill(tmp_path / "raw.zarr", lengths, expected=64, packed=packed)
    same(tmp_path / "raw.zarr", wanted)


def test_sensor_steps_are_stored_as_integers_and_times_not_at_all(tmp_path: Path) -> None:
    fill(tmp_path / "raw.zarr", [100], expected=100)
    with xr.open_zarr(tmp_path / "raw.zarr", mask_and_scale=False) as stored:
        assert stored["distance"].dtype == np.uint16
        assert "time" not in stored.variables
    with datasets.load(tmp_path / "raw.zarr") as raw:
        assert raw.attrs["sample_rate"] == RATE
        assert raw.attrs["time_start"] == 0.0
        np.testing.assert_allclose(raw["time"].values, np.arange(100) / RATE)


def test_texts_have_a_type_with_a_specification(tmp_path: Path) -> None:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        fill(tmp_path / "raw.zarr", [100, 28], expected=100)
    assert not found
    assert json.loads((tmp_path / "raw.zarr" / "sensor" / "zarr.json").read_text())["data_type"] == "string"


def test_lossy_packing_is_omitted(tmp_path: Path) -> None:
    part = chunk(0, 100)
    part["distance"].values[0, 50] += LSB / 10
    store = RawStore.create(tmp_path / "raw.zarr", part, "time", 0.1)
    store.append(part)
    store.commit()
    same(tmp_path / "raw.zarr", part)


def test_inexact_packing_is_an_error(tmp_path: Path) -> None:
    store = RawStore.create(tmp_path / "raw.zarr", chunk(0, 10), "time", 0.1)
    part = chunk(0, 10)
    part["distance"].values[0, 0] += LSB / 10
    with pytest.raises(RunError, match=r"expected '\w+' in integer steps of 3\.1e-08"):
        store.append(part)


def test_counts_of_lost_samples_are_summed(tmp_path: Path) -> None:
    fill(tmp_path / "raw.zarr", [10, 10, 10], expected=30)
    with datasets.load(tmp_path / "raw.zarr") as raw:
        assert raw.attrs["dropped"] == 3
        assert raw.attrs["invalid"] == '{"dark": 9}'


def test_a_test_continues_in_the_middle_of_a_block(tmp_path: Path) -> None:
    path = tmp_path / "raw.zarr"
    fill(path, [50, 27], expected=64)
    store = RawStore(path, "time")
    assert store.count == store.committed == 77
    store.append(chunk(77, 200))
    store.commit()
    same(path, chunk(0, 277))


class PowerCutError(Exception):
    """The process ends here."""


@pytest.mark.slow
def test_after_any_last_write_readers_see_complete_samples_and_writing_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process ends before each of its writes in turn (length of an array, a chunk, the new text of the root)."""
    from zarr.storage import _local

    put, replace = _local._put, store_module.replace_text
    writes = cut_at = 0

    def counted(function):  # type: ignore[no-untyped-def]
        def write(*arguments, **keywords):  # type: ignore[no-untyped-def]
            nonlocal writes
            if writes == cut_at:
                raise PowerCutError
            writes += 1
            return function(*arguments, **keywords)

        return write

    monkeypatch.setattr(_local, "_put", counted(put))
    monkeypatch.setattr(store_module, "replace_text", counted(replace))
    lengths = [40, 40, 1, 60]
    seen = set()
    cut_at = 10**9
    RawStore.create(tmp_path / "new.zarr", chunk(0, 40), "time", 64 / RATE)
    for case in range(200):
        path = shutil.copytree(tmp_path / "new.zarr", tmp_path / f"{case}.zarr")
        writes, cut_at = 0, case
        try:
            store = RawStore(path, "time")
            first = 0
            for n in lengths:
                store.append(chunk(first, n))
                first += n
                store.commit()
        except PowerCutError:
            pass
        else:
            break
        cut_at = 10**9
        kept = committed_length(path, "time")
        seen.add(kept)
        if kept:
            same(path, chunk(0, kept))
        store = RawStore(path, "time")
        assert store.count == kept
        store.append(chunk(kept, 100))
        store.commit()
        same(path, chunk(0, kept + 100))
    else:
        pytest.fail("the writing never came to its end")
    assert seen == {0, 40, 80, 81}


def test_gap_is_refused_with_the_time_that_was_expected(tmp_path: Path) -> None:
    store = RawStore.create(tmp_path / "raw.zarr", chunk(0, 10), "time", 0.1)
    store.append(chunk(0, 10))
    with pytest.raises(RunError, match=r"expected the next samples at 0\.010000 s; .* from 0\.011000 s"):
        store.append(chunk(11, 10))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda raw: raw.drop_vars("temperature"), "expected the variables distance, temperature along 'time'"),
        (
            lambda raw: raw.assign(extra=raw["distance"]),
            "yielded the variable 'extra', which is missing in its first dataset",
        ),
        (
            lambda raw: raw.isel(channel=slice(3)),
            r"'distance' has the sizes \{'channel': 3\}; expected \{'channel': 5\}",
        ),
        (lambda raw: raw.isel(time=0), "expected data along 'time'"),
    ],
)
def test_an_incompatible_dataset_is_an_error(tmp_path: Path, change, message: str) -> None:  # type: ignore[no-untyped-def]
    store = RawStore.create(tmp_path / "raw.zarr", chunk(0, 10), "time", 0.1)
    store.append(chunk(0, 10))
    with pytest.raises(RunError, match=message):
        store.append(change(chunk(10, 10)))


def test_joins_along_named_channels(tmp_path: Path) -> None:
    """Data of a beam detection are appended by channel, together with the names of the channels."""
    parts = [
        xr.Dataset({"distance": (("channel", "step"), np.full((1, 4), k))}, coords={"channel": [name]})
        for k, name in enumerate(["X1", "X2", "a long name"])
    ]
    store = RawStore.create(tmp_path / "raw.zarr", parts[0], "channel", 3)
    for part in parts:
        store.append(part)
        store.commit()
    same(tmp_path / "raw.zarr", xr.concat(parts, "channel"))


def test_damaged_metadata_are_an_error_and_never_an_empty_store(tmp_path):
    """A store without samples is removed and measured again: an unknown state must not look like one."""
    path = tmp_path / "raw.zarr"
    store = RawStore.create(path, chunk(0, 50), "time")
    store.append(chunk(0, 50))
    store.commit()
    file = path / "zarr.json"
    good = file.read_text()
    assert committed_length(path, "time") == 50
    root = json.loads(good)
    shapeless = json.loads(good)
    for metadata in shapeless["consolidated_metadata"]["metadata"].values():
        metadata["shape"] = [float("nan")] * 2
    flat = json.loads(good)
    for metadata in flat["consolidated_metadata"]["metadata"].values():
        metadata["shape"] = []
    damaged = (
        *("", "[]", "{}", "[" * 5000, good[:-20], good.replace("consolidated_metadata", "consolidated_metadatb")),
        json.dumps({**root, "consolidated_metadata": {"metadata": {}}}),
        json.dumps(shapeless),
        json.dumps(flat),
    )
    for text in damaged:
        file.write_text(text)
        with pytest.raises(RunError, match="is damaged; restore it from a copy"):
            committed_length(path, "time")
    file.unlink()
    with pytest.raises(RunError, match="cannot be read"):
        committed_length(path, "time")
