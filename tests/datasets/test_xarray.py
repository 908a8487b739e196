"""Use of this package through xarray only: the engine, the accessor, tables of pandas."""

import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import datasets
from errormotion.errors import DatasetError

ALONE = """
import sys, xarray as xr
with xr.open_dataset(sys.argv[1]) as plain:
    print(plain.em.names[0], plain.em.notes)
with xr.open_dataset(sys.argv[1], engine="errormotion") as ds:
    print(ds.em.to_dataframe("EXC").columns[-1])
print([name for name in sys.modules if name.startswith("matplotlib")])
"""


def test_xarray_alone_opens_a_result_with_its_accessor_and_without_matplotlib(errors, tmp_path) -> None:
    file = datasets.save(errors(notes=["warm"]), tmp_path / "errors.nc")
    done = subprocess.run([sys.executable, "-c", ALONE, str(file)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["EX ['warm']", "U(EXC) / um", "[]"]


def test_the_engine_opens_the_same_datasets_as_load(errors, drift, tmp_path) -> None:
    file = datasets.save(errors(), tmp_path / "errors.nc")
    xr.testing.assert_identical(xr.open_dataset(file, engine="errormotion"), errors())
    xr.testing.assert_identical(
        xr.open_dataset(file, engine="errormotion", drop_variables=["influence", "none"]),
        errors().drop_vars("influence"),
    )
    raw = datasets.save(drift(), tmp_path / "raw.zarr")
    with xr.open_dataset(raw, engine="errormotion") as ds:
        xr.testing.assert_identical(ds, drift())
    with pytest.raises(DatasetError, match="there is no such file"):
        xr.open_dataset(tmp_path / "none.nc", engine="errormotion")
    with raises("engine.options.unknown"):
        xr.open_dataset(file, engine="errormotion", group="a")


def test_a_table_has_field_units_and_a_row_for_each_place(errors) -> None:
    ds = errors(unseen=(5,), coords={"time": 60.0 * np.arange(7), "sensor": ["frame"],
        "temperature": (("time", "sensor"), np.full((7, 1), 20.5), {"units": "degC"}),
        "spindle_speed": ("time", np.full(7, 5e3), {"units": "1/min"})})  # fmt: skip
    table = ds.em.to_dataframe(["EXC", "EC", "EB"], k=3)
    assert list(table.columns) == [
        "time / min", "temperature frame / degC", "spindle_speed / (1/min)",
        "EXC / um", "U(EXC) / um", "ECC / arcsec", "U(ECC) / arcsec",
        "EBC / arcsec", "U(EBC) / arcsec",
    ]  # fmt: skip
    np.testing.assert_allclose(table["time / min"], np.arange(7))
    np.testing.assert_allclose(table["EXC / um"], 1e6 * ds["EX"])
    np.testing.assert_allclose(table["U(EXC) / um"], 3e6 * np.sqrt(ds["covariance"].values[:, 0, 0]))
    np.testing.assert_allclose(table["EBC / arcsec"], np.degrees(ds["EB"]) * 3600)
    assert table["ECC / arcsec"].isna().all()
    assert (table["temperature frame / degC"] == 20.5).all()
    assert table.attrs["k"] == 3


def test_a_table_of_two_dims_repeats_the_coordinates(errors) -> None:
    values = np.arange(36.0).reshape(2, 3, 6) * 1e-6
    ds = errors(
        values=values, covariance=np.tile(np.eye(6) * 1e-12, (2, 3, 1, 1)), influence=None, sources=None,
        source_groups=None, dims=("time", "position"), component="Y",
        coords={"time": [0.0, 60.0], "y": ("position", [0.0, 0.1, 0.2])},
    )  # fmt: skip
    table = ds.em.to_dataframe("EX")
    np.testing.assert_allclose(table["time / min"], [0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(table["y / mm"], [0, 100, 200] * 2)
    np.testing.assert_allclose(table["EXY / um"], 1e6 * values[..., 0].ravel())
    with raises("errors.freedoms.unknown"):
        ds.em.to_dataframe("EQ")
