"""The models that the dashboard offers: other files of the folder are not read."""

import shutil
from pathlib import Path

import pytest
from compensated_machine import model

from errormotion import datasets
from errormotion.dashboard.compensations import Compensations

DATA = Path(__file__).parents[1] / "data" / "datasets"


def test_only_models_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for file in sorted(DATA.glob("*.nc")):
        shutil.copy(file, tmp_path)
    model(tmp_path / "model.nc")
    (tmp_path / "cut.nc").write_bytes((tmp_path / "model.nc").read_bytes()[:3000])
    (tmp_path / "text.nc").write_text("no dataset")
    load, read = datasets.load, []

    def noted(path: Path):
        read.append(path.name)
        return load(path)

    monkeypatch.setattr(datasets, "load", noted)
    assert [each.name for each in Compensations(tmp_path / "runs", tmp_path).models()] == ["model.nc"]
    assert read == ["model.nc"]
