"""Damaged datasets and calibrations: every mutant is read, or refused with an error of the project, in bounded time."""

from pathlib import Path

import mutants
import numpy as np
import pytest
import xarray as xr

from errormotion.datasets import storage
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.datasets.calibrations.pretravel import PretravelMap
from errormotion.datasets.validation import validate

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

    mutants.check(read, data, seed=1, number=mutants.count(120))


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

    mutants.check(read, data, seed=2, number=mutants.count(120))
