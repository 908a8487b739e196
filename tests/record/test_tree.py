"""A run as one tree of datasets."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.datasets import provenance
from errormotion.errors import RunError
from errormotion.record import open_run


def errors() -> xr.Dataset:
    return datasets.build_errors(
        np.full(6, 1e-6), np.eye(6) * 1e-14, dims=(), coords={}, component="X", machine="M", frame="machine",
        functional_point=(0, 0, 0), reference="cold", method="own", method_version="1",
        provenance=provenance.make({}, None, None),
    )  # fmt: skip


def test_a_run_is_a_tree_of_its_datasets(tmp_path: Path) -> None:
    run = tmp_path / "run-1"
    (run / "errors" / "own-1").mkdir(parents=True)
    stated = {
        "schema": "errormotion.run/1",
        "id": "1",
        "test": "drift",
        "status": "finished",
        "bench": {"machine": "M"},
    }
    (run / "run.json").write_text(json.dumps(stated))
    tree = open_run(run)
    assert (tree.name, tree.attrs["machine"], tree.attrs["status"], list(tree)) == ("run-1", "M", "finished", [])
    assert json.loads(tree.attrs["run"]) == stated

    datasets.save(errors(), run / "errors" / "own-1" / "errors.nc")
    datasets.save(xr.Dataset({"distance": ("time", [1.0])}), run / "raw.zarr")
    (run / "run.json").write_text(json.dumps({**stated, "errors": "errors/own-1/errors.nc"}))
    tree = open_run(run)
    assert list(tree) == ["raw", "errors"]
    xr.testing.assert_identical(tree["errors"].to_dataset(), errors())
    assert tree["errors"].to_dataset().em.names[0] == "EX"
    with xr.open_datatree(run, engine="errormotion") as opened:
        assert (opened.name, opened.attrs["machine"], list(opened)) == ("run-1", "M", ["raw", "errors"])
        xr.testing.assert_identical(opened["errors"].to_dataset(), errors())
    with xr.open_groups(run, engine="errormotion")["/raw"] as raw:
        assert raw["distance"].values.tolist() == [1.0]
    with pytest.raises(RunError, match=r"run\.json"):
        open_run(tmp_path)
    with pytest.raises(RunError, match=r"run\.json"):
        xr.open_datatree(tmp_path, engine="errormotion")
