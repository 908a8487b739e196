import errno
import io
import json
import os
import shutil
import time
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from coded import raises
from xarray.indexes import RangeIndex

from errormotion import datasets
from errormotion.datasets import load, save, validate
from errormotion.datasets.files.writing import whole
from errormotion.datasets.storage.compression import as_stored, round_significand
from errormotion.datasets.storage.disk import reading
from errormotion.errors import DatasetError
from errormotion.methods.spindle_drift import simulation
from errormotion.twin import VirtualMachine

both = pytest.mark.parametrize("suffix", [".nc", ".zarr"])


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@both
def test_an_error_dataset_is_unchanged_by_storage(errors, tmp_path, suffix) -> None:
    ds = errors(unseen=(5,))
    back = load(save(ds, tmp_path / f"errors{suffix}"))
    xr.testing.assert_identical(back, ds)
    assert back["source"].dtype.kind == back["dof"].dtype.kind == "U"
    assert datasets.violations(back) == []
    assert names(tmp_path) == [f"errors{suffix}"]


@both
def test_a_long_record_is_compressed_and_only_influences_are_rounded(errors, tmp_path, suffix) -> None:
    ds = errors(n=10_000)
    path = save(ds, tmp_path / f"errors{suffix}")
    back = load(path)
    for name, variable in ds.variables.items():
        if name != "influence":
            assert back[name].values.tobytes() == variable.values.tobytes(), name
    # 28 significant bits, as the attribute states: half a unit in the last of them
    np.testing.assert_allclose(back["influence"], ds["influence"], rtol=2.0**-28, atol=0)
    assert back["influence"].attrs["_QuantizeBitRoundNumberOfSignificantBits"] == 28
    assert datasets.violations(back) == []
    if suffix == ".nc":
        with h5py.File(path) as file:  # 27 stored bits, sign and a few bits of the exponent, of 64
            assert file["influence"].id.get_storage_size() < 0.58 * ds["influence"].nbytes
    assert datasets.hash_dataset(back) == datasets.hash_dataset(as_stored(ds))
    xr.testing.assert_identical(load(save(back, tmp_path / f"again{suffix}")), back)  # rounded once


def test_rounding_does_not_change_nan_or_values_with_few_bits(errors) -> None:
    kept = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1.5e-6, np.finfo(float).max])  # the last would overflow
    kept[5] = 1.0 + 2.0**-27
    assert round_significand(kept).tobytes() == kept.tobytes()
    found = round_significand(np.array([1.0 + 2.0**-29, -1.0 - 1.5 * 2.0**-28]))
    assert found.tolist() == [1.0, -1.0 - 2.0**-27]
    assert as_stored(errors(n=10)).identical(errors(n=10))  # small ones as they are


def test_rounded_influences_conform_to_the_schema_without_independent_noise(errors, tmp_path) -> None:
    influence = np.random.default_rng(3).normal(size=(8, 5000, 6)) * 1e-6
    covariance = np.einsum("spi,spj->pij", influence, influence)
    groups = {"sources": [f"source {k}" for k in range(8)], "source_groups": ["all"] * 8}
    ds = errors(n=5000, influence=influence, covariance=covariance, **groups)
    assert datasets.violations(load(save(ds, tmp_path / "errors.nc"))) == []


@both
def test_texts_have_a_type_with_a_specification(drift, tmp_path, suffix) -> None:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        path = save(drift(), tmp_path / f"raw{suffix}")
    assert not found
    if suffix == ".zarr":
        assert json.loads((path / "channel" / "zarr.json").read_text())["data_type"] == "string"


def test_a_store_with_texts_of_fixed_length_is_read(drift, tmp_path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", zarr.errors.UnstableSpecificationWarning
        )  # which versions of zarr raise it differs
        drift().to_zarr(tmp_path / "raw.zarr", consolidated=False)
    assert json.loads((tmp_path / "raw.zarr" / "channel" / "zarr.json").read_text())["data_type"] != "string"
    with load(tmp_path / "raw.zarr") as back:
        xr.testing.assert_identical(back, drift())


@both
def test_a_raw_dataset_is_loaded_unchanged_and_lazily(drift, tmp_path, suffix) -> None:
    ds = drift()
    with load(save(ds, tmp_path / f"raw{suffix}")) as back:
        assert not back["distance"].variable._in_memory
        assert float(back["distance"].sel(channel="Z", time=0.5)) == float(ds["distance"].sel(channel="Z", time=0.5))
        xr.testing.assert_identical(back, ds)


@both
def test_a_loaded_dataset_can_be_saved_in_the_other_format(drift, tmp_path, suffix) -> None:
    other = {".nc": ".zarr", ".zarr": ".nc"}[suffix]
    with load(save(drift(), tmp_path / f"a{suffix}")) as first, load(save(first, tmp_path / f"b{other}")) as second:
        xr.testing.assert_identical(second, drift())


@both
def test_evenly_spaced_times_are_reported_by_rate_and_start(drift, tmp_path, suffix) -> None:
    ds = drift(n=40).drop_vars(["time", "temperature"]).assign_attrs(sample_rate=20e3, time_start=2.5)
    with load(save(ds, tmp_path / f"raw{suffix}")) as back:
        assert isinstance(back.xindexes["time"], RangeIndex)
        np.testing.assert_allclose(back["time"], 2.5 + np.arange(40) / 20e3, rtol=1e-15)
        assert back["time"].attrs == {"units": "s"}
        assert datasets.violations(back) == []
        later = back.isel(time=slice(10, 20))
        with load(save(later, tmp_path / f"later{suffix}")) as part:
            assert part.attrs["time_start"] == pytest.approx(2.5 + 10 / 20e3, rel=1e-15)
            np.testing.assert_array_equal(part["time"], later["time"])
        thinned = back.isel(time=slice(0, None, 2))  # no longer at the rate of the attribute
        with load(save(thinned, tmp_path / f"thinned{suffix}")) as part:
            np.testing.assert_array_equal(part["time"], thinned["time"])


def test_the_times_of_a_long_record_are_stored_as_a_rule(tmp_path) -> None:
    n = 3_000_000  # of 60 MB, without any: less than what is refused as out of proportion
    root = zarr.create_group(tmp_path / "raw.zarr", attributes={"sample_rate": 20e3})
    root.create_array("distance", shape=(5, n), chunks=(5, 2**20), dtype="f4", dimension_names=("channel", "time"))
    with load(tmp_path / "raw.zarr") as ds:
        assert not ds["time"].variable._in_memory
        assert float(ds["time"][-1]) == pytest.approx((n - 1) / 20e3, rel=1e-15)


def test_long_stored_times_are_not_loaded_into_memory(drift, tmp_path) -> None:
    n = 100_001
    ds = drift(n=n).drop_vars(["temperature"])
    with load(save(ds, tmp_path / "raw.nc")) as back:
        assert "time" not in back.xindexes
        assert not back["time"].variable._in_memory
        assert datasets.violations(back) == []
        assert not back["time"].variable._in_memory


def test_metadata_in_the_root_have_priority_over_those_of_the_arrays(tmp_path) -> None:
    root = zarr.create_group(tmp_path / "raw.zarr")
    a = root.create_array("a", shape=(4,), chunks=(4,), dtype="f8", dimension_names=("time",))
    with pytest.warns(zarr.errors.ZarrUserWarning, match="not part in the Zarr format 3"):
        zarr.consolidate_metadata(tmp_path / "raw.zarr")
    a.resize((9,))  # a writer that was cut off before it updated the root
    with load(tmp_path / "raw.zarr") as ds:
        assert ds.sizes == {"time": 4}


@both
def test_a_file_is_overwritten_only_on_request(errors, tmp_path, suffix) -> None:
    path = save(errors(seed=1), tmp_path / f"errors{suffix}")
    with raises("file.exists"):
        save(errors(seed=2), path)
    xr.testing.assert_identical(load(path), errors(seed=1))
    save(errors(seed=2), path, overwrite=True)
    xr.testing.assert_identical(load(path), errors(seed=2))
    assert names(tmp_path) == [path.name]


@both
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_leaves_no_part_and_does_not_change_the_old_file(
    errors, tmp_path, monkeypatch, suffix, code
) -> None:
    path = save(errors(seed=1), tmp_path / f"errors{suffix}")

    def full(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", full)
    for target in (path, tmp_path / f"new{suffix}"):
        with pytest.raises(DatasetError, match=r"(full|quota).*Nothing was written"):
            save(errors(seed=2), target, overwrite=True)
    monkeypatch.undo()
    assert names(tmp_path) == [path.name]
    xr.testing.assert_identical(load(path), errors(seed=1))


def test_a_read_only_disk_is_reported(errors, tmp_path, monkeypatch) -> None:
    """The incomplete file cannot be removed either."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(os, "fsync", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(DatasetError, match=r"new\.nc: cannot be written: the file system is read-only"):
        save(errors(seed=1), tmp_path / "new.nc")


def test_a_file_is_written_completely_or_not_changed(tmp_path, monkeypatch) -> None:
    path = tmp_path / "page.html"
    path.write_text("old")
    with whole(path) as part:
        part.write_text("new")
    assert path.read_text() == "new"

    def fill(path: Path) -> None:
        with whole(path) as part:
            part.write_text("ne")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(DatasetError, match=r"page\.html: cannot be written: the disk is full"):
        fill(path)
    assert path.read_text() == "new"
    assert names(tmp_path) == ["page.html"]


def test_a_limit_of_the_system_is_reported(errors, tmp_path) -> None:
    resource = pytest.importorskip("resource", reason="limits of a process are a matter of Unix")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    big = errors(n=2000)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        for name in ("errors.nc", "errors.zarr"):
            with pytest.raises(DatasetError, match=r"larger than allowed\. Nothing was written"):
                save(big, tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert names(tmp_path) == []


def test_a_truncated_chunk_is_named(tmp_path) -> None:
    path = save(xr.Dataset({"values": ("x", np.arange(1000.0))}), tmp_path / "raw.zarr")
    [chunk] = (file for file in (path / "values" / "c").rglob("*") if file.is_file())
    os.truncate(chunk, 3)
    with pytest.raises(DatasetError, match=r"'values': c/0: expected a chunk .* truncated or damaged: copy the folder"):
        load(path)


def test_chunks_written_after_a_failed_one_do_not_create_the_folder_again(tmp_path) -> None:
    resource = pytest.importorskip("resource", reason="limits of a process are a matter of Unix")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    values = np.zeros((4000, 2000))
    values[:600] = np.random.default_rng(0).standard_normal((600, 2000))  # the other chunks are small enough
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with pytest.raises(DatasetError, match="larger than allowed"):
            save(xr.Dataset({"values": (("x", "y"), values)}), tmp_path / "raw.zarr")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    time.sleep(0.2)
    assert names(tmp_path) == []


@both
def test_an_interruption_leaves_no_part(errors, tmp_path, monkeypatch, suffix) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save(errors(), tmp_path / f"errors{suffix}")
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_renamed_leaves_the_old_one(errors, tmp_path, monkeypatch) -> None:
    path = save(errors(seed=1), tmp_path / "errors.zarr")
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.suffix == ".part":
            raise PermissionError(errno.EACCES, "no")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(DatasetError, match="permission denied"):
        save(errors(seed=2), path, overwrite=True)
    assert names(tmp_path) == [path.name]
    xr.testing.assert_identical(load(path), errors(seed=1))


def test_a_location_that_cannot_be_written_is_reported(errors, tmp_path) -> None:
    with pytest.raises(DatasetError, match="there is no such folder"):
        save(errors(), tmp_path / "none" / "errors.nc")
    with raises("file.name.ending"):
        save(errors(), tmp_path / "errors.txt")


def test_an_attribute_that_cannot_be_stored_is_reported_before_writing(errors, tmp_path) -> None:
    ds = errors().assign_attrs(operator=None)
    ds["EX"].attrs["valid"] = True
    with pytest.raises(DatasetError) as caught:
        save(ds, tmp_path / "errors.nc")
    assert "attribute 'operator'" in str(caught.value)
    assert "EX: attribute 'valid'" in str(caught.value)
    assert names(tmp_path) == []


@pytest.mark.parametrize("kept", [0.0, 0.0002, 0.5, 0.999])
def test_a_truncated_file_is_reported(drift, tmp_path, kept) -> None:
    path = save(drift(), tmp_path / "raw.nc")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(DatasetError, match=r"(is empty|is truncated).* create it again"):
        load(path)


def test_a_damaged_folder_is_reported(errors, tmp_path) -> None:
    path = save(errors(), tmp_path / "errors.zarr")
    for broken in (path / "EX" / "zarr.json", path / "zarr.json"):
        broken.write_text(broken.read_text()[:20])
        with raises("file.damaged"):
            load(path)


def test_a_truncated_chunk_is_reported(errors, tmp_path) -> None:
    path = save(errors(), tmp_path / "errors.zarr")
    (chunk,) = [file for file in (path / "covariance").rglob("*") if file.is_file() and file.name != "zarr.json"]
    chunk.write_bytes(chunk.read_bytes()[:20])
    with raises("file.damaged"):
        load(path)


def test_a_file_that_is_not_a_dataset_is_reported(tmp_path) -> None:
    (tmp_path / "log.csv").write_text("t;X1;X2\n")
    with raises("csv.schema.missing"):
        load(tmp_path / "log.csv")
    with pytest.raises(DatasetError, match="there is no such file"):
        load(tmp_path / "none.nc")
    with pytest.raises(DatasetError, match=r"folder without zarr\.json"):
        load(tmp_path)
    (tmp_path / "old.nc").write_bytes(b"CDF\x01" + b"\xff" * 100)
    with raises("file.damaged"):
        load(tmp_path / "old.nc")


def test_netcdf_of_the_classic_format_is_read_as_well(tmp_path) -> None:
    raw = simulation.raw_drift(VirtualMachine("cframe", seed=1), [0.0, 10.0], seed=0)
    raw.drop_vars(["temperature", "spindle_speed", "sensor"]).to_netcdf(tmp_path / "raw.nc", engine="scipy")
    with load(tmp_path / "raw.nc") as found:
        validate(found)
        np.testing.assert_array_equal(found["distance"], raw["distance"])


def test_a_truncated_chunk_is_reported_during_reading(tmp_path) -> None:
    raw = simulation.raw_drift(VirtualMachine("cframe", seed=1), np.arange(5000.0), seed=0)
    path = save(raw, tmp_path / "raw.zarr")
    (chunk, *_) = [file for file in (path / "distance").rglob("*") if file.is_file() and file.name != "zarr.json"]
    chunk.write_bytes(chunk.read_bytes()[:20])
    with pytest.raises(DatasetError, match=r"raw\.zarr: is damaged or incomplete"), reading(path):
        load(path)["distance"].load()
    with pytest.raises(RuntimeError, match="ours"), reading(path):
        raise RuntimeError("ours")


def test_a_folder_around_a_dataset_points_to_it(drift, tmp_path) -> None:
    save(drift(), tmp_path / "raw.zarr")
    with raises("zarr.folder.other"):
        load(tmp_path)


def test_a_file_that_may_not_be_read_is_reported(errors, tmp_path, monkeypatch) -> None:
    path = save(errors(), tmp_path / "errors.nc")

    def denied(*_: object, **__: object) -> io.BytesIO:
        raise PermissionError(errno.EACCES, "no")

    monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(DatasetError, match="cannot be read: permission denied"):
        load(path)


def test_a_run_folder_may_move(errors, tmp_path) -> None:
    path = save(errors(), tmp_path / "errors.zarr")
    moved = shutil.move(path, tmp_path / "elsewhere.zarr")
    xr.testing.assert_identical(load(moved), errors())


@pytest.mark.parametrize("head", [b"CDF", b"CDF\x02" + bytes(7) + b"\x0a" + b"\x7f" * 20])
def test_damaged_netcdf_of_the_classic_format_is_an_error(tmp_path, head) -> None:
    path = tmp_path / "classic.nc"
    path.write_bytes(head)
    with pytest.raises(DatasetError, match=r"classic\.nc: is "):
        load(path)
