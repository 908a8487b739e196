"""Stored datasets of released schemas: every later version loads them unchanged, and they are valid.

They are results with few instants, without the larger further results. Files are not replaced; a version with a new
schema adds files.
"""

from pathlib import Path

import numpy as np
import pytest

from errormotion import datasets

FOLDER = Path(__file__).parents[1] / "data" / "datasets"
FILES = sorted(FOLDER.glob("*.nc"))
LARGEST = 60_000
"""Bytes of a file."""


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_stored_dataset_loads_and_is_valid(file: Path) -> None:
    assert file.stat().st_size < LARGEST
    ds = datasets.load(file)
    datasets.validate(ds)
    if file.stem != "comparison":
        values, u = ds.em.estimates().values, ds.em.expanded(2).values
        assert np.isfinite(values).any()
        assert np.array_equal(np.isfinite(values), np.isfinite(u))


def test_every_kind_of_dataset_is_stored() -> None:
    methods = {str(datasets.load(file).attrs.get("method", "")) for file in FILES}
    assert methods >= {"spindle_drift", "normal_vector", "beam_direction", "multilateration", "crossbeam_scan", ""}


def test_the_data_for_a_comparison_are_stored() -> None:
    drift = datasets.load(FOLDER / "spindle_drift_drift.nc")
    named = dict(zip(drift["source"].values.tolist(), drift["source_id"].values.tolist(), strict=True))
    assert named["beam X1.1"].startswith("sha256:")
    assert named["reference X1"] == ""
    reference = drift["source"].values[drift["source_reference"].values == 1]
    assert all(str(name).startswith("reference ") for name in reference)
    assert len(reference) == 5
    probing = datasets.load(FOLDER / "normal_vector.nc")
    assert probing.attrs["start"] == "2026-03-02T07:00:00+00:00"
    assert (probing["source_reference"].values == 1).all()
    found = datasets.load(FOLDER / "comparison.nc")
    assert found["cause"].values[0, 0] == "functional point of 'wrong-point'"
