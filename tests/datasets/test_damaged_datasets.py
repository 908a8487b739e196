"""Damaged datasets and calibrations, truncated or with other contents, are read or refused with an error.

Other changes of the bytes of a NetCDF file are not tested: the HDF5 library does not limit its time for them.
"""

import contextlib
from pathlib import Path

import h5py
import mutants
import numpy as np
import pytest
import xarray as xr

from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.datasets.calibrations.pretravel import PretravelMap
from errormotion.datasets.storage import disk as storage
from errormotion.datasets.validation import validate
from errormotion.errors import ErrormotionError

ROOT = Path(__file__).parents[2]
CALIBRATION = ROOT / "examples" / "virtual_beam" / "calibrations" / "lk-h050.nc"


@pytest.mark.parametrize("reader", [InclinationCalibration, PretravelMap])
def test_damaged_calibrations(tmp_path: Path, reader: type) -> None:
    path = tmp_path / "calibration.nc"
    data = CALIBRATION.read_bytes()

    def read(each: bytes) -> None:
        path.write_bytes(each)
        if each != data or reader is InclinationCalibration:
            reader.load(path)

    mutants.check(read, data, seed=1, number=mutants.count(30), changes=(mutants.cut,))


def test_damaged_raw_datasets(tmp_path: Path) -> None:
    path = tmp_path / "raw.nc"
    raw = xr.Dataset(
        {
            "displacement": (("station", "target"), np.ones((2, 3)), {"units": "m"}),
            "target_nominal": (("target", "direction"), np.ones((3, 3)), {"units": "m"}),
            "displacement_noise": ((), 1e-6, {"units": "m"}),
        },
        {"station": ["S1", "S2"], "target": [1, 2, 3], "direction": list("xyz")},
        {"schema": "errormotion.raw.multilateration/1"},
    )
    storage.save(raw, path)
    data = path.read_bytes()

    def read(each: bytes) -> None:
        path.write_bytes(each)
        with storage.load(path) as found, storage.reading(path):
            validate(found)

    mutants.check(read, data, seed=2, number=mutants.count(60), changes=(mutants.cut,))


NUMBERS = (np.nan, np.inf, -1e308, 1e-320, 0.0, -1.0, 1e30)


@pytest.mark.slow
def test_calibrations_with_other_numbers(tmp_path: Path) -> None:
    path = tmp_path / "calibration.nc"
    path.write_bytes(CALIBRATION.read_bytes())
    rng = np.random.default_rng(3)
    with h5py.File(path) as file:
        good = {name: each[()] for name, each in file.items() if each.dtype.kind == "f"}
    assert good
    for trial in range(mutants.count(2 * len(good))):
        name, values = list(good.items())[trial % len(good)]
        changed = np.copy(values)
        with np.errstate(over="ignore"):  # infinite, where a variable has 32 bits
            changed.flat[rng.integers(values.size)] = rng.choice(NUMBERS)
        _write(path, name, changed)
        with contextlib.suppress(ErrormotionError):
            InclinationCalibration.load(path)
        _write(path, name, values)


def _write(path: Path, name: str, values: np.ndarray) -> None:
    with h5py.File(path, "r+") as file:
        file[name][...] = values
