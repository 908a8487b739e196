"""The raw store contains the appended data, whichever write was the last."""

import json
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import datasets
from errormotion.campaign.storage import column as column_module
from errormotion.campaign.storage.recorder import Recorder
from errormotion.campaign.storage.store import RawStore, committed_length
from errormotion.errors import RunError

RATE = 1000.0
LSB = 3.1e-8  # m; a step of a 16 bit sensor of 2 mm range


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
    with raises("method.data.steps"):
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


def with_pulses(first: int, n: int) -> xr.Dataset:
    """Samples with a pulse and its temperature at every seventh; a dataset may have none."""
    index = np.arange(first, first + n)
    at = index[index % 7 == 0]
    return chunk(first, n).assign(
        pulse_time=("pulse", at / RATE, {"units": "s"}),
        pulse_temperature=(("sensor", "pulse"), np.stack([at, -at]) / 3),
    )


@pytest.mark.parametrize("lengths", [[64], [1, 2, 3, 250], [100] * 7, [3, 3, 300, 1]])
def test_two_dimensions_grow_independently(tmp_path: Path, lengths: list[int]) -> None:
    path, first = tmp_path / "raw.zarr", 0
    store = RawStore.create(path, with_pulses(0, lengths[0]), "time", 64 / RATE, ("pulse",))
    for n in lengths:
        store.append(with_pulses(first, n))
        first += n
        store.commit()
        store = RawStore(path, "time", ("pulse",))
        same(path, with_pulses(0, first))
    assert store.count == committed_length(path, "time") == first
    assert committed_length(path, "pulse") == -(-first // 7)


def test_the_recorder_joins_both_dimensions(tmp_path: Path) -> None:
    with Recorder(tmp_path / "raw.zarr", "time", 1.0, {}, ("pulse",)) as recorder:
        for first, n in ((0, 5), (5, 1), (6, 90)):
            recorder.put(with_pulses(first, n))
    same(tmp_path / "raw.zarr", with_pulses(0, 96))


def test_a_variable_along_both_dimensions_is_refused(tmp_path: Path) -> None:
    both = with_pulses(0, 14).assign(cross=(("time", "pulse"), np.zeros((14, 2))))
    with pytest.raises(RunError, match="expected 'cross' along one of time, pulse"):
        RawStore.create(tmp_path / "raw.zarr", both, "time", 1.0, ("pulse",))
    with pytest.raises(RunError, match="expected data along 'pulse'"):
        RawStore.create(tmp_path / "raw.zarr", chunk(0, 14), "time", 1.0, ("pulse",))


def test_gap_is_refused_with_the_time_that_was_expected(tmp_path: Path) -> None:
    store = RawStore.create(tmp_path / "raw.zarr", chunk(0, 10), "time", 0.1)
    store.append(chunk(0, 10))
    with raises("method.data.times"):
        store.append(chunk(11, 10))


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda raw: raw.drop_vars("temperature"), "method.data.variables"),
        (
            lambda raw: raw.assign(extra=raw["distance"]),
            "method.data.variables",
        ),
        (
            lambda raw: raw.isel(channel=slice(3)),
            "method.data.sizes",
        ),
        (lambda raw: raw.isel(time=0), "method.data.dim"),
    ],
)
def test_an_incompatible_dataset_is_an_error(tmp_path: Path, change, code: str) -> None:  # type: ignore[no-untyped-def]
    store = RawStore.create(tmp_path / "raw.zarr", chunk(0, 10), "time", 0.1)
    store.append(chunk(0, 10))
    with raises(code):
        store.append(change(chunk(10, 10)))


def pulses(first: int, n: int, **changes: object) -> xr.Dataset:
    """A chunk with what a method states once: pulses of an index, a place, a flag, a name, and an unknown value."""
    raw = chunk(first, n).assign_coords(place=("direction", [0.1, np.nan, 0.3]))
    once = {"index_time": ("pulse", np.arange(17.0)), "count": 3, "ok": True, "who": "A. Operator", **changes}
    return raw.assign(once).assign_attrs(rotation="right", offsets=[0.0, 1e-3])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda raw: raw.assign(index_time=("pulse", np.arange(17.0, 66))),
            r"'index_time' .* \{'pulse': 17\}.*'pulse': 49",
        ),
        (lambda raw: raw.assign(index_time=("pulse", np.arange(1.0, 18))), r"'index_time' does not grow along 'time'"),
        (lambda raw: raw.assign(index_time=("pulse", np.full(17, np.nan))), "'index_time' does not grow"),
        (lambda raw: raw.assign(index_time=("other", np.arange(17.0))), "'index_time' does not grow"),
        (lambda raw: raw.assign(count=4), "'count' does not grow"),
        (lambda raw: raw.assign(ok=False), "'ok' does not grow"),
        (lambda raw: raw.assign(who="B. Operator"), r"'who' .* expected one value \(A\. Operator\); found one value"),
        (lambda raw: raw.assign_coords(sensor=["frame", "table"]), "'sensor' does not grow"),
        (lambda raw: raw.assign_coords(place=("direction", [0.1, 0.2, 0.3])), "'place' does not grow"),
        (lambda raw: raw.assign(more=("pulse", np.arange(17.0))), "'more' is new"),
        (lambda raw: raw.drop_vars("index_time"), "'index_time' is missing"),
        (lambda raw: raw.assign_attrs(rotation="left"), "attribute 'rotation' of the dataset .* 'right'; found 'left'"),
        (lambda raw: raw.assign_attrs(offsets=[0.0, 2e-3]), "attribute 'offsets' of the dataset"),
        (lambda raw: raw.assign_attrs(note="new"), "attribute 'note' of the dataset .* expected None; found 'new'"),
        (lambda raw: raw.assign_attrs(sample_rate=2000.0), "attribute 'sample_rate'"),
        (lambda raw: raw.assign(temperature=raw["temperature"].assign_attrs(units="K")), "'units' of 'temperature'"),
        (lambda raw: raw.assign(temperature=raw["temperature"].astype(complex)), "'temperature' of the type float64"),
        (lambda raw: raw.assign_coords(time=np.linspace(0.01, 0.03, 10)), "expected 10 samples at 1000.0 Hz"),
    ],
)
def test_what_would_be_lost_is_refused_and_the_data_so_far_stay(tmp_path: Path, change, message: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "raw.zarr"
    first = pulses(0, 10)
    store = RawStore.create(path, first, "time", 0.1)
    store.append(first)
    same_again = pulses(10, 10)
    with pytest.raises(RunError, match=message):
        store.append(change(same_again))
    assert store.count == 10
    store.append(same_again)
    store.close()
    again = RawStore(path, "time")  # continued: compared with what is stored
    with pytest.raises(RunError, match=message):
        again.append(change(pulses(20, 10)))
    again.append(pulses(20, 10))
    again.close()
    same(path, pulses(0, 30))


def test_another_type_of_values_is_stored_only_without_a_change(tmp_path: Path) -> None:
    first = xr.Dataset({"count": ("scan", np.arange(3, dtype=np.int32)), "name": ("scan", ["a", "bb", "c"])})
    store = RawStore.create(tmp_path / "raw.zarr", first, "scan")
    store.append(first)
    store.append(first.assign(count=first["count"].astype(np.int16)))
    for other in (float, np.int64, np.uint32):
        with pytest.raises(RunError, match="'count' of the type int32"):
            store.append(first.assign(count=first["count"].astype(other)))
    store.close()
    same(tmp_path / "raw.zarr", xr.concat([first, first], "scan"))


def test_times_and_other_objects_are_refused_by_name(tmp_path: Path) -> None:
    for values in (np.array(["2026-03-31"], "datetime64[s]"), np.array([{}], object)):
        with pytest.raises(RunError, match="expected numbers or texts; 'when' has the type"):
            RawStore.create(tmp_path / "raw.zarr", xr.Dataset({"when": ("scan", values)}), "scan")


def test_the_recorder_keeps_what_came_before_a_refused_dataset(tmp_path: Path) -> None:
    path = tmp_path / "raw.zarr"

    def record() -> None:
        with Recorder(path, "time", 1.0, {}) as recorder:
            recorder.put(pulses(0, 10))
            recorder.put(pulses(10, 10))
            recorder.put(pulses(20, 10, index_time=("pulse", np.arange(66.0))))
            while True:
                recorder.put(pulses(30, 10))

    with pytest.raises(RunError, match="'index_time' does not grow"):
        record()
    same(path, pulses(0, 20))


def test_a_commit_costs_what_is_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes of values given to the compression, at any length of the record."""
    encoded = column_module.encoded
    sizes: list[int] = []
    monkeypatch.setattr(
        column_module, "encoded", lambda values, meta: sizes.append(values.nbytes) or encoded(values, meta)
    )
    rate, new = 20_000.0, 10_000
    parts = [chunk(k * new, new).assign_attrs(sample_rate=rate, time_start=k * new / rate) for k in range(30)]
    store = RawStore.create(tmp_path / "raw.zarr", parts[0], "time", 4 * 3600.0)
    costs = []
    for part in parts:
        sizes.clear()
        store.append(part)
        store.commit()
        costs.append(sum(sizes))
    of_new = new * (5 * 2 + 2 * 8)
    assert np.mean(costs) < 5 * of_new
    assert max(costs) < 10 * of_new


def test_the_memory_of_a_commit_does_not_grow_with_the_record(tmp_path: Path) -> None:
    """Rows of a monitor, stored one by one for more than an hour."""

    def row(k: int) -> xr.Dataset:
        values = {f"value{n}": ("time", [float(n * k)]) for n in range(6)}
        return xr.Dataset(
            {"temperature": (("time", "sensor"), np.full((1, 8), 20.0 + k)), **values}, {"time": ("time", [float(k)])}
        )

    def peak(store: RawStore) -> int:
        tracemalloc.start()
        try:
            store.append(row(store.count))
            store.commit()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    store = RawStore.create(tmp_path / "raw.zarr", row(0), "time", 4096)
    found = []
    for length in (30, 1000, 3700):
        while store.count < length:
            store.append(row(store.count))
        found.append(peak(store))
    assert max(found) < 250_000  # bytes; a block of all variables has 2**18 bytes, and is compressed


@pytest.mark.parametrize("damage", ["", "{", None])
def test_damaged_metadata_of_an_array_are_rebuilt_from_the_root(tmp_path: Path, damage: str | None) -> None:
    path = tmp_path / "raw.zarr"
    fill(path, [50, 27], expected=64)
    for file in path.glob("*/zarr.json"):
        file.unlink() if damage is None else file.write_text(damage)
    (path / "distance" / "c" / "0" / ".1.0123456789abcdef.part").write_bytes(b"")
    (path / "distance" / "c" / "0" / "1.0123456789abcdef.partial").write_bytes(b"")
    (path / "distance" / "c" / "0" / "2").write_bytes(b"")  # of samples that were not committed
    same(path, chunk(0, 77))
    store = RawStore(path, "time")
    assert not [*path.rglob("*.part"), *path.rglob("*.partial")]
    store.append(chunk(77, 200))
    store.close()
    same(path, chunk(0, 277))
    with xr.open_zarr(path, consolidated=False) as found:
        assert found.sizes["time"] == 277


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
        with raises("run.file.damaged"):
            committed_length(path, "time")
    file.unlink()
    with raises("run.file.unreadable"):
        committed_length(path, "time")
