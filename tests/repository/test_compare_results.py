"""The comparison of results detects a change of one value, and reports no difference of equal results."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import xarray as xr

SCRIPT = Path(__file__).parents[2] / "tools" / "compare_results.py"
U = 1e-6
"""Standard uncertainty of each freedom of the test dataset, m or rad."""


def errors() -> xr.Dataset:
    """Return a dataset with the parts of an error dataset that the comparison treats differently."""
    n = 4
    values = np.random.default_rng(1).normal(size=(6, n)) * 1e-5
    values[5] = np.nan
    covariance = np.tile(np.eye(6) * U**2, (n, 1, 1))
    covariance[:, 5] = covariance[:, :, 5] = np.nan
    names = ("EX", "EY", "EZ", "EA", "EB", "EC")
    software = {"errormotion": "0.1.0"}
    return xr.Dataset(
        {name: ("time", row, {"units": "m"}) for name, row in zip(names, values, strict=True)}
        | {"covariance": (("time", "dof", "dof_"), covariance), "count": ("time", np.arange(n))},
        {"time": np.arange(n) * 1.0, "sensor": ("time", list("abcd"))},
        {"notes": "4 readings left out", "provenance": json.dumps({"software": software, "settings": {"noise": 1e-6}})},
    )


def store(folder: Path, ds: xr.Dataset) -> Path:
    """Write a folder of results with one dataset."""
    (folder / "errors").mkdir(parents=True)
    ds.to_netcdf(folder / "errors" / "one.nc", engine="h5netcdf")
    (folder / "digests.json").write_text('{"raw": {"one": {"digests": {"distance": "0"}}}, "measured": {}}')
    return folder


def script() -> ModuleType:
    """Return the script as a module."""
    spec = importlib.util.spec_from_file_location(SCRIPT.stem, SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def compared(
    old: Path, new: Path, *, within: float | None = None, wording: bool = False, by_group: bool = False
) -> tuple[int, str]:
    """Return exit code and output of the comparison."""
    with contextlib.redirect_stdout(io.StringIO()) as text:
        code = script().compare(old, new, within, [], wording, by_group, 5)
    return code, text.getvalue()


def changed(what: str) -> xr.Dataset:
    """Return the dataset with one thing changed."""
    ds = errors()
    if what == "last bit":
        ds["EX"][1] = np.nextafter(ds["EX"].values[1], 1.0)
    elif what == "NaN":
        ds["EC"][2] = 0.0
    elif what == "sign of zero":
        ds["time"] = ds["time"] * np.array([-1.0, 1.0, 1.0, 1.0])
    elif what == "integer":
        ds["count"][0] = 7
    elif what == "text":
        ds = ds.assign_coords(sensor=("time", list("abce")))
    elif what == "type":
        ds["EY"] = ds["EY"].astype(np.float32)
    elif what == "unit":
        ds["EX"].attrs["units"] = "mm"
    elif what == "settings":
        ds.attrs["provenance"] = ds.attrs["provenance"].replace("1e-06", "2e-06")
    elif what == "missing":
        ds = ds.drop_vars("EZ")
    elif what == "covariance":
        ds["covariance"][0, 0, 0] *= 1.0 + 1e-15
    return ds


def test_equal_results_are_equal_with_any_software(tmp_path: Path) -> None:
    old, new = store(tmp_path / "old", errors()), errors()
    new.attrs["provenance"] = new.attrs["provenance"].replace("0.1.0", "0.2.0")
    code, text = compared(old, store(tmp_path / "new", new))
    assert code == 0, text
    assert "1 x provenance.software.errormotion" in text


@pytest.mark.parametrize(
    "what",
    ["last bit", "NaN", "sign of zero", "integer", "text", "type", "unit", "settings", "missing", "covariance"],
)
def test_one_change_is_found(tmp_path: Path, what: str) -> None:
    code, text = compared(store(tmp_path / "old", errors()), store(tmp_path / "new", changed(what)))
    assert code == 1
    assert "2 datasets, 1 different" in text


@pytest.mark.parametrize(("fraction", "code"), [(0.9e-9, 0), (1.1e-9, 1)])
def test_within_is_a_fraction_of_the_standard_uncertainty(tmp_path: Path, fraction: float, code: int) -> None:
    new = errors()
    new["EB"][3] += fraction * U
    assert compared(store(tmp_path / "old", errors()), store(tmp_path / "new", new), within=1e-9)[0] == code


@pytest.mark.parametrize(("notes", "code"), [("left out: 4 readings", 0), ("left out: 5 readings", 1)])
def test_another_wording_is_accepted_only_with_the_same_numbers(tmp_path: Path, notes: str, code: int) -> None:
    old, new = store(tmp_path / "old", errors()), store(tmp_path / "new", errors().assign_attrs(notes=notes))
    assert compared(old, new)[0] == 1
    assert compared(old, new, wording=True)[0] == code


def test_an_earlier_name_of_a_group_of_sources_is_the_present_one(tmp_path: Path) -> None:
    def stored(name: str, groups: list[str]) -> Path:
        return store(tmp_path / name, errors().assign_coords(source_group=("source", groups)))

    old = stored("old", ["air", "stations"])
    assert compared(old, stored("new", ["refraction", "stations"]))[0] == 0
    assert compared(old, stored("other", ["refraction", "scales"]))[0] == 1


def test_a_missing_dataset_and_another_input_are_differences(tmp_path: Path) -> None:
    old, new = store(tmp_path / "old", errors()), store(tmp_path / "new", errors())
    (new / "digests.json").write_text((new / "digests.json").read_text().replace('"0"', '"1"'))
    assert compared(old, new)[0] == 1
    shutil.copy(old / "digests.json", new)
    assert compared(old, new)[0] == 0
    (new / "errors" / "one.nc").unlink()
    assert compared(old, new)[0] == 1


def sourced(effects: np.ndarray, groups: list[str]) -> xr.Dataset:
    """Return the dataset with the effects of sources (source, time, dof)."""
    coords = {"source": [f"source {k}" for k in range(len(groups))], "source_group": ("source", groups)}
    return errors().assign(influence=(("source", "time", "dof"), effects)).assign_coords(coords)


@pytest.mark.parametrize(("factor", "code"), [(1.0, 0), (1.0 + 1e-8, 1)])
def test_fewer_sources_of_a_group_are_equal_by_group_only(tmp_path: Path, factor: float, code: int) -> None:
    """Three sources are replaced by two with the same covariance, and one of another group by none of no effect."""
    rng = np.random.default_rng(2)
    two = U * rng.normal(size=(2, 4, 6))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :2]
    three = np.einsum("ij,jtd->itd", turn, two)
    before = sourced(np.concatenate([three, np.zeros((1, 4, 6))]), ["drift", "drift", "drift", "scale"])
    after = sourced(two * factor, ["drift", "drift"])
    old, new = store(tmp_path / "old", before), store(tmp_path / "new", after)
    assert compared(old, new, within=1e-9)[0] == 1
    found, text = compared(old, new, within=1e-9, by_group=True)
    assert found == code, text
