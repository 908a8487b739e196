"""Packages of arrays are loaded when they are used, and then xarray knows their arrays."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from xarray.namedarray import pycompat

from errormotion import datasets
from errormotion.datasets import unloaded


def test_xarray_holds_what_it_knows_under_the_name_that_is_expected() -> None:
    assert isinstance(getattr(pycompat, unloaded._HELD), dict)
    assert set(unloaded._MODULES) <= set(getattr(pycompat, unloaded._HELD))


PROGRAM = """
import sys
import numpy as np, xarray as xr
from errormotion.datasets import load, save

ds = load(sys.argv[1])
save(ds, sys.argv[2])
ds["EX"].mean().values
print([name for name in ("pint", "dask.array", "scipy.stats", "numba", "matplotlib") if name in sys.modules])
if len(sys.argv) > 3:
    ds = xr.Dataset({"x": ("t", np.arange(10.0))})
    ds["x"].values
    lazy = ds.chunk(t=3)
    from xarray.namedarray import pycompat
    import dask.array
    assert pycompat.array_type("dask") == (dask.array.Array,)
    assert pycompat.mod_version("dask").major > 2000
    print(lazy["x"].chunks, float((lazy["x"] + 1).sum().values), lazy.compute().identical(ds))
"""
DASK = [] if importlib.util.find_spec("dask") is None else ["dask"]


def test_packages_of_arrays_are_loaded_when_they_are_used_and_known_then(tmp_path, errors) -> None:
    path = datasets.save(errors(), tmp_path / "errors.nc")
    command = [sys.executable, "-c", PROGRAM, path, tmp_path / "again.nc", *DASK]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    first, *rest = done.stdout.splitlines()
    assert first == "[]"
    if not DASK:
        pytest.skip("dask is not installed")
    assert rest == ["((3, 3, 3, 1),) 55.0 True"]


def test_a_package_that_is_not_installed_has_no_arrays(monkeypatch) -> None:
    monkeypatch.setitem(unloaded._MODULES, "cubed", "cubed")
    assert unloaded.Unloaded("cubed").type == ()
    assert unloaded.Unloaded("cubed").available is (importlib.util.find_spec("cubed") is not None)
    assert not hasattr(unloaded.Unloaded("cubed"), "_unknown")


def test_values_without_units_are_values() -> None:
    np.testing.assert_array_equal(xr.DataArray(np.arange(3.0), dims="t").to_numpy(), [0.0, 1.0, 2.0])
